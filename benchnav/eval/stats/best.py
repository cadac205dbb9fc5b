"""The best condition of each block, and the conditions that are significantly worse.

`benchnav.stats.best` defines the test.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.stats.pairs import on_common_draws
from benchnav.stats.best import best_set_p
from benchnav.stats.by_map import alike
from benchnav.stats.holm import ALPHA
from benchnav.stats.intervals import success_interval

# Columns that define a block: its conditions have the same task, maps and noise.
BLOCK = ("data", "scenario", "world", "robot", "objective")
# Models that receive part of the truth; the model that receives most comes first.
PRIVILEGED = ("clairvoyant", "oracle", "ideal")

_COLUMNS = (
    "condition",
    "best",
    "best_rivals",
    "best_episodes",
    "best_maps",
    "best_difference",
    "best_low",
    "best_high",
    "best_p",
    "best_shown",
    "best_alike",
    "best_marked",
)


def privileged_models(conditions: Mapping[str, Any]) -> dict[str, str]:
    """Return the models of conditions that receive part of the truth.

    Args:
        conditions: entries of `run.json` by id.

    Returns:
        Names in `PRIVILEGED`, by the id of each condition with a privileged model.
    """
    privileged = {}
    for condition, entry in conditions.items():
        model = entry["value"]["model"]["part"]
        is_used = entry["labels"]["model"] != NOT_USED
        if is_used and model in PRIVILEGED:
            privileged[condition] = model
    return privileged


def competing(rows: pd.DataFrame) -> pd.Series:
    """Return a mask of the conditions of a block that compete to be the best.

    A condition with a privileged model is only a reference, unless no other condition
    of the block uses a prediction.

    Args:
        rows: summary of one block, with `privileged` as in `against_best`.

    Returns:
        Boolean series with the index of `rows`.
    """
    has_model = rows["model"] != NOT_USED
    for excluded in (PRIVILEGED, PRIVILEGED[:1]):
        is_competing = ~rows["privileged"].isin(excluded)
        if (is_competing & has_model).any():
            return is_competing
    return pd.Series(True, index=rows.index)


def against_best(
    episodes: pd.DataFrame,
    summary: pd.DataFrame,
    privileged: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Compare the competing conditions of each block with the best condition, per map.

    The conditions of a block are compared on their common episodes, so that all have
    the same maps. The best condition has the highest success rate on these episodes;
    ties are decided by the lower mean T_total.

    Args:
        episodes: rows of episodes.
        summary: summary of the episodes, from `summary.summarise`.
        privileged: names from `privileged_models`; by default no model is privileged.

    Returns:
        One row per condition, in the order of the summary, with the columns below.
        Values that compare the condition with the best are NaN if the condition does
        not compete or is the best.

        - `condition`; `privileged`, its model in `PRIVILEGED` or empty; `best`, the id
          of the best condition of the block.
        - `best_rivals`, the number of other competing conditions; `best_episodes`, the
          number of common episodes; `best_maps`, the number of maps of these episodes,
          or of groups of maps.
        - `best_difference`, the success rate of the best minus that of the condition,
          with the limits `best_low` and `best_high` of its uncorrected 95 % interval;
          `best_p`, the p-value from `best_set_p`; `best_shown`, the minimum detectable
          difference with 80 % power.
        - `best_alike`, true if the condition competes and is not significantly worse
          than the best; `best_marked`, true if also some condition of the block is
          significantly worse.
    """
    groups = dict(list(episodes.groupby("condition", sort=False)))
    model_names = summary["condition"].map(privileged or {})
    summary = summary.assign(privileged=model_names.fillna(""))
    table_rows: list[dict[str, Any]] = []
    for _, rows in summary.groupby(list(BLOCK), sort=False, dropna=False):
        rivals = rows.loc[competing(rows), "condition"]
        block_columns, compared = _compare({name: groups[name] for name in rivals})
        alike_flags = [columns["best_alike"] for columns in compared.values()]
        some_worse = not all(alike_flags)
        for condition in rows["condition"]:
            columns = compared.get(condition, {"best_alike": False})
            row = {"condition": condition, **block_columns, **columns}
            row["best_marked"] = columns["best_alike"] and some_worse
            table_rows.append(row)
    table = pd.DataFrame(table_rows).reindex(columns=_COLUMNS)
    return summary[["condition", "privileged"]].merge(
        table, on="condition", how="left", validate="1:1"
    )


def _compare(
    rivals: Mapping[str, pd.DataFrame],
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Return the columns of `against_best` for a whole block, and for each condition.

    Args:
        rivals: rows of episodes by id of each competing condition.
    """
    common = on_common_draws(rivals)
    has_no_draws = any(rows.empty for rows in common.values())
    rows_of = rivals if has_no_draws else common
    names = sorted(rows_of)  # remaining ties are decided by id
    times = np.array([rows_of[name]["total_time_s"].mean() for name in names])
    mean_s = dict(zip(names, alike(times, times.max()), strict=True))
    rates = {name: rows_of[name]["success"].mean() for name in names}
    best, *others = sorted(names, key=lambda name: (-rates[name], mean_s[name]))
    n_episodes = len(rows_of[best])
    n_maps = rows_of[best]["group"].nunique()
    block_columns = {
        "best": best,
        "best_rivals": len(others),
        "best_episodes": n_episodes,
        "best_maps": n_maps,
    }
    by_condition: dict[str, dict[str, Any]] = {best: {"best_alike": True}}
    if has_no_draws:  # no common episode to compare
        for condition in others:
            by_condition[condition] = {"best_alike": True, "best_p": 1.0}
        return block_columns, by_condition
    wins = []
    for condition in (best, *others):
        by_group = rows_of[condition].groupby("group")["success"]
        wins.append(by_group.sum().to_numpy(dtype=int))
    values = np.stack(wins, axis=1)
    draws = rows_of[best].groupby("group").size().to_numpy()
    p, detectable = best_set_p(values, draws)
    for index, condition in enumerate(others, start=1):
        gain = values[:, 0] - values[:, index]
        columns: dict[str, Any] = {"best_p": p[index]}
        columns["best_alike"] = bool(p[index] >= ALPHA)
        columns["best_difference"] = gain.sum() / n_episodes
        if n_maps > 1:
            _, low, high = success_interval(gain, draws)
            columns["best_low"] = float(low)
            columns["best_high"] = float(high)
            columns["best_shown"] = detectable[index]
        by_condition[condition] = columns
    return block_columns, by_condition
