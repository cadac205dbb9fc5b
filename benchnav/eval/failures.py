"""How, when and where each failed episode ended; and which failures the sheets show.

The sheets are of each block: failures of the best setting and of the worst.
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

# Gives a recording of each of some failures of one condition, rows of `failures_table`.
RecordDriven = Callable[[pd.DataFrame], Sequence[Recording]]

ACROSS = 4  # failures of a condition that are shown
_MOST_BLOCKS = 6
# Failures of one condition whose ground is predicted again.
_MOST_FAILURES = 100

_KEYS = ["condition", "seed", "realisation", "map"]
_ENDS = ("x_m", "y_m", "end_traversability", "last_traversability")
_LAST_S = 2.0


def failures_table(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Tabulates the failed episodes of a run.

    Args:
        folder: the run folder, of which the steps are read.
        episodes: its rows.

    Returns:
        A row a failure: `condition`, `planner`, `risk`, `model`, `scenario`, `world`,
        `seed`, `realisation`, `map`, `outcome`, `end_time_s`, `code`; `x_m`, `y_m`,
        where it ended; `end_traversability`, the observed λ in the last step; and
        `last_traversability`, the mean of observed λ in the last 2 s. The last four are
        NaN where steps were not kept.
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
    ]
    failed = episodes.loc[
        ~episodes["success"].astype(bool), [*columns, "end_time_s", "code"]
    ].reset_index(drop=True)
    read = [*_KEYS, "time_s", "x_m", "y_m", "traversability"]
    steps = [rows[read] for rows in step_files(folder, set(failed["condition"]))]
    if not steps:
        return failed.assign(**dict.fromkeys(_ENDS, np.nan))
    return failed.merge(
        _ends(pd.concat(steps, ignore_index=True)), on=_KEYS, how="left"
    )


def _ends(steps: pd.DataFrame) -> pd.DataFrame:
    """The last place of each episode, and λ at its end; the last state of an episode
    has no λ of its own.
    """
    groups = steps.groupby(_KEYS, sort=False)
    last = groups[["x_m", "y_m"]].last()
    met = steps[steps["traversability"].notna()]
    end = (
        met.groupby(_KEYS, sort=False)["traversability"]
        .last()
        .rename("end_traversability")
    )
    from_s = groups["time_s"].transform("max") - _LAST_S
    late = met[met["time_s"] >= from_s.loc[met.index] - 1e-9]
    mean = (
        late.groupby(_KEYS, sort=False)["traversability"]
        .mean()
        .rename("last_traversability")
    )
    return (
        last.join([end, mean])
        .reset_index()
        .astype(
            {"x_m": np.float64, "y_m": np.float64, "end_traversability": np.float64}
        )
    )


@dataclass(frozen=True, kw_only=True)
class FailedLine:
    """A line of a sheet: failures of one condition.

    Args:
        name: of the condition.
        failures: rows of `failures_table`, at most `ACROSS`.
        recordings: of each, with what was predicted and driven.
        among: number of failures that these were chosen of.
    """

    name: str
    failures: pd.DataFrame
    recordings: Sequence[Recording]
    among: int


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """What is shown of failures.

    Args:
        shown: of each block its title and the lines of its sheet.
        predicted: by condition λ̂ where its failed episodes ended, shape [N].
        left_out: why sheets are missing; empty where none is, or nothing failed.
    """

    shown: tuple[tuple[str, tuple[FailedLine, ...]], ...]
    predicted: dict[str, np.ndarray]
    left_out: str


def collect_sheets(
    summary: pd.DataFrame, failures: pd.DataFrame, record_driven: RecordDriven | None
) -> Sheets:
    """Collects the sheets of a run.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        failures: from `failures_table`.
        record_driven: it may raise a `BenchnavError`. None where no sheet is asked for.
    """
    placed = failures[failures["x_m"].notna()]
    if record_driven is None or placed.empty:
        asked = record_driven is not None and not failures.empty
        why = (
            "there is no figure of failures, since the run kept no steps"
            if asked
            else ""
        )
        return Sheets(shown=(), predicted={}, left_out=why)
    shown, predicted, left_out = [], {}, []
    if len(every := blocks(with_names(summary))) > _MOST_BLOCKS:
        left_out.append(
            f"figures of failures show the first {_MOST_BLOCKS} of {len(every)} blocks"
        )
    for title, rows in every[:_MOST_BLOCKS]:
        lines = []
        try:
            for row in _looked_at(rows):
                condition = row["condition"]
                own = (
                    placed[placed["condition"] == condition]
                    .head(_MOST_FAILURES)
                    .reset_index(drop=True)
                )
                if own.empty:
                    continue
                recordings, chosen = record_driven(own), choose_failures(own)
                predicted[condition] = np.array(
                    [recording.predicted_at_end for recording in recordings]
                )
                lines.append(
                    FailedLine(
                        name=row["name"],
                        failures=chosen.reset_index(drop=True),
                        recordings=[recordings[place] for place in chosen.index],
                        among=int((failures["condition"] == condition).sum()),
                    )
                )
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


def _looked_at(rows: pd.DataFrame) -> list[dict[Any, Any]]:
    """The best of a block and the worst, of those that look at a prediction."""
    seeing = rows[competing(rows) & (rows["model"] != NOT_USED)]
    worst = seeing.sort_values("success_rate", kind="stable").head(1)
    both = pd.concat([seeing[seeing["condition"] == seeing["best"]], worst])
    return both.drop_duplicates("condition").to_dict("records")


def choose_failures(failures: pd.DataFrame) -> pd.DataFrame:
    """Chooses failures to be shown: each outcome once before any twice, the most
    frequent outcome first.
    """
    placed = failures[failures["x_m"].notna()]
    turn = placed.groupby("outcome", sort=False).cumcount()
    often = -placed.groupby("outcome")["outcome"].transform("size")
    return (
        placed.assign(turn=turn, often=often)
        .sort_values(["turn", "often"], kind="stable")
        .head(ACROSS)
    )
