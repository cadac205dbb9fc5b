"""Table I of the paper compared with a run.

Intervals of the paper's values are Wilson's for success in 20 episodes, and Student's
for a mean of 20, from its standard deviation. p is of Fisher's exact test for success
and of Welch's test for T_total. Holm's correction is over the scenarios, separately for
the two.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import fisher_exact, t, ttest_ind_from_stats

from benchnav.core.tables import Table
from benchnav.stats.holm import holm
from benchnav.stats.intervals import wilson_interval
from studies.tables import success, table

# Success, mean and standard deviation of T_total of MPPI under CVaR at 0.9: Endo, Honda
# and Ishigami (2024), Table I.
PAPER_EPISODES = 20
PAPER = {"std": (0.90, 52.7, 22.5), "hg": (0.80, 60.2, 26.1), "hs": (0.85, 58.6, 25.7)}


def paper(run: Path) -> Table:
    """Return the paper's rows next to those of MPPI under `cvar`."""
    summary = pd.read_csv(run / "summary.csv")
    ours = summary[(summary["planner"] == "mppi") & (summary["risk"] == "cvar")]
    rows = [row for row in ours.to_dict("records") if row["scenario"] in PAPER]
    p = (holm(np.array(values)) for values in zip(*map(_p_values, rows), strict=True))
    headings = (
        "scenario",
        "Succ. [%], paper",
        "ours",
        "p",
        "T_total [s], paper",
        "ours",
        "p",
    )
    cells = []
    for row, of_success, of_time in zip(rows, *p, strict=True):
        rates, times = _cells(row)
        cells.append(
            (row["scenario"], *rates, f"{of_success:.2g}", *times, f"{of_time:.2g}")
        )
    return table(headings, cells)


def _cells(row: Mapping[Any, Any]) -> tuple[tuple[str, str], tuple[str, str]]:
    """Return the cells of success and of T_total in a scenario: the paper's and ours."""
    rate, mean, std = PAPER[row["scenario"]]
    low, high = wilson_interval(rate, PAPER_EPISODES)
    half = t.ppf(0.975, PAPER_EPISODES - 1) * std / PAPER_EPISODES**0.5
    theirs = f"{100 * rate:.0f} ({100 * low:.0f}–{100 * high:.0f})"
    ours = (
        f"{row['total_time_mean_s']:.1f} "
        f"({row['total_time_low_s']:.1f}–{row['total_time_high_s']:.1f})"
    )
    return (theirs, success(row)), (
        f"{mean:.1f} ({mean - half:.1f}–{mean + half:.1f})",
        ours,
    )


def _p_values(row: Mapping[Any, Any]) -> tuple[float, float]:
    """Return the uncorrected p-values of success and of T_total."""
    rate, mean, std = PAPER[row["scenario"]]
    count = row["n_episodes"]
    theirs, ours = round(rate * PAPER_EPISODES), round(row["success_rate"] * count)
    of_success = fisher_exact(
        [[theirs, PAPER_EPISODES - theirs], [ours, count - ours]]
    ).pvalue
    ours_s = (row["total_time_mean_s"], row["total_time_std_s"], count)
    of_time = ttest_ind_from_stats(
        mean, std, PAPER_EPISODES, *ours_s, equal_var=False
    ).pvalue
    return float(of_success), float(of_time)
