"""Recordings of episodes, taken while a unit runs."""

from collections.abc import Iterable
from typing import Any

import torch

from benchnav.core.terrain import Terrain
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.report.recorded.drawn_plan import DrawnPlan, drawing_interval, drawn_plan, thinned
from benchnav.eval.report.recorded.recording import Recording
from benchnav.eval.report.recorded.snapshot import SNAPSHOT_S
from benchnav.eval.run.rollout import Episodes
from benchnav.planning.planners.planner import Plan
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation


class Recorder:
    """Keeps what was planned for some episodes of a unit.

    Args:
        unit: what is run.
        problem: the unit's.
        simulation: the unit's; of it the λ that stays what it is.
        terrain: the unit's true maps; of them the truth of λ, which no planner is told.
        members: which of the unit's episodes.
    """

    def __init__(
        self, unit: Unit, problem: Problem, simulation: Simulation, terrain: Terrain, members: Iterable[int]
    ) -> None:
        """Begins with nothing."""
        self.unit, self.problem, self.simulation, self.terrain = unit, problem, simulation, terrain
        self.every = drawing_interval(problem.dt_s)
        self._plans: dict[int, list[DrawnPlan]] = {member: [] for member in members}

    def watch(self, step: int, plan: Plan, planned: list[int]) -> None:
        """Keeps a step's plan; those that no figure will show are thinned, since there may be many.

        Args:
            step: its number.
            plan: of some episodes.
            planned: which of the unit's these are.
        """
        whole = step * self.problem.dt_s <= SNAPSHOT_S + 1e-6
        places = {member: place for place, member in enumerate(planned)}
        for member, plans in self._plans.items():
            if member not in places:
                continue  # it has ended
            drawn = drawn_plan(step, plan.lines(places[member]))
            plans.append(drawn if whole else thinned(drawn))

    def recording(self, episodes: Episodes, member: int) -> Recording:
        """All that is played back of one episode."""
        unit, problem, steps = self.unit, self.problem, int(episodes.steps[member])
        about = {
            "condition": unit.condition.id,
            **unit.condition.labels,
            "seed": str(unit.seed),
            "realisation": str(unit.realisation),
            "map": str(unit.maps[member]),
            "outcome": Outcome(int(episodes.outcome[member])).name.lower(),
        }
        free = problem.task.rules.free_space
        return Recording(
            about=about,
            grid=problem.grid,
            rgb=problem.observation.rgb[member].cpu().numpy(),
            elevation_m=problem.elevation_m[member].cpu().numpy(),
            predicted=problem.risk_map[member].cpu().numpy(),
            free=problem.free[member].cpu().numpy(),
            free_by=free.by,
            free_above=free.above,
            **self._ground(member),
            goal_m=problem.goal_m[member].cpu().numpy(),
            dt_s=problem.dt_s,
            time_budget_s=float(problem.time_budget_s[member]),
            action_names=problem.robot.action_names,
            states=episodes.states[member, : steps + 1].cpu().numpy(),
            actions=episodes.actions[member, :steps].cpu().numpy(),
            traversability=episodes.traversability[member, :steps].cpu().numpy(),
            plans=self._plans[member],
        )

    def _ground(self, member: int) -> dict[str, Any]:
        """What the ground is like, of which planners are told nothing."""
        truth = self.terrain.truth
        soft = (truth.weights[member, 1:] > 0).any(dim=0).cpu().numpy()
        mean = truth.select(torch.tensor([member])).mean()[0].float().cpu().numpy()
        field = None if self.simulation.field is None else self.simulation.field[member].cpu().numpy()
        immobilising = self.simulation.immobilising[member].cpu().numpy()
        return {"true_mean": mean, "field": field, "soft": soft, "immobilising": immobilising}
