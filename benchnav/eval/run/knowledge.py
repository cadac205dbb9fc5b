"""What robots of a unit learn while they drive, and the problem that their planner is
given of it.

`benchnav.planning.sensing.knowledge` says what they know. Here their planner is told
where λ̂ has changed for it, and what they know is measured against the ground ahead of
them. Letters in shapes: B episodes, S state dimensions, H×W cells.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import put_if_alike
from benchnav.eval.folder.steps import AHEAD_DEG, AHEAD_M
from benchnav.eval.recording import KnownMap, reach_outline
from benchnav.planning.free_space import cells_at_goal
from benchnav.planning.problem import Problem
from benchnav.planning.robots import steps_in
from benchnav.planning.sensing.belief import Fields
from benchnav.planning.sensing.knowledge import Knowledge, Truth, call
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.world.outcome import Outcome

_LEAST_CHANGE = 0.02  # of λ̂ somewhere on a map, for which its planner is told
_LEAST_LOG_SCORE = -10.0  # of λ that was held impossible


@dataclass(frozen=True, kw_only=True)
class Learning:
    """How the robots of a batch learn.

    Args:
        learner: how that is done.
        start: what they know when they set out.
        truth: of B episodes, for sensors and privileged models alone.
        field_at: gives λ of every cell at a step, [B, H, W]; None where it stays what
            `truth` says.
    """

    learner: Learner
    start: Knowledge
    truth: Truth
    field_at: Callable[[int], Tensor] | None = None


class Knowing:
    """What the robots of a batch know, from the first step to the last.

    Args:
        how: they learn.
        problem: what their planner was given when they set out.

    Attributes:
        revisions: how often each episode's map was changed, int64, shape [B].
        seen_cells: how many cells each robot saw by its last update, int64, shape [B].
        sensed_cells: of how many cells each sensed λ by then, int64, shape [B].
        ahead: by step, RMSE of E[λ] and mean log score of the belief over the cells
            ahead of each robot of which λ was not sensed, shape [B, 2]; NaN where there
            are none.
        known: what is known, of the episodes that are left.
        members: which these are, int64.
    """

    def __init__(self, how: Learning, problem: Problem) -> None:
        """Knows what is known at the start."""
        self._how, self._problem, self._truth = how, problem, how.truth
        self.known = how.start
        self._every = steps_in(problem.task.rules.replan_every_s, problem.dt_s)
        self._at_goal = cells_at_goal(
            problem.grid, problem.goal_m, problem.goal_radius_m
        )
        self.members = torch.arange(len(problem), device=problem.start.device)
        self.revisions = torch.zeros_like(self.members)
        self.seen_cells = self.known.seen.flatten(1).sum(1)
        self.sensed_cells = torch.zeros_like(self.members)
        self.ahead: dict[int, Tensor] = {}

    def keep(self, left: Tensor) -> None:
        """Forgets all episodes but some, by their places among those that are left,
        int64.
        """
        self.known = self._how.learner.select(self.known, left)
        self._problem, self._truth = (
            self._problem.select(left),
            self._truth.select(left),
        )
        self._at_goal, self.members = self._at_goal[left], self.members[left]

    def is_due(self, step: int) -> bool:
        """Whether what is known is updated in a step."""
        return step % self._every == 0

    def learn(self, step: int, robot_state: Tensor, running: Tensor) -> Problem | None:
        """Senses, and updates what is known where that is due.

        Args:
            step: steps taken so far.
            robot_state: where the robots are that are left, a copy, shape [B, S].
            running: which of these episodes go on, bool, shape [B].

        Returns:
            The problem as it now is, which starts where the robots are; None where the
            planner need not be told.

        Raises:
            KnowledgeError: a sensor, the belief, the model or the risk measure raised,
                or gave what is none.
        """
        how = self._how
        due = self.is_due(step)
        # To draw λ of all cells takes long, and between updates only a belief that
        # learns is told any.
        if how.field_at is not None and (due or how.learner.belief.learns):
            self._truth = replace(self._truth, field=how.field_at(step)[self.members])
        # Who has ended senses nothing more, whenever it leaves the batch.
        looks = running if due else torch.zeros_like(running)
        self.known = how.learner.sense(
            self.known, self._truth, robot_state, step, looks, running
        )
        if not due:
            return None
        on = self.members[running]
        self.seen_cells[on] = self.known.seen[running].flatten(1).sum(1)
        self.sensed_cells[on] = self.known.ever_sensed[running].flatten(1).sum(1)
        known, changed = how.learner.update(self.known, self._truth)
        self.known = known
        return self._told(robot_state, running) if bool(changed.any()) else None

    def _told(self, robot_state: Tensor, running: Tensor) -> Problem | None:
        """The problem with the maps of the episodes that go on and in which enough has
        changed.
        """
        known, before = self.known, self._problem
        free = known.free | self._at_goal
        moved = ((known.risk_map - before.risk_map).abs() > _LEAST_CHANGE) | (
            free != before.free
        )
        told = moved.flatten(1).any(1) & running
        if not bool(told.any()):
            return None
        self.revisions[self.members[told]] += 1
        which, places = told[:, None, None], told.nonzero()[:, 0]
        fields = before.fields
        if isinstance(fields, Fields):
            belief, believed = self._how.learner.belief, known.belief_state
            if not bool((told | ~running).all()):
                state = fields.state
                believed = call(
                    Outcome.BELIEF_ERROR,
                    lambda: belief.put(
                        state, places, belief.select(known.belief_state, places)
                    ),
                )
            fields = replace(fields, state=believed)
        self._problem = replace(
            before,
            # Of other episodes the planner is told nothing, so that none depends on
            # those beside it.
            observation=put_if_alike(before.observation, places, known.observation),
            distribution=put_if_alike(
                before.distribution, places, self._how.learner.distribution(known)
            ),
            risk_map=torch.where(which, known.risk_map, before.risk_map),
            free=torch.where(which, free, before.free),
            start=robot_state,
            fields=fields,
        )
        return self._problem

    def look_ahead(self, step: int, robot_state: Tensor, running: Tensor) -> None:
        """Measures what is believed of the ground ahead of the robots; arguments as of
        `learn`.
        """
        grid, known = self._problem.grid, self.known
        row, column = (
            torch.arange(size, device=robot_state.device) for size in grid.shape
        )
        x, y = grid.centre_of(row[:, None], column[None, :])
        away_x, away_y = (
            x - robot_state[:, 0, None, None],
            y - robot_state[:, 1, None, None],
        )
        turn = torch.atan2(away_y, away_x) - robot_state[:, 2, None, None]
        turn = torch.atan2(turn.sin(), turn.cos())
        near = (torch.hypot(away_x, away_y) <= AHEAD_M) & (
            turn.abs() <= math.radians(AHEAD_DEG)
        )
        cells = near & ~known.ever_sensed & running[:, None, None]
        found = torch.full(
            (len(self.revisions), 2), torch.nan, device=robot_state.device
        )
        if bool(cells.any()):
            value = self._truth.field[cells]
            error = self._how.learner.at(known, cells).mean()[0] - value
            score = (
                self._how.learner.distribution(known).at(cells).log_prob(value[None])[0]
            )
            member = cells.nonzero()[:, 0]
            count = torch.bincount(member, minlength=len(cells))
            sums = torch.stack(
                (error.square().double(), score.double().clamp(min=_LEAST_LOG_SCORE)), 1
            )
            means = torch.zeros(
                len(cells), 2, dtype=torch.float64, device=sums.device
            ).index_add_(0, member, sums)
            means = means / count[:, None]
            found[self.members] = torch.stack(
                (means[:, 0].sqrt(), means[:, 1]), 1
            ).float()
        self.ahead[step] = found

    def maps_of(self, step: int, wanted: Iterable[int]) -> dict[int, KnownMap]:
        """What is known in some episodes, by their numbers, of those that are left."""
        places = {
            int(member): place for place, member in enumerate(self.members.tolist())
        }
        learner, known = self._how.learner, self.known
        maps = {}
        for member in wanted:
            if member not in places:
                continue
            place = places[member]
            cells = torch.zeros_like(known.free)
            cells[place] = True
            believed = learner.at(known, cells)

            def own(values: Tensor, place: int = place) -> np.ndarray:
                return values[place].cpu().numpy()

            def whole(values: Tensor) -> np.ndarray:
                return values.reshape(self._problem.grid.shape).float().cpu().numpy()

            maps[member] = KnownMap(
                step=step,
                predicted=own(known.risk_map),
                free=own(known.free | self._at_goal),
                mean=whole(believed.mean()),
                spread=whole(believed.spread()),
                seen=own(known.seen),
                sensed=own(known.ever_sensed),
                outline=reach_outline(
                    own(known.footprint), self._problem.grid.resolution_m
                ),
            )
        return maps
