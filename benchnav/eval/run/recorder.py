"""Recordings of episodes, taken while a unit runs."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchnav.core.terrain import Terrain
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.recording import (
    MOMENT_S,
    NUMBERS,
    DrawnPlan,
    KnownMap,
    Recording,
    drawing_interval,
    drawn_plan,
    thinned,
)
from benchnav.eval.run.knowledge import Knowing
from benchnav.eval.run.rollout import Episodes, Observer
from benchnav.planning.planners.planner import Plan
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation


class Recorder:
    """Keeps what was planned for some episodes of a unit, and what was known in them.

    Args:
        unit: what is run.
        problem: the unit's.
        simulation: the unit's; of it the λ that stays what it is.
        terrain: the unit's true maps; of them the truth of λ, which no planner is told.
        members: which of the unit's episodes.
    """

    def __init__(
        self,
        unit: Unit,
        problem: Problem,
        simulation: Simulation,
        terrain: Terrain,
        members: Iterable[int],
    ) -> None:
        """Begins with nothing."""
        self.unit, self.problem, self.simulation, self.terrain = (
            unit,
            problem,
            simulation,
            terrain,
        )
        self._plans: dict[int, list[DrawnPlan]] = {member: [] for member in members}
        self._known: dict[int, list[KnownMap]] = {member: [] for member in self._plans}

    def watch(self, step: int, plan: Plan, planned: list[int]) -> None:
        """Keeps a step's plan; those that no figure will show are thinned, since there
        may be many.

        Args:
            step: its number.
            plan: of some episodes.
            planned: which of the unit's these are.
        """
        whole = step * self.problem.dt_s <= MOMENT_S + 1e-6
        for place, member in enumerate(planned):
            if member in self._plans:
                drawn = drawn_plan(step, plan.lines(place))
                self._plans[member].append(drawn if whole else thinned(drawn))

    @property
    def observer(self) -> Observer:
        """What `run_episodes` calls with plans and with what is known."""
        return Observer(
            plan=self.watch,
            every=drawing_interval(self.problem.dt_s),
            knowledge=self.learn,
        )

    def learn(self, step: int, knowing: Knowing) -> None:
        """Keeps what is known from a step on.

        Args:
            step: its number.
            knowing: what is known.
        """
        for member, known in knowing.maps_of(step, self._known).items():
            # Half as large, and finer than what a file keeps.
            less = {name: getattr(known, name).astype(np.float16) for name in NUMBERS}
            self._known[member].append(replace(known, **less))

    def recording(self, episodes: Episodes, member: int) -> Recording:
        """All that is played back of one episode."""
        steps = int(episodes.steps[member])
        return self.driven(
            member,
            Outcome(int(episodes.outcome[member])).name.lower(),
            episodes.states[member, : steps + 1].numpy(),
            episodes.actions[member, :steps].numpy(),
            episodes.traversability[member, :steps].numpy(),
        )

    def driven(
        self,
        member: int,
        outcome: str,
        states: np.ndarray,
        actions: np.ndarray,
        traversability: np.ndarray,
    ) -> Recording:
        """Records an episode that was driven elsewhere, with what was planned here for
        it.

        Args:
            member: which of the unit's episodes; letters in the shapes of what follows
                are those of `Recording`.
            outcome: how it ended.
            states: shape [N + 1, S].
            actions: shape [N, A].
            traversability: observed λ, shape [N].
        """
        unit, problem, simulation = self.unit, self.problem, self.simulation

        def own(values: Any) -> np.ndarray:
            return values[member].cpu().numpy()

        truth, free = self.terrain.truth, problem.task.rules.free_space
        numbers = {
            "seed": unit.seed,
            "realisation": unit.realisation,
            "map": unit.maps[member],
        }
        return Recording(
            about={
                "condition": unit.condition.id,
                **unit.condition.labels,
                **{name: str(number) for name, number in numbers.items()},
                "outcome": outcome,
            },
            resolution_m=problem.grid.resolution_m,
            rgb=own(self.terrain.rgb),
            field=None if simulation.field is None else own(simulation.field),
            immobilising=own(simulation.immobilising),
            goal_m=own(problem.goal_m),
            elevation_m=own(self.terrain.elevation_m),
            true_mean=truth.select(torch.tensor([member]))
            .mean()[0]
            .float()
            .cpu()
            .numpy(),
            soft=(truth.weights[member, 1:] > 0).any(dim=0).cpu().numpy(),
            predicted=own(problem.risk_map),
            free=own(problem.free),
            free_by=free.by,
            free_above=free.above,
            dt_s=problem.dt_s,
            time_budget_s=float(problem.time_budget_s[member]),
            action_names=problem.robot.action_names,
            states=states,
            actions=actions,
            traversability=traversability,
            plans=self._plans.get(member, ()),
            layers={name: own(layer) for name, layer in self.terrain.layers.items()},
            # An ended episode may stay in a batch that goes on.
            known=tuple(
                known
                for known in self._known.get(member, ())
                if known.step <= len(actions)
            ),
        )
