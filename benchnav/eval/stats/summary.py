"""Summaries of conditions: success rates with intervals, and means with counts.

The statistical unit is the map, or the group of maps if a dataset has groups. Episodes
on one map under several seeds or realisations are correlated: a hundred of them on
twenty maps contain less information than a hundred maps. The design effect states how
much less.
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

# Metrics with mean and standard deviation, with a median, and of learning with a mean.
_SPREAD: tuple[Metric, ...] = (
    shipped.TRAVERSABILITY,
    shipped.TIME_RATIO,
    shipped.SCORE,
)
_SPREAD += (shipped.PATH_LENGTH, shipped.STUCK_FRACTION, shipped.ROUGHNESS)
_MEDIANS: tuple[Metric, ...] = shipped.PLANNING
_LEARNT: tuple[Metric, ...] = (
    shipped.SEEN_CELLS,
    shipped.SENSED_CELLS,
    shipped.REVISIONS,
    *shipped.AHEAD,
    shipped.LEARNING_TIME,
)


def time_budgets(episodes: pd.DataFrame, world: Mapping[str, Any]) -> pd.Series:
    """Return T of each episode in seconds: T_total of a failure, else from the world.

    Args:
        episodes: rows of one condition.
        world: world of the condition, as in `run.json`.
    """
    if "time_budget_ratio" in world:
        # The time over its ratio is the reference time at the robot's top speed.
        granted = (
            world["time_budget_ratio"]
            * episodes["total_time_s"]
            / episodes["time_ratio"]
        )
    else:
        granted = world["time_budget_s"]
    return episodes["total_time_s"].where(~episodes["success"], granted)


def success_mean(episodes: pd.DataFrame) -> tuple[float, float, float]:
    """Return the success rate of a condition with Wilson's 95 % interval.

    The number of episodes is divided by `design_effect`.
    """
    success = episodes["success"].to_numpy(dtype=bool)
    effect = design_effect(success, episodes["group"].to_numpy())
    rate = float(success.mean())
    low, high = wilson_interval(rate, len(success) / effect)
    return rate, low, high


def total_time_mean(
    episodes: pd.DataFrame, world: Mapping[str, Any]
) -> tuple[float, float, float]:
    """Return the mean T_total of a condition with its 95 % interval within [0, T].

    Args:
        episodes: rows of one condition.
        world: world of the condition, as in `run.json`.

    Returns:
        Mean and ends in seconds; the ends are NaN below `stats.bootstrap.LEAST_MAPS`
        maps.
    """
    success = episodes["success"].to_numpy(dtype=bool)
    maps = episodes["group"].to_numpy()
    taken = episodes["total_time_s"].to_numpy()
    budgets = time_budgets(episodes, world)
    arrival = taken[success].mean() if success.any() else 0.0  # no arrival takes less
    _, low, high = success_mean(episodes)
    mean, low_s, high_s = total_time_interval(
        by_map(taken, maps),
        by_map(1.0 - success, maps),
        (1 - high, 1 - low),
        budgets.mean() - arrival,
        len(np.unique(maps[success])),
    )
    return (
        float(mean),
        float(np.maximum(low_s, 0.0)),
        float(np.minimum(high_s, budgets.max())),
    )


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
        A row a condition: `condition` and its labels; `n_episodes`, `n_maps`, and
        `n_groups`, equal to `n_maps` if the dataset has no groups; `success_rate` with
        Wilson's interval `success_low`, `success_high` on the number of episodes over
        `design_effect`. For each quantity `NAME_mean`, `NAME_std` and `NAME_n`, the
        number of episodes that have it: total time, where a failure counts as T; time
        of successes only; observed λ; time over the reference time; score; path length;
        fraction of stuck steps; roughness.
        `total_time_low_s`, `total_time_high_s`, the 95 % interval of its mean, from
        `total_time_interval`. `planning_ms_median`, and so for `planning_ms_p95` and
        `planning_start_ms`; `NAME_mean` of metrics of learning, NaN if robots do not
        learn; `compiled_share`; and `OUTCOME_count` of each failure. For each further
        quantity mean, standard deviation and number of episodes, as above, and
        `NAME_low`, `NAME_high`, Student's 95 % interval of the mean per map.
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
    effect = design_effect(success, group["group"].to_numpy())
    rate, low, high = success_mean(group)
    row: dict[str, object] = {
        name: group[name].iloc[0] for name in ("condition", *LABELS)
    }
    row |= {
        "n_episodes": len(group),
        "n_maps": group["map"].nunique(),
        "n_groups": group["group"].nunique(),
    }
    row |= {
        "success_rate": rate,
        "success_low": low,
        "success_high": high,
        "design_effect": effect,
    }
    total_time = shipped.TOTAL_TIME.quantity
    taken = group[total_time.column]
    row |= _spread(total_time, taken)
    _, row["total_time_low_s"], row["total_time_high_s"] = total_time_mean(group, world)
    row |= _spread(replace(total_time, column="success_time_s"), taken.where(success))
    for metric in _SPREAD:
        row |= _spread(metric.quantity, group[metric.column])
    for metric in _MEDIANS:
        row[metric.quantity.summary_column("median")] = group[metric.column].median()
    for metric in _LEARNT:
        mean = group[metric.column].mean() if metric.column in group else np.nan
        row[metric.quantity.summary_column("mean")] = mean
    row["compiled_share"] = group["compiled"].astype(float).mean()
    outcomes = [outcome.name.lower() for outcome in FAILURES]
    row |= {f"{name}_count": int((group["outcome"] == name).sum()) for name in outcomes}
    for quantity in further:
        row |= _mean_with_interval(quantity, group)
    return row


def _spread(quantity: Quantity, values: pd.Series) -> dict[str, object]:
    """Return mean and standard deviation of a quantity, and its number of episodes."""
    stem = quantity.column.removesuffix(quantity.suffix)
    return {
        quantity.summary_column("mean"): values.mean(),
        quantity.summary_column("std"): values.std(),
        f"{stem}_n": int(values.notna().sum()),
    }


def _mean_with_interval(quantity: Quantity, group: pd.DataFrame) -> dict[str, object]:
    """Return `_spread` with Student's 95 % interval of the mean per map.

    The column may be missing if the run is not finished.
    """
    values = pd.Series(np.nan, index=group.index)
    if quantity.column in group:
        values = group[quantity.column]
    has_value = values.notna()
    by_unit = by_map(
        values[has_value].to_numpy(dtype=float),
        group.loc[has_value, "group"].to_numpy(),
    )
    _, low, high = mean_interval(by_unit)
    return {
        **_spread(quantity, values),
        quantity.summary_column("low"): float(low),
        quantity.summary_column("high"): float(high),
    }
