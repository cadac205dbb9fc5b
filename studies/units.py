"""One unit of a suite, built and run in this process: what scripts of studies ask of problems and episodes."""

from pathlib import Path
from typing import Any

import numpy as np

from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent, Unit, units
from benchnav.eval.run.rollout import Episodes
from benchnav.eval.run.unit import Built, Settings, build, simulate
from benchnav.planning.world.outcome import Outcome

# What suites of the studies in the world `stakes` have in common.
STAKES: dict[str, Any] = {
    "objectives": ("travel_time",), "scenarios": ("std",), "record": "none", "world": ("stakes",), "seeds": (1,),
}  # fmt: skip


def stakes_suite(data: Path, **options: Any) -> Suite:
    """Return a suite in the world `stakes`, or in another that is named."""
    return Suite(data=str(data), **STAKES | options)


def one_unit(suite: Suite, maps: int) -> Unit:
    """Return the unit of the first maps of a suite's first condition."""
    condition = conditions_of(suite, lambda data: ["std"])[0]
    return units({condition.id: (condition, Extent.product(suite.seeds or (0,), 1, maps))})[0]


def build_unit(unit: Unit) -> Built:
    """Return the problem and the simulation of a unit."""
    return build(unit, Settings().origins().of(unit))


def seconds_of(episodes: Episodes, dt_s: float) -> np.ndarray:
    """Return seconds to the goal, infinite if it was not reached, shape [B]."""
    has_arrived = (episodes.outcome == Outcome.SUCCESS).numpy()
    return np.where(has_arrived, episodes.steps.double().numpy() * dt_s, np.inf)


def drive_unit(unit: Unit) -> tuple[np.ndarray, Built]:
    """Return seconds to the goal, infinite if it was not reached, shape [B], and what was driven."""
    built = build_unit(unit)
    episodes, _ = simulate(unit, built, Settings())
    return seconds_of(episodes, built.problem.dt_s), built
