"""Comparison of the worlds of one or several runs, with its tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.core.store import write_texts
from benchnav.core.tables import Table, to_latex, to_markdown, to_terminal
from benchnav.eval.compare import merge_runs, read_conditions, select_conditions
from benchnav.eval.experiment.metrics import further_quantities, quantities
from benchnav.eval.folder.results import Results, read_results
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.report.between_tables import between_findings, between_tables
from benchnav.eval.stats.between import BetweenWorlds, compare_worlds
from benchnav.eval.stats.pairs import check_maps, check_one_value_each
from benchnav.eval.stats.world_blocks import find_blocks

_CAPTION = "Success of the same settings in several worlds."


@dataclass(frozen=True, eq=False)
class Between:
    """The same settings in several worlds: rates, agreement, robust set.

    Args:
        settings: one row per setting and world: success rate with its interval, whether
            the setting is in the best set of the world and in the robust set, and its
            worst regret.
        agreement: one row per pair of worlds: correlations, rank violation, Cohen's κ
            of episodes, and signs of significant differences.
        hypotheses: one row per registered hypothesis and world; empty without
            hypotheses.
        tables: formatted tables, with notes.
        findings: sentences on the robust set.
    """

    settings: pd.DataFrame
    agreement: pd.DataFrame
    hypotheses: pd.DataFrame
    tables: tuple[Table, ...]
    findings: tuple[str, ...]

    def save(self, stem: str | Path) -> list[Path]:
        """Write STEM.md, STEM.tex and a CSV file per table; return their paths."""
        path = Path(stem)
        markdown = [f"{table.title}\n\n{to_markdown(table)}" for table in self.tables]
        latex = [
            to_latex([table], _CAPTION, f"{path.name}-{number}")
            for number, table in enumerate(self.tables, start=1)
        ]
        lines = [f"- {sentence}" for sentence in self.findings]
        texts = {".md": "\n".join([*lines, "", *markdown]), ".tex": "\n".join(latex)}
        numbers = {
            ".csv": self.settings,
            "-agreement.csv": self.agreement,
            "-hypotheses.csv": self.hypotheses,
        }
        for suffix, table in numbers.items():
            if not table.empty:
                texts[suffix] = table.to_csv(index=False, float_format="%.6g")
        return write_texts(path, texts)

    def __repr__(self) -> str:
        """Return one line with the numbers of settings and worlds."""
        worlds = self.settings["world"].unique()
        first = self.settings["world"] == worlds[0]
        return (
            f"Between {len(worlds)} worlds, {first.sum()} settings; .settings, "
            ".agreement and .hypotheses are DataFrames, print() shows the tables"
        )

    def __str__(self) -> str:
        """Return the findings and the tables as text."""
        tables = [to_terminal(table) for table in self.tables]
        return "\n".join([*self.findings, *tables])

    def _repr_markdown_(self) -> str:
        return "\n".join(to_markdown(table) for table in self.tables)


def between_results(results: Results, labels: Mapping[str, Sequence[str]]) -> Between:
    """Compare the worlds of a run, finished or not.

    Args:
        results: rows of the run.
        labels: labels that select conditions, by column; a missing column selects all.

    Raises:
        ConfigError: If no setting was run in two worlds, or a label does not exist.
    """
    conditions = results.conditions
    for name, values in labels.items():
        known = {entry["labels"][name]: None for entry in conditions.values()}
        for value in values:
            check_known(f"`{name}`", value, known)
        conditions = {
            condition: entry
            for condition, entry in conditions.items()
            if entry["labels"][name] in values
        }
    manifest = results.run.manifest
    all_quantities = quantities(further_quantities(manifest))
    compared = compare_worlds(
        conditions,
        results.episodes,
        manifest.get("hypotheses"),
        not results.is_partial,
        all_quantities,
    )
    return _formatted(compared, results.episodes, all_quantities)


def between_runs(
    folders: Sequence[Path], labels: Mapping[str, Sequence[str]]
) -> Between:
    """Compare the worlds of finished runs; several runs have no common hypotheses.

    Args:
        folders: finished runs, on the same maps.
        labels: labels that select conditions, by column; a missing column selects all.

    Raises:
        ConfigError: If no setting was run in two worlds, a label does not exist, or
            maps differ between worlds.
    """
    if len(folders) == 1:
        return between_results(read_results(folders[0]), labels)
    runs = [open_run(folder) for folder in folders]
    selected = select_conditions(read_conditions(runs), labels)
    check_one_value_each(selected)
    compared = {str(i): c for i, c in enumerate(merge_runs(selected))}
    conditions: dict[str, dict[str, Any]] = {}
    tables = []
    for condition, member in compared.items():
        conditions[condition] = {"labels": member.labels, "value": member.value}
        tables.append(member.episodes.assign(condition=condition))
    for block in find_blocks(conditions):
        for setting in block.settings:
            first, *others = [compared[i] for i in setting.ids.values()]
            for other in others:
                check_maps(first, other, " and ".join(setting.ids))
    episodes = pd.concat(tables, ignore_index=True)
    return _formatted(compare_worlds(conditions, episodes), episodes, {})


def _formatted(
    compared: BetweenWorlds, episodes: pd.DataFrame, all_quantities: Mapping[str, Any]
) -> Between:
    if compared.settings.empty:
        labels = ", ".join(episodes["world"].unique())
        raise ConfigError(
            "Expected a setting that was run in two or more worlds, got conditions "
            f"with world {labels}. List several under `world` of the suite."
        )
    counts = episodes.groupby("condition")[["group", "map"]].nunique()
    has_groups = (counts["group"] < counts["map"]).any()
    unit = "group" if has_groups else "map"
    return Between(
        settings=compared.settings,
        agreement=compared.agreement,
        hypotheses=compared.hypotheses,
        tables=between_tables(compared, unit, all_quantities),
        findings=tuple(between_findings(compared)),
    )
