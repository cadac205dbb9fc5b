"""The best condition of each block of a run, and which others are significantly worse
(`benchnav.stats.best`).
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

# Conditions of a block met the same maps and the same noise, and were asked the same.
BLOCK = ("data", "scenario", "world", "robot", "objective")
# Privileged models, the one that knows most first.
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
    """Which conditions' models are privileged: given part of the truth.

    Args:
        conditions: by id what `run.json` knows of them.

    Returns:
        By id one of `PRIVILEGED`.
    """
    looking = {
        condition: about["value"]["model"]["part"]
        for condition, about in conditions.items()
        if about["labels"]["model"] != NOT_USED
    }
    return {
        condition: part for condition, part in looking.items() if part in PRIVILEGED
    }


def competing(rows: pd.DataFrame) -> pd.Series:
    """Tells which conditions of a block compete for the best.

    A privileged model is a reference and no rival, unless nothing else is there that
    looks at a prediction.

    Args:
        rows: of the summary, of one block, with `privileged` as of `against_best`.

    Returns:
        Bool, by the index of `rows`.
    """
    for out in (list(PRIVILEGED), list(PRIVILEGED)[:1]):
        left = ~rows["privileged"].isin(out)
        if (left & (rows["model"] != NOT_USED)).any():
            return left
    return pd.Series(True, index=rows.index)


def against_best(
    episodes: pd.DataFrame,
    summary: pd.DataFrame,
    privileged: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Compares the conditions of each block that compete, map by map, and tells which
    are worse than the best.

    All of them on the episodes that they have in common, so that one which was run on
    more maps is not judged by others. The best has the highest success rate there and,
    of several, the least mean T_total.

    Args:
        episodes: rows of episodes.
        summary: of them, from `summary.summarise`.
        privileged: from `privileged_models`; none where not given.

    Returns:
        A row a condition, in the order of the summary: `condition`; `privileged`, of
        `PRIVILEGED`, empty where nothing is; `best`, the condition that is the best of
        its block; `best_rivals`, how many others compete; `best_episodes`, of each of
        them in common, on `best_maps`, of which a group counts as one;
        `best_difference`, by how much the best's success rate is higher, with its 95 %
        interval `_low`, `_high`, of the pair alone; `best_p`, from `best_set_p`;
        `best_shown`, the minimum detectable difference with 80 % power; `best_alike`,
        true where it competes and is not significantly worse than the best; and
        `best_marked`, true where it is alike and something in its block is worse. NaN
        where a condition does not compete, and for the best itself.
    """
    groups = dict(list(episodes.groupby("condition", sort=False)))
    summary = summary.assign(
        privileged=summary["condition"].map(privileged or {}).fillna("")
    )
    found: list[dict[str, Any]] = []
    for _, rows in summary.groupby(list(BLOCK), sort=False, dropna=False):
        about, compared = _compare(
            {
                condition: groups[condition]
                for condition in rows.loc[competing(rows), "condition"]
            }
        )
        some_worse = not all(one["best_alike"] for one in compared.values())
        for condition in rows["condition"]:
            one = compared.get(condition, {"best_alike": False})
            marked = {"best_marked": one["best_alike"] and some_worse}
            found.append({"condition": condition, **about, **one, **marked})
    table = pd.DataFrame(found).reindex(columns=_COLUMNS)
    return summary[["condition", "privileged"]].merge(
        table, on="condition", how="left", validate="1:1"
    )


def _compare(
    rivals: Mapping[str, pd.DataFrame],
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Columns of `against_best` that are those of the block, and by condition its own."""
    common = on_common_draws(rivals)
    is_none = any(rows.empty for rows in common.values())
    judged = rivals if is_none else common
    # those that are as good and as fast, in the order of their digests
    names = sorted(judged)
    times = np.array([judged[name]["total_time_s"].mean() for name in names])
    mean_s = dict(zip(names, alike(times, times.max()), strict=True))
    best, *others = sorted(
        names, key=lambda name: (-judged[name]["success"].mean(), mean_s[name])
    )
    episodes, maps = len(judged[best]), judged[best]["group"].nunique()
    about = {
        "best": best,
        "best_rivals": len(others),
        "best_episodes": episodes,
        "best_maps": maps,
    }
    made: dict[str, dict[str, Any]] = {best: {"best_alike": True}}
    if is_none:  # nothing to compare
        return about, made | {
            condition: {"best_alike": True, "best_p": 1.0} for condition in others
        }
    wins = [judged[one].groupby("group")["success"].sum() for one in (best, *others)]
    values = np.stack([won.to_numpy(dtype=int) for won in wins], axis=1)
    draws = judged[best].groupby("group").size().to_numpy()
    p, shown = best_set_p(values, draws)
    for place, condition in enumerate(others, start=1):
        gain = values[:, 0] - values[:, place]
        entry = {"best_p": p[place], "best_alike": bool(p[place] >= ALPHA)}
        entry["best_difference"] = gain.sum() / episodes
        if maps > 1:
            _, entry["best_low"], entry["best_high"] = map(
                float, success_interval(gain, draws)
            )
            entry["best_shown"] = shown[place]
        made[condition] = entry
    return about, made
