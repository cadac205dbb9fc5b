"""The best trial of each block of a run, and which others the paired test does not tell from it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from statsmodels.stats.multitest import multipletests

from benchnav.eval.stats.comparison import ALPHA
from benchnav.eval.stats.difference import sign_flip_p, standard_deviation, success_interval
from benchnav.eval.stats.power import smallest_difference
from benchnav.eval.trial import NOT_USED

# Trials of a block met the same maps and the same luck, and were asked the same.
BLOCK = ("data", "scenario", "world", "robot", "objective")
# Models that are told the truth, the one that knows most first.
TOLD = ("clairvoyant", "oracle", "ideal")

_LUCK = ["seed", "realisation", "instance"]


def told_the_truth(trials: Mapping[str, Any]) -> dict[str, str]:
    """Which trials' models are told the truth.

    Args:
        trials: by id what `run.json` knows of them.

    Returns:
        By id one of `TOLD`.
    """
    looking = {
        trial: about["value"].get("model", {}).get("part")
        for trial, about in trials.items()
        if about["labels"].get("model") != NOT_USED
    }
    return {trial: part for trial, part in looking.items() if part in TOLD}


def competing(rows: pd.DataFrame) -> pd.Series:
    """Tells which trials of a block compete for the best.

    What is told the truth is a yardstick and no rival, unless nothing else is there that looks at a prediction.

    Args:
        rows: of the summary, of one block, with `told` as of `against_best`.

    Returns:
        Bool, by the index of `rows`.
    """
    for out in (list(TOLD), list(TOLD)[:1]):
        left = ~rows["told"].isin(out)
        if (left & (rows["model"] != NOT_USED)).any():
            return left
    return pd.Series(True, index=rows.index)


def against_best(
    episodes: pd.DataFrame, summary: pd.DataFrame, told: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """Compares the best trial of each block with all others that compete, map by map.

    All of them on the episodes that they have in common, so that one which was run on more maps is not judged by
    others. The best has the highest success rate there and, of several, the least mean T_total. Holm's correction
    is over the others of its block.

    Args:
        episodes: rows of episodes.
        summary: of them, from `summary.summarise`.
        told: from `told_the_truth`; none where not given.

    Returns:
        A row a trial, in the order of the summary: `trial`; `told`, what is told the truth, of `TOLD`, empty
        where nothing is; `best`, the trial that is the best of its block;
        `best_rivals`, how many others compete; `best_episodes`, of each of them in common; `best_difference`, by how
        much the best's success rate is higher, with its 95 % interval `_low`, `_high`; `best_p_holm`; `best_shown`,
        the smallest difference that so many maps show with a chance of 80 %; and `best_alike`, true where the best is
        not told from it. NaN and false where a trial does not compete, NaN and true for the best itself.
    """
    groups = dict(list(episodes.groupby("trial", sort=False)))
    summary = summary.assign(told=summary["trial"].map(told or {}).fillna(""))
    found: list[dict[str, Any]] = []
    for _, rows in summary.groupby(list(BLOCK), sort=False, dropna=False):
        rivals = _in_common({trial: groups[trial] for trial in rows.loc[competing(rows), "trial"]})
        best, *others = sorted(
            rivals, key=lambda trial: (-rivals[trial]["success"].mean(), rivals[trial]["total_time_s"].mean())
        )
        alpha = ALPHA / max(len(others), 1)
        compared = [_compare(rivals[best], rivals[other], alpha) for other in others]
        p = [one["best_p_holm"] for one in compared]
        corrected = multipletests(p, ALPHA, method="holm")[1] if p else []
        for other, one, value in zip(others, compared, corrected, strict=True):
            found.append({"trial": other, **one, "best_p_holm": value, "best_alike": bool(value >= ALPHA)})
        left_out = rows.loc[~rows["trial"].isin(list(rivals)), "trial"]
        found += [
            {"trial": best, "best_alike": True},
            *({"trial": one, "best_alike": False} for one in left_out),
        ]
        for entry in found[-len(rows) :]:
            entry |= {"best": best, "best_rivals": len(others), "best_episodes": len(rivals[best])}
    columns = ["trial", "best", "best_rivals", "best_episodes", "best_difference", "best_low", "best_high"]
    columns += ["best_p_holm", "best_shown", "best_alike"]
    table = pd.DataFrame(found).reindex(columns=columns)
    return summary[["trial", "told"]].merge(table, on="trial", how="left", validate="1:1")


def _in_common(trials: Mapping[str, pd.DataFrame]) -> Mapping[str, pd.DataFrame]:
    """Episodes of trials under the luck that all of them met; all of each where there is none."""
    met = [set(rows[_LUCK].itertuples(index=False, name=None)) for rows in trials.values()]
    common = pd.DataFrame(sorted(set.intersection(*met)), columns=_LUCK)
    if common.empty:
        return trials
    return {trial: rows.merge(common, on=_LUCK) for trial, rows in trials.items()}


def _compare(best: pd.DataFrame, other: pd.DataFrame, alpha: float) -> dict[str, float]:
    """Success of the best less that of another; p is not corrected yet."""
    columns = [*_LUCK, "success"]
    both = best[columns].merge(other[columns], on=_LUCK, suffixes=("", "_other"))
    if both.empty:
        return {"best_p_holm": 1.0}  # no map in common: nothing tells them apart
    draws = both.groupby("instance")["success"].transform("size")
    count = int(draws.mode().max())  # as many draws as most episodes have
    both = both[draws == count]
    gain = both["success"].astype(int) - both["success_other"].astype(int)
    by_map = gain.groupby(both["instance"]).sum().to_numpy()
    if len(by_map) < 2:
        return {"best_difference": float(by_map.mean()) / count, "best_p_holm": sign_flip_p(by_map)}
    difference, low, high = (float(value) for value in success_interval(by_map, count))
    shown = smallest_difference(float(np.asarray(standard_deviation(by_map, count))), len(by_map), alpha)
    return {
        "best_difference": difference,
        "best_low": low,
        "best_high": high,
        "best_p_holm": sign_flip_p(by_map),
        "best_shown": shown,
    }
