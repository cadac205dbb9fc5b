"""Summaries of conditions: success rates with intervals, and means with counts.

The statistical unit is the map, or the group of maps if a dataset has groups. Episodes
on the same map with different seeds or realisations are correlated: 100 episodes on 20
maps contain less information than 100 episodes on 100 maps. The design effect
quantifies this loss.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.eval.experiment.condition import LABELS
from benchnav.metrics import shipped
from benchnav.metrics.base import Metric
from benchnav.planning.world.outcome import FAILURES
from benchnav.stats.by_map import by_map
from benchnav.stats.intervals import (
    design_effect,
    mean_interval,
    total_time_interval,
    wilson_interval,
)

# Metrics that are summarised by mean and standard deviation.
_SPREAD: tuple[Metric, ...] = (
    shipped.TRAVERSABILITY,
    shipped.TIME_RATIO,
    shipped.SCORE,
    shipped.PATH_LENGTH,
    shipped.STUCK_FRACTION,
    shipped.ROUGHNESS,
)
# Metrics that are summarised by the median.
_MEDIANS: tuple[Metric, ...] = shipped.PLANNING
# Metrics that are summarised by the mean.
_LEARNING: tuple[Metric, ...] = (
    shipped.SEEN_CELLS,
    shipped.SENSED_CELLS,
    shipped.REVISIONS,
    *shipped.AHEAD,
    shipped.LEARNING_TIME,
)


def time_budgets(episodes: pd.DataFrame, world: Mapping[str, Any]) -> pd.Series:
    """Return each episode's T in seconds.

    T is the T_total of a failure. For a success, T follows from the world.

    Args:
        episodes: rows of one condition.
        world: world of the condition, as in `run.json`.
    """
    total_s = episodes["total_time_s"]
    if "time_budget_ratio" in world:
        # T_total divided by its ratio is the reference time at the robot's top speed.
        budget_s = world["time_budget_ratio"] * total_s / episodes["time_ratio"]
    else:
        budget_s = world["time_budget_s"]
    return total_s.where(~episodes["success"], budget_s)


def success_mean(episodes: pd.DataFrame) -> tuple[float, float, float]:
    """Return the success rate of a condition with Wilson's 95 % interval.

    For the interval, the number of episodes is divided by `design_effect`.
    """
    success = episodes["success"].to_numpy(dtype=bool)
    maps = episodes["group"].to_numpy()
    n_effective = len(success) / design_effect(success, maps)
    rate = float(success.mean())
    low, high = wilson_interval(rate, n_effective)
    return rate, low, high


def total_time_mean(
    episodes: pd.DataFrame, world: Mapping[str, Any]
) -> tuple[float, float, float]:
    """Return the mean T_total of a condition with its 95 % interval within [0, T].

    Args:
        episodes: rows of one condition.
        world: world of the condition, as in `run.json`.

    Returns:
        Mean and limits in seconds; the limits are NaN with fewer than
        `stats.bootstrap.LEAST_MAPS` maps.
    """
    success = episodes["success"].to_numpy(dtype=bool)
    maps = episodes["group"].to_numpy()
    total_s = episodes["total_time_s"].to_numpy()
    budgets_s = time_budgets(episodes, world)
    arrival_s = 0.0  # minimum time of a success, if no episode succeeded
    if success.any():
        arrival_s = total_s[success].mean()
    _, low, high = success_mean(episodes)
    maps_of_success = np.unique(maps[success])
    mean_s, low_s, high_s = total_time_interval(
        by_map(total_s, maps),
        by_map(1.0 - success, maps),
        (1 - high, 1 - low),
        budgets_s.mean() - arrival_s,
        len(maps_of_success),
    )
    low_s = np.maximum(low_s, 0.0)
    high_s = np.minimum(high_s, budgets_s.max())
    return float(mean_s), float(low_s), float(high_s)


def summarise(
    episodes: pd.DataFrame,
    worlds: Mapping[str, Mapping[str, Any]],
    further: Sequence[Quantity] = (),
) -> pd.DataFrame:
    """Summarise each condition, in the order in which conditions first appear.

    Args:
        episodes: rows of episodes.
        worlds: world of each condition by id, as in `run.json`.
        further: quantities of the episodes in addition to the built-in ones.

    Returns:
        One row per condition, with these columns:

        - `condition` and its labels; `n_episodes`; `n_maps`; `n_groups`, which is
          `n_maps` if the dataset has no groups.
        - `success_rate`, with the limits `success_low` and `success_high` of its
          interval, and `design_effect`; see `success_mean`.
        - `NAME_mean`, `NAME_std`, and `NAME_n`, the number of episodes with a value,
          for the total time (a failure counts as T), the time of successes only,
          observed λ, the time divided by the reference time, the score, the path
          length, the fraction of stuck steps, and the roughness.
        - `total_time_low_s` and `total_time_high_s`, the limits of the 95 % interval of
          the mean total time from `total_time_mean`.
        - the medians `planning_ms_median`, `planning_ms_p95_median` and
          `planning_start_ms_median`.
        - `NAME_mean` for metrics of learning, NaN if robots do not learn;
          `compiled_share`, the fraction of episodes with a compiled planner;
          `OUTCOME_count`, the number of failures with each outcome.
        - for each further quantity: mean, standard deviation and number of episodes, as
          above; and `NAME_low` and `NAME_high`, the limits of Student's 95 % interval
          of the mean over maps.
    """
    groups = episodes.groupby("condition", sort=False)
    rows = [
        _summarise_condition(group, worlds[str(condition)], further)
        for condition, group in groups
    ]
    return pd.DataFrame(rows)


def _summarise_condition(
    group: pd.DataFrame, world: Mapping[str, Any], further: Sequence[Quantity]
) -> dict[str, object]:
    success = group["success"].to_numpy(dtype=bool)
    rate, low, high = success_mean(group)
    row: dict[str, object] = {
        name: group[name].iloc[0] for name in ("condition", *LABELS)
    }
    row["n_episodes"] = len(group)
    row["n_maps"] = group["map"].nunique()
    row["n_groups"] = group["group"].nunique()
    row["success_rate"] = rate
    row["success_low"] = low
    row["success_high"] = high
    row["design_effect"] = design_effect(success, group["group"].to_numpy())
    total_time = shipped.TOTAL_TIME.quantity
    total_s = group[total_time.column]
    row |= _spread(total_time, total_s)
    _, low_s, high_s = total_time_mean(group, world)
    row["total_time_low_s"] = low_s
    row["total_time_high_s"] = high_s
    success_time = replace(total_time, column="success_time_s")
    row |= _spread(success_time, total_s.where(success))
    for metric in _SPREAD:
        row |= _spread(metric.quantity, group[metric.column])
    for metric in _MEDIANS:
        name = metric.quantity.summary_column("median")
        row[name] = group[metric.column].median()
    for metric in _LEARNING:
        name = metric.quantity.summary_column("mean")
        # If robots do not learn, the table lacks these columns.
        values = group.get(metric.column)
        row[name] = np.nan if values is None else values.mean()
    row["compiled_share"] = group["compiled"].astype(float).mean()
    for outcome in FAILURES:
        name = outcome.name.lower()
        is_outcome = group["outcome"] == name
        row[f"{name}_count"] = int(is_outcome.sum())
    for quantity in further:
        row |= _mean_with_interval(quantity, group)
    return row


def _spread(quantity: Quantity, values: pd.Series) -> dict[str, object]:
    """Return mean, standard deviation and number of values, keyed by column name."""
    stem = quantity.column.removesuffix(quantity.suffix)
    return {
        quantity.summary_column("mean"): values.mean(),
        quantity.summary_column("std"): values.std(),
        f"{stem}_n": int(values.notna().sum()),
    }


def _mean_with_interval(quantity: Quantity, group: pd.DataFrame) -> dict[str, object]:
    """Return the columns of `_spread`, and Student's 95 % interval over maps.

    If the run is not finished, the quantity's column may be missing.
    """
    values = pd.Series(np.nan, index=group.index)
    if quantity.column in group:
        values = group[quantity.column]
    has_value = values.notna()
    numbers = values[has_value].to_numpy(dtype=float)
    maps = group.loc[has_value, "group"].to_numpy()
    _, low, high = mean_interval(by_map(numbers, maps))
    return {
        **_spread(quantity, values),
        quantity.summary_column("low"): float(low),
        quantity.summary_column("high"): float(high),
    }
