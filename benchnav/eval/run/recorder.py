"""Recordings of episodes, taken while a unit runs."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchnav.core.terrain import Terrain
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.recorded_plans import (
    NUMBERS,
    DrawnPlan,
    KnownMap,
    drawn_plan,
    thinned,
)
from benchnav.eval.recording import MOMENT_S, Recording, drawing_interval
from benchnav.eval.run.knowledge import KnowledgeTracker
from benchnav.eval.run.rollout import Episodes, Observer
from benchnav.planning.planners.planner import Plan
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation, SimulationState


class Recorder:
    """Collector of the plans, known maps and bodies of some episodes of a unit.

    Args:
        unit: unit whose episodes are recorded.
        problem: the unit's problem.
        simulation: the unit's simulation, with a λ field that is not resampled.
        terrain: the unit's true maps, with the true λ, which no planner receives.
        episode_indices: indices of the recorded episodes in the unit.
    """

    def __init__(
        self,
        unit: Unit,
        problem: Problem,
        simulation: Simulation,
        terrain: Terrain,
        episode_indices: Iterable[int],
    ) -> None:
        """Start without plans."""
        self.unit = unit
        self.problem = problem
        self.simulation = simulation
        self.terrain = terrain
        self._plans: dict[int, list[DrawnPlan]] = {
            episode_index: [] for episode_index in episode_indices
        }
        self._known: dict[int, list[KnownMap]] = {
            episode_index: [] for episode_index in self._plans
        }
        self._bodies: list[dict[str, np.ndarray]] = []

    def store_plan(self, step: int, plan: Plan, planned: list[int]) -> None:
        """Store the plan of a step; thin its lines after the time that figures show.

        Args:
            step: index of the step.
            plan: plan of the remaining episodes.
            planned: indices of these episodes in the unit.
        """
        is_shown = step * self.problem.dt_s <= MOMENT_S + 1e-6
        for index, episode_index in enumerate(planned):
            if episode_index not in self._plans:
                continue
            drawn = drawn_plan(step, plan.lines(index))
            if not is_shown:
                drawn = thinned(drawn)
            self._plans[episode_index].append(drawn)

    @property
    def observer(self) -> Observer:
        """Callbacks of this recorder, for `run_episodes`."""
        return Observer(
            plan=self.store_plan,
            plan_interval=drawing_interval(self.problem.dt_s),
            knowledge=self.store_knowledge,
            state=self.store_bodies,
        )

    def store_knowledge(self, step: int, tracker: KnowledgeTracker) -> None:
        """Store the robots' known maps from a step on.

        Args:
            step: index of the step.
            tracker: knowledge of the robots of the batch.
        """
        for episode_index, known_map in tracker.maps_of(step, self._known).items():
            # float16 needs half the memory, and is finer than the levels in files.
            halved = {
                name: getattr(known_map, name).astype(np.float16) for name in NUMBERS
            }
            self._known[episode_index].append(replace(known_map, **halved))

    def store_bodies(self, now: SimulationState) -> None:
        """Store the values that the simulation offers to draw robots.

        Args:
            now: state of the simulation at the start, or after a step.
        """
        members = list(self._plans)
        bodies = {}
        for name, values in self.simulation.drawn(now).items():
            bodies[name] = values[members].float().cpu().numpy()
        self._bodies.append(bodies)

    def _body(self, episode_index: int, states: np.ndarray) -> dict[str, np.ndarray]:
        """Return the values of an episode's robot at each step, by name.

        If the simulation did not run, only contacts on level terrain are known.
        """
        if self._bodies:
            member = list(self._plans).index(episode_index)
            stored = self._bodies[: len(states)]
            return {
                name: np.stack([bodies[name][member] for bodies in stored])
                for name in stored[0]
            }
        footprint = self.problem.robot.footprint
        if footprint is None:
            return {}
        contacts_m = footprint.contacts(torch.tensor(states)).flatten(1, 2)
        return {"contacts_m": contacts_m.float().numpy()}

    def recording(self, episodes: Episodes, episode_index: int) -> Recording:
        """Return the recording of an episode, by its index in the unit."""
        steps = int(episodes.steps[episode_index])
        outcome = Outcome(int(episodes.outcome[episode_index]))
        return self.recording_from_states(
            episode_index,
            outcome.name.lower(),
            episodes.states[episode_index, : steps + 1].numpy(),
            episodes.actions[episode_index, :steps].numpy(),
            episodes.traversability[episode_index, :steps].numpy(),
        )

    def recording_from_states(
        self,
        episode_index: int,
        outcome: str,
        states: np.ndarray,
        actions: np.ndarray,
        traversability: np.ndarray,
    ) -> Recording:
        """Return the recording of an episode from its driven states.

        The recording contains the collected plans and known maps. Letters in shapes are
        those of `Recording`.

        Args:
            episode_index: index of the episode in the unit.
            outcome: name of the outcome.
            states: robot states, shape [N + 1, S].
            actions: commanded actions, shape [N, A].
            traversability: observed λ, shape [N].
        """
        problem = self.problem
        terrain = self.terrain

        def as_array(values: Any) -> np.ndarray:
            return values[episode_index].cpu().numpy()

        truth = terrain.truth
        true_mean = truth.select(torch.tensor([episode_index])).mean()[0]
        soft = (truth.weights[episode_index, 1:] > 0).any(dim=0)
        field = None
        if self.simulation.field is not None:
            field = as_array(self.simulation.field)
        layers = {name: as_array(layer) for name, layer in terrain.layers.items()}
        # A batch may continue after the episode has ended.
        known_maps = [
            known_map
            for known_map in self._known.get(episode_index, ())
            if known_map.step <= len(actions)
        ]
        free_space = problem.task.rules.free_space
        return Recording(
            about=self._identity(episode_index, outcome),
            resolution_m=problem.grid.resolution_m,
            rgb=as_array(terrain.rgb),
            field=field,
            immobilising=as_array(self.simulation.immobilising),
            goal_m=as_array(problem.goal_m),
            elevation_m=as_array(terrain.elevation_m),
            true_mean=true_mean.float().cpu().numpy(),
            soft=soft.cpu().numpy(),
            predicted=as_array(problem.risk_map),
            free=as_array(problem.free),
            free_by=free_space.by,
            free_above=free_space.above,
            dt_s=problem.dt_s,
            time_budget_s=float(problem.time_budget_s[episode_index]),
            action_names=problem.robot.action_names,
            states=states,
            actions=actions,
            traversability=traversability,
            plans=self._plans.get(episode_index, ()),
            layers=layers,
            known=tuple(known_maps),
            body=self._body(episode_index, states),
        )

    def _identity(self, episode_index: int, outcome: str) -> dict[str, str]:
        """Return the columns that identify an episode, with values as text."""
        unit = self.unit
        identity = {"condition": unit.condition.id, **unit.condition.labels}
        identity["seed"] = str(unit.seed)
        identity["realisation"] = str(unit.realisation)
        identity["map"] = str(unit.maps[episode_index])
        identity["outcome"] = outcome
        return identity
