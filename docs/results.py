"""Paired comparisons of a run's trials, for docs/results.md.

    python docs/results.py runs/paper --against mean
    python docs/results.py runs/paper --against straight

Each risk setting is compared with `mean` (or each planner with the blind `straight`) on the same instances,
which met the same luck. Success: difference in percentage points, and the exact McNemar test. Time:
difference of T_total (a failure counts as T), with a bootstrap interval over maps, and Wilcoxon's
signed-rank test. Holm's correction is over the rows that are printed, for each of the two tests.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest, bootstrap, wilcoxon

KEYS = ["seed", "realisation", "instance"]


def pairs(rows: pd.DataFrame, against: str) -> Iterator[tuple[str, str, str, pd.DataFrame]]:
    """Scenario, planner, setting, and the episodes of both side by side."""
    for scenario, here in rows.groupby("scenario", sort=False):
        for (planner, risk), trial in here.groupby(["planner", "risk"], sort=False):
            if against == "straight":
                other = here[here["planner"] == "straight"]
            else:
                other = here[(here["planner"] == planner) & (here["risk"] == against)]
            same = planner == against or risk == against
            if not other.empty and not same:
                yield scenario, planner, risk, trial.merge(other, on=KEYS, suffixes=("", "_other"))


def compare(pair: pd.DataFrame) -> dict[str, float]:
    """Differences of a pair of trials, with their tests."""
    wins = int((pair["success"] & ~pair["success_other"]).sum())
    losses = int((~pair["success"] & pair["success_other"]).sum())
    by_map = (pair["total_time_s"] - pair["total_time_s_other"]).groupby(pair["instance"]).mean().to_numpy()
    interval = bootstrap((by_map,), np.mean, rng=np.random.default_rng(0)).confidence_interval
    return {
        "success": 100 * (pair["success"].mean() - pair["success_other"].mean()),
        "won": wins,
        "lost": losses,
        "success_p": binomtest(wins, wins + losses).pvalue if wins + losses else 1.0,
        "time": by_map.mean(),
        "low": interval.low,
        "high": interval.high,
        "time_p": wilcoxon(by_map).pvalue if np.any(by_map) else 1.0,
    }


def holm(p: pd.Series) -> pd.Series:
    """Holm's step-down correction."""
    order = p.sort_values()
    stepped = (order * (len(p) - np.arange(len(p)))).cummax().clip(upper=1)
    return stepped.reindex(p.index)


def main() -> None:
    """Prints the comparisons of a run as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--against", default="mean", help="a risk setting, or straight")
    given = parser.parse_args()
    rows = pd.read_parquet(given.run / "episodes.parquet")
    made = [
        {"scenario": scenario, "planner": planner, "risk": risk, **compare(pair)}
        for scenario, planner, risk, pair in pairs(rows, given.against)
    ]
    table = pd.DataFrame(made)
    table["success_p"], table["time_p"] = holm(table["success_p"]), holm(table["time_p"])
    measures = f"Δ success [points] | only it : only {given.against} | p | Δ T_total [s] | 95 % | p"
    print(f"| scenario | planner | risk | {measures} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in table.to_dict("records"):
        print(
            f"| {row['scenario']} | {row['planner']} | {row['risk']} | {row['success']:+.0f} | "
            f"{row['won']} : {row['lost']} | {row['success_p']:.2g} | {row['time']:+.1f} | "
            f"{row['low']:+.1f} to {row['high']:+.1f} | {row['time_p']:.2g} |"
        )


if __name__ == "__main__":
    main()
