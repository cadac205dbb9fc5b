"""Rows of a run: its table if it is finished, else its finished units.

Nothing is locked or written, so that a run can be read while another process works on
it: each unit is one file, written atomically.
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

_NAMED = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """Rows of a run, and how many of its units are finished.

    Args:
        run: the run; if it is not finished, `about` has the `codes` of finished units.
        episodes: a row an episode.
        finished: number of units with rows.
        units: number of units of the run.
        without: names of the conditions without an episode.
        is_partial: whether the run is not finished, even if all its units are.
    """

    run: Run
    episodes: pd.DataFrame
    finished: int = 0
    units: int = 0
    without: tuple[str, ...] = ()
    is_partial: bool = False

    @property
    def mark(self) -> str:
        """Mark of tables and figures of a run that is not finished; else empty."""
        if not self.is_partial:
            return ""
        return f"partial: {self.finished} of {self.units} units"

    @property
    def conditions(self) -> dict[str, Any]:
        """Entries of `run.json` of conditions that have rows, by id, in its order."""
        shown = set(self.episodes["condition"])
        return {
            i: entry for i, entry in self.run.about["conditions"].items() if i in shown
        }

    def notes(self) -> list[str]:
        """Return notes for readers of partial results; empty if the run is finished."""
        if not self.is_partial:
            return []
        planned = sum(extent.episodes for _, extent in self.run.conditions.values())
        lines = [
            f"{self.mark}, {len(self.episodes)} of {planned} episodes. Conditions may "
            "have different episodes: rates "
            "do not compare them. Intervals and p-values hold for a finished run, not "
            "for one that is read repeatedly as it grows"
        ]
        if self.without:
            more = ""
            if len(self.without) > _NAMED:
                more = f" and {len(self.without) - _NAMED} more"
            lines.append(
                f"{self.mark}, no episode yet: {'; '.join(self.without[:_NAMED])}{more}"
            )
        if len(self.run.about["codes"]) > 1:
            count = len(self.run.about["codes"])
            lines.append(
                f"{self.mark}, made by {count} versions of the code; column `code` "
                "indicates which rows"
            )
        return lines


def read_results(folder: Path, partial: bool = False) -> Results:
    """Read the rows of a run.

    Args:
        folder: a run folder.
        partial: whether to accept a run that is not finished, or a shard.

    Raises:
        ConfigError: If the folder is no run folder, its run is not finished and
            `partial` is false, or no unit is.
    """
    run = open_run(folder)
    if (folder / EPISODES).exists() or not partial:
        return Results(run=run, episodes=read_table(folder, EPISODES))
    all_units = newest_units(run)
    finished_units = [
        (unit, making) for unit, making in all_units if making is not None
    ]
    finished = [making for _, making in finished_units]
    if not finished:
        raise ConfigError(
            f"Expected a run with a finished unit, got {folder} with none of "
            f"{len(all_units)}. Wait for the first, or give "
            "its `benchnav-eval run` command."
        )
    episodes = pd.concat(
        [labelled_rows(unit, making) for unit, making in finished_units],
        ignore_index=True,
    )
    shown = set(episodes["condition"])
    names = condition_names([condition for condition, _ in run.conditions.values()])
    without = [
        name for i, name in zip(run.conditions, names, strict=True) if i not in shown
    ]
    return Results(
        run=replace(run, about={**run.about, "codes": _codes(finished), "reused": ""}),
        episodes=episodes,
        finished=len(finished),
        units=len(all_units),
        without=tuple(without),
        is_partial=True,
    )


def newest_units(run: Run) -> list[tuple[Unit, Finished | None]]:
    """Return the units of a run in the order of its table, with their newest making."""
    all_units = in_table_order(units(run.conditions), run.conditions)
    return [
        (unit, next(iter(find_units(run.folder, unit)), None)) for unit in all_units
    ]


def code_of(run: Run, digest: str) -> Mapping[str, Any]:
    """Return the code of rows by its digest in the column `code`.

    Args:
        run: a run, finished or not.
        digest: digest of the code.
    """
    codes = run.about.get("codes", {})
    if digest not in codes:  # of a unit that no table has yet
        codes = _codes(
            [making for _, making in newest_units(run) if making is not None]
        )
    code: Mapping[str, Any] = codes[digest]
    return code


def _codes(finished: list[Finished]) -> dict[str, Any]:
    return {
        code_digest(making.about["code"]): making.about["code"] for making in finished
    }
