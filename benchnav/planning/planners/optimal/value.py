"""Value iteration over (x, y, θ): the minimum cost to go of a unicycle on a cost map.

A state is a cell centre and one of Q headings. An action covers about the width of a
cell: full speed along one of five arcs (one of them straight), or a turn in place by
one heading. λ scales speed and turn rate by the same factor. Hence an arc is the same
curve on all terrain, and takes 1/λ times as long. Relative to its start, it passes the
same cells everywhere. A sweep over all states is therefore a convolution of the values
for each arc. Between cell centres, values are interpolated bilinearly over the open
cells. Source: Falcone and Ferretti (2013), "Semi-Lagrangian approximation schemes for
linear and Hamilton-Jacobi equations".

If terrain immobilises a robot after some dwell time, a state has L costs to go, one for
each level of dwell time. It is the minimum over the drives that are still possible if
the current dwell time is at that level. It is stored with the maximum current dwell
time for which its drive is possible. This maximum is not rounded to a level, so that
the dwell times of successive actions add up exactly. Letters in shapes: B maps, H×W
cells, Q headings, A actions, N points along an arc, R reach of an arc in cells, L
levels of dwell time.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from benchnav.core.batch import Batch
from benchnav.core.grid import Grid
from benchnav.planning.robots import Unicycle

_POINTS = 8  # number N of points along an arc
UNREACHED = 1e6
"""Cost to go of a state for which no path has been found."""
# A larger cost to go is mostly interpolated from states without a path.
_MIXED = UNREACHED / 100
_BARRED = 1e-9  # interpolation weight of a cell that is not open
_TOLERANCE = 1e-3  # maximum change of a cost at convergence
_CHECK_EVERY = 10  # sweeps between checks for convergence
_MAX_SWEEPS = 40  # maximum number of sweeps per cell of the longer side
_MIN_DWELL_S = 1e-6  # minimum of the maximum current dwell time of a possible drive
_CHUNK_MAPS = 8  # number of maps whose intermediate results fit into the CPU cache


@dataclass(frozen=True)
class Moves:
    """Actions of a robot, each of which covers about the width of a cell.

    Args:
        actions: actions (v, ω), shape [A, 2].
        seconds: duration of each action at λ = 1 in seconds, shape [A].
        turns: number of headings by which each action turns, positive to the left, A
            numbers.
    """

    actions: Tensor
    seconds: Tensor
    turns: tuple[int, ...]

    @classmethod
    def of(cls, robot: Unicycle, cell_m: float, headings: int) -> "Moves":
        """Return the actions of a unicycle.

        A straight line is as long as a cell is wide. An arc turns by a whole number of
        headings, at least one, and is otherwise no longer than a cell. A turn in place
        turns by one heading.
        """
        top, max_rate = robot.action_high
        bin_rad = 2 * math.pi / headings
        actions = [(top, 0.0)]
        durations = [cell_m / top]
        turns = [0]
        for speed, rate in ((top, max_rate / 2), (top, max_rate), (0.0, max_rate)):
            bins = 1
            if speed:
                cell_rad = cell_m * rate / speed
                bins = max(1, math.floor(cell_rad / bin_rad + 1e-9))
            for side in (1, -1):
                actions.append((speed, side * rate))
                durations.append(bins * bin_rad / rate)
                turns.append(side * bins)
        seconds = torch.tensor(durations, dtype=torch.float64)
        return cls(torch.tensor(actions, dtype=torch.float64), seconds, tuple(turns))

    def offsets(self, heading: Tensor, fraction: Tensor) -> Tensor:
        """Return displacements after fractions of each action.

        Args:
            heading: initial headings θ in radians, shape [*K].
            fraction: fractions of the duration of actions, shape [N].

        Returns:
            Displacements (x, y) in metres, shape [*K, A, N, 2].
        """
        speed, rate = self.actions.T.to(heading)[..., None]
        time = self.seconds.to(heading)[:, None] * fraction
        angle = heading[..., None, None]
        # The chord of an arc has the length v·t·sin(ωt/2) / (ωt/2) and the direction of
        # the mean heading.
        chord = speed * time * torch.sinc(rate * time / (2 * math.pi))
        mean = angle + rate * time / 2
        return torch.stack((chord * mean.cos(), chord * mean.sin()), -1)


def headings_of(count: int) -> Tensor:
    """Return the angles of Q headings, float64, shape [Q]."""
    return torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)


@dataclass(frozen=True, kw_only=True)
class Costs(Batch):
    """Costs of driving on maps.

    Args:
        rate: cost per second of motion at λ = 1, shape [B, H, W].
        open: mask of cells whose values are interpolated, bool, shape [B, H, W].
        final: cost to go in cells where paths end, which is negative within the goal's
            disc; NaN in other cells; shape [B, H, W].
        hazard: hazard of immobilisation per metre, −ln of the survival probability,
            shape [B, H, W]; None without a hazard.
        loss: cost of an immobilised robot, shape [B].
        immobile_s: dwell time per second of motion at λ = 1, which is 0 on terrain that
            does not immobilise, shape [B, H, W]; None if no terrain immobilises a
            robot.
        lost_after_s: dwell time in seconds after which a robot is immobilised.
        levels: number L of levels of dwell time.
    """

    rate: Tensor
    open: Tensor
    final: Tensor
    loss: Tensor
    hazard: Tensor | None = None
    immobile_s: Tensor | None = None
    lost_after_s: float = 1.0
    levels: int = 1


@dataclass(frozen=True, kw_only=True)
class CostToGo(Batch):
    """Minimum cost to go of every state.

    Args:
        value: cost to go, shape [B, L, Q, H, W]; `UNREACHED` if no drive reaches the
            goal. At level l, it is the minimum over drives that are possible if the
            current dwell time is l / L of the dwell time that immobilises a robot.
        max_dwell_s: current dwell time in seconds below which the drive of `value` is
            possible, of the same shape; None if no terrain immobilises a robot.
    """

    value: Tensor
    max_dwell_s: Tensor | None = None


def value_iteration(costs: Costs, moves: Moves, grid: Grid, headings: int) -> CostToGo:
    """Return the minimum cost to go of every state.

    Args:
        costs: costs on B maps.
        moves: actions of the robot.
        grid: grid of the maps.
        headings: number of headings Q.
    """
    arcs = _arcs(moves, grid, headings, costs.rate)
    maps = torch.arange(len(costs.rate), device=costs.rate.device)
    values = []
    dwells = []
    for chunk in maps.split(_CHUNK_MAPS):
        solved = _solve(costs.select(chunk), arcs, grid)
        values.append(solved.value)
        if solved.max_dwell_s is not None:
            dwells.append(solved.max_dwell_s)
    max_dwell_s = torch.cat(dwells) if dwells else None
    return CostToGo(value=torch.cat(values), max_dwell_s=max_dwell_s)


@dataclass(frozen=True)
class _Arc:
    """An action from each of Q headings.

    Args:
        seconds: duration in seconds at λ = 1.
        metres: length in metres; 0 for a turn in place.
        turn: number of headings by which the robot turns.
        passed: fraction of the arc in each cell around its first cell, shape
            [Q, 1, 2R + 1, 2R + 1].
        ends: interpolation weight of each of these cells at the end of the arc, of the
            same shape.
        points: for each of the N points along the arc, Q rows and Q columns of its
            cell, one for each heading.
    """

    seconds: float
    metres: float
    turn: int
    passed: Tensor
    ends: Tensor
    points: tuple[tuple[list[int], list[int]], ...]

    @property
    def reach(self) -> int:
        """Reach R in cells."""
        return self.ends.shape[-1] // 2


def _arcs(moves: Moves, grid: Grid, headings: int, like: Tensor) -> list[_Arc]:
    # Fractions of an arc at which costs are read; the last is its end.
    fractions = (torch.arange(_POINTS) + 0.5) / _POINTS
    fractions = torch.cat((fractions, torch.ones(1))).double()
    offsets_m = moves.offsets(headings_of(headings), fractions)
    offsets = offsets_m / grid.resolution_m  # [Q, A, N + 1, 2]
    reach = max(1, math.ceil(float(offsets.abs().max()) - 1e-9))
    speeds = moves.actions[:, 0].abs().tolist()
    arcs = []
    for index, seconds in enumerate(moves.seconds.tolist()):
        cells_at = offsets[:, index].flip(-1) + reach  # rows and columns
        cells = (cells_at[:, :-1] + 0.5).floor().long()
        points = []
        for point_cells in cells.unbind(1):
            rows, columns = point_cells.T.tolist()
            points.append((rows, columns))
        arc = _Arc(
            seconds=seconds,
            metres=speeds[index] * seconds,
            turn=moves.turns[index],
            passed=_fractions_in(cells, reach)[:, None].to(like),
            ends=_end_weights(cells_at[:, -1], reach)[:, None].to(like),
            points=tuple(points),
        )
        arcs.append(arc)
    return arcs


def _fractions_in(cells: Tensor, reach: int) -> Tensor:
    """Return the fraction of an arc in each cell, from cells [Q, N, 2] of points."""
    width = 2 * reach + 1
    fractions = torch.zeros(len(cells), width, width)
    for heading, points in enumerate(cells.tolist()):
        for row, column in points:
            fractions[heading, row, column] += 1 / _POINTS
    return fractions


def _end_weights(ends: Tensor, reach: int) -> Tensor:
    """Return bilinear weights of the cells around ends (row, column), ends [Q, 2]."""
    width = 2 * reach + 1
    weights = torch.zeros(len(ends), width, width)
    for heading, (end_row, end_column) in enumerate(ends.tolist()):
        row = min(math.floor(end_row + 1e-9), width - 2)
        column = min(math.floor(end_column + 1e-9), width - 2)
        for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
            down_weight = abs(1 - down - (end_row - row))
            across_weight = abs(1 - across - (end_column - column))
            weights[heading, row + down, column + across] += down_weight * across_weight
    return weights


def _solve(costs: Costs, arcs: list[_Arc], grid: Grid) -> CostToGo:
    headings = len(arcs[0].ends)
    frame = (arcs[0].reach,) * 4
    weights = torch.where(costs.open, 1.0, _BARRED)[:, None]
    step_costs = []
    scales = []
    dwells = []
    survivals: list[Tensor | None] = []
    # Off the map, the cost per second is the cost of a missing path, and the
    # interpolation weights are those of the map's border.
    rate = pad(costs.rate[:, None], frame, value=UNREACHED)
    framed = pad(weights, frame, mode="replicate")
    for arc in arcs:
        cost = arc.seconds * conv2d(rate, arc.passed)
        scales.append(1 / conv2d(framed, arc.ends))
        survival = None
        if costs.hazard is not None:
            hazard = pad(costs.hazard[:, None], frame)
            survival = torch.exp(-arc.metres * conv2d(hazard, arc.passed))
            cost = cost + (1 - survival) * costs.loss[:, None, None, None]
        dwell_along = None
        if costs.immobile_s is not None:
            dwell_along = _dwell_along(costs.immobile_s, costs.lost_after_s, arc)
        step_costs.append(cost)
        survivals.append(survival)
        dwells.append(dwell_along)

    def at_end(arc: _Arc, scale: Tensor, values: Tensor) -> Tensor:
        """Interpolate values at the end of an arc."""
        turned = values.roll(-arc.turn, 2)
        if not arc.metres:
            return turned
        weighted = (turned * weights[:, None]).flatten(0, 1)
        padded = pad(weighted, frame, mode="replicate")
        weighted_sum = conv2d(padded, arc.ends, groups=headings).view_as(values)
        return weighted_sum * scale[:, None]

    final = costs.final[:, None, None]
    is_inner = final.isnan()
    start = torch.where(is_inner, UNREACHED, final)
    value = start.expand(-1, costs.levels, headings, -1, -1).clone()
    dwell = None
    if costs.immobile_s is not None:
        dwell = torch.full_like(value, costs.lost_after_s)
    converged = torch.zeros_like(is_inner)[..., :1, :1]
    for sweep in range(1, _MAX_SWEEPS * max(grid.shape)):
        value_before = value
        dwell_before = dwell
        for index, arc in enumerate(arcs):
            to_go = at_end(arc, scales[index], value)
            dwell_along = dwells[index]
            new_dwell = None
            if dwell_along is not None:
                assert dwell is not None
                end_dwell = at_end(arc, scales[index], dwell)
                to_go, new_dwell = dwell_along.before(to_go, end_dwell)
            survival = survivals[index]
            if survival is not None:
                to_go = to_go * survival[:, None]
            candidate = to_go + step_costs[index][:, None]
            better = is_inner & (candidate < value)
            value = torch.where(better, candidate, value)
            if new_dwell is not None:
                assert dwell is not None
                dwell = torch.where(better, new_dwell, dwell)
        # A converged map no longer changes, so that its result does not depend on the
        # other maps of the chunk.
        value = torch.where(converged, value_before, value)
        if dwell is not None and dwell_before is not None:
            dwell = torch.where(converged, dwell_before, dwell)
        if sweep % _CHECK_EVERY == 0:
            change = value_before - value
            if dwell is not None:
                # Values that are interpolated between states with and without a path
                # decrease for many sweeps, but do not affect any path.
                change = torch.where(value < _MIXED, change, 0.0)
            max_change = change.flatten(1).amax(1)[:, None, None, None, None]
            converged = max_change < _TOLERANCE
            if bool(converged.all()):
                break
    return CostToGo(value=value, max_dwell_s=dwell)


@dataclass(frozen=True)
class _Dwell:
    """Dwell times along an arc, from every state.

    Args:
        first_s: dwell time before the arc first leaves immobilising terrain in seconds,
            shape [B, Q, H, W]; the dwell time on the whole arc if it does not leave it.
        last_s: dwell time after the arc last entered immobilising terrain in seconds,
            of the same shape; 0 if the arc ends on other terrain, or does not leave
            immobilising terrain.
        leaves: mask of arcs with a point on other terrain, bool, of the same shape.
        is_lost: mask of arcs on which a robot is immobilised after it has left
            immobilising terrain once, bool, of the same shape.
        lost_after_s: dwell time in seconds after which a robot is immobilised.
    """

    first_s: Tensor
    last_s: Tensor
    leaves: Tensor
    is_lost: Tensor
    lost_after_s: float

    def before(self, value: Tensor, max_dwell_s: Tensor) -> tuple[Tensor, Tensor]:
        """Return costs to go and maximum dwell times at the start of an arc.

        Args:
            value: costs to go at the end of the arc, shape [B, L, Q, H, W].
            max_dwell_s: maximum dwell times at the end of the arc, of the same shape.
        """
        levels = value.shape[1]
        limit_s = self.lost_after_s
        max_end_s = torch.where(self.leaves[:, None], limit_s, max_dwell_s)
        dwell = max_end_s - self.first_s[:, None]
        is_lost = self.is_lost[:, None] | (max_dwell_s <= self.last_s[:, None])
        dwell = torch.where(is_lost, 0.0, dwell)
        # Both the maximum dwell time and the cost increase with the level. Hence the
        # first level whose maximum dwell time suffices has the cheapest drive.
        first_levels = []
        for level in range(levels):
            min_dwell_s = max(level * limit_s / levels, _MIN_DWELL_S)
            first_levels.append((dwell < min_dwell_s).sum(1))
        index = torch.stack(first_levels, 1)
        unreached = torch.full_like(value[:, :1], UNREACHED)
        unlimited = torch.full_like(unreached, limit_s)
        values = torch.cat((value, unreached), 1).gather(1, index)
        dwells = torch.cat((dwell, unlimited), 1).gather(1, index)
        return values, dwells


def _dwell_along(immobile_s: Tensor, lost_after_s: float, arc: _Arc) -> _Dwell:
    _, height, width = immobile_s.shape
    padded = pad(immobile_s[:, None], (arc.reach,) * 4)[:, 0]
    first = torch.zeros(1).to(padded)
    current = first
    leaves = first.bool()
    is_lost = leaves
    for rows, columns in arc.points:
        passed = []
        for row, column in zip(rows, columns, strict=True):
            passed.append(padded[:, row : row + height, column : column + width])
        seconds = arc.seconds / _POINTS * torch.stack(passed, 1)
        leaves = leaves | (seconds == 0)
        first = first + torch.where(leaves, 0.0, seconds)
        current = torch.where(seconds > 0, current + seconds, 0.0)
        is_lost = is_lost | (leaves & (current >= lost_after_s))
    return _Dwell(
        first_s=first,
        last_s=torch.where(leaves, current, 0.0),
        leaves=leaves,
        is_lost=is_lost,
        lost_after_s=lost_after_s,
    )
