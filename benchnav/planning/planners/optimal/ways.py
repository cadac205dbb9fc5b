"""Motion primitives to nearby cell centres, by which a robot descends the cost to go.

Between cell centres the interpolated cost to go is too low in front of slow terrain and
too high in it. A robot that only compares its next actions may therefore oscillate.
Hence motion primitives end at centres, up to some cells away. They turn in place,
follow a circle at full speed, and then drive straight.
Letters in shapes: B episodes, H×W cells, Q headings, K primitives, N points, L levels
of dwell time.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.grid import Grid
from benchnav.planning.planners.optimal.drive import Drive
from benchnav.planning.planners.optimal.value import UNREACHED, Costs, CostToGo
from benchnav.planning.problem import Problem

_NEAR_CELLS = 4  # maximum distance of ends
_POINTS = 16  # N, along a primitive
# Maximum bearings of a cell at which a primitive begins on a circle.
_BESIDE = (math.pi / 4, math.pi / 2)
_EVEN = 1e-4  # an arc this close to a whole circle counts as none
_DRAWN_WAYS = 100  # primitives of the path that is drawn


@dataclass(frozen=True, kw_only=True)
class OptimalState(Batch):
    """Plan state of the optimal planner.

    Args:
        problem: the problem.
        grid: cells of value iteration, H×W.
        costs: costs of driving on them.
        to_go: cost to go of every state.
        dwell_s: dwell times of the robots in seconds, shape [B].
        taken: number of steps taken, int64, shape [B].
        drive: simulated drive, which a robot follows as long as it is on it; None for
            none.
    """

    problem: Problem
    grid: Grid
    costs: Costs
    to_go: CostToGo
    dwell_s: Tensor
    taken: Tensor
    drive: Drive | None = None


@dataclass(frozen=True)
class Ways:
    """Motion primitives from the robots' poses, K of them in each episode.

    Args:
        cost: cost of the primitive and from its end to the goal, shape [B, K].
        turn: angle by which the robot turns first, in radians, shape [B, K].
        rolls: mask of primitives that drive while turning, bool, shape [B, K].
        points: (x, y) along the primitive, the last at its end, shape [B, K, N + 1, 2].
        heading: θ at its end, shape [B, K].
    """

    cost: Tensor
    turn: Tensor
    rolls: Tensor
    points: Tensor
    heading: Tensor


def ways_from(pose: Tensor, dwell_s: Tensor, plan_state: OptimalState) -> Ways:
    """Return motion primitives to nearby cells, and their costs.

    Args:
        pose: (x, y, θ), shape [B, 3].
        dwell_s: dwell times of the robots in seconds, shape [B].
        plan_state: costs and values.
    """
    grid, robot = plan_state.grid, plan_state.problem.robot
    top, rate = robot.action_high
    row, column, inside = _near(pose, grid)
    offset = torch.stack(grid.centre_of(row, column), -1) - pose[:, None, :2]
    ahead, leftward = _seen_from(pose[:, 2:], offset)
    bearing = torch.atan2(leftward, ahead)
    # A turn in place until the robot faces the cell, or has it at a bearing of
    # `_BESIDE`.
    turn_first = torch.cat(
        [(bearing.abs() - max_bearing).clamp(min=0) for max_bearing in (0.0, *_BESIDE)],
        1,
    )
    count = len(_BESIDE) + 1
    offset, bearing, inside = (
        own.repeat(1, count, *[1] * (own.dim() - 2))
        for own in (offset, bearing, inside)
    )
    side = torch.where(bearing < 0, -1.0, 1.0).to(pose)
    first = pose[:, 2:] + side * turn_first
    ahead, leftward = _seen_from(first, offset)
    # The arc until the robot faces the cell, if the cell is outside the circle.
    radius = torch.as_tensor(top / rate).to(pose)
    past = side * leftward - radius
    square = ahead.square() + past.square() - radius.square()
    straight = square.clamp(min=0).sqrt()
    angle = torch.atan2(past, ahead) + torch.atan2(radius, straight) + _EVEN
    arc = torch.remainder(angle, 2 * math.pi) - _EVEN
    possible = inside & (square >= 0) & (arc <= math.pi)

    fractions = (torch.arange(_POINTS, device=pose.device) + 0.5) / _POINTS
    drive_s = arc / rate + straight / top
    time = fractions * drive_s[..., None]
    turning = torch.minimum(time, arc[..., None] / rate)
    chord = 2 * radius * (turning * rate / 2).sin()
    mean = first[..., None] + side[..., None] * turning * rate / 2
    heading = first + side * arc
    straight_m = top * (time - turning)
    x = chord * mean.cos() + straight_m * heading[..., None].cos()
    y = chord * mean.sin() + straight_m * heading[..., None].sin()
    points = pose[:, None, None, :2] + torch.stack((x, y), -1)
    cells = row.repeat(1, count), column.repeat(1, count)
    cost = _cost(
        pose, dwell_s, points, turn_first / rate, drive_s, heading, cells, plan_state
    )
    ends = (pose[:, None, :2] + offset)[:, :, None]
    return Ways(
        cost=torch.where(possible, cost, UNREACHED),
        turn=side * (turn_first + arc),
        rolls=turn_first == 0,
        points=torch.cat((points, ends), 2),
        heading=heading,
    )


def _seen_from(heading: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far ahead and to the left offsets are.

    Args:
        heading: headings of the robots, [B, 1] or [B, K].
        offset: (x, y) in metres, [B, K, 2].
    """
    x = offset[..., 0]
    y = offset[..., 1]
    cosine = heading.cos()
    sine = heading.sin()
    return x * cosine + y * sine, y * cosine - x * sine


def path_of(plan_state: OptimalState, pose: Tensor, dwell_s: Tensor) -> Tensor:
    """Return positions along the best primitives to the goal, shape [B, N, 2].

    NaN behind the goal.
    """
    problem, points_of_path = plan_state.problem, [pose[:, None, :2]]
    member = torch.arange(len(pose), device=pose.device)
    for _ in range(_DRAWN_WAYS):
        distance_m = torch.linalg.vector_norm(pose[:, :2] - problem.goal_m, dim=1)
        is_away = distance_m >= problem.goal_radius_m
        if not bool(is_away.any()):
            break
        ways = ways_from(pose, dwell_s, plan_state)
        best = ways.cost.argmin(1)
        points = ways.points[member, best]
        points_of_path.append(torch.where(is_away[:, None, None], points, torch.nan))
        ended = torch.cat((points[:, -1], ways.heading[member, best, None]), 1)
        pose, dwell_s = (
            torch.where(is_away[:, None], ended, pose),
            torch.zeros_like(dwell_s),
        )
    return torch.cat(points_of_path, 1)


def _near(pose: Tensor, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows and columns of cells around robots, and a mask of those on the map.

    Each has the shape [B, K].
    """
    around = torch.arange(-_NEAR_CELLS, _NEAR_CELLS + 1, device=pose.device)
    offsets = torch.cartesian_prod(around, around)
    offsets = offsets[(offsets.square().sum(1) <= _NEAR_CELLS**2) & offsets.any(1)]
    row, column = (index[:, None] for index in grid.cell_of(pose[:, 0], pose[:, 1]))
    row, column = row + offsets[:, 0], column + offsets[:, 1]
    inside = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
    return row, column, inside


def _cost(
    pose: Tensor,
    dwell_s: Tensor,
    points: Tensor,
    spot_s: Tensor,
    drive_s: Tensor,
    heading: Tensor,
    cells: tuple[Tensor, ...],
    plan_state: OptimalState,
) -> Tensor:
    """Return costs of primitives and from their ends on, shape [B, K].

    Args:
        pose: (x, y, θ), shape [B, 3].
        dwell_s: dwell times of the robots in seconds, shape [B].
        points: (x, y) along the primitives, shape [B, K, N, 2].
        spot_s: duration of the turn in place at λ = 1, shape [B, K].
        drive_s: duration of the drive at λ = 1, shape [B, K].
        heading: θ at the ends, shape [B, K].
        cells: rows and columns of the ends, each of shape [B, K].
        plan_state: costs and values.
    """
    grid = plan_state.grid
    costs = plan_state.costs
    problem = plan_state.problem

    def read(values: Tensor, outside: float) -> tuple[Tensor, Tensor]:
        """Return map values at the robots, [B, 1], and along primitives, [B, K, N]."""
        padded = grid.pad(values, outside)
        at_robot = grid.lookup(padded, pose[:, :1], pose[:, 1:2])
        return at_robot, grid.lookup(padded, points[..., 0], points[..., 1])

    at_robot, along = read(costs.rate, UNREACHED)
    cost = spot_s * at_robot + drive_s * along.mean(2)
    max_dwell = current_dwell = torch.zeros_like(cost)
    if costs.immobile_s is not None:
        at_robot, along = read(costs.immobile_s, 0.0)
        max_dwell = current_dwell = torch.where(
            at_robot > 0, dwell_s[:, None] + spot_s * at_robot, 0.0
        )
        for seconds in (along * drive_s[..., None] / _POINTS).unbind(2):
            current_dwell = torch.where(seconds > 0, current_dwell + seconds, 0.0)
            max_dwell = torch.maximum(max_dwell, current_dwell)
    to_go = _value_at(plan_state.to_go, current_dwell, heading, cells)
    if costs.hazard is not None:
        _, along = read(costs.hazard, 0.0)
        survival = torch.exp(-along.mean(2) * drive_s * problem.robot.top_speed_mps)
        to_go = survival * to_go + (1 - survival) * costs.loss[:, None]
    return torch.where(max_dwell < costs.lost_after_s, cost + to_go, UNREACHED)


def _value_at(
    to_go: CostToGo, dwell_s: Tensor, heading: Tensor, cells: tuple[Tensor, ...]
) -> Tensor:
    """Return the cost to go of poses at cell centres, between headings, shape [B, K].

    It is undefined for cells off the map.
    """
    _, levels, headings, height, width = to_go.value.shape
    row, column = cells[0].clamp(0, height - 1), cells[1].clamp(0, width - 1)
    bin = heading / (2 * math.pi / headings)
    first = bin.floor()
    index = [
        (first.long() + step) % headings * height * width + row * width + column
        for step in (0, 1)
    ]

    def read(values: Tensor) -> Tensor:
        """Return values of all levels, shape [B, L, K]."""
        flat = values.flatten(2)
        before, behind = (
            flat.gather(2, indices[:, None].expand(-1, levels, -1)) for indices in index
        )
        return torch.lerp(before, behind, (bin - first)[:, None])

    value = read(to_go.value)
    if to_go.max_dwell_s is not None:
        is_possible = read(to_go.max_dwell_s) > dwell_s[:, None]
        value = torch.where(is_possible, value, UNREACHED)
    return value.amin(1)
