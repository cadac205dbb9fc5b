"""How long a planner takes for one step of one robot, which a batch does not tell.

Of each planner, robot, objective and way of learning of a run one episode is run alone
on one thread, without its end: its first step prepares and perhaps compiles, and is not
counted; each later one is, with whatever the planner plans anew in it.
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

_MOST_STEPS = 100
_MOST_S = 3.0


def measure_latencies(
    folder: Path, chosen: Collection[str], settings: Settings
) -> None:
    """Measures the planners of some conditions and writes it into `run.json`, where it
    is not there yet.

    What is written by condition: `median_ms`, `p95_ms` and `max_ms` over `steps` steps.
    Conditions of one planner, robot, objective and way of learning share one
    measurement, on the first map of the first of them. A planner that fails has none.

    Args:
        folder: the run folder.
        chosen: ids of the conditions.
        settings: how planners are run.
    """
    run = open_run(folder)
    entries = run.about["conditions"]
    own = [i for i in run.conditions if i in chosen]
    known = {
        _key(entries[i]): entries[i]["latency"] for i in own if "latency" in entries[i]
    }
    missing = [i for i in own if "latency" not in entries[i]]
    for condition_id in missing:
        entry = entries[condition_id]
        if _key(entry) not in known:
            known[_key(entry)] = _measure(*run.conditions[condition_id], settings)
        if latency := known[_key(entry)]:
            entry["latency"] = latency
    if missing:
        write_run(folder, run.about)


def _key(entry: Mapping[str, Any]) -> str:
    return repr(
        [
            entry["value"].get(name)
            for name in ("planner", "robot", "objective", *KNOWLEDGE)
        ]
    )


def _measure(
    condition: Condition, extent: Extent, settings: Settings
) -> dict[str, Any] | None:
    seed, realisation, _ = extent.draws[0]
    unit = Unit(condition=condition, seed=seed, realisation=realisation, maps=(0,))
    warm: list[float] = []

    def enough(step: int) -> bool:
        if step == 1:
            warm.append(time.perf_counter())
        return step > _MOST_STEPS or (
            step > 2 and time.perf_counter() - warm[0] > _MOST_S
        )

    with one_thread():
        try:
            built = build(
                unit, settings.origins().of(unit), torch.device(settings.device)
            )
            episodes, _ = simulate(unit, built, settings, enough=enough)
        except Exception:  # what failed has failed its episodes too, which say how
            return None
    counted = 1e3 * episodes.planning_s[1:].numpy()
    if any(episodes.errors) or not len(counted):
        return None
    median, high, most = (
        float(np.percentile(counted, share)) for share in (50, 95, 100)
    )
    return {"median_ms": median, "p95_ms": high, "max_ms": most, "steps": len(counted)}
