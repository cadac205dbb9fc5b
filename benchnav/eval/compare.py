"""Compares trials of one run or several: reads them, pairs them, and writes the table."""

import shutil
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from benchnav import registry
from benchnav.errors import ConfigError
from benchnav.eval.folder.folder import EPISODES, Run, open_run, read_table
from benchnav.eval.report.comparison import comparison_table
from benchnav.eval.report.rendering import to_latex, to_markdown, to_terminal
from benchnav.eval.report.tables import ResultTable
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairing import Compared, Pair, find_pairs
from benchnav.eval.stats.summary import LABELS, time_budgets
from benchnav.eval.trial import NOT_USED
from benchnav.files import write_text

_CAPTION = "Differences of success and of time between trials that met the same maps under the same luck."


def compare_runs(
    folders: Sequence[Path], by: str, against: str, asked: Mapping[str, str], difference: float
) -> tuple[pd.DataFrame, ResultTable]:
    """Compares the trials of runs pair by pair.

    Args:
        folders: finished runs, of format version 2 or later.
        by: label in which trials differ; see `pairing.find_pairs`.
        against: what all others are compared with; all pairs when empty.
        asked: labels of the trials that are looked at, several with a comma between; all when not named.
        difference: of success, for which the maps needed are counted.

    Returns:
        The numbers, and the table that is shown.

    Raises:
        ConfigError: there is nothing to compare, or it cannot be paired.
    """
    if not folders:
        raise ConfigError("Expected one or more run folders, got none.")
    if not 0 < difference <= 1:
        raise ConfigError(f"Expected `points` in (0, 100], got {100 * difference:g}.")
    runs = [open_run(folder) for folder in folders]
    pairs = find_pairs(_chosen(read_trials(runs), asked), by, against)
    table = compare(pairs, difference)
    shown = comparison_table(table, difference)
    notes = (*_about(pairs, table), *shown.notes, *_sources(runs))
    return table, ResultTable(headings=shown.headings, labels=shown.labels, rows=shown.rows, notes=notes)


def write_comparison(stem: Path, table: pd.DataFrame, shown: ResultTable) -> list[Path]:
    """Writes a comparison as CSV, with all its numbers, Markdown and LaTeX.

    Args:
        stem: path without a suffix.
        table: the numbers.
        shown: the table.

    Returns:
        What was written.
    """
    texts = {
        ".csv": table.to_csv(index=False, float_format="%.6g"),
        ".md": to_markdown(shown),
        ".tex": to_latex(shown, _CAPTION, stem.name),
    }
    paths = [stem.with_name(stem.name + suffix) for suffix in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
    return paths


def print_comparison(shown: ResultTable) -> None:
    """Prints the table as wide as the terminal, or unbroken where none is."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    print(to_terminal(shown, width).rstrip())


def read_trials(runs: Sequence[Run]) -> list[Compared]:
    """Reads the trials of runs, each with its episodes.

    Raises:
        ConfigError: a run is not finished, or of format version 1, or there twice.
    """
    for run in runs:
        if run.version == 1:
            raise ConfigError(
                f"Expected runs of format version 2, got {run.folder} of version 1, which does not say on what maps it "
                "was. Run its suite again."
            )
    names = _names([run.folder for run in runs])
    shared = Counter(trial for run in runs for trial in run.trials)
    found = []
    for run, name in zip(runs, names, strict=True):
        episodes = dict(list(read_table(run.folder, EPISODES).groupby("trial", sort=False)))
        for trial, about in run.about["trials"].items():
            labels, value, rows = about["labels"], about["value"], episodes[trial]
            found.append(
                Compared(
                    labels={**labels, "run": name if shared[trial] > 1 else NOT_USED},
                    world=value["world"],
                    maps=run.about["datasets"][labels["data"]]["maps"][value["split"]],
                    episodes=rows.assign(time_budget_s=time_budgets(rows, value["world"])),
                )
            )
    return found


def _names(folders: Sequence[Path]) -> list[str]:
    """Short names of runs, with as much of the path as tells them apart."""
    paths = [folder.resolve() for folder in folders]
    if len(set(paths)) < len(paths):
        raise ConfigError(f"Expected runs that differ, got {', '.join(map(str, folders))}.")
    parts = next(n for n in range(1, 100) if len({path.parts[-n:] for path in paths}) == len(paths))
    return ["/".join(path.parts[-parts:]) for path in paths]


def _chosen(trials: Iterable[Compared], asked: Mapping[str, str]) -> list[Compared]:
    chosen = list(trials)
    for name, values in asked.items():
        known = list(dict.fromkeys(trial.labels[name] for trial in chosen))
        for value in values.split(","):
            if value not in known:
                raise ConfigError(
                    f"Expected `{name}` among {', '.join(known)}, got {value!r}.{registry.hint(value, known)}"
                )
        chosen = [trial for trial in chosen if trial.labels[name] in values.split(",")]
    return chosen


def _about(pairs: Sequence[Pair], table: pd.DataFrame) -> list[str]:
    same = [
        f"{name} {table[name].iloc[0]}"
        for name in LABELS
        if name in table and table[name].nunique() == 1 and table[name].iloc[0] != NOT_USED
    ]
    lines = [f"Of {', '.join(same)}."]
    if table["n_maps"].nunique() == table["n_draws"].nunique() == 1:
        draws = table["n_draws"].iloc[0]
        episodes = "1 episode" if draws == 1 else f"{draws} episodes"
        lines.append(
            f"Each pair: {table['n_maps'].iloc[0]} maps, {episodes} on each, both trials under the same luck."
        )
    left = sum(pair.left_out for pair in pairs)
    if left:
        lines.append(f"{left} episodes were left out, on maps or under luck that only one of two trials met.")
    return lines


def _sources(runs: Sequence[Run]) -> list[str]:
    versions = dict.fromkeys(run.about["code"]["sources"] for run in runs)
    if len(versions) == 1:
        return []
    return ["The runs were made by different sources of benchnav, which may be what differs."]
