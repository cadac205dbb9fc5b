"""Time of learning online: episodes with the belief `copula` compared with `static`.

    python -m benchmarks.knowledge

50 episodes run on maps of `stakes-v1-test` in the world `stakes`, with A*+DWA and the
oracle under `expected-time`, on one thread. A row has the CPU time per simulated second
of an episode, its ratio to `static` in the same turn, and the fractions for learning
and planning; all are medians of three turns. `copula` observes λ within 1 m and may
replan every 0.5 s.

A second table has the time of an update in one episode, on the first and the last 4 m
of a path of 24 m. It grows with the footprint of the probe, but not with the path. Both
tables take about two minutes.
"""

import time
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd
import torch

from benchmarks.timing import show
from benchnav import Grid, Terrain, TraversabilityMixture
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.unit import Settings, UnitInputs, simulate
from benchnav.planning import Copula, CovarianceModel, NoiseKey, Probe
from benchnav.planning.sensing.belief import draw_scores
from studies.units import build_unit, one_unit, stakes_suite

EPISODES, STEPS, TURNS = 50, 100, 3  # steps of 0.1 s
LEARNS: dict[str, Any] = {
    "planners": ("astar_dwa",),
    "models": ("oracle",),
    "risks": ("expected-time",),
}
ESTIMATED = {
    "part": "copula",
    "label": "copula, estimated ℓ",
    "options": {"correlation_m": "estimated"},
}
BELIEFS: dict[str, dict[str, Any]] = {
    "static": {"beliefs": ("static",)},
    "copula": {"beliefs": ("copula",), "grounds": ("probe:1",)},
    "copula, estimated ℓ": {"beliefs": (ESTIMATED,), "grounds": ("probe:1",)},
}


def drive(unit: Unit, built: UnitInputs, steps: int = STEPS) -> dict[str, float]:
    """Return CPU milliseconds per simulated second, and fractions of learning, planning."""
    cpu_start_s, start_s = time.process_time(), time.perf_counter()
    episodes, _ = simulate(unit, built, Settings(), stop=lambda step: step == steps)
    cpu_s, elapsed_s = time.process_time() - cpu_start_s, time.perf_counter() - start_s
    driven_s = built.problem.dt_s * int(episodes.steps.sum())
    return {
        "ms a second driven": 1e3 * cpu_s / driven_s,
        "learning": episodes.learning_s / elapsed_s,
        "planning": float(episodes.planning_s.sum()) / elapsed_s,
    }


def drives() -> list[dict[str, Any]]:
    """Return the rows of the first table."""
    built_units = {}
    for name, options in BELIEFS.items():
        unit = one_unit(
            stakes_suite(Path("stakes-v1-test"), **LEARNS, **options), EPISODES
        )
        built_units[name] = unit, build_unit(unit)
        drive(*built_units[name], steps=10)  # warm up: compile and load
    turns = []
    for _ in range(TURNS):
        turn = {name: drive(*built_unit) for name, built_unit in built_units.items()}
        static = turn["static"]["ms a second driven"]
        turns += [
            {
                "belief": name,
                **measured,
                "times static": measured["ms a second driven"] / static,
            }
            for name, measured in turn.items()
        ]
    medians = pd.DataFrame(turns).groupby("belief", sort=False).median().reset_index()
    return medians.to_dict("records")


def update(resolution_m: float, radius_m: float) -> dict[str, Any]:
    """Return the time of an update on the first and last 4 m of 24 m, and the footprint.

    Args:
        resolution_m: size of a cell in metres.
        radius_m: radius of the probe in metres.
    """
    height, width = round(12 / resolution_m), round(28 / resolution_m)
    covariance = CovarianceModel(
        grid=Grid(height, width, resolution_m), correlation_m=1.5
    )
    parameters = (
        torch.tensor(pair).view(1, 2, 1, 1).expand(1, 2, height, width)
        for pair in ((0.1, 0.9), (0.05, 0.7), (0.1, 0.1))
    )
    prior = TraversabilityMixture(*(values.contiguous() for values in parameters))
    field = prior.from_normal(draw_scores(covariance, 1, (0,))[:, 0].float())
    flat = torch.zeros(1, height, width)
    terrain = Terrain(
        rgb=torch.zeros(1, 3, height, width, dtype=torch.uint8),
        class_id=flat.long(),
        elevation_m=flat,
        slope_deg=flat,
        truth=prior,
        traversability=field,
        grid=covariance.grid,
    )
    belief, times = Copula(), []
    state = belief.init(prior, covariance)
    for index in range(49):
        pose = torch.tensor([[2 + 0.5 * index, 6.0, 0.0]])
        measurement = Probe(radius_m).sense(terrain, field, pose, NoiseKey((0,), index))
        start = time.process_time()
        state = belief.update(state, measurement)
        times.append(1e3 * (time.process_time() - start))
    return {
        "cells": f"{resolution_m:g} m",
        "probe": f"{radius_m:g} m",
        "sensed in 24 m": int(state.observed.sum()),
        "ms an update, first 4 m": median(times[1:9]),
        "last 4 m": median(times[-8:]),
    }


def main() -> None:
    """Print both tables."""
    torch.set_num_threads(1)
    show(drives())
    show([update(*sizes) for sizes in product((0.5, 0.25), (1.0, 2.0, 4.0))])


if __name__ == "__main__":
    main()
