"""How long a planner takes for one step of one robot, which a batch does not tell.

Of each planner, robot and objective of a run one episode is run alone on one thread, without its end: its first step
prepares and perhaps compiles, and is not counted; each later one is, with whatever the planner plans anew in it.
"""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.unit import Extent, Unit
from benchnav.eval.run.episode import build, one_thread, simulate

_MOST_STEPS = 100
_MOST_S = 3.0

_FACTORS = ("planner", "robot", "objective")


def measure_latencies(
    conditions: Mapping[str, tuple[Condition, Extent]],
    known: Mapping[str, Mapping[str, Any]],
    run_id: str,
    planner_limit_s: float,
    device: str,
) -> dict[str, dict[str, Any]]:
    """Measures what was not measured.

    Args:
        conditions: by id.
        known: latencies by condition, as this gives them.
        run_id: predictions are kept for one run alone.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        device: where all is computed.

    Returns:
        By condition, of those that were measured: `median_ms`, `p95_ms` and `max_ms` over `steps` steps. Conditions of
        one planner, robot and objective share one measurement, on the first map of the first of them. A planner that
        fails has none.
    """
    found: dict[str, Any] = {_key(conditions[i][0]): about for i, about in known.items() if i in conditions}
    for condition, extent in conditions.values():
        if _key(condition) not in found:
            found[_key(condition)] = _measure(
                condition, extent, run_id, planner_limit_s, torch.device(device)
            )
    every = {condition_id: found[_key(condition)] for condition_id, (condition, _) in conditions.items()}
    return {condition_id: about for condition_id, about in every.items() if about}


def _key(condition: Condition) -> str:
    value = condition.value
    return repr([value[name] for name in _FACTORS])


def _measure(
    condition: Condition, extent: Extent, run_id: str, planner_limit_s: float, device: torch.device
) -> dict[str, Any] | None:
    seed, realisation, _ = extent.draws[0]
    unit = Unit(condition=condition, seed=seed, realisation=realisation, maps=(0,))
    warm: list[float] = []

    def enough(step: int) -> bool:
        if step == 1:
            warm.append(time.perf_counter())
        return step > _MOST_STEPS or (step > 2 and time.perf_counter() - warm[0] > _MOST_S)

    with one_thread():
        try:
            problem, simulation = build(unit, run_id, device)
            episodes, _ = simulate(unit, problem, simulation, None, 1, planner_limit_s, enough=enough)
        except Exception:  # what failed has failed its episodes too, which say how
            return None
    counted = 1e3 * episodes.planning_s[1:].numpy()
    if any(episodes.errors) or not len(counted):
        return None
    median, high, most = (float(np.percentile(counted, share)) for share in (50, 95, 100))
    return {"median_ms": median, "p95_ms": high, "max_ms": most, "steps": len(counted)}
