"""Failed episodes: table of outcomes, times and positions, and sheets of examples.

A sheet shows failures of the best and of the worst condition of a block.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.errors import BenchnavError
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.folder.steps import step_files
from benchnav.eval.recording import Recording
from benchnav.eval.stats.best import competing
from benchnav.eval.words import blocks, with_names

# Function from rows of `failures_table` of one condition to recordings of the episodes.
RecordDriven = Callable[[pd.DataFrame], Sequence[Recording]]

ACROSS = 4  # maximum number of failures that a sheet shows for a condition
_MAX_BLOCKS = 6
# Maximum number of failures of a condition whose maps are predicted again.
_MAX_FAILURES = 100

_KEYS = ["condition", "seed", "realisation", "map"]
_ENDS = ("x_m", "y_m", "end_traversability", "last_traversability")
_LAST_S = 2.0  # time before the end, for `last_traversability`


def failures_table(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the failed episodes of a run.

    Args:
        folder: the run folder, whose steps are read.
        episodes: rows of the run.

    Returns:
        One row per failure: `condition`, `planner`, `risk`, `model`, `scenario`,
        `world`, `seed`, `realisation`, `map`, `outcome`, `end_time_s`, `code`; `x_m`
        and `y_m`, the robot's last position in metres; `end_traversability`, the
        observed λ in the last step; and `last_traversability`, the mean of observed λ
        in the last 2 s. These last four columns are NaN if steps were not stored.
    """
    columns = [
        "condition",
        "planner",
        "risk",
        "model",
        "scenario",
        "world",
        *_KEYS[1:],
        "outcome",
        "end_time_s",
        "code",
    ]
    is_failure = ~episodes["success"].astype(bool)
    failed = episodes.loc[is_failure, columns].reset_index(drop=True)
    step_columns = [*_KEYS, "time_s", "x_m", "y_m", "traversability"]
    files = step_files(folder, set(failed["condition"]))
    steps = [rows[step_columns] for rows in files]
    if not steps:
        return failed.assign(**dict.fromkeys(_ENDS, np.nan))
    ends = _ends(pd.concat(steps, ignore_index=True))
    return failed.merge(ends, on=_KEYS, how="left")


def _ends(steps: pd.DataFrame) -> pd.DataFrame:
    """Return the last position of each episode, and observed λ at its end.

    λ is observed in a step, so that the row of the last state has none.
    """
    groups = steps.groupby(_KEYS, sort=False)
    last = groups[["x_m", "y_m"]].last()
    taken = steps[steps["traversability"].notna()]
    end = _traversability_of(taken).last()
    from_s = groups["time_s"].transform("max") - _LAST_S
    is_late = taken["time_s"] >= from_s.loc[taken.index] - 1e-9
    mean = _traversability_of(taken[is_late]).mean()
    further = [end.rename("end_traversability"), mean.rename("last_traversability")]
    ends = last.join(further).reset_index()
    return ends.astype(
        {"x_m": np.float64, "y_m": np.float64, "end_traversability": np.float64}
    )


def _traversability_of(steps: pd.DataFrame) -> Any:
    """Group observed λ by episode."""
    return steps.groupby(_KEYS, sort=False)["traversability"]


@dataclass(frozen=True, kw_only=True)
class FailedLine:
    """A line of a sheet: failures of one condition.

    Args:
        name: name of the condition.
        failures: rows of `failures_table` that are shown, at most `ACROSS`.
        recordings: recordings of these failures.
        total: number of failures of the condition.
    """

    name: str
    failures: pd.DataFrame
    recordings: Sequence[Recording]
    total: int


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """Sheets of failures, and λ̂ where episodes failed.

    Args:
        shown: title and lines of the sheet of each block.
        predicted: λ̂ at the end of failed episodes, by condition, shape [number of
            recorded failures].
        left_out: reason for missing sheets; empty if no sheet is missing.
    """

    shown: tuple[tuple[str, tuple[FailedLine, ...]], ...]
    predicted: dict[str, np.ndarray]
    left_out: str


def collect_sheets(
    summary: pd.DataFrame, failures: pd.DataFrame, record_driven: RecordDriven | None
) -> Sheets:
    """Collect the sheets of a run.

    Args:
        summary: table from `summary.summarise`, joined with `best.against_best`.
        failures: table from `failures_table`.
        record_driven: function that records failures; it may raise `BenchnavError`. If
            None, there are no sheets.
    """
    located = failures[failures["x_m"].notna()]
    if record_driven is None or located.empty:
        reason = ""
        if record_driven is not None and not failures.empty:
            reason = "there is no figure of failures, since the run stored no steps"
        return Sheets(shown=(), predicted={}, left_out=reason)
    shown = []
    predicted: dict[str, np.ndarray] = {}
    left_out = []
    all_blocks = blocks(with_names(summary))
    if len(all_blocks) > _MAX_BLOCKS:
        left_out.append(
            f"figures of failures show the first {_MAX_BLOCKS} of {len(all_blocks)} "
            "blocks"
        )
    for title, rows in all_blocks[:_MAX_BLOCKS]:
        lines = []
        try:
            for row in _best_and_worst(rows):
                condition = row["condition"]
                condition_failures = located[located["condition"] == condition]
                if condition_failures.empty:
                    continue
                recorded = condition_failures.head(_MAX_FAILURES).reset_index(drop=True)
                recordings = record_driven(recorded)
                at_ends = [recording.predicted_at_end for recording in recordings]
                predicted[condition] = np.array(at_ends)
                chosen = choose_failures(recorded)
                is_of_condition = failures["condition"] == condition
                line = FailedLine(
                    name=row["name"],
                    failures=chosen.reset_index(drop=True),
                    recordings=[recordings[index] for index in chosen.index],
                    total=int(is_of_condition.sum()),
                )
                lines.append(line)
        except (BenchnavError, OSError) as error:
            left_out.append(f"a figure of failures is missing: {error}")
            continue
        if lines:
            shown.append((title, tuple(lines)))
    return Sheets(
        shown=tuple(shown),
        predicted=predicted,
        left_out="; ".join(dict.fromkeys(left_out)),
    )


def _best_and_worst(rows: pd.DataFrame) -> list[dict[Any, Any]]:
    """Return the best and the worst condition of a block, among those with a model."""
    with_model = rows[competing(rows) & (rows["model"] != NOT_USED)]
    best = with_model[with_model["condition"] == with_model["best"]]
    worst = with_model.sort_values("success_rate", kind="stable").head(1)
    chosen = pd.concat([best, worst])
    return chosen.drop_duplicates("condition").to_dict("records")


def choose_failures(failures: pd.DataFrame) -> pd.DataFrame:
    """Return up to `ACROSS` failures with a position, to show many outcomes.

    The outcomes take turns, frequent outcomes first.
    """
    located = failures[failures["x_m"].notna()]
    turn = located.groupby("outcome", sort=False).cumcount()
    rarity = -located.groupby("outcome")["outcome"].transform("size")
    keyed = located.assign(turn=turn, rarity=rarity)
    ordered = keyed.sort_values(["turn", "rarity"], kind="stable")
    return ordered.head(ACROSS)
