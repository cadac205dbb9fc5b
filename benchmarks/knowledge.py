"""What it costs to learn while driving: episodes with the belief `copula` next to the
same ones without.

    python -m benchmarks.knowledge

50 episodes on maps of `stakes-v1-test` in the world `stakes`, A*+DWA, the oracle under
expected-time, one thread. A row has the processor's time of a second of driving of an
episode, its ratio to `static` in the same turn, and how much of
it is learning and planning: medians of three turns. `copula` is given λ within 1 m and
may replan each 0.5 s. Another table has the milliseconds of an update of one episode,
on the first and the last 4 m of 24 m: they grow with the cells that a probe reaches,
and not with the path. Some two minutes.
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
from benchnav.eval.run.unit import Built, Settings, simulate
from benchnav.planning import Copula, Law, Moment, Probe
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


def drive(unit: Unit, built: Built, steps: int = STEPS) -> dict[str, float]:
    """Return milliseconds of a second of driving of an episode, and which fractions are
    learning and planning.
    """
    start, began = time.process_time(), time.perf_counter()
    found, _ = simulate(unit, built, Settings(), enough=lambda step: step == steps)
    took, waited = time.process_time() - start, time.perf_counter() - began
    return {
        "ms a second driven": 1e3
        * took
        / (built.problem.dt_s * int(found.steps.sum())),
        "learning": found.learning_s / waited,
        "planning": float(found.planning_s.sum()) / waited,
    }


def drives() -> list[dict[str, Any]]:
    """Return the rows of the first table."""
    made = {}
    for name, options in BELIEFS.items():
        unit = one_unit(
            stakes_suite(Path("stakes-v1-test"), **LEARNS, **options), EPISODES
        )
        made[name] = unit, build_unit(unit)
        drive(*made[name], steps=10)  # compiles, and loads what is loaded once
    turns = []
    for _ in range(TURNS):
        turn = {name: drive(*own) for name, own in made.items()}
        static = turn["static"]["ms a second driven"]
        turns += [
            {"belief": name, **own, "times static": own["ms a second driven"] / static}
            for name, own in turn.items()
        ]
    medians = pd.DataFrame(turns).groupby("belief", sort=False).median().reset_index()
    return medians.to_dict("records")


def update(resolution_m: float, radius_m: float) -> dict[str, Any]:
    """Return milliseconds of an update on the first and the last 4 m of 24 m, and how
    many cells were sensed.
    """
    height, width = round(12 / resolution_m), round(28 / resolution_m)
    law = Law(grid=Grid(height, width, resolution_m), correlation_m=1.5)
    parameters = (
        torch.tensor(pair).view(1, 2, 1, 1).expand(1, 2, height, width)
        for pair in ((0.1, 0.9), (0.05, 0.7), (0.1, 0.1))
    )
    prior = TraversabilityMixture(*(values.contiguous() for values in parameters))
    field = prior.from_normal(draw_scores(law, 1, (0,))[:, 0].float())
    flat = torch.zeros(1, height, width)
    terrain = Terrain(
        rgb=torch.zeros(1, 3, height, width, dtype=torch.uint8),
        class_id=flat.long(),
        elevation_m=flat,
        slope_deg=flat,
        truth=prior,
        traversability=field,
        grid=law.grid,
    )
    belief, times = Copula(), []
    state = belief.init(prior, law)
    for number in range(49):
        pose = torch.tensor([[2 + 0.5 * number, 6.0, 0.0]])
        sensed = Probe(radius_m).sense(terrain, field, pose, Moment((0,), number))
        start = time.process_time()
        state = belief.update(state, sensed)
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
