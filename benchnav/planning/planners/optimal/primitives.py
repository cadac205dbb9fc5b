"""Motion primitives to nearby cell centres, by which a robot descends the cost to go.

Between cell centres, the interpolated cost to go is too low in front of slow terrain
and too high on it. A robot that compared only its next actions might therefore
oscillate. Hence motion primitives end at the centres of cells at a distance of up to
four cells. A primitive consists of a turn in place, an arc of the minimum radius at
full speed, and a straight line. Letters in shapes: B episodes, H×W cells, Q headings, K
primitives, N points, L levels of dwell time.
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

_NEAR_CELLS = 4  # maximum distance of a primitive's end in cells
_POINTS = 16  # number N of points along a primitive
# A primitive turns in place until the bearing of the cell is at most one of these
# angles.
_BEARINGS = (0.0, math.pi / 4, math.pi / 2)
_ANGLE_TOLERANCE = 1e-4  # An arc this close to a full circle, in rad, has length 0.
_MAX_PLOTTED = 100  # maximum number of primitives of a path in a figure


@dataclass(frozen=True, kw_only=True)
class OptimalState(Batch):
    """Plan state of the optimal planner.

    Args:
        problem: problems of B episodes.
        grid: H×W cells of value iteration.
        costs: costs of driving on these cells.
        to_go: cost to go of every state of value iteration.
        dwell_s: dwell times of the robots on immobilising terrain in seconds, shape
            [B].
        n_steps: number of planned steps, int64, shape [B].
        drive: simulated drive, which a robot follows until it deviates from it; None if
            no drive is simulated.
    """

    problem: Problem
    grid: Grid
    costs: Costs
    to_go: CostToGo
    dwell_s: Tensor
    n_steps: Tensor
    drive: Drive | None = None


@dataclass(frozen=True)
class Primitives:
    """K motion primitives from the robot's pose in each episode.

    Args:
        cost: cost of the primitive plus the cost to go at its end, shape [B, K].
        turn: angle by which the robot turns first, in radians, shape [B, K].
        rolls: mask of primitives that begin without a turn in place, bool, shape
            [B, K].
        points: N points (x, y) along the primitive, and its end, in metres, shape
            [B, K, N + 1, 2].
        heading: heading θ at the end in radians, shape [B, K].
    """

    cost: Tensor
    turn: Tensor
    rolls: Tensor
    points: Tensor
    heading: Tensor


def primitives_from(
    pose: Tensor, dwell_s: Tensor, plan_state: OptimalState
) -> Primitives:
    """Return motion primitives to nearby cells, and their costs.

    Args:
        pose: poses (x, y, θ) of the robots, shape [B, 3].
        dwell_s: dwell times of the robots in seconds, shape [B].
        plan_state: plan state with costs and costs to go.
    """
    grid = plan_state.grid
    top, rate = plan_state.problem.robot.action_high
    position = pose[:, None, :2]
    row, column, inside = _near(pose, grid)
    offset = torch.stack(grid.centre_of(row, column), -1) - position
    ahead, leftward = _in_robot_frame(pose[:, 2:], offset)
    bearing = torch.atan2(leftward, ahead)
    # There is a turn in place for each of `_BEARINGS`.
    turns = [(bearing.abs() - max_bearing).clamp(min=0) for max_bearing in _BEARINGS]
    turn_first = torch.cat(turns, 1)
    count = len(_BEARINGS)
    offset = offset.repeat(1, count, 1)
    bearing = bearing.repeat(1, count)
    inside = inside.repeat(1, count)
    side = torch.where(bearing < 0, -1.0, 1.0).to(pose)
    first = pose[:, 2:] + side * turn_first
    ahead, leftward = _in_robot_frame(first, offset)
    # The arc ends when the robot faces the cell. A cell within the turning circle
    # cannot be reached.
    radius = torch.as_tensor(top / rate).to(pose)
    past = side * leftward - radius
    square = ahead.square() + past.square() - radius.square()
    straight = square.clamp(min=0).sqrt()
    angle = torch.atan2(past, ahead) + torch.atan2(radius, straight)
    angle = torch.remainder(angle + _ANGLE_TOLERANCE, 2 * math.pi)
    arc = angle - _ANGLE_TOLERANCE
    possible = inside & (square >= 0) & (arc <= math.pi)

    fractions = (torch.arange(_POINTS, device=pose.device) + 0.5) / _POINTS
    arc_s = arc / rate
    drive_s = arc_s + straight / top
    time_s = fractions * drive_s[..., None]
    turning_s = torch.minimum(time_s, arc_s[..., None])
    chord = 2 * radius * (turning_s * rate / 2).sin()
    mean = first[..., None] + side[..., None] * turning_s * rate / 2
    heading = first + side * arc
    last = heading[..., None]
    straight_m = top * (time_s - turning_s)
    x = chord * mean.cos() + straight_m * last.cos()
    y = chord * mean.sin() + straight_m * last.sin()
    points = position[:, :, None] + torch.stack((x, y), -1)
    cells = row.repeat(1, count), column.repeat(1, count)
    turn_s = turn_first / rate
    cost = _cost(pose, dwell_s, points, turn_s, drive_s, heading, cells, plan_state)
    ends = (position + offset)[:, :, None]
    return Primitives(
        cost=torch.where(possible, cost, UNREACHED),
        turn=side * (turn_first + arc),
        rolls=turn_first == 0,
        points=torch.cat((points, ends), 2),
        heading=heading,
    )


def _in_robot_frame(heading: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return the components of offsets ahead of robots and to their left.

    Args:
        heading: headings of the robots in radians, shape [B, 1] or [B, K].
        offset: offsets (x, y) in metres, shape [B, K, 2].

    Returns:
        The two components in metres, each of shape [B, K].
    """
    x = offset[..., 0]
    y = offset[..., 1]
    cosine = heading.cos()
    sine = heading.sin()
    return x * cosine + y * sine, y * cosine - x * sine


def path_of(plan_state: OptimalState, pose: Tensor, dwell_s: Tensor) -> Tensor:
    """Return positions along the cheapest primitives to the goal.

    Args:
        plan_state: plan state with costs and costs to go.
        pose: poses (x, y, θ) of the robots, shape [B, 3].
        dwell_s: dwell times of the robots in seconds, shape [B].

    Returns:
        Positions (x, y) in metres, NaN after the goal, shape [B, N, 2].
    """
    problem = plan_state.problem
    path = [pose[:, None, :2]]
    member = torch.arange(len(pose), device=pose.device)
    for _ in range(_MAX_PLOTTED):
        distance_m = torch.linalg.vector_norm(pose[:, :2] - problem.goal_m, dim=1)
        is_away = distance_m >= problem.goal_radius_m
        if not bool(is_away.any()):
            break
        primitives = primitives_from(pose, dwell_s, plan_state)
        best = primitives.cost.argmin(1)
        points = primitives.points[member, best]
        path.append(torch.where(is_away[:, None, None], points, torch.nan))
        heading = primitives.heading[member, best, None]
        end = torch.cat((points[:, -1], heading), 1)
        pose = torch.where(is_away[:, None], end, pose)
        dwell_s = torch.zeros_like(dwell_s)
    return torch.cat(path, 1)


def _near(pose: Tensor, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """Return the cells around robots.

    Returns:
        Rows and columns of cells, int64, and a mask of cells on the map, bool, each of
        shape [B, K].
    """
    around = torch.arange(-_NEAR_CELLS, _NEAR_CELLS + 1, device=pose.device)
    offsets = torch.cartesian_prod(around, around)
    in_range = offsets.square().sum(1) <= _NEAR_CELLS**2
    offsets = offsets[in_range & offsets.any(1)]
    own_row, own_column = grid.cell_of(pose[:, 0], pose[:, 1])
    row = own_row[:, None] + offsets[:, 0]
    column = own_column[:, None] + offsets[:, 1]
    inside = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
    return row, column, inside


def _cost(
    pose: Tensor,
    dwell_s: Tensor,
    points: Tensor,
    turn_s: Tensor,
    drive_s: Tensor,
    heading: Tensor,
    cells: tuple[Tensor, ...],
    plan_state: OptimalState,
) -> Tensor:
    """Return the costs of primitives plus the costs to go at their ends, shape [B, K].

    Args:
        pose: poses (x, y, θ) of the robots, shape [B, 3].
        dwell_s: dwell times of the robots in seconds, shape [B].
        points: points (x, y) along the primitives in metres, shape [B, K, N, 2].
        turn_s: duration of the turn in place at λ = 1 in seconds, shape [B, K].
        drive_s: duration of the drive at λ = 1 in seconds, shape [B, K].
        heading: headings θ at the ends in radians, shape [B, K].
        cells: rows and columns of the ends, each of shape [B, K].
        plan_state: plan state with costs and costs to go.
    """
    grid = plan_state.grid
    costs = plan_state.costs
    problem = plan_state.problem

    def read(values: Tensor, outside: float) -> tuple[Tensor, Tensor]:
        """Return map values at the robots, [B, 1], and along primitives, [B, K, N]."""
        padded = grid.pad(values, outside)
        at_robot = grid.lookup(padded, pose[:, :1], pose[:, 1:2])
        along = grid.lookup(padded, points[..., 0], points[..., 1])
        return at_robot, along

    at_robot, along = read(costs.rate, UNREACHED)
    cost = turn_s * at_robot + drive_s * along.mean(2)
    current_dwell = torch.zeros_like(cost)
    max_dwell = current_dwell
    if costs.immobile_s is not None:
        at_robot, along = read(costs.immobile_s, 0.0)
        dwell_after_turn = dwell_s[:, None] + turn_s * at_robot
        current_dwell = torch.where(at_robot > 0, dwell_after_turn, 0.0)
        max_dwell = current_dwell
        dwell_per_point = along * drive_s[..., None] / _POINTS
        for seconds in dwell_per_point.unbind(2):
            current_dwell = torch.where(seconds > 0, current_dwell + seconds, 0.0)
            max_dwell = torch.maximum(max_dwell, current_dwell)
    to_go = _value_at(plan_state.to_go, current_dwell, heading, cells)
    if costs.hazard is not None:
        _, along = read(costs.hazard, 0.0)
        log_survival = -along.mean(2) * drive_s * problem.robot.top_speed_mps
        survival = torch.exp(log_survival)
        to_go = survival * to_go + (1 - survival) * costs.loss[:, None]
    is_possible = max_dwell < costs.lost_after_s
    return torch.where(is_possible, cost + to_go, UNREACHED)


def _value_at(
    to_go: CostToGo, dwell_s: Tensor, heading: Tensor, cells: tuple[Tensor, ...]
) -> Tensor:
    """Return the cost to go at cell centres, interpolated over headings, shape [B, K].

    Results for cells off the map have no meaning.
    """
    _, levels, headings, height, width = to_go.value.shape
    row = cells[0].clamp(0, height - 1)
    column = cells[1].clamp(0, width - 1)
    bin = heading / (2 * math.pi / headings)
    first = bin.floor()
    fraction = (bin - first)[:, None]
    indices = []
    for step in (0, 1):
        nearest = (first.long() + step) % headings
        index = nearest * height * width + row * width + column
        indices.append(index[:, None].expand(-1, levels, -1))

    def read(values: Tensor) -> Tensor:
        """Return values of all levels, shape [B, L, K]."""
        flat = values.flatten(2)
        lower, upper = (flat.gather(2, index) for index in indices)
        return torch.lerp(lower, upper, fraction)

    value = read(to_go.value)
    if to_go.max_dwell_s is not None:
        is_possible = read(to_go.max_dwell_s) > dwell_s[:, None]
        value = torch.where(is_possible, value, UNREACHED)
    return value.amin(1)
