"""Motion primitives to nearby cell centres, by which a robot goes down the cost to go.

Between cells' centres the interpolated cost to go is too low before slow ground and too
high in it, so that a robot that looks at its next moves alone may turn to and fro. Ways
therefore end at centres, up to some cells away: a turn on the spot, along a circle at
full speed, and straight on.
Letters in shapes: B episodes, H×W cells, Q headings, K ways, N points, L levels of
dwell time.
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

_NEAR_CELLS = 4  # how far ways lead
_POINTS = 16  # N, along a way
# how far beside a robot's heading a cell may lie for a circle
_BESIDE = (
    math.pi / 4,
    math.pi / 2,
)
_EVEN = 1e-4  # an arc of a whole circle but for rounding is none
_DRAWN_WAYS = 100  # of the path that is drawn


@dataclass(frozen=True, kw_only=True)
class OptimalState(Batch):
    """What the optimal planner knows.

    Args:
        problem: what is being solved.
        grid: cells of value iteration, H×W.
        costs: of driving on them.
        to_go: cost to go of every state.
        held: dwell time of the robots in seconds, shape [B].
        taken: steps taken, int64, shape [B].
        drive: simulated to its end; a robot follows it as long as it is on it; None for
            none.
    """

    problem: Problem
    grid: Grid
    costs: Costs
    to_go: CostToGo
    held: Tensor
    taken: Tensor
    drive: Drive | None = None


@dataclass(frozen=True)
class Ways:
    """Ways from where robots are, K of them in each episode.

    Args:
        cost: of the way and from its end to the goal, shape [B, K].
        turn: angle by which the robot turns first, shape [B, K].
        rolls: whether it drives while it turns, bool, shape [B, K].
        points: (x, y) along the way, the last at its end, shape [B, K, N + 1, 2].
        heading: θ at its end, shape [B, K].
    """

    cost: Tensor
    turn: Tensor
    rolls: Tensor
    points: Tensor
    heading: Tensor


def ways_from(pose: Tensor, held: Tensor, plan_state: OptimalState) -> Ways:
    """Finds ways to near cells, and what they cost.

    Args:
        pose: (x, y, θ), shape [B, 3].
        held: dwell time of the robots in seconds, shape [B].
        plan_state: costs and values.
    """
    grid, robot = plan_state.grid, plan_state.problem.robot
    top, rate = robot.action_high
    row, column, inside = _near(pose, grid)
    away = torch.stack(grid.centre_of(row, column), -1) - pose[:, None, :2]
    ahead, left = _seen_from(pose[:, 2:], away)
    bearing = torch.atan2(left, ahead)
    # A turn until the robot looks at the cell, or as far beside it as it drives along a
    # circle for.
    off = torch.cat(
        [(bearing.abs() - most).clamp(min=0) for most in (0.0, *_BESIDE)], 1
    )
    count = len(_BESIDE) + 1
    away, bearing, inside = (
        own.repeat(1, count, *[1] * (own.dim() - 2)) for own in (away, bearing, inside)
    )
    side = torch.where(bearing < 0, -1.0, 1.0).to(pose)
    first = pose[:, 2:] + side * off
    ahead, left = _seen_from(first, away)
    # The circle until the robot looks at the cell, where the cell is not within it.
    radius = torch.as_tensor(top / rate).to(pose)
    past = side * left - radius
    square = ahead.square() + past.square() - radius.square()
    straight = square.clamp(min=0).sqrt()
    arc = (
        torch.remainder(
            torch.atan2(past, ahead) + torch.atan2(radius, straight) + _EVEN,
            2 * math.pi,
        )
        - _EVEN
    )
    possible = inside & (square >= 0) & (arc <= math.pi)

    share = (torch.arange(_POINTS, device=pose.device) + 0.5) / _POINTS
    drive_s = arc / rate + straight / top
    time = share * drive_s[..., None]
    turning = torch.minimum(time, arc[..., None] / rate)
    chord = 2 * radius * (turning * rate / 2).sin()
    mean = first[..., None] + side[..., None] * turning * rate / 2
    heading, on = first + side * arc, top * (time - turning)
    points = pose[:, None, None, :2] + torch.stack(
        (
            chord * mean.cos() + on * heading[..., None].cos(),
            chord * mean.sin() + on * heading[..., None].sin(),
        ),
        -1,
    )
    cells = row.repeat(1, count), column.repeat(1, count)
    cost = _cost(pose, held, points, off / rate, drive_s, heading, cells, plan_state)
    return Ways(
        cost=torch.where(possible, cost, UNREACHED),
        turn=side * (off + arc),
        rolls=off == 0,
        points=torch.cat((points, (pose[:, None, :2] + away)[:, :, None]), 2),
        heading=heading,
    )


def _seen_from(heading: Tensor, away: Tensor) -> tuple[Tensor, Tensor]:
    """How far ahead and to the left offsets [B, K, 2] are for a robot of headings [B,
    1] or [B, K].
    """
    x, y, cosine, sine = away[..., 0], away[..., 1], heading.cos(), heading.sin()
    return x * cosine + y * sine, y * cosine - x * sine


def path_of(plan_state: OptimalState, pose: Tensor, held: Tensor) -> Tensor:
    """Positions along the best ways, one after another, until the goal, shape [B, N,
    2]; NaN behind it.
    """
    problem, found = plan_state.problem, [pose[:, None, :2]]
    own = torch.arange(len(pose), device=pose.device)
    for _ in range(_DRAWN_WAYS):
        left = (
            torch.linalg.vector_norm(pose[:, :2] - problem.goal_m, dim=1)
            >= problem.goal_radius_m
        )
        if not bool(left.any()):
            break
        ways = ways_from(pose, held, plan_state)
        best = ways.cost.argmin(1)
        points = ways.points[own, best]
        found.append(torch.where(left[:, None, None], points, torch.nan))
        ended = torch.cat((points[:, -1], ways.heading[own, best, None]), 1)
        pose, held = torch.where(left[:, None], ended, pose), torch.zeros_like(held)
    return torch.cat(found, 1)


def _near(pose: Tensor, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns of the cells around robots, and which lie on the map, each of
    shape [B, K].
    """
    around = torch.arange(-_NEAR_CELLS, _NEAR_CELLS + 1, device=pose.device)
    near = torch.cartesian_prod(around, around)
    near = near[(near.square().sum(1) <= _NEAR_CELLS**2) & near.any(1)]
    row, column = (own[:, None] for own in grid.cell_of(pose[:, 0], pose[:, 1]))
    row, column = row + near[:, 0], column + near[:, 1]
    inside = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
    return row, column, inside


def _cost(
    pose: Tensor,
    held: Tensor,
    points: Tensor,
    spot_s: Tensor,
    drive_s: Tensor,
    heading: Tensor,
    cells: tuple[Tensor, ...],
    plan_state: OptimalState,
) -> Tensor:
    """Cost of ways and from their ends on, shape [B, K].

    Args:
        pose: (x, y, θ), shape [B, 3].
        held: dwell time of the robots in seconds, shape [B].
        points: (x, y) along the ways, shape [B, K, N, 2].
        spot_s: for how long they turn on the spot, with λ = 1, shape [B, K].
        drive_s: for how long they drive, with λ = 1, shape [B, K].
        heading: θ at the ends, shape [B, K].
        cells: rows and columns of the ends, each of shape [B, K].
        plan_state: costs and values.
    """
    grid, costs, problem = plan_state.grid, plan_state.costs, plan_state.problem

    def read(values: Tensor, outside: float) -> tuple[Tensor, Tensor]:
        """What a map holds where the robots are, [B, 1], and along the ways, [B, K, N]."""
        padded = grid.pad(values, outside)
        here = grid.lookup(padded, pose[:, :1], pose[:, 1:2])
        return here, grid.lookup(padded, points[..., 0], points[..., 1])

    here, along = read(costs.rate, UNREACHED)
    cost = spot_s * here + drive_s * along.mean(2)
    most = now = torch.zeros_like(cost)
    if costs.immobile_s is not None:
        here, along = read(costs.immobile_s, 0.0)
        most = now = torch.where(here > 0, held[:, None] + spot_s * here, 0.0)
        for seconds in (along * drive_s[..., None] / _POINTS).unbind(2):
            now = torch.where(seconds > 0, now + seconds, 0.0)
            most = torch.maximum(most, now)
    to_go = _value_at(plan_state.to_go, now, heading, cells)
    if costs.hazard is not None:
        _, along = read(costs.hazard, 0.0)
        kept = torch.exp(-along.mean(2) * drive_s * problem.robot.top_speed_mps)
        to_go = kept * to_go + (1 - kept) * costs.loss[:, None]
    return torch.where(most < costs.lost_after_s, cost + to_go, UNREACHED)


def _value_at(
    to_go: CostToGo, dwell_s: Tensor, heading: Tensor, cells: tuple[Tensor, ...]
) -> Tensor:
    """The cost to go of poses at cells' centres, between headings, shape [B, K]; cells
    off the map mean nothing.
    """
    _, levels, headings, height, width = to_go.value.shape
    row, column = cells[0].clamp(0, height - 1), cells[1].clamp(0, width - 1)
    place = heading / (2 * math.pi / headings)
    first = place.floor()
    index = [
        (first.long() + more) % headings * height * width + row * width + column
        for more in (0, 1)
    ]

    def read(values: Tensor) -> Tensor:
        """Values of all levels, shape [B, L, K]."""
        flat = values.flatten(2)
        before, behind = (
            flat.gather(2, each[:, None].expand(-1, levels, -1)) for each in index
        )
        return torch.lerp(before, behind, (place - first)[:, None])

    value = read(to_go.value)
    if to_go.max_dwell_s is not None:
        value = torch.where(
            read(to_go.max_dwell_s) > dwell_s[:, None], value, UNREACHED
        )
    return value.amin(1)
