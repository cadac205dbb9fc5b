"""The table of failures: how, when and where each failed episode ended, and what ground it met there."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds

from benchnav.eval.folder.steps import open_steps, rows_of

_KEYS = ["condition", "seed", "realisation", "map"]
_ENDS = ("x_m", "y_m", "end_traversability", "last_traversability")
_LAST_S = 2.0


def failures_table(folder: Path, episodes: pd.DataFrame) -> pd.DataFrame:
    """Tabulates the failed episodes of a run.

    Args:
        folder: the run folder, of which the steps are read.
        episodes: its rows.

    Returns:
        A row a failure: `condition`, `planner`, `risk`, `model`, `scenario`, `world`, `seed`, `realisation`,
        `map`, `outcome`, `end_time_s`, `code`; `x_m`, `y_m`, where it ended; `end_traversability`, the observed λ
        in the last step; and `last_traversability`, the mean of observed λ in the last 2 s. The last four are NaN where
        steps were not kept.
    """
    labels = ["planner", "risk", "model", "scenario", "world"]
    columns = ["condition", *labels, *_KEYS[1:], "outcome", "end_time_s", "code"]
    failed = episodes.loc[~episodes["success"].astype(bool), columns].reset_index(drop=True)
    source = open_steps(folder)
    if source is None:
        return failed.assign(**dict.fromkeys(_ENDS, np.nan))
    chosen = ds.field("condition").isin(pa.array(failed["condition"].unique(), pa.string()))
    steps = rows_of(folder, source, [*_KEYS, "time_s", "x_m", "y_m", "traversability"], chosen)
    return failed.merge(_ends(steps), on=_KEYS, how="left")


def _ends(steps: pd.DataFrame) -> pd.DataFrame:
    """The last place of each episode, and λ at its end; the last state of an episode has no λ of its own."""
    groups = steps.groupby(_KEYS, sort=False)
    last = groups[["x_m", "y_m"]].last()
    met = steps[steps["traversability"].notna()]
    end = met.groupby(_KEYS, sort=False)["traversability"].last().rename("end_traversability")
    from_s = groups["time_s"].transform("max") - _LAST_S
    late = met[met["time_s"] >= from_s.loc[met.index] - 1e-9]
    mean = late.groupby(_KEYS, sort=False)["traversability"].mean().rename("last_traversability")
    return (
        last.join([end, mean])
        .reset_index()
        .astype({"x_m": np.float64, "y_m": np.float64, "end_traversability": np.float64})
    )
