"""How long a planner takes for one step of one robot, which a batch does not tell.

Of each planner, robot and objective of a run one episode is run alone on one thread, without its end: its first step
prepares and perhaps compiles, and is not counted; each later one is, with whatever the planner plans anew in it.
"""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from benchnav.eval.run.episode import build, one_thread, simulate
from benchnav.eval.trial import Trial
from benchnav.eval.unit import Extent, Unit

_MOST_STEPS = 100
_MOST_S = 3.0

_FACTORS = ("planner", "robot", "objective")


def measure_latencies(
    trials: Mapping[str, tuple[Trial, Extent]],
    known: Mapping[str, Mapping[str, Any]],
    run_id: str,
    planner_limit_s: float,
    device: str,
) -> dict[str, dict[str, Any]]:
    """Measures what was not measured.

    Args:
        trials: by id.
        known: latencies by trial, as this gives them.
        run_id: predictions are kept for one run alone.
        planner_limit_s: time limit of each call of a planner; 0 for none.
        device: where all is computed.

    Returns:
        By trial, of those that were measured: `median_ms`, `p95_ms` and `max_ms` over `steps` steps. Trials of one
        planner, robot and objective share one measurement, on the first map of the first of them. A planner that
        fails has none.
    """
    found: dict[str, Any] = {_key(trials[i][0]): about for i, about in known.items() if i in trials}
    for trial, extent in trials.values():
        if _key(trial) not in found:
            found[_key(trial)] = _measure(trial, extent, run_id, planner_limit_s, torch.device(device))
    every = {trial_id: found[_key(trial)] for trial_id, (trial, _) in trials.items()}
    return {trial_id: about for trial_id, about in every.items() if about}


def _key(trial: Trial) -> str:
    value = trial.value
    return repr([value[name] for name in _FACTORS])


def _measure(
    trial: Trial, extent: Extent, run_id: str, planner_limit_s: float, device: torch.device
) -> dict[str, Any] | None:
    seed, realisation, _ = extent.draws[0]
    unit = Unit(trial=trial, seed=seed, realisation=realisation, instances=(0,))
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
