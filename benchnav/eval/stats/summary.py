"""Summaries of conditions: success with its interval, and means with how many episodes each is made of.

The map is the unit, or the group of maps where a dataset has groups. Episodes on one map, under other seeds or
realisations, have much in common, so that a hundred of them on twenty maps tell less than a hundred maps would. The
design effect says how much less.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from statsmodels.stats.proportion import proportion_confint

from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.stats.paired_difference import by_map, total_time_interval
from benchnav.planning.world.outcome import FAILURES

# Of each column its name in the summary, which the statistic parts, and its unit.
_QUANTITIES = {
    "total_time_s": ("total_time", "_s"),
    "success_time_s": ("success_time", "_s"),
    "traversability": ("traversability", ""),
    "time_ratio": ("time_ratio", ""),
    "score": ("score", ""),
    "path_length_m": ("path_length", "_m"),
    "stuck_share": ("stuck_share", ""),
    "roughness_radps2": ("roughness", "_radps2"),
}

# Columns of episodes that say what robots learnt on their way.
LEARNT = ("seen_cells", "sensed_cells", "revisions", "ahead_rmse", "ahead_log_score", "learning_ms")


def wilson_interval(rate: float, n: float) -> tuple[float, float]:
    """Wilson's 95 % score interval for a rate. Source: Wilson (1927).

    Args:
        rate: share of successes, in [0, 1].
        n: number of independent trials, > 0; an effective number need not be whole.

    Returns:
        Lower and upper end, in [0, 1].
    """
    low, high = proportion_confint(rate * n, n, method="wilson")
    return float(low), float(high)


def design_effect(success: np.ndarray, maps: np.ndarray) -> float:
    """How many episodes tell as much as one on a map of its own would.

    1 + (m − 1)·ρ, with m the size-weighted mean number of episodes a map and ρ the intra-class correlation
    of success by map, from the analysis of variance and kept in [0, 1]. Where the outcomes do not differ at
    all, or there is but one map, ρ cannot be seen; it is then 1, so that a map counts as one episode. Since ρ
    is an estimate, a 95 % interval made with it holds 93 % of the time on 20 maps and 95 % on 60 (simulated,
    five episodes a map).
    Source: Donner and Klar (2000), "Design and Analysis of Cluster Randomization Trials in Health Research", 1.2 and
    6.2.1; Ridout, Demétrio and Firth (1999) for the estimator on binary data.

    Args:
        success: bool, shape [N].
        maps: which map each episode was on, any labels, shape [N].

    Returns:
        At least 1, at most N.
    """
    _, member, size = np.unique(maps, return_inverse=True, return_counts=True)
    value, episodes, count = success.astype(float), len(success), len(size)
    if episodes == count:
        return 1.0
    weighted = float((size**2).sum()) / episodes
    within_maps = 1.0
    if count > 1:
        mean = np.bincount(member, weights=value) / size
        between = float((size * (mean - value.mean()) ** 2).sum()) / (count - 1)
        within = float(((value - mean[member]) ** 2).sum()) / (episodes - count)
        if between or within:
            typical = (episodes - weighted) / (count - 1)
            within_maps = min(max((between - within) / (between + (typical - 1) * within), 0.0), 1.0)
    return 1 + (weighted - 1) * within_maps


def cautious_design_effect(success: np.ndarray, maps: np.ndarray) -> float:
    """Does `design_effect` as if two more maps had been met, on one of which all arrived and on the other none.

    Near 0 and 1 the correlation is seen by few maps, and underestimated where these are few: intervals made with
    `design_effect` alone then hold 0.90 where 0.95 is promised (50 maps, three episodes each), with this 0.95 and
    more; see `benchmarks/statistics_studies.py`.

    Args:
        success: as there.
        maps: as there.

    Returns:
        At least 1.
    """
    _, member, size = np.unique(maps, return_inverse=True, return_counts=True)
    each = round(size.mean())
    if each == 1:
        return design_effect(success, maps)
    added = np.repeat([len(size), len(size) + 1], each)
    ends = np.repeat([True, False], each)
    effect = design_effect(np.concatenate([success, ends]), np.concatenate([member, added]))
    return min(effect, len(success))


def time_budgets(episodes: pd.DataFrame, world: Mapping[str, Any]) -> pd.Series:
    """T of each episode in seconds: what a failure counts as, and what a success might have cost.

    Args:
        episodes: rows of one condition.
        world: of the condition, as `run.json` holds it.
    """
    if "time_budget_ratio" in world:
        # The time over its ratio is the reference time at the robot's top speed.
        granted = world["time_budget_ratio"] * episodes["total_time_s"] / episodes["time_ratio"]
    else:
        granted = world["time_budget_s"]
    return episodes["total_time_s"].where(~episodes["success"], granted)


def success_mean(episodes: pd.DataFrame) -> tuple[float, float, float]:
    """Success rate of one condition with its 95 % interval, Wilson's on the episodes over `cautious_design_effect`."""
    success = episodes["success"].to_numpy(dtype=bool)
    effect = cautious_design_effect(success, episodes["group"].to_numpy())
    return float(success.mean()), *wilson_interval(float(success.mean()), len(success) / effect)


def total_time_mean(episodes: pd.DataFrame, world: Mapping[str, Any]) -> tuple[float, float, float]:
    """Mean of T_total of one condition with its 95 % interval, which lies within 0 and T.

    Args:
        episodes: rows of one condition.
        world: of the condition, as `run.json` holds it.

    Returns:
        Mean and ends in seconds; the ends are NaN where there are fewer than `core.resampling.LEAST_MAPS` maps.
    """
    success, maps = episodes["success"].to_numpy(dtype=bool), episodes["group"].to_numpy()
    taken, budgets = episodes["total_time_s"].to_numpy(), time_budgets(episodes, world)
    arrival = taken[success].mean() if success.any() else 0.0  # no arrival takes less
    _, low, high = success_mean(episodes)
    mean, low_s, high_s = total_time_interval(
        by_map(taken, maps), by_map(1.0 - success, maps), (1 - high, 1 - low),
        budgets.mean() - arrival, len(np.unique(maps[success])),
    )  # fmt: skip
    return float(mean), float(np.maximum(low_s, 0.0)), float(np.minimum(high_s, budgets.max()))


def summarise(episodes: pd.DataFrame, worlds: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Summarises each condition, in the order in which conditions first appear.

    Args:
        episodes: rows of episodes.
        worlds: by condition what λ did, as `run.json` holds it.

    Returns:
        A row a condition: `condition` and its labels; `n_episodes`, `n_maps`, and `n_groups`, which is the number of
        maps where the dataset has no groups; `success_rate` with Wilson's interval `success_low`, `success_high` on the
        number of episodes over `cautious_design_effect`. Of each quantity
        `NAME_mean`, `NAME_std` and `NAME_n`, the number of episodes that have it: total time, a failure
        counted as T; time of the successes alone; observed λ; time over the reference time; score; path length;
        share of stuck steps; roughness. `total_time_low_s`, `total_time_high_s`, the 95 % interval of its mean,
        from `total_time_interval`. `planning_ms_median`, and so for `planning_ms_p95` and `planning_start_ms`;
        `NAME_mean` of what `LEARNT` names, NaN where robots learn nothing; `compiled_share`; and `OUTCOME_count` of
        each failure.
    """
    groups = episodes.groupby("condition", sort=False)
    return pd.DataFrame([_summarise_condition(group, worlds[str(condition)]) for condition, group in groups])


def _summarise_condition(group: pd.DataFrame, world: Mapping[str, Any]) -> dict[str, object]:
    success = group["success"].to_numpy(dtype=bool)
    effect = cautious_design_effect(success, group["group"].to_numpy())
    rate, low, high = success_mean(group)
    row: dict[str, object] = {name: group[name].iloc[0] for name in ("condition", *LABELS)}
    row |= {"n_episodes": len(group), "n_maps": group["map"].nunique(), "n_groups": group["group"].nunique()}
    row |= {"success_rate": rate, "success_low": low, "success_high": high, "design_effect": effect}
    columns = group.assign(success_time_s=group["total_time_s"].where(success))
    for column, (name, unit) in _QUANTITIES.items():
        values = columns[column]
        row |= {f"{name}_mean{unit}": values.mean(), f"{name}_std{unit}": values.std()}
        row[f"{name}_n"] = int(values.notna().sum())
        if name == "total_time":
            _, row["total_time_low_s"], row["total_time_high_s"] = total_time_mean(group, world)
    for name in ("planning_ms", "planning_ms_p95", "planning_start_ms"):
        row[f"{name}_median"] = group[name].median()
    for name in LEARNT:
        row[f"{name}_mean"] = group[name].mean() if name in group else np.nan
    row["compiled_share"] = group["compiled"].astype(float).mean()
    outcomes = [outcome.name.lower() for outcome in FAILURES]
    return row | {f"{name}_count": int((group["outcome"] == name).sum()) for name in outcomes}
