"""Rows of a run: from its table if the run is finished, else from its finished units.

A run can be read while another process works on it. Reading locks and writes nothing,
and each unit is one file, which is written atomically.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import condition_names
from benchnav.eval.experiment.unit import Unit, in_table_order, units
from benchnav.eval.folder.provenance import code_digest
from benchnav.eval.folder.run_folder import (
    EPISODES,
    Finished,
    Run,
    find_units,
    labelled_rows,
    open_run,
    read_table,
)

_MAX_NAMED = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """Rows of a run, and the number of its finished units.

    Args:
        run: the run; if it is not finished, `codes` in its manifest are those of the
            finished units.
        episodes: one row per episode.
        finished: number of finished units of an unfinished run; 0 if it is finished.
        units: number of all units of an unfinished run; 0 if it is finished.
        without: names of the conditions without an episode.
        is_partial: whether the run has no table yet, even if all units are finished.
    """

    run: Run
    episodes: pd.DataFrame
    finished: int = 0
    units: int = 0
    without: tuple[str, ...] = ()
    is_partial: bool = False

    @property
    def mark(self) -> str:
        """Mark for tables and figures of an unfinished run; empty for a finished run."""
        if not self.is_partial:
            return ""
        return f"partial: {self.finished} of {self.units} units"

    @property
    def conditions(self) -> dict[str, Any]:
        """Entries in `run.json` of the conditions that have rows, by id."""
        with_rows = set(self.episodes["condition"])
        entries = self.run.manifest["conditions"]
        return {i: entry for i, entry in entries.items() if i in with_rows}

    def notes(self) -> list[str]:
        """Return notes for readers of partial results; empty if the run is finished."""
        if not self.is_partial:
            return []
        planned = sum(extent.episodes for _, extent in self.run.conditions.values())
        lines = [
            f"{self.mark}, {len(self.episodes)} of {planned} episodes. Conditions may "
            "have different episodes, so that their rates cannot be compared. Intervals "
            "and p-values are valid for a finished run, not for a run that is read "
            "repeatedly as it grows"
        ]
        if self.without:
            named = "; ".join(self.without[:_MAX_NAMED])
            if len(self.without) > _MAX_NAMED:
                named += f" and {len(self.without) - _MAX_NAMED} more"
            lines.append(f"{self.mark}, no episode yet: {named}")
        n_codes = len(self.run.manifest["codes"])
        if n_codes > 1:
            lines.append(
                f"{self.mark}, run with {n_codes} versions of the code; the column "
                "`code` identifies the version of each row"
            )
        return lines


def read_results(folder: Path, partial: bool = False) -> Results:
    """Read the rows of a run.

    Args:
        folder: a run folder.
        partial: whether to accept a run that is not finished, or a shard.

    Raises:
        ConfigError: If the folder is no run folder, if its run is not finished and
            `partial` is false, or if no unit is finished.
    """
    run = open_run(folder)
    if (folder / EPISODES).exists() or not partial:
        return Results(run=run, episodes=read_table(folder, EPISODES))
    all_units = newest_units(run)
    finished = []
    tables = []
    for unit, finished_unit in all_units:
        if finished_unit is not None:
            finished.append(finished_unit)
            tables.append(labelled_rows(unit, finished_unit))
    if not finished:
        raise ConfigError(
            f"Expected a run with a finished unit, got {folder}, where 0 of "
            f"{len(all_units)} units are finished. Wait for the first unit, or repeat "
            "the `benchnav-eval run` command of this folder."
        )
    episodes = pd.concat(tables, ignore_index=True)
    with_rows = set(episodes["condition"])
    names = condition_names([condition for condition, _ in run.conditions.values()])
    without = []
    for condition_id, name in zip(run.conditions, names, strict=True):
        if condition_id not in with_rows:
            without.append(name)
    manifest = {**run.manifest, "codes": _codes(finished), "reused": ""}
    return Results(
        run=replace(run, manifest=manifest),
        episodes=episodes,
        finished=len(finished),
        units=len(all_units),
        without=tuple(without),
        is_partial=True,
    )


def newest_units(run: Run) -> list[tuple[Unit, Finished | None]]:
    """Return the units of a run in the order of its table, each with its newest file.

    An unfinished unit has None instead of a file.
    """
    newest = []
    for unit in in_table_order(units(run.conditions), run.conditions):
        finished_units = find_units(run.folder, unit)
        newest.append((unit, finished_units[0] if finished_units else None))
    return newest


def code_of(run: Run, digest: str) -> Mapping[str, Any]:
    """Return the code of rows by its digest in the column `code`.

    Args:
        run: a run, finished or not.
        digest: digest of the code.
    """
    codes = run.manifest.get("codes", {})
    if digest not in codes:  # if the unit is not yet in the table
        finished_units = [
            finished_unit
            for _, finished_unit in newest_units(run)
            if finished_unit is not None
        ]
        codes = _codes(finished_units)
    code: Mapping[str, Any] = codes[digest]
    return code


def _codes(finished: list[Finished]) -> dict[str, Any]:
    """Return the codes of finished units by digest."""
    codes = [finished_unit.metadata["code"] for finished_unit in finished]
    return {code_digest(code): code for code in codes}
