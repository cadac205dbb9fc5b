"""Robots' knowledge during the episodes of a unit, and the problem of their planner.

`benchnav.planning.sensing.knowledge` defines the knowledge. This module passes changes
of λ̂ to the planner, and scores the belief over the terrain ahead of the robots.
Letters in shapes: B episodes, S state dimensions, H×W cells.
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
from benchnav.eval.recorded_plans import KnownMap, footprint_outline
from benchnav.planning.free_space import cells_at_goal
from benchnav.planning.problem import Problem
from benchnav.planning.robots import steps_in
from benchnav.planning.sensing.belief import Fields
from benchnav.planning.sensing.knowledge import Knowledge, Truth, call_user_code
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.world.outcome import Outcome

_MIN_CHANGE = 0.02  # a planner replans if λ̂ of any cell changes by more
_MIN_LOG_SCORE = -10.0  # lower limit of the log score, e.g. for a density of 0


@dataclass(frozen=True, kw_only=True)
class Learning:
    """Sensing and belief of the robots of a batch.

    Args:
        learner: sensors, belief and risk measure.
        start: knowledge at the start of the episodes.
        truth: true terrain of B episodes, for sensors and privileged models only.
        field_at: function from the index of a step to λ of all cells, shape [B, H, W];
            None if λ does not change.
    """

    learner: Learner
    start: Knowledge
    truth: Truth
    field_at: Callable[[int], Tensor] | None = None


class KnowledgeTracker:
    """Knowledge of the robots of a batch, updated from step to step.

    Args:
        learning: sensing and belief of the robots.
        problem: the planner's problem at the start.

    Attributes:
        revisions: number of times each robot's λ̂ map was updated, int64, shape [B].
        seen_cells: number of cells whose appearance each robot has observed up to its
            last update, int64, shape [B].
        sensed_cells: number of cells whose λ each robot has measured up to its last
            update, int64, shape [B].
        ahead: scores by step, shape [B, 2]: RMSE of E[λ] and mean log score of the
            belief, over the cells ahead of each robot whose λ was not measured. NaN
            without such cells.
        known: knowledge of the remaining episodes.
        episode_indices: indices of the remaining episodes among the B episodes, int64.
    """

    def __init__(self, learning: Learning, problem: Problem) -> None:
        """Start with the initial knowledge."""
        self._learning = learning
        self._problem = problem
        self._truth = learning.truth
        self.known = learning.start
        self._interval = steps_in(problem.task.rules.replan_every_s, problem.dt_s)
        self._at_goal = cells_at_goal(
            problem.grid, problem.goal_m, problem.goal_radius_m
        )
        self.episode_indices = torch.arange(len(problem), device=problem.start.device)
        self.revisions = torch.zeros_like(self.episode_indices)
        self.seen_cells = self.known.seen.flatten(1).sum(1)
        self.sensed_cells = torch.zeros_like(self.episode_indices)
        self.ahead: dict[int, Tensor] = {}

    def keep(self, indices: Tensor) -> None:
        """Keep only some of the remaining episodes.

        Args:
            indices: indices among the remaining episodes, int64.
        """
        self.known = self._learning.learner.select(self.known, indices)
        self._problem = self._problem.select(indices)
        self._truth = self._truth.select(indices)
        self._at_goal = self._at_goal[indices]
        self.episode_indices = self.episode_indices[indices]

    def is_due(self, step: int) -> bool:
        """Return whether the knowledge is updated at a step."""
        return step % self._interval == 0

    def learn(self, step: int, robot_state: Tensor, running: Tensor) -> Problem | None:
        """Sense, and update the knowledge if an update is due.

        Args:
            step: number of steps taken so far.
            robot_state: copy of the states of the remaining robots, shape [B, S].
            running: mask of the remaining episodes that have not ended, bool, shape
                [B].

        Returns:
            The problem with the current maps and the robots' states as starts; None if
            the planner need not replan.

        Raises:
            KnowledgeError: If a sensor, the belief, the model or the risk measure fails.
        """
        field_at = self._learning.field_at
        learner = self._learning.learner
        due = self.is_due(step)
        # Drawing λ of all cells is slow. Between updates, only a belief that learns
        # needs it.
        if field_at is not None and (due or learner.belief.learns):
            field = field_at(step)[self.episode_indices]
            self._truth = replace(self._truth, field=field)
        # An ended episode senses nothing, even while it remains in the batch.
        observing = running if due else torch.zeros_like(running)
        self.known = learner.sense(
            self.known, self._truth, robot_state, step, observing, running
        )
        if not due:
            return None
        self._count_cells(running)
        self.known, changed = learner.update(self.known, self._truth)
        if bool(changed.any()):
            return self._updated_problem(robot_state, running)
        return None

    def _count_cells(self, running: Tensor) -> None:
        """Count the cells that the robots of running episodes have seen and measured."""
        episode_indices = self.episode_indices[running]
        seen = self.known.seen[running]
        sensed = self.known.ever_sensed[running]
        self.seen_cells[episode_indices] = seen.flatten(1).sum(1)
        self.sensed_cells[episode_indices] = sensed.flatten(1).sum(1)

    def _updated_problem(self, robot_state: Tensor, running: Tensor) -> Problem | None:
        """Return the problem with new maps where they changed enough; None if nowhere."""
        knowledge = self.known
        problem = self._problem
        risk_map, free = self._planner_maps()
        risk_map_change = (risk_map - problem.risk_map).abs()
        has_changed = (risk_map_change > _MIN_CHANGE) | (free != problem.free)
        is_updated = has_changed.flatten(1).any(1) & running
        if not bool(is_updated.any()):
            return None
        self.revisions[self.episode_indices[is_updated]] += 1
        # The maps of other episodes stay, so that no episode depends on its batch.
        update_mask = is_updated[:, None, None]
        indices = is_updated.nonzero()[:, 0]
        fields = problem.fields
        if isinstance(fields, Fields):
            believed = knowledge.belief_state
            if not bool((is_updated | ~running).all()):
                believed = self._merged_belief(fields.state, indices)
            fields = replace(fields, state=believed)
        distribution = self._learning.learner.distribution(knowledge)
        self._problem = replace(
            problem,
            observation=put_if_alike(
                problem.observation, indices, knowledge.observation
            ),
            distribution=put_if_alike(problem.distribution, indices, distribution),
            risk_map=torch.where(update_mask, risk_map, problem.risk_map),
            free=torch.where(update_mask, free, problem.free),
            start=robot_state,
            fields=fields,
        )
        return self._problem

    def _planner_maps(self) -> tuple[Tensor, Tensor]:
        """Return λ̂ and the free mask of the current knowledge as planners get them."""
        problem = self._problem
        task = problem.task
        risk_map = task.inflate(self.known.risk_map, problem.grid)
        free = task.inflate(self.known.free, problem.grid)
        return risk_map, free | self._at_goal

    def _merged_belief(self, state: Any, indices: Tensor) -> Any:
        """Return `state` with the current belief in some episodes.

        Args:
            state: belief state of the remaining episodes in the planner's problem.
            indices: indices of the episodes to replace, int64.
        """
        belief = self._learning.learner.belief
        current = self.known.belief_state

        def merge() -> Any:
            changed = belief.select(current, indices)
            return belief.put(state, indices, changed)

        return call_user_code(Outcome.BELIEF_ERROR, merge)

    def look_ahead(self, step: int, robot_state: Tensor, running: Tensor) -> None:
        """Store scores of the belief ahead of the robots; arguments as in `learn`."""
        knowledge = self.known
        is_ahead = self._cells_ahead(robot_state)
        cells = is_ahead & ~knowledge.ever_sensed & running[:, None, None]
        shape = (len(self.revisions), 2)
        scores = torch.full(shape, torch.nan, device=robot_state.device)
        if bool(cells.any()):
            learner = self._learning.learner
            value = self._truth.field[cells]
            error = learner.at(knowledge, cells).mean()[0] - value
            distribution = learner.distribution(knowledge).at(cells)
            score = distribution.log_prob(value[None])[0]
            square = error.square().double()
            bounded_score = score.double().clamp(min=_MIN_LOG_SCORE)
            values = torch.stack((square, bounded_score), 1)
            index = cells.nonzero()[:, 0]
            count = torch.bincount(index, minlength=len(cells))
            sums = values.new_zeros(len(cells), 2).index_add_(0, index, values)
            means = sums / count[:, None]
            rmse = means[:, 0].sqrt()
            scores[self.episode_indices] = torch.stack((rmse, means[:, 1]), 1).float()
        self.ahead[step] = scores

    def _cells_ahead(self, robot_state: Tensor) -> Tensor:
        """Return a mask of the cells ahead of each robot, bool, shape [B, H, W]."""
        grid = self._problem.grid
        row, column = (
            torch.arange(size, device=robot_state.device) for size in grid.shape
        )
        x, y = grid.centre_of(row[:, None], column[None, :])
        away_x = x - robot_state[:, 0, None, None]
        away_y = y - robot_state[:, 1, None, None]
        turn = torch.atan2(away_y, away_x) - robot_state[:, 2, None, None]
        turn = torch.atan2(turn.sin(), turn.cos())
        is_near = torch.hypot(away_x, away_y) <= AHEAD_M
        return is_near & (turn.abs() <= math.radians(AHEAD_DEG))

    def maps_of(self, step: int, episode_indices: Iterable[int]) -> dict[int, KnownMap]:
        """Return the known maps of the given episodes that still run.

        Args:
            step: index of the step.
            episode_indices: indices of episodes among the B episodes.

        Returns:
            Known maps by the index of the episode among the B episodes.
        """
        indices = {
            episode_index: index
            for index, episode_index in enumerate(self.episode_indices.tolist())
        }
        return {
            episode_index: self._known_map(step, indices[episode_index])
            for episode_index in episode_indices
            if episode_index in indices
        }

    def _known_map(self, step: int, index: int) -> KnownMap:
        """Return the known map of an episode, by its index among the remaining ones."""
        grid = self._problem.grid
        knowledge = self.known
        cells = torch.zeros_like(knowledge.free)
        cells[index] = True
        believed = self._learning.learner.at(knowledge, cells)
        risk_map, free = self._planner_maps()

        def as_array(values: Tensor) -> np.ndarray:
            return values[index].cpu().numpy()

        def as_grid(values: Tensor) -> np.ndarray:
            return values.reshape(grid.shape).float().cpu().numpy()

        footprint = as_array(knowledge.footprint)
        return KnownMap(
            step=step,
            predicted=as_array(risk_map),
            free=as_array(free),
            mean=as_grid(believed.mean()),
            spread=as_grid(believed.spread()),
            seen=as_array(knowledge.seen),
            sensed=as_array(knowledge.ever_sensed),
            outline=footprint_outline(footprint, grid.resolution_m),
        )
