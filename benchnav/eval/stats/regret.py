"""Regret, split along a chain of conditions that ends at the near-optimal reference.

The chain leads from a planner with a model's prediction to the optimal planner with the
same prediction, then with the models `ideal` and `oracle`, and to the near-optimal
reference, which is given λ itself. The reference's trajectories are feasible, so regret
against it is at most the regret against the minimum time; the table also has the lower
bound of the time, which no trajectory undercuts. Each step is a paired difference. The
steps add up to the total by construction, which does not make them causes: a step may
be negative, and another order of steps would give other values.
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
    """Find complete chains of five conditions.

    Robots that learn during the episode are in no chain: optimal planners plan once.

    Args:
        conditions: entries of `run.json` by id.

    Returns:
        Five ids for each chain: a planner with a model, the optimal planner with it,
        with `ideal` and with `oracle`, and the reference.
    """
    values = {condition: entry["value"] for condition, entry in conditions.items()}

    def like(
        value: Mapping[str, Any], ignored: Sequence[str], **parts: str
    ) -> list[str]:
        """Return conditions with these parts that equal `value` except in some keys."""
        expected = _without(value, ignored)
        matching = []
        for condition, candidate in values.items():
            has_parts = all(candidate[kind]["part"] == parts[kind] for kind in parts)
            if has_parts and _without(candidate, ignored) == expected:
                matching.append(condition)
        return matching

    chains = []
    for condition, value in values.items():
        planner = value["planner"]["part"]
        model = value["model"]["part"]
        blind = conditions[condition]["labels"]["model"] == NOT_USED
        if planner in (OPTIMAL, REFERENCE) or model in PRIVILEGED or blind:
            continue
        references = like(
            value,
            ("planner", "model", "risk"),
            planner=REFERENCE,
            model="clairvoyant",
        )
        # With zero levels, entering a soft spot counts as a loss: no reference.
        references = [
            name
            for name in references
            if values[name]["planner"]["options"].get("levels") != 0
        ]
        for optimal in like(value, ("planner",), planner=OPTIMAL):
            privileged = [
                like(values[optimal], ("model",), model=name) for name in _MODELS
            ]
            if not all(privileged):
                continue
            start = [condition, optimal, *(names[0] for names in privileged)]
            chains += [[*start, reference] for reference in references]
    return chains


def _without(value: Mapping[str, Any], ignored: Sequence[str]) -> dict[str, Any]:
    return {key: part for key, part in value.items() if key not in ignored}


def split_regret(
    conditions: Mapping[str, Mapping[str, Any]],
    episodes: pd.DataFrame,
    worlds: Mapping[str, Mapping[str, Any]],
) -> pd.DataFrame:
    """Tabulate paired differences along each chain, on common episodes.

    Args:
        conditions: entries of `run.json` by id.
        episodes: all rows of the run.
        worlds: world of each condition, by id.

    Returns:
        A row a step of a chain: `chain`, its index from 1; labels of its first
        condition; `against`, the reference; ids, planners and models of the two
        conditions, `one`, `one_planner`, `one_model` and `other…`; `n_maps`, where a
        group counts as one, and `n_episodes`; for `success` and `time` (T_total in
        seconds, a failure counts as T) the means `_one` and `_other`, and their
        `_difference`, one minus other, with its 95 % interval `_low`, `_high`; and
        `_bound`, the best mean that the lower bounds of the time allow, NaN if the
        reference's rows have none.
    """
    rows = dict(list(episodes.groupby("condition", sort=False)))
    steps: list[dict[str, Any]] = []
    for number, chain in enumerate(find_chains(conditions), start=1):
        common = on_common_draws({condition: rows[condition] for condition in chain})
        with_budgets = {}
        for condition, group in common.items():
            budgets = time_budgets(group, worlds[condition])
            with_budgets[condition] = group.assign(time_budget_s=budgets)
        if with_budgets[chain[0]].empty:
            continue
        labels = conditions[chain[0]]["labels"]
        of_chain = {name: labels[name] for name in (*BLOCK, "planner", "model", "risk")}
        bounds = best_possible(with_budgets[chain[-1]])
        for first, second in pairwise(chain):
            paired = side_by_side(
                with_budgets[first],
                with_budgets[second],
                ["success", "total_time_s", "time_budget_s"],
            )
            step = {"chain": number, **of_chain, "against": AGAINST}
            step |= {"one": first, "other": second}
            for side, condition in (("one", first), ("other", second)):
                for kind in ("planner", "model"):
                    step[f"{side}_{kind}"] = conditions[condition]["labels"][kind]
            steps.append({**step, **_differences(paired), **bounds})
    return pd.DataFrame(steps)


def best_possible(rows: pd.DataFrame) -> dict[str, float]:
    """Return the best means of success and T_total that the lower bounds allow.

    Args:
        rows: episodes, with `time_budget_s`.

    Returns:
        `success_bound`, and `time_bound` in seconds; NaN if some episode has no
        `lower_bound_s`.
    """
    bounds = rows.get("lower_bound_s")
    if bounds is None or bounds.isna().any():
        return {"success_bound": float("nan"), "time_bound": float("nan")}
    budgets = rows["time_budget_s"]
    return {
        "success_bound": float((bounds <= budgets).mean()),
        "time_bound": float(bounds.clip(upper=budgets).mean()),
    }


def _differences(paired: pd.DataFrame) -> dict[str, Any]:
    row: dict[str, Any] = {
        "n_maps": paired["group"].nunique(),
        "n_episodes": len(paired),
    }
    for name, column in (("success", "success"), ("time", "total_time_s")):
        row |= {
            f"{name}_one": float(paired[column].mean()),
            f"{name}_other": float(paired[f"{column}_other"].mean()),
        }
        row |= named(name, interval_of(paired, column))
    return row
