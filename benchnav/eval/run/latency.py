"""Planning time per step of a single robot, which a batch does not show.

For each combination of planner, robot, objective, sensors and belief of a run, the
first steps of one episode are run on one thread. The first step is not counted, since
it may compile. Each later step is counted, including any replanning.
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

    The entry of each condition gets `median_ms`, `p95_ms` and `max_ms` over `steps`
    steps. Conditions with the same planner, robot, objective, sensors and belief get
    the same measurement, on the first map of the first such condition. A planner that
    fails has no measurement.

    Args:
        folder: the run folder.
        chosen: ids of the conditions.
        settings: settings of the run.
    """
    run = open_run(folder)
    entries = run.manifest["conditions"]
    latencies: dict[str, Any] = {}
    missing = []
    for condition_id in run.conditions:
        if condition_id not in chosen:
            continue
        entry = entries[condition_id]
        if "latency" in entry:
            latencies[_key(entry)] = entry["latency"]
        else:
            missing.append(condition_id)
    for condition_id in missing:
        entry = entries[condition_id]
        key = _key(entry)
        if key not in latencies:
            condition, extent = run.conditions[condition_id]
            latencies[key] = _measure(condition, extent, settings)
        if latencies[key]:
            entry["latency"] = latencies[key]
    if missing:
        write_run(folder, run.manifest)


def _key(entry: Mapping[str, Any]) -> str:
    names = ("planner", "robot", "objective", *KNOWLEDGE)
    return repr([entry["value"].get(name) for name in names])


def _measure(
    condition: Condition, extent: Extent, settings: Settings
) -> dict[str, Any] | None:
    seed, realisation, _ = extent.draws[0]
    unit = Unit(condition=condition, seed=seed, realisation=realisation, maps=(0,))
    begin_s = 0.0  # time after the first step

    def stop(step: int) -> bool:
        nonlocal begin_s
        if step == 1:
            begin_s = time.perf_counter()
        is_late = step > 2 and time.perf_counter() - begin_s > _MAX_S
        return step > _MAX_STEPS or is_late

    with one_thread():
        try:
            origin = settings.origins().of(unit)
            inputs = build(unit, origin, torch.device(settings.device))
            episodes, _ = simulate(unit, inputs, settings, stop=stop)
        except Exception:  # The rows of the condition report the error.
            return None
    times_ms = 1e3 * episodes.planning_s[1:].numpy()
    if any(episodes.errors) or not len(times_ms):
        return None
    return {
        "median_ms": float(np.percentile(times_ms, 50)),
        "p95_ms": float(np.percentile(times_ms, 95)),
        "max_ms": float(np.percentile(times_ms, 100)),
        "steps": len(times_ms),
    }
