"""Knowledge of the robots of a unit during episodes, and their planner's problem.

`benchnav.planning.sensing.knowledge` defines the knowledge. This module passes changes
of λ̂ to the planner, and scores the belief over the terrain ahead of the robots. Letters
in shapes: B episodes, S state dimensions, H×W cells.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import put_if_alike
from benchnav.eval.folder.steps import AHEAD_DEG, AHEAD_M
from benchnav.eval.recorded_plans import KnownMap, reach_outline
from benchnav.planning.free_space import cells_at_goal
from benchnav.planning.problem import Problem
from benchnav.planning.robots import steps_in
from benchnav.planning.sensing.belief import Fields
from benchnav.planning.sensing.knowledge import Knowledge, Truth, call
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.world.outcome import Outcome

_MIN_CHANGE = 0.02  # maximum change of λ̂ on a map from which its planner replans
_MIN_LOG_SCORE = -10.0  # log score of λ with probability 0


@dataclass(frozen=True, kw_only=True)
class Learning:
    """Sensing and belief of the robots of a batch.

    Args:
        learner: sensors, belief and risk measure.
        start: knowledge at the start of the episodes.
        truth: truth of B episodes, only for sensors and privileged models.
        field_at: returns λ of all cells at a step, [B, H, W]; None if λ does not change.
    """

    learner: Learner
    start: Knowledge
    truth: Truth
    field_at: Callable[[int], Tensor] | None = None


class Knowing:
    """Knowledge of the robots of a batch, updated from step to step.

    Args:
        learning: sensing and belief of the robots.
        problem: the planner's problem at the start.

    Attributes:
        revisions: number of changes of each episode's map, int64, shape [B].
        seen_cells: number of cells each robot saw by its last update, int64, shape [B].
        sensed_cells: number of cells whose λ each robot measured by then, int64,
            shape [B].
        ahead: by step, RMSE of E[λ] and mean log score of the belief over the cells
            ahead of each robot whose λ was not measured, shape [B, 2]; NaN without
            such cells.
        known: knowledge of the remaining episodes.
        members: indices of the remaining episodes, int64.
    """

    def __init__(self, learning: Learning, problem: Problem) -> None:
        """Start with the initial knowledge."""
        self._learning = learning
        self._problem = problem
        self._truth = learning.truth
        self.known = learning.start
        self._every = steps_in(problem.task.rules.replan_every_s, problem.dt_s)
        self._at_goal = cells_at_goal(
            problem.grid, problem.goal_m, problem.goal_radius_m
        )
        self.members = torch.arange(len(problem), device=problem.start.device)
        self.revisions = torch.zeros_like(self.members)
        self.seen_cells = self.known.seen.flatten(1).sum(1)
        self.sensed_cells = torch.zeros_like(self.members)
        self.ahead: dict[int, Tensor] = {}

    def keep(self, indices: Tensor) -> None:
        """Drop all episodes except some, by int64 indices into the remaining ones."""
        self.known = self._learning.learner.select(self.known, indices)
        self._problem = self._problem.select(indices)
        self._truth = self._truth.select(indices)
        self._at_goal = self._at_goal[indices]
        self.members = self.members[indices]

    def is_due(self, step: int) -> bool:
        """Return whether knowledge is updated in a step."""
        return step % self._every == 0

    def learn(self, step: int, robot_state: Tensor, running: Tensor) -> Problem | None:
        """Sense, and update the knowledge if that is due.

        Args:
            step: steps taken so far.
            robot_state: a copy of the states of the remaining robots, shape [B, S].
            running: mask of these episodes that continue, bool, shape [B].

        Returns:
            The current problem, which starts at the robots' states; None if the planner
            need not replan.

        Raises:
            KnowledgeError: If a sensor, the belief, the model or the risk measure fails.
        """
        learning = self._learning
        due = self.is_due(step)
        # Drawing λ of all cells is slow, and between updates only a belief that learns
        # receives it.
        if learning.field_at is not None and (due or learning.learner.belief.learns):
            self._truth = replace(
                self._truth, field=learning.field_at(step)[self.members]
            )
        # An ended episode senses nothing, even while it remains in the batch.
        observing = running if due else torch.zeros_like(running)
        self.known = learning.learner.sense(
            self.known, self._truth, robot_state, step, observing, running
        )
        if not due:
            return None
        running_members = self.members[running]
        self.seen_cells[running_members] = self.known.seen[running].flatten(1).sum(1)
        self.sensed_cells[running_members] = (
            self.known.ever_sensed[running].flatten(1).sum(1)
        )
        knowledge, changed = learning.learner.update(self.known, self._truth)
        self.known = knowledge
        if bool(changed.any()):
            return self._updated_problem(robot_state, running)
        return None

    def _updated_problem(self, robot_state: Tensor, running: Tensor) -> Problem | None:
        """Return the problem with new maps where running episodes changed enough."""
        knowledge = self.known
        problem = self._problem
        free = knowledge.free | self._at_goal
        risk_map_change = (knowledge.risk_map - problem.risk_map).abs()
        has_changed = (risk_map_change > _MIN_CHANGE) | (free != problem.free)
        is_updated = has_changed.flatten(1).any(1) & running
        if not bool(is_updated.any()):
            return None
        self.revisions[self.members[is_updated]] += 1
        update_mask = is_updated[:, None, None]
        indices = is_updated.nonzero()[:, 0]
        fields = problem.fields
        if isinstance(fields, Fields):
            belief = self._learning.learner.belief
            believed = knowledge.belief_state
            if not bool((is_updated | ~running).all()):
                state = fields.state

                def merge() -> Any:
                    changed = belief.select(knowledge.belief_state, indices)
                    return belief.put(state, indices, changed)

                believed = call(Outcome.BELIEF_ERROR, merge)
            fields = replace(fields, state=believed)
        self._problem = replace(
            problem,
            # Other episodes keep their maps, so that none depends on its batch.
            observation=put_if_alike(
                problem.observation, indices, knowledge.observation
            ),
            distribution=put_if_alike(
                problem.distribution,
                indices,
                self._learning.learner.distribution(knowledge),
            ),
            risk_map=torch.where(update_mask, knowledge.risk_map, problem.risk_map),
            free=torch.where(update_mask, free, problem.free),
            start=robot_state,
            fields=fields,
        )
        return self._problem

    def look_ahead(self, step: int, robot_state: Tensor, running: Tensor) -> None:
        """Score the belief over the cells ahead of the robots; arguments as in `learn`."""
        grid = self._problem.grid
        knowledge = self.known
        row, column = (
            torch.arange(size, device=robot_state.device) for size in grid.shape
        )
        x, y = grid.centre_of(row[:, None], column[None, :])
        away_x = x - robot_state[:, 0, None, None]
        away_y = y - robot_state[:, 1, None, None]
        turn = torch.atan2(away_y, away_x) - robot_state[:, 2, None, None]
        turn = torch.atan2(turn.sin(), turn.cos())
        is_ahead = (torch.hypot(away_x, away_y) <= AHEAD_M) & (
            turn.abs() <= math.radians(AHEAD_DEG)
        )
        cells = is_ahead & ~knowledge.ever_sensed & running[:, None, None]
        scores = torch.full(
            (len(self.revisions), 2), torch.nan, device=robot_state.device
        )
        if bool(cells.any()):
            value = self._truth.field[cells]
            error = self._learning.learner.at(knowledge, cells).mean()[0] - value
            distribution = self._learning.learner.distribution(knowledge).at(cells)
            score = distribution.log_prob(value[None])[0]
            members_of_cells = cells.nonzero()[:, 0]
            count = torch.bincount(members_of_cells, minlength=len(cells))
            sums = torch.stack(
                (error.square().double(), score.double().clamp(min=_MIN_LOG_SCORE)), 1
            )
            means = torch.zeros(
                len(cells), 2, dtype=torch.float64, device=sums.device
            ).index_add_(0, members_of_cells, sums)
            means = means / count[:, None]
            scores[self.members] = torch.stack(
                (means[:, 0].sqrt(), means[:, 1]), 1
            ).float()
        self.ahead[step] = scores

    def maps_of(self, step: int, members: Iterable[int]) -> dict[int, KnownMap]:
        """Return the known maps of some of the remaining episodes, by index."""
        indices = {
            int(member): index for index, member in enumerate(self.members.tolist())
        }
        learner = self._learning.learner
        knowledge = self.known
        maps = {}
        for member in members:
            if member not in indices:
                continue
            index = indices[member]
            cells = torch.zeros_like(knowledge.free)
            cells[index] = True
            believed = learner.at(knowledge, cells)

            def of_member(values: Tensor, index: int = index) -> np.ndarray:
                return values[index].cpu().numpy()

            def on_grid(values: Tensor) -> np.ndarray:
                return values.reshape(self._problem.grid.shape).float().cpu().numpy()

            maps[member] = KnownMap(
                step=step,
                predicted=of_member(knowledge.risk_map),
                free=of_member(knowledge.free | self._at_goal),
                mean=on_grid(believed.mean()),
                spread=on_grid(believed.spread()),
                seen=of_member(knowledge.seen),
                sensed=of_member(knowledge.ever_sensed),
                outline=reach_outline(
                    of_member(knowledge.footprint), self._problem.grid.resolution_m
                ),
            )
        return maps
