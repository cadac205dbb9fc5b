"""What robots learn while they drive, and the problem that their planner is given of it.

At each step the sensor says what is learnt of the ground. Now and then the belief is updated with it; where λ̂ has
changed for it, the planner goes on under the new map. Letters in shapes: B episodes, S state dimensions, H×W cells.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from benchnav.core.device import GPU_FAULTS
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import BenchnavError, ConfigError, expect
from benchnav.core.settings import fault
from benchnav.core.terrain import Terrain
from benchnav.planning import risk
from benchnav.planning.free_space import cells_at_goal
from benchnav.planning.planners.boundary import find_tensor_fault
from benchnav.planning.problem import Problem
from benchnav.planning.robots import steps_in
from benchnav.planning.sensing.belief import Belief, Law
from benchnav.planning.sensing.sensor import Moment, Sensed, Sensor
from benchnav.planning.world.outcome import Outcome

_LEAST_CHANGE = 0.02  # of λ̂ somewhere on a map, for which its planner is told

Result = TypeVar("Result")


class KnowledgeError(BenchnavError):
    """A sensor, a belief or a risk measure raised on the way; the cause says what."""

    def __init__(self, message: str, outcome: Outcome) -> None:
        """Keeps how the episodes end for it."""
        super().__init__(message)
        self.outcome = outcome


@dataclass(frozen=True, kw_only=True)
class Learning:
    """How the robots of a batch learn.

    Args:
        ground: the sensor.
        belief: what is made of what is sensed.
        law: how λ hangs together.
        measure: the risk measure that gives λ̂.
        terrain: the truth, B maps, for the sensor alone.
        field: λ of every cell in the episodes, for the sensor alone, shape [B, H, W].
        keys: a stream key of each episode for the sensor's noise, B of them.
        replan_every_s: time between two updates of the belief.
    """

    ground: Sensor
    belief: Belief[Any]
    law: Law
    measure: risk.RiskMeasure
    terrain: Terrain
    field: Tensor
    keys: Sequence[int]
    replan_every_s: float = 0.5

    def __post_init__(self) -> None:
        """Refuses times that never come."""
        expect(
            0 < self.replan_every_s < float("inf"),
            f"`replan_every_s` > 0 and finite, got {self.replan_every_s}.",
        )


class Knowledge:
    """What the robots of a batch know, from the first step to the last.

    Args:
        how: they learn.
        problem: what is known when they set out.

    Attributes:
        revisions: how often each episode's map was changed, int64, shape [B].
    """

    def __init__(self, how: Learning, problem: Problem) -> None:
        """Knows the prediction alone."""
        self._how, self._problem = how, problem
        self._terrain, self._field, self._keys = how.terrain, how.field, list(how.keys)
        self._every = steps_in(how.replan_every_s, problem.dt_s)
        self._at_goal = cells_at_goal(problem.grid, problem.goal_m, problem.goal_radius_m)
        # What is known by now; the planner is told where it differs enough from the problem that it has.
        self._risk_map, self._free = problem.risk_map, problem.free
        self._members = torch.arange(len(problem), device=problem.start.device)
        self.revisions = torch.zeros_like(self._members)
        self._state = _call(
            Outcome.BELIEF_ERROR, lambda: how.belief.init(problem.distribution.clone(), how.law)
        )
        self._sensed = self._nothing()

    def keep(self, left: Tensor) -> None:
        """Forgets all episodes but some, by their places among those that are left, int64."""
        self._state = _call(Outcome.BELIEF_ERROR, lambda: self._how.belief.select(self._state, left))
        self._problem, self._terrain = self._problem.select(left), self._terrain.select(left)
        self._keys = [self._keys[place] for place in left.tolist()]
        self._sensed = self._sensed.select(left)
        for name in ("_field", "_at_goal", "_risk_map", "_free", "_members"):
            setattr(self, name, getattr(self, name)[left])

    def learn(self, step: int, robot_state: Tensor, running: Tensor) -> Problem | None:
        """Senses, and updates the belief where that is due.

        Args:
            step: steps taken so far.
            robot_state: where the robots are that are left, a copy, shape [B, S].
            running: which of these episodes go on, bool, shape [B].

        Returns:
            The problem as it now is, which starts where the robots are; None where the planner need not be told.

        Raises:
            KnowledgeError: the sensor, the belief or the risk measure raised, or gave what is none.
        """
        self._sense(step, robot_state)
        if step % self._every or not bool(self._sensed.mask.any()):
            return None
        how, before = self._how, self._state
        self._state = _call(Outcome.BELIEF_ERROR, lambda: how.belief.update(before, self._sensed))
        self._sensed = self._nothing()
        changed = _call(
            Outcome.BELIEF_ERROR, lambda: self._checked_cells(how.belief.changed(before, self._state))
        )
        if not bool(changed.any()):
            return None
        self._infer(changed)
        return self._told(robot_state, running)

    def _sense(self, step: int, robot_state: Tensor) -> None:
        """Adds what is sensed to what was since the last update; of two looks at a cell the later counts."""
        moment = Moment(self._keys, step)

        def look() -> Sensed:
            given = self._terrain.clone(), self._field.clone(), robot_state, moment
            return self._checked(self._how.ground.sense(*given))

        new = _call(Outcome.SENSOR_ERROR, look)
        kept, mask = self._sensed, new.mask
        self._sensed = Sensed(
            traversability=torch.where(mask, new.traversability, kept.traversability),
            std=torch.where(mask, new.std, kept.std),
        )

    def _infer(self, changed: Tensor) -> None:
        """Tells λ̂ and what is free of the cells of which something else is believed."""
        how, rules = self._how, self._problem.task.rules
        wanted = (1, int(changed.sum()))

        def believe() -> TraversabilityDistribution:
            believed = how.belief.at(self._state, changed)
            expect(
                believed.shape == wanted,
                f"a distribution of shape {list(wanted)} from `at`, got {list(believed.shape)}.",
            )
            return believed

        believed = _call(Outcome.BELIEF_ERROR, believe)
        found = _call(Outcome.MODEL_ERROR, lambda: risk.apply(how.measure, believed))
        free = _call(Outcome.BELIEF_ERROR, lambda: rules.free_space.mask(found, believed))
        self._risk_map, self._free = self._risk_map.clone(), self._free.clone()
        self._risk_map[changed] = found[0].to(self._risk_map.dtype)
        self._free[changed] = free[0]
        self._free |= self._at_goal

    def _told(self, robot_state: Tensor, running: Tensor) -> Problem | None:
        """The problem with the maps of the episodes that go on and in which enough has changed."""
        known, before = self._how.belief, self._problem
        moved = ((self._risk_map - before.risk_map).abs() > _LEAST_CHANGE) | (self._free != before.free)
        told = moved.flatten(1).any(1) & running
        if not bool(told.any()):
            return None
        self.revisions[self._members[told]] += 1
        which = told[:, None, None]
        self._problem = replace(
            before,
            distribution=_call(Outcome.BELIEF_ERROR, lambda: known.distribution(self._state)),
            risk_map=torch.where(which, self._risk_map, before.risk_map),
            free=torch.where(which, self._free, before.free),
            start=robot_state,
        )
        return self._problem

    def _nothing(self) -> Sensed:
        nothing = torch.full_like(self._field, torch.nan)
        return Sensed(traversability=nothing, std=torch.ones_like(nothing))

    def _checked(self, sensed: Any) -> Sensed:
        """What a sensor said, where it is what a sensor may say."""
        expect(isinstance(sensed, Sensed), f"a Sensed from `sense`, got {type(sensed).__name__}.")
        for name in ("traversability", "std"):
            self._check(f"`Sensed.{name}`", getattr(sensed, name), self._field.dtype)
        seen = sensed.traversability[sensed.mask]
        expect(bool(((seen >= 0) & (seen <= 1)).all()), "`Sensed.traversability` in [0, 1], or NaN.")
        return sensed

    def _checked_cells(self, cells: Any) -> Tensor:
        self._check("cells from `changed`", cells, torch.bool)
        return cells

    def _check(self, what: str, values: Any, dtype: torch.dtype) -> None:
        """Refuses what is no map of all cells."""
        like = self._field
        if wrong := find_tensor_fault(what, values, dtype, tuple(like.shape), like.device):
            raise ConfigError(wrong)


def _call(outcome: Outcome, work: Callable[[], Result]) -> Result:
    """Does what a part of a user's may fail at."""
    try:
        return work()
    except GPU_FAULTS:
        raise
    except (Exception, SystemExit) as error:
        raise KnowledgeError(fault(error), outcome) from error
