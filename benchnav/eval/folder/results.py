"""The rows of a run: of a finished one its sealed table, of one that is not the units
that are finished by now.

Nothing is locked and nothing is written, so that a run can be read while another
process works on it: each unit is one file that is there as a whole or not at all.
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
    """What a run holds.

    Args:
        run: the run; of one that is not finished `about` has the `codes` of the units
            that are.
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
        """What each table and figure of a run that is not finished says; empty for one
        that is.
        """
        return (
            f"partial: {self.finished} of {self.units} units" if self.is_partial else ""
        )

    @property
    def conditions(self) -> dict[str, Any]:
        """What `run.json` knows of the conditions that have rows, by id, in the order
        of the run.
        """
        shown = set(self.episodes["condition"])
        return {
            i: entry for i, entry in self.run.about["conditions"].items() if i in shown
        }

    def notes(self) -> list[str]:
        """What readers of partial results should know, a line each; none where they are
        whole.
        """
        if not self.is_partial:
            return []
        planned = sum(extent.episodes for _, extent in self.run.conditions.values())
        lines = [
            f"{self.mark}, {len(self.episodes)} of {planned} episodes. Conditions may "
            "have different episodes: rates "
            "do not compare them. Intervals and p-values hold for a run that is "
            "whole, not for one that is looked at "
            "as it grows"
        ]
        if self.without:
            more = (
                f" and {len(self.without) - _NAMED} more"
                if len(self.without) > _NAMED
                else ""
            )
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
    """Reads the rows of a run.

    Args:
        folder: a run folder.
        partial: also of a run that is not finished, or of a shard.

    Raises:
        ConfigError: If the folder is no run folder, its run is not finished and
            `partial` is false, or no unit is.
    """
    run = open_run(folder)
    if (folder / EPISODES).exists() or not partial:
        return Results(run=run, episodes=read_table(folder, EPISODES))
    every = newest_units(run)
    known = [(unit, one) for unit, one in every if one is not None]
    there = [one for _, one in known]
    if not there:
        raise ConfigError(
            f"Expected a run with a finished unit, got {folder} with none of "
            f"{len(every)}. Wait for the first, or give "
            "its `benchnav-eval run` command."
        )
    episodes = pd.concat(
        [labelled_rows(unit, one) for unit, one in known], ignore_index=True
    )
    shown = set(episodes["condition"])
    names = condition_names([condition for condition, _ in run.conditions.values()])
    without = [
        name for i, name in zip(run.conditions, names, strict=True) if i not in shown
    ]
    return Results(
        run=replace(run, about={**run.about, "codes": _codes(there), "reused": ""}),
        episodes=episodes,
        finished=len(there),
        units=len(every),
        without=tuple(without),
        is_partial=True,
    )


def newest_units(run: Run) -> list[tuple[Unit, Finished | None]]:
    """The units of a run in the order of its table, each with its newest making; None
    where it is not finished.
    """
    every = in_table_order(units(run.conditions), run.conditions)
    return [(unit, next(iter(find_units(run.folder, unit)), None)) for unit in every]


def code_of(run: Run, digest: str) -> Mapping[str, Any]:
    """The code that made rows, by what the column `code` says.

    Args:
        run: finished or not.
        digest: of the code.
    """
    codes = run.about.get("codes", {})
    if digest not in codes:  # of a unit that no table has yet
        codes = _codes([one for _, one in newest_units(run) if one is not None])
    code: Mapping[str, Any] = codes[digest]
    return code


def _codes(finished: list[Finished]) -> dict[str, Any]:
    return {code_digest(one.about["code"]): one.about["code"] for one in finished}
