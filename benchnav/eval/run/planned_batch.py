"""The planned part of a batch: a planner with the episodes that still run.

Letters in shapes: B episodes, A action dimensions.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchnav.planning.planners.boundary import (
    Answer,
    act,
    revise,
    standing_actions,
)
from benchnav.planning.planners.planner import Planner
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step

_MAX_REMAINING = 0.75  # a batch is reduced if at most this fraction still runs


class PlannedBatch:
    """The planned episodes: at first all, later only those that still run.

    Args:
        planner: planner of all episodes.
        problem: problem of all episodes.
        plan_state: plan state that `begin` returned.

    Attributes:
        episode_indices: indices of the planned episodes among all, int64 on the CPU.
    """

    def __init__(
        self, planner: Planner[Any], problem: Problem, plan_state: Any
    ) -> None:
        """Plan all episodes at first."""
        self.episode_indices = torch.arange(len(problem))
        self._planner = planner
        self._all = problem
        self._part = problem
        self._state = plan_state
        self._index = self.episode_indices.to(problem.start.device)

    def drop_ended(self, running: Tensor) -> Tensor | None:
        """Remove ended episodes if at least a quarter has ended.

        A planner that does not implement `select` keeps all episodes.

        Args:
            running: mask of running episodes, bool on the CPU, shape [B].

        Returns:
            Indices of the remaining episodes among those planned so far, int64; None if
            no episode was removed.
        """
        remaining = running[self.episode_indices].nonzero()[:, 0]
        if len(remaining) > _MAX_REMAINING * len(self.episode_indices):
            return None
        indices = remaining.to(self._index.device)
        state = self._planner.select(self._state, indices)
        if state is NotImplemented:
            return None
        self._state = state
        self.episode_indices = self.episode_indices[remaining]
        self._index = self.episode_indices.to(self._index.device)
        self._part = self._part.select(indices)
        return indices

    def part_of(self, values: Tensor) -> Tensor:
        """Select the planned episodes from the values of all episodes, [B, ...]."""
        return values[self._index]

    def revise(self, problem: Problem, generator: torch.Generator) -> None:
        """Replan for a changed problem of the planned episodes."""
        self._state = revise(self._planner, self._state, problem, generator)
        self._part = problem

    def act(self, step: Step) -> Answer:
        """Return the planner's answer for the planned episodes."""
        part_step = replace(
            step,
            state=step.state[self._index],
            traversability=step.traversability[self._index],
        )
        answer = act(self._planner, part_step, self._state, self._part)
        self._state = answer.plan_state
        return answer

    def spread(self, answer: Answer) -> tuple[Tensor, Tensor, Tensor]:
        """Return actions, fault masks and statuses of all episodes, shape [B, ...].

        Episodes that are no longer planned stand still, without a fault.
        """
        index = self._index
        zeros = torch.zeros(len(self._all), dtype=torch.int64, device=index.device)
        standing = standing_actions(self._all)
        action = standing.index_copy(0, index, answer.action)
        faulty = zeros.bool().index_copy(0, index, answer.faulty)
        status = zeros.index_copy(0, index, answer.plan.status)
        return action, faulty, status
