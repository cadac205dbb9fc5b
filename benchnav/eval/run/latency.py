"""Planning time of one step of one robot, which a batch does not show.

For each planner, robot, objective and way of learning of a run, one episode is run on
one thread, without its end. The first step prepares and may compile, and is not
counted; each later step is, including whatever the planner replans in it.
"""

import time
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchnav.eval.experiment.condition import KNOWLEDGE, Condition
from benchnav.eval.experiment.unit import Extent, Unit
from benchnav.eval.folder.run_folder import open_run, write_run
from benchnav.eval.run.unit import Settings, build, one_thread, simulate

_MAX_STEPS = 100
_MAX_S = 3.0


def measure_latencies(
    folder: Path, chosen: Collection[str], settings: Settings
) -> None:
    """Measure planning times of conditions, and write missing ones into `run.json`.

    Each condition gets `median_ms`, `p95_ms` and `max_ms` over `steps` steps.
    Conditions of one planner, robot, objective and way of learning share one
    measurement, on the first map of the first of them. A planner that fails gets none.

    Args:
        folder: the run folder.
        chosen: ids of the conditions.
        settings: settings of the run.
    """
    run = open_run(folder)
    entries = run.about["conditions"]
    chosen_ids = [i for i in run.conditions if i in chosen]
    latencies: dict[str, Any] = {}
    for i in chosen_ids:
        if "latency" in entries[i]:
            latencies[_key(entries[i])] = entries[i]["latency"]
    missing = [i for i in chosen_ids if "latency" not in entries[i]]
    for condition_id in missing:
        entry = entries[condition_id]
        key = _key(entry)
        if key not in latencies:
            latencies[key] = _measure(*run.conditions[condition_id], settings)
        if latencies[key]:
            entry["latency"] = latencies[key]
    if missing:
        write_run(folder, run.about)


def _key(entry: Mapping[str, Any]) -> str:
    names = ("planner", "robot", "objective", *KNOWLEDGE)
    return repr([entry["value"].get(name) for name in names])


def _measure(
    condition: Condition, extent: Extent, settings: Settings
) -> dict[str, Any] | None:
    seed, realisation, _ = extent.draws[0]
    unit = Unit(condition=condition, seed=seed, realisation=realisation, maps=(0,))
    warm: list[float] = []

    def stop(step: int) -> bool:
        if step == 1:
            warm.append(time.perf_counter())
        return step > _MAX_STEPS or (
            step > 2 and time.perf_counter() - warm[0] > _MAX_S
        )

    with one_thread():
        try:
            origin = settings.origins().of(unit)
            built = build(unit, origin, torch.device(settings.device))
            episodes, _ = simulate(unit, built, settings, stop=stop)
        except Exception:  # The condition's rows report the fault.
            return None
    counted = 1e3 * episodes.planning_s[1:].numpy()
    if any(episodes.errors) or not len(counted):
        return None
    median_ms, p95_ms, max_ms = (
        float(np.percentile(counted, percentile)) for percentile in (50, 95, 100)
    )
    return {
        "median_ms": median_ms,
        "p95_ms": p95_ms,
        "max_ms": max_ms,
        "steps": len(counted),
    }
