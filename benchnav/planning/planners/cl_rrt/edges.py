"""Edges of the tree: references, their closed-loop simulation, and collisions.

An edge is the simulated motion of a robot whose controller follows a reference from a
node. The robot moves through F with predicted traversability, step by step. The edge
ends at the end of its reference, at the goal, after its maximum duration, or where it
collides.

- An edge collides if it leaves the map, *enters* a non-free cell, or passes in one time
  step between two non-free cells that touch at a corner (`gridgraph.squeezes`). An edge
  that begins in a non-free cell, because λ differs from the prediction, may leave the
  cell and continue.
- If edges may cross non-free cells (`ClosedLoop.crossing`), they do not collide with
  such cells. Each metre of an edge in or between such cells has a penalty.
- If an edge collides, the first half of its free part is kept, since in narrow passages
  no edge of full length is free. Kuwata et al. likewise keep feasible nodes along a
  path.

Source: Kuwata et al. (2009), algorithm 1, lines 4–10. Letters in shapes: B episodes, R
edges simulated at once, T time steps, N points of a reference, P drawn points of an
edge, S state dimensions.
"""

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import pad

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

DRAWN_M = 0.5  # distance between the stored points of an edge, in metres
_CHECK_STEPS = 8  # steps between checks whether all edges of a round have ended


@dataclass(frozen=True, kw_only=True)
class ClosedLoop:
    """Robots and their controller on predicted terrain, for all edges of a tree.

    Args:
        problem: B problems.
        follower: the controller.
        radius_m: turning radius of the references in metres, shape [B].
        crossing: mask of episodes whose edges may enter non-free cells, bool, shape
            [B].
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
        """Number of stored points P of an edge."""
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
        at: closed-loop states at the ends of the edges.
        exists: mask of edges with at least one step, bool, shape [B, R].
        time_s: durations in seconds, shape [B, R].
        blocked_m: lengths in or between non-free cells in metres, shape [B, R].
        arrived: mask of edges that end at the goal, bool, shape [B, R].
        end_m: arc length along the reference at the end of each edge in metres, shape
            [B, R].
        drawn: stored positions along the edges, NaN past their ends, shape
            [B, R, P, 2].
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
    """Return references: the shortest paths to points with any final heading.

    Args:
        loop: closed loop with the turning radii and the maximum length of an edge.
        pose: start poses (x, y, θ) of the paths, shape [B, R, 3].
        target_m: points (x, y) to reach, in metres, shape [B, R, 2].

    Returns:
        The references, and the length of each path in metres, shape [B, R]. References
        continue straight past the ends of the paths.
    """
    radius_m = loop.radius_m[:, None]
    curvature, lengths_m = dubins_segments_to_point(pose, target_m, radius_m)
    # The look-ahead point of the controller may be beyond the end of an edge.
    reach_m = loop.step_m + loop.follower.lookahead_m
    count = 2 + math.ceil(reach_m / SPACING_M)
    poses = sample_segments(pose, curvature, lengths_m, SPACING_M, count)
    length_m = lengths_m.sum(dim=-1)
    return Reference.along(poses, length_m), length_m


def drive(
    loop: ClosedLoop, begin: LoopState, reference: Reference, length_m: Tensor
) -> Edges:
    """Return edges that are simulated along references, up to a collision.

    Args:
        loop: robots, controller and terrain.
        begin: closed-loop states at the start of the edges, shape [B, R].
        reference: references to follow, shape [B, R].
        length_m: length of each reference in metres, shape [B, R].
    """
    problem = loop.problem
    end_m = length_m.clamp(max=loop.step_m)
    log = _simulate(loop, begin, reference, end_m)
    path, progress, free, collided, integral, error = log
    squeezed = _squeezed(problem, path, free)
    barred_squeeze = squeezed & ~loop.crossing[:, None]
    collided = collided | barred_squeeze.cummax(dim=0).values
    at_goal = distance(path, problem.goal_m[:, None]) < problem.goal_radius_m
    over = (progress >= end_m) | at_goal
    over[-1] = True  # No edge continues after the last simulated step.
    last = _first(over)  # step at which each edge ends
    half = (_first(collided) - 1).clamp(min=0) // 2
    last = torch.where(_at(collided, last), half, last)
    before = (last - 1).clamp(min=0)
    position_m = _at(path, before)[..., :2]
    tracking = Tracking(position_m, _at(integral, last), _at(error, last))
    end = LoopState(state=_at(path, last), tracking=tracking, free=_at(free, last))
    blocked_m = _blocked_m(path, free, squeezed)
    return Edges(
        exists=last > 0,
        at=end,
        time_s=last.to(path) * problem.dt_s,
        blocked_m=_at(blocked_m, last),
        arrived=_at(at_goal, last),
        end_m=_at(progress, last),
        drawn=_thin(path[..., :2], progress, last, loop.drawn_points),
    )


def _simulate(
    loop: ClosedLoop, begin: LoopState, reference: Reference, end_m: Tensor
) -> list[Tensor]:
    """Simulate until all edges have ended or collided.

    Returns:
        States at each of T steps, shape [T, B, R, S]. Then, each of shape [T, B, R]:
        progress in metres, masks of robots in free cells and of robots that have
        collided by this step, and the integral and error of the controller.
    """
    problem = loop.problem
    follower = loop.follower
    barred = ~loop.crossing[:, None]
    min_traversability = problem.task.rules.min_traversability
    state = begin.state
    tracking = begin.tracking
    progress = torch.zeros_like(end_m)
    was_free = begin.free
    collided = torch.zeros_like(was_free)
    log: list[tuple[Tensor, ...]] = []
    for step in range(steps_in(loop.edge_time_s, problem.dt_s) + 1):
        progress = follower.advance(reference, state, progress)
        ground = problem.ground_at(state)
        free = ground > 0
        entered = was_free & barred & ~free
        collided = collided | entered | (ground == 0)
        was_free = was_free | free
        integral, error = tracking.integral, tracking.error_mps
        log.append((state, progress, free, collided, integral, error))
        if step % _CHECK_STEPS == 0:
            has_ended = (progress >= end_m) | collided
            if bool(has_ended.all()):
                break
        action, tracking = follower.act(reference, state, tracking, progress)
        traversability = motion_traversability(ground, min_traversability)
        state = problem.robot(state, action, traversability)
    return [torch.stack(values) for values in zip(*log, strict=True)]


def _squeezed(problem: Problem, path: Tensor, free: Tensor) -> Tensor:
    """Return a mask of steps on which a robot has passed between two non-free cells.

    Args:
        problem: B problems.
        path: states, shape [T, B, R, S].
        free: mask of robots in free cells, bool, shape [T, B, R].

    Returns:
        Mask, bool, shape [T, B, R].
    """
    cells = cell_at(problem.grid, path).movedim(0, -1)
    source = cells[..., :-1].flatten(1)
    target = cells[..., 1:].flatten(1)
    is_free = partial(torch.gather, problem.free.flatten(1), 1)
    passed = squeezes(is_free, source, target, problem.grid.width)
    passed = passed.unflatten(1, (path.shape[2], -1)).movedim(-1, 0)
    # `cell_at` returns the nearest cell for a robot off the map.
    passed = passed & free[:-1] & free[1:]
    return pad(passed, (0, 0, 0, 0, 1, 0))


def _blocked_m(path: Tensor, free: Tensor, squeezed: Tensor) -> Tensor:
    """Return lengths in or between non-free cells up to each step, in m, [T, B, R]."""
    is_free_step = free[:-1] & ~squeezed[1:]
    step_m = distance(path[1:], path[:-1])
    blocked_m = torch.where(is_free_step, 0, step_m)
    return pad(blocked_m.cumsum(dim=0), (0, 0, 0, 0, 1, 0))


def _first(condition: Tensor) -> Tensor:
    """Return the first step at which a mask [T, B, R] is true, else 0; shape [B, R]."""
    return condition.to(torch.uint8).argmax(dim=0)


def _at(log: Tensor, step: Tensor) -> Tensor:
    """Return a log [T, B, R, *F] at steps [B, R] of its first dimension, [B, R, *F]."""
    feature_dims = [1] * (log.dim() - 3)
    index = step.reshape(1, *step.shape, *feature_dims)
    return log.take_along_dim(index, 0)[0]


def _thin(path: Tensor, progress: Tensor, last: Tensor, count: int) -> Tensor:
    """Return the positions at equal steps of progress, and the last position.

    Args:
        path: positions (x, y) in metres, shape [T, B, R, 2].
        progress: arc lengths along the references in metres, shape [T, B, R].
        last: step at which each edge ends, shape [B, R].
        count: number of points P.

    Returns:
        Positions, NaN past the end, shape [B, R, P, 2].
    """
    level = torch.arange(count, dtype=progress.dtype, device=progress.device) * DRAWN_M
    levels = level.expand(*last.shape, -1).contiguous()
    along = progress.movedim(0, -1).contiguous()
    step = torch.searchsorted(along, levels)
    step = torch.minimum(step, last[..., None])
    thinned = path.movedim(0, 2).take_along_dim(step[..., None], 2)
    is_used = step[..., :-1] < last[..., None]
    is_used = pad(is_used, (1, 0), value=True)
    return torch.where(is_used[..., None], thinned, math.nan)
