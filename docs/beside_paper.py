"""The paper's Table I beside a run's, with the intervals of both, for docs/results.md.

    python docs/beside_paper.py runs/full

Theirs: Wilson's interval of 20 episodes, and Student's of a mean of 20 by its standard deviation. Ours as in the
run's report. p: Fisher's exact test of success, Welch's test of T_total; corrected by Holm over the scenarios,
each of the two apart.
"""

import argparse
from pathlib import Path
from typing import Any

import pandas as pd
from scipy.stats import fisher_exact, t, ttest_ind_from_stats
from statsmodels.stats.multitest import multipletests

from benchnav.eval.stats.summary import wilson_interval

# MPPI under CVaR at 0.9; Endo, Honda and Ishigami (2024), Table I: success, mean and standard deviation of T_total.
EPISODES = 20
PAPER = {"std": (0.90, 52.7, 22.5), "hg": (0.80, 60.2, 26.1), "hs": (0.85, 58.6, 25.7)}


def beside(row: dict[Any, Any]) -> tuple[list[str], float, float]:
    """The cells of a scenario, and p of success and of T_total, before correction."""
    rate, mean, std = PAPER[row["scenario"]]
    low, high = wilson_interval(rate, EPISODES)
    reach = t.ppf(0.975, EPISODES - 1) * std / EPISODES**0.5
    cells = [
        f"{100 * rate:.0f} ({100 * low:.0f}–{100 * high:.0f})",
        f"{100 * row['success_rate']:.1f} ({100 * row['success_low']:.0f}–{100 * row['success_high']:.0f})",
        f"{mean:.1f} ({mean - reach:.1f}–{mean + reach:.1f})",
        f"{row['total_time_mean_s']:.1f} ({row['total_time_low_s']:.1f}–{row['total_time_high_s']:.1f})",
    ]
    theirs, ours, count = (
        round(rate * EPISODES),
        round(row["success_rate"] * row["n_episodes"]),
        row["n_episodes"],
    )
    success = fisher_exact([[theirs, EPISODES - theirs], [ours, count - ours]]).pvalue
    own = (row["total_time_mean_s"], row["total_time_std_s"], count)
    time = ttest_ind_from_stats(mean, std, EPISODES, *own, equal_var=False).pvalue
    return cells, float(success), float(time)


def main() -> None:
    """Prints the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    summary = pd.read_csv(parser.parse_args().run / "summary.csv")
    ours = summary[(summary["planner"] == "mppi") & (summary["risk"] == "cvar")]
    rows = [(row["scenario"], *beside(row)) for row in ours.to_dict("records") if row["scenario"] in PAPER]
    corrected = [multipletests([row[place] for row in rows], method="holm")[1] for place in (2, 3)]
    print("| scenario | Succ. [%], paper | ours | p | T_total [s], paper | ours | p |\n" + "|---" * 7 + "|")
    for (scenario, cells, *_), success, time in zip(rows, *corrected, strict=True):
        print("|", " | ".join([scenario, *cells[:2], f"{success:.2g}", *cells[2:], f"{time:.2g}"]), "|")


if __name__ == "__main__":
    main()
