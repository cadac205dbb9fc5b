"""Regret, split along a chain of conditions that ends at the near-optimal reference.

From a planner with a model's prediction to the optimal planner with the same
prediction, with that of ideal eyes (`ideal`), with the true distribution (`oracle`),
and to the near-optimal reference, which is given λ itself. What that drives is
feasible, so regret against it is at most that against the least time; the lower bound
of the time, which no trajectory undercuts, is given with it. Each step is a paired
difference of its own. They add up to the whole by construction, which does not make
them causes: a step may be negative, and another order of steps would give others.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import pandas as pd

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.stats.best import BLOCK, PRIVILEGED
from benchnav.eval.stats.comparison import named
from benchnav.eval.stats.pairs import on_common_draws, side_by_side
from benchnav.eval.stats.summary import time_budgets
from benchnav.stats.episodes import interval_of

AGAINST = "near-optimal reference"
OPTIMAL = "optimal"
REFERENCE = "near_optimal"
_MODELS = ("ideal", "oracle")


def find_chains(conditions: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Finds chains of which all five conditions are there.

    Robots that learn on their way are in none: the optimal planners plan once.

    Args:
        conditions: by id what `run.json` knows of them.

    Returns:
        Of each chain its conditions, by id: a planner with a model, the optimal planner
        with it, with `ideal` and with `oracle`, and the reference.
    """
    values = {condition: about["value"] for condition, about in conditions.items()}

    def like(value: Mapping[str, Any], but: Sequence[str], **parts: str) -> list[str]:
        """Conditions that are as one is but for some keys, with these parts."""
        kept = {key: own for key, own in value.items() if key not in but}
        return [
            other
            for other, own in values.items()
            if {key: one for key, one in own.items() if key not in but} == kept
            and all(own[kind]["part"] == part for kind, part in parts.items())
        ]

    chains = []
    for condition, value in values.items():
        planner, model = value["planner"]["part"], value["model"]["part"]
        blind = conditions[condition]["labels"]["model"] == NOT_USED
        if planner in (OPTIMAL, REFERENCE) or model in PRIVILEGED or blind:
            continue
        references = [
            other
            for other in like(
                value,
                ("planner", "model", "risk"),
                planner=REFERENCE,
                model="clairvoyant",
            )
            if values[other]["planner"]["options"].get("levels")
            != 0  # where entry is loss it is no reference
        ]
        for optimal in like(value, ("planner",), planner=OPTIMAL):
            told = [like(values[optimal], ("model",), model=one) for one in _MODELS]
            if all(told):
                chains += [
                    [condition, optimal, *(found[0] for found in told), last]
                    for last in references
                ]
    return chains


def split_regret(
    conditions: Mapping[str, Mapping[str, Any]],
    episodes: pd.DataFrame,
    worlds: Mapping[str, Mapping[str, Any]],
) -> pd.DataFrame:
    """Paired differences along each chain, on the episodes that all five of its
    conditions have in common.

    Args:
        conditions: by id what `run.json` knows of them.
        episodes: all rows of the run.
        worlds: by condition what λ did.

    Returns:
        A row a step of a chain: `chain`, its number; labels of what it begins with;
        `against`, the end that regret is against; ids, planners and models of the
        two conditions, `one`, `one_planner`, `one_model` and `other…`; `n_maps`, of
        which a group counts as one, and `n_episodes`; of `success` and of `time`,
        T_total in seconds, a failure counted as T: the means `_one` and `_other`, and
        the `_difference` of one less other with its 95 % interval `_low`, `_high`; and
        `_bound`, the best mean that the lower bounds of the time allow, NaN where the
        reference's rows have none.
    """
    rows = dict(list(episodes.groupby("condition", sort=False)))
    made: list[dict[str, Any]] = []
    for number, chain in enumerate(find_chains(conditions), start=1):
        common = on_common_draws({condition: rows[condition] for condition in chain})
        own = {
            condition: found.assign(
                time_budget_s=time_budgets(found, worlds[condition])
            )
            for condition, found in common.items()
        }
        if own[chain[0]].empty:
            continue
        labels = conditions[chain[0]]["labels"]
        about = {name: labels[name] for name in (*BLOCK, "planner", "model", "risk")}
        bounds = best_possible(own[chain[-1]])
        for one, other in pairwise(chain):
            both = side_by_side(
                own[one], own[other], ["success", "total_time_s", "time_budget_s"]
            )
            made.append(
                {
                    "chain": number,
                    **about,
                    "against": AGAINST,
                    "one": one,
                    "other": other,
                    **{
                        f"{end}_{kind}": conditions[condition]["labels"][kind]
                        for end, condition in (("one", one), ("other", other))
                        for kind in ("planner", "model")
                    },
                    **_differences(both),
                    **bounds,
                }
            )
    return pd.DataFrame(made)


def best_possible(rows: pd.DataFrame) -> dict[str, float]:
    """The best means that the lower bounds of the time allow: `success_bound`, and
    `time_bound` in seconds of T_total.

    Args:
        rows: episodes, with `time_budget_s`; NaN where some have no `lower_bound_s`.
    """
    least = rows.get("lower_bound_s")
    if least is None or least.isna().any():
        return {"success_bound": float("nan"), "time_bound": float("nan")}
    limit = rows["time_budget_s"]
    return {
        "success_bound": float((least <= limit).mean()),
        "time_bound": float(least.clip(upper=limit).mean()),
    }


def _differences(both: pd.DataFrame) -> dict[str, Any]:
    row: dict[str, Any] = {"n_maps": both["group"].nunique(), "n_episodes": len(both)}
    for name, column in (("success", "success"), ("time", "total_time_s")):
        row |= {
            f"{name}_one": float(both[column].mean()),
            f"{name}_other": float(both[f"{column}_other"].mean()),
        }
        row |= named(name, interval_of(both, column))
    return row
