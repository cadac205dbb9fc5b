"""The best condition of each block, and which are significantly worse.

The test is `benchnav.stats.best`.
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

# Conditions of a block have the same task, maps and noise.
BLOCK = ("data", "scenario", "world", "robot", "objective")
# Privileged models, the one given most first.
PRIVILEGED = ("clairvoyant", "oracle", "ideal")

_COLUMNS = (
    *(
        "condition",
        "best",
        "best_rivals",
        "best_episodes",
        "best_maps",
        "best_difference",
        "best_low",
    ),
    *("best_high", "best_p", "best_shown", "best_alike", "best_marked"),
)


def privileged_models(conditions: Mapping[str, Any]) -> dict[str, str]:
    """Return the conditions whose models are privileged: given part of the truth.

    Args:
        conditions: entries of `run.json` by id.

    Returns:
        One of `PRIVILEGED` by id.
    """
    models = {
        condition: entry["value"]["model"]["part"]
        for condition, entry in conditions.items()
        if entry["labels"]["model"] != NOT_USED
    }
    return {condition: part for condition, part in models.items() if part in PRIVILEGED}


def competing(rows: pd.DataFrame) -> pd.Series:
    """Return which conditions of a block compete for the best.

    A privileged model is only a reference, unless no other condition of the block uses
    a prediction.

    Args:
        rows: summary of one block, with `privileged` as in `against_best`.

    Returns:
        Bool, by the index of `rows`.
    """
    for excluded in (list(PRIVILEGED), list(PRIVILEGED)[:1]):
        is_competing = ~rows["privileged"].isin(excluded)
        if (is_competing & (rows["model"] != NOT_USED)).any():
            return is_competing
    return pd.Series(True, index=rows.index)


def against_best(
    episodes: pd.DataFrame,
    summary: pd.DataFrame,
    privileged: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Compare the competing conditions of each block per map with the best.

    All are compared on the episodes that they have in common, so that a condition run
    on more maps is compared on the same ones. The best has the highest success rate
    there; ties are decided by the smaller mean T_total.

    Args:
        episodes: rows of episodes.
        summary: their summary, from `summary.summarise`.
        privileged: from `privileged_models`; by default no model is.

    Returns:
        A row a condition, in the order of the summary: `condition`; `privileged`, of
        `PRIVILEGED` or empty; `best`, the best condition of its block; `best_rivals`,
        the number of other competitors; `best_episodes`, the number of common episodes,
        on `best_maps` maps, where a group counts as one;
        `best_difference`, by how much the best's success rate is higher, with its 95 %
        interval `_low`, `_high`, of that pair, uncorrected; `best_p`, from `best_set_p`;
        `best_shown`, the minimum detectable difference with 80 % power; `best_alike`,
        true if it competes and is not significantly worse than the best; and
        `best_marked`, true if it is alike and some condition of its block is worse. NaN
        if a condition does not compete, and for the best itself.
    """
    groups = dict(list(episodes.groupby("condition", sort=False)))
    summary = summary.assign(
        privileged=summary["condition"].map(privileged or {}).fillna("")
    )
    table_rows: list[dict[str, Any]] = []
    for _, rows in summary.groupby(list(BLOCK), sort=False, dropna=False):
        rivals = rows.loc[competing(rows), "condition"]
        of_block, compared = _compare({name: groups[name] for name in rivals})
        some_worse = not all(
            of_condition["best_alike"] for of_condition in compared.values()
        )
        for condition in rows["condition"]:
            of_condition = compared.get(condition, {"best_alike": False})
            marked = {"best_marked": of_condition["best_alike"] and some_worse}
            table_rows.append(
                {"condition": condition, **of_block, **of_condition, **marked}
            )
    table = pd.DataFrame(table_rows).reindex(columns=_COLUMNS)
    return summary[["condition", "privileged"]].merge(
        table, on="condition", how="left", validate="1:1"
    )


def _compare(
    rivals: Mapping[str, pd.DataFrame],
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Return the columns of `against_best` for the block, and for each condition."""
    common = on_common_draws(rivals)
    has_no_draws = any(rows.empty for rows in common.values())
    rows_of = rivals if has_no_draws else common
    names = sorted(rows_of)  # ties are in the order of digests
    times = np.array([rows_of[name]["total_time_s"].mean() for name in names])
    mean_s = dict(zip(names, alike(times, times.max()), strict=True))
    rates = {name: rows_of[name]["success"].mean() for name in names}
    best, *others = sorted(names, key=lambda name: (-rates[name], mean_s[name]))
    episodes = len(rows_of[best])
    maps = rows_of[best]["group"].nunique()
    of_block = {
        "best": best,
        "best_rivals": len(others),
        "best_episodes": episodes,
        "best_maps": maps,
    }
    of_conditions: dict[str, dict[str, Any]] = {best: {"best_alike": True}}
    if has_no_draws:  # nothing to compare
        untested = {"best_alike": True, "best_p": 1.0}
        return of_block, of_conditions | {name: dict(untested) for name in others}
    wins = [rows_of[name].groupby("group")["success"].sum() for name in (best, *others)]
    values = np.stack([won.to_numpy(dtype=int) for won in wins], axis=1)
    draws = rows_of[best].groupby("group").size().to_numpy()
    p, shown = best_set_p(values, draws)
    for index, condition in enumerate(others, start=1):
        gain = values[:, 0] - values[:, index]
        entry = {"best_p": p[index], "best_alike": bool(p[index] >= ALPHA)}
        entry["best_difference"] = gain.sum() / episodes
        if maps > 1:
            _, low, high = success_interval(gain, draws)
            entry["best_low"] = float(low)
            entry["best_high"] = float(high)
            entry["best_shown"] = shown[index]
        of_conditions[condition] = entry
    return of_block, of_conditions
