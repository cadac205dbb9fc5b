"""Statistics of a cell of a suite."""

import pandas as pd
from scipy.stats import binomtest

CELL = ["scenario", "planner", "risk"]


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval for a rate. Source: Wilson (1927).

    Args:
        successes: number of successes.
        trials: number of trials, ≥ 1.
        confidence: coverage asked for.

    Returns:
        Lower and upper end, in [0, 1].
    """
    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def summarise(episodes: pd.DataFrame) -> pd.DataFrame:
    """Summarises each cell, in the order in which cells first appear.

    Args:
        episodes: from `metrics.episode_table`.

    Returns:
        A row a cell. Times and traversability as mean and standard deviation over instances; time
        both over all instances, a failure counted as the whole budget, and over successes alone.
    """
    rows = []
    for cell, group in episodes.groupby(CELL, sort=False):
        wins = group[group["success"]]
        low, high = wilson_interval(len(wins), len(group))
        rows.append(
            dict(zip(CELL, cell, strict=True))
            | {
                "episodes": len(group),
                "success_rate": len(wins) / len(group),
                "success_low": low,
                "success_high": high,
                "total_time_mean_s": group["total_time_s"].mean(),
                "total_time_std_s": group["total_time_s"].std(),
                "success_time_mean_s": wins["total_time_s"].mean(),
                "success_time_std_s": wins["total_time_s"].std(),
                "traversability_mean": group["traversability"].mean(),
                "traversability_std": group["traversability"].std(),
                "time_ratio_mean": group["time_ratio"].mean(),
                "path_length_mean_m": group["path_length_m"].mean(),
                "stuck_share_mean": group["stuck_share"].mean(),
                "roughness_mean": group["roughness"].mean(),
            }
            | {
                f"{outcome}_count": int((group["outcome"] == outcome).sum())
                for outcome in ("timeout", "stuck", "out_of_bounds", "planner_failure")
            }
        )
    return pd.DataFrame(rows)
