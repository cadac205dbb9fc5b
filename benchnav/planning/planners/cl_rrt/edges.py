"""Edges of the tree: references are drawn, simulated in closed loop, and judged.

An edge is what becomes of the robot when its controller follows a reference from a
node: it is driven through F with predicted traversability, step by step, and ends where
its reference ends, at the goal, after its time, or where it collides.

- An edge collides where it leaves the map, *enters* ground that is not free, or passes
  in one time step between two such cells that touch at a corner (`gridgraph.squeezes`).
  One that begins on ground that is not free, because the truth differs from the
  prediction, may leave it, and goes on.
- A loop that may cross does not collide with ground that is not free. How far an edge
  drives on such ground, or between such cells, is counted, since a metre of it has a
  penalty.
- Of an edge that collides the nearer half of its free part stays, as the source keeps
  feasible nodes along
  the way: in tight places no edge of full length is free.

Source: Kuwata et al. (2009), algorithm 1, lines 4–10. Letters in shapes: B episodes, R
edges driven at once, T time steps, N points of a reference, P drawn points of an edge,
S state dimensions.
"""

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.gridgraph import squeezes
from benchnav.planning.objective import distance
from benchnav.planning.planners.astar.astar import cell_at
from benchnav.planning.planners.cl_rrt.pursuit import (
    SPACING_M,
    PathFollower,
    Reference,
    Tracking,
)
from benchnav.planning.planners.dubins import dubins_segments_to_point, sample_segments
from benchnav.planning.problem import Problem, motion_traversability
from benchnav.planning.robots import steps_in

DRAWN_M = 0.5  # between the drawn points of an edge
_CHECK_STEPS = 8  # between looks at whether all edges of a round have ended


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """Robots and their controller on predicted terrain, for all edges of a tree.

    Args:
        problem: B problems.
        follower: the controller.
        radius_m: turning radius of the references in metres, shape [B].
        crossing: whether edges may enter non-free cells, bool, shape [B].
        step_m: maximum length of an edge along its reference in metres.
        edge_time_s: maximum duration of an edge in seconds.
    """

    problem: Problem
    follower: PathFollower
    radius_m: Tensor
    crossing: Tensor
    step_m: float
    edge_time_s: float

    @property
    def drawn_points(self) -> int:
        """Number of drawn points P of an edge."""
        return 1 + math.ceil(self.step_m / DRAWN_M)


@dataclass(frozen=True, kw_only=True)
class LoopState(Batch):
    """Closed-loop state from which a simulation can continue.

    Args:
        state: robot state, shape [B, R, S].
        tracking: state of the controller, shape [B, R].
        free: mask of robots in free cells, bool, shape [B, R].
    """

    state: Tensor
    tracking: Tracking
    free: Tensor


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Simulated edges.

    Args:
        at: closed-loop state at its end.
        exists: mask of edges of which a part is left, bool, shape [B, R].
        time_s: duration in seconds, shape [B, R].
        blocked_m: metres in non-free cells, shape [B, R].
        arrived: mask of edges that end at the goal, bool, shape [B, R].
        end_m: arc length along its reference at its end in metres, shape [B, R].
        drawn: positions along it, NaN past its end, shape [B, R, P, 2].
    """

    at: LoopState
    exists: Tensor
    time_s: Tensor
    blocked_m: Tensor
    arrived: Tensor
    end_m: Tensor
    drawn: Tensor


def draw_references(
    loop: ClosedLoop, pose: Tensor, target_m: Tensor
) -> tuple[Reference, Tensor]:
    """Return the shortest paths to points with free heading.

    Args:
        loop: gives radii and lengths.
        pose: where they begin, shape [B, R, 3].
        target_m: points to reach, shape [B, R, 2].

    Returns:
        The references, and the length of each path, shape [B, R]; references run
        straight on past it.
    """
    curvature, lengths_m = dubins_segments_to_point(
        pose, target_m, loop.radius_m[:, None]
    )
    # As far as the controller looks ahead from an edge's end.
    count = 2 + math.ceil((loop.step_m + loop.follower.lookahead_m) / SPACING_M)
    poses = sample_segments(pose, curvature, lengths_m, SPACING_M, count)
    length_m = lengths_m.sum(dim=-1)
    return Reference.along(poses, length_m), length_m


def drive(
    loop: ClosedLoop, begin: LoopState, reference: Reference, length_m: Tensor
) -> Edges:
    """Return edges driven along references, as far as they are free of collision.

    Args:
        loop: robots, controller and ground.
        begin: where the edges begin.
        reference: what to follow, of shape [B, R].
        length_m: length of each reference, shape [B, R].

    Returns:
        The edges.
    """
    problem, end_m = loop.problem, length_m.clamp(max=loop.step_m)
    path, progress, free, collided, integral, error = _simulate(
        loop, begin, reference, end_m
    )
    squeezed = _squeezed(problem, path, free)
    collided = collided | (squeezed & ~loop.crossing[:, None]).cummax(dim=0).values
    at_goal = distance(path, problem.goal_m[:, None]) < problem.goal_radius_m
    over = (progress >= end_m) | at_goal
    over[-1] = True  # no edge goes on past the log
    last = _first(over)  # the step at which each edge ends
    half = (_first(collided) - 1).clamp(min=0) // 2
    last = torch.where(_at(collided, last), half, last)
    before = (last - 1).clamp(min=0)
    tracking = Tracking(
        _at(path, before)[..., :2], _at(integral, last), _at(error, last)
    )
    return Edges(
        exists=last > 0,
        at=LoopState(state=_at(path, last), tracking=tracking, free=_at(free, last)),
        time_s=last.to(path) * problem.dt_s,
        blocked_m=_at(_blocked_m(path, free, squeezed), last),
        arrived=_at(at_goal, last),
        end_m=_at(progress, last),
        drawn=_thin(path[..., :2], progress, last, loop.drawn_points),
    )


def _simulate(
    loop: ClosedLoop, begin: LoopState, reference: Reference, end_m: Tensor
) -> list[Tensor]:
    """Simulate until all edges have ended or collided.

    Returns:
        At each of T steps: states, shape [T, B, R, S]; progress; whether the robot is
        on free ground; whether it has collided by then; integral and error of the
        controller; each of shape [T, B, R].
    """
    problem, follower, barred = loop.problem, loop.follower, ~loop.crossing[:, None]
    state, tracking, progress = begin.state, begin.tracking, torch.zeros_like(end_m)
    was_free, collided = begin.free, torch.zeros_like(begin.free)
    log: list[tuple[Tensor, ...]] = []
    for step in range(steps_in(loop.edge_time_s, problem.dt_s) + 1):
        progress = follower.advance(reference, state, progress)
        ground = problem.ground_at(state)
        free = ground > 0
        collided = collided | (was_free & barred & ~free) | (ground == 0)
        was_free = was_free | free
        log.append(
            (state, progress, free, collided, tracking.integral, tracking.error_mps)
        )
        if step % _CHECK_STEPS == 0 and bool(((progress >= end_m) | collided).all()):
            break
        action, tracking = follower.act(reference, state, tracking, progress)
        state = problem.robot(
            state,
            action,
            motion_traversability(ground, problem.task.rules.min_traversability),
        )
    return [torch.stack(values) for values in zip(*log, strict=True)]


def _squeezed(problem: Problem, path: Tensor, free: Tensor) -> Tensor:
    """Return at which steps a robot has just passed between two non-free cells.

    Bool, shape [T, B, R].

    Args:
        problem: B problems.
        path: states, shape [T, B, R, S].
        free: which are on free ground, bool, shape [T, B, R].
    """
    cells = cell_at(problem.grid, path).movedim(0, -1)
    source, target = (part.flatten(1) for part in (cells[..., :-1], cells[..., 1:]))
    free_cells = problem.free.flatten(1)
    passed = squeezes(
        partial(torch.gather, free_cells, 1), source, target, problem.grid.width
    )
    # A robot off the map is read in the nearest cell.
    passed = (
        passed.unflatten(1, (path.shape[2], -1)).movedim(-1, 0) & free[:-1] & free[1:]
    )
    return torch.nn.functional.pad(passed, (0, 0, 0, 0, 1, 0))


def _blocked_m(path: Tensor, free: Tensor, squeezed: Tensor) -> Tensor:
    """Return metres in or between non-free cells up to each step, shape [T, B, R]."""
    moved = torch.where(free[:-1] & ~squeezed[1:], 0, distance(path[1:], path[:-1]))
    return torch.nn.functional.pad(moved.cumsum(dim=0), (0, 0, 0, 0, 1, 0))


def _first(condition: Tensor) -> Tensor:
    """Return the first step of a condition [T, B, R], int64, [B, R]; 0 without one."""
    return condition.to(torch.uint8).argmax(dim=0)


def _at(log: Tensor, step: Tensor) -> Tensor:
    """Return a log [T, B, R, *F] at steps [B, R] of its first dimension, [B, R, *F]."""
    return log.take_along_dim(step.reshape(1, *step.shape, *[1] * (log.dim() - 3)), 0)[
        0
    ]


def _thin(path: Tensor, progress: Tensor, last: Tensor, count: int) -> Tensor:
    """Return simulated positions at equal progress, the last position included.

    Args:
        path: positions, shape [T, B, R, 2].
        progress: shape [T, B, R].
        last: step at which each edge ends, shape [B, R].
        count: points P.

    Returns:
        Positions, NaN past the end, shape [B, R, P, 2].
    """
    level = torch.arange(count, dtype=progress.dtype, device=progress.device) * DRAWN_M
    along = progress.movedim(0, -1).contiguous()
    step = torch.searchsorted(along, level.expand(*last.shape, -1).contiguous())
    step = torch.minimum(step, last[..., None])
    thinned = path.movedim(0, 2).take_along_dim(step[..., None], 2)
    used = torch.nn.functional.pad(step[..., :-1] < last[..., None], (1, 0), value=True)
    return torch.where(used[..., None], thinned, math.nan)
