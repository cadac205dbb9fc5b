"""Regret, split along a chain of conditions that ends at the near-optimal reference.

The chain starts at a planner with a model's prediction. The next conditions are the
optimal planner with the same prediction, with the model `ideal` and with the model
`oracle`. The last is the near-optimal reference, which is given λ itself. The
reference's trajectories are feasible, so that the regret against the reference is at
most the regret against the minimum time. The table also has a lower bound of the time
of all trajectories.

Each step of the chain is a paired difference. By construction, the steps add up to the
total. They are not causes: a step may be negative, and another order of steps would
give other values.
"""

import math
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

    A chain has no robots that learn during the episode, since optimal planners plan
    only once.

    Args:
        conditions: entries of `run.json` by id.

    Returns:
        Five ids for each chain: a planner with a model; the optimal planner with this
        model, with `ideal` and with `oracle`; and the near-optimal reference.
    """
    values = {condition: entry["value"] for condition, entry in conditions.items()}
    chains = []
    for condition, value in values.items():
        planner = value["planner"]["part"]
        model = value["model"]["part"]
        is_blind = conditions[condition]["labels"]["model"] == NOT_USED
        if planner in (OPTIMAL, REFERENCE) or model in PRIVILEGED or is_blind:
            continue
        references = _references(values, value)
        for optimal in _alike(values, value, ("planner",), planner=OPTIMAL):
            privileged = []
            for name in _MODELS:
                privileged += _alike(values, values[optimal], ("model",), model=name)[
                    :1
                ]
            if len(privileged) < len(_MODELS):
                continue
            for reference in references:
                chains.append([condition, optimal, *privileged, reference])
    return chains


def _references(
    values: Mapping[str, Mapping[str, Any]], value: Mapping[str, Any]
) -> list[str]:
    """Return the conditions that are references for a condition, given its value."""
    parts = {"planner": REFERENCE, "model": "clairvoyant"}
    references = []
    for condition in _alike(values, value, ("planner", "model", "risk"), **parts):
        options = values[condition]["planner"]["options"]
        # With zero levels, the planner rejects paths over soft spots: no reference.
        if options.get("levels") != 0:
            references.append(condition)
    return references


def _alike(
    values: Mapping[str, Mapping[str, Any]],
    value: Mapping[str, Any],
    ignored: Sequence[str],
    **parts: str,
) -> list[str]:
    """Return the conditions with given parts whose other settings equal a value.

    Args:
        values: values of all conditions by id.
        value: value that is compared.
        ignored: keys in which a condition may differ from `value`.
        **parts: required parts by kind.
    """
    expected = _without(value, ignored)
    matching = []
    for condition, candidate in values.items():
        has_parts = all(candidate[kind]["part"] == parts[kind] for kind in parts)
        if has_parts and _without(candidate, ignored) == expected:
            matching.append(condition)
    return matching


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
        One row per step of a chain, with these columns:

        - `chain`, the index of the chain from 1; labels of the chain's first condition;
          `against`, the name of the reference.
        - id, planner and model of the two conditions of the step: `one`, `one_planner`,
          `one_model`, `other`, `other_planner`, `other_model`.
        - `n_maps`, the number of maps, or of groups of maps; `n_episodes`.
        - for `success` and `time` (T_total in seconds; a failure counts as T): the
          means `…_one` and `…_other`; `…_difference` (one minus other), with the
          limits `…_low` and `…_high` of its 95 % interval; and `…_bound`, the best mean
          that the lower bounds of the time allow, NaN if the rows of the reference have
          no bounds.
    """
    rows = dict(list(episodes.groupby("condition", sort=False)))
    steps: list[dict[str, Any]] = []
    for index, chain in enumerate(find_chains(conditions), start=1):
        common = on_common_draws({condition: rows[condition] for condition in chain})
        with_budgets = {}
        for condition, group in common.items():
            budgets = time_budgets(group, worlds[condition])
            with_budgets[condition] = group.assign(time_budget_s=budgets)
        if with_budgets[chain[0]].empty:
            continue
        labels = conditions[chain[0]]["labels"]
        chain_labels = {
            name: labels[name] for name in (*BLOCK, "planner", "model", "risk")
        }
        bounds = best_possible(with_budgets[chain[-1]])
        for first, second in pairwise(chain):
            paired = side_by_side(
                with_budgets[first],
                with_budgets[second],
                ["success", "total_time_s", "time_budget_s"],
            )
            step = {"chain": index, **chain_labels, "against": AGAINST}
            sides = {"one": first, "other": second}
            step |= sides
            for side, condition in sides.items():
                side_labels = conditions[condition]["labels"]
                step[f"{side}_planner"] = side_labels["planner"]
                step[f"{side}_model"] = side_labels["model"]
            steps.append({**step, **_differences(paired), **bounds})
    return pd.DataFrame(steps)


def best_possible(rows: pd.DataFrame) -> dict[str, float]:
    """Return the best means of success and T_total that the lower bounds allow.

    Args:
        rows: rows of episodes, with the time budget T in the column `time_budget_s`.

    Returns:
        `success_bound`, and `time_bound` in seconds; NaN if any episode has no
        `lower_bound_s`.
    """
    bounds_s = rows.get("lower_bound_s")
    if bounds_s is None or bounds_s.isna().any():
        return {"success_bound": math.nan, "time_bound": math.nan}
    budgets_s = rows["time_budget_s"]
    is_reachable = bounds_s <= budgets_s
    times_s = bounds_s.clip(upper=budgets_s)
    return {
        "success_bound": float(is_reachable.mean()),
        "time_bound": float(times_s.mean()),
    }


def _differences(paired: pd.DataFrame) -> dict[str, Any]:
    row: dict[str, Any] = {
        "n_maps": paired["group"].nunique(),
        "n_episodes": len(paired),
    }
    for name, column in (("success", "success"), ("time", "total_time_s")):
        row[f"{name}_one"] = float(paired[column].mean())
        row[f"{name}_other"] = float(paired[f"{column}_other"].mean())
        row |= named(name, interval_of(paired, column))
    return row
