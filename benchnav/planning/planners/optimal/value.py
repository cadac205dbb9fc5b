"""Value iteration over (x, y, θ): the minimum cost to go of a unicycle on a cost map.

A state is a cell centre and one of Q headings. An action lasts for about a cell: full
speed along one of five arcs, or a turn in place by one heading. λ scales speed and turn
rate by the same factor. Hence an arc is the same curve on all terrain, and takes 1/λ
times as long; its end and its cells are the same for all cells of all maps. A sweep
over all states is therefore a convolution of the values for each arc. Between cells
values are interpolated, bilinearly, over those that are open.
Source: Falcone and Ferretti (2013), "Semi-Lagrangian approximation schemes for linear
and Hamilton-Jacobi equations".

If terrain immobilises a robot after some dwell time, a state has several costs to go:
the minimum over all drives, and those over drives that are still possible after more
and more dwell time. Each is stored with the dwell time up to which it is possible,
without rounding, so that moves add up exactly.
Letters in shapes: B maps, H×W cells, Q headings, A actions, N points along an arc, R
reach of an arc in cells, L levels of dwell time.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from benchnav.core.batch import Batch
from benchnav.core.grid import Grid
from benchnav.planning.robots import Unicycle

_POINTS = 8  # N
UNREACHED = 1e6
"""Cost to go before a path is found, or without one."""
# Cost to go that is mostly interpolated from unreached states.
_MIXED = UNREACHED / 100
_BARRED = 1e-9  # weight of a non-free cell next to a free one
_TOLERANCE = 1e-3  # change of a cost at which iteration has converged
_CHECK_EVERY = 10  # sweeps
_MAX_SWEEPS = 40  # per cell of the longer side
_MIN_DWELL_S = 1e-6  # a drive that leaves no more dwell time is impossible
_CHUNK_MAPS = 8  # so that intermediate results fit the CPU cache


@dataclass(frozen=True)
class Moves:
    """Actions of a robot for about a cell at λ = 1.

    Args:
        actions: (v, ω), shape [A, 2].
        seconds: duration of each action, shape [A].
        turns: number of headings by which each turns, A of them.
    """

    actions: Tensor
    seconds: Tensor
    turns: tuple[int, ...]

    @classmethod
    def of(cls, robot: Unicycle, cell_m: float, headings: int) -> "Moves":
        """Return the actions of a unicycle.

        Turns last for a whole number of headings, at least one and otherwise at most
        for a cell; straight driving lasts for a cell.
        """
        top, max_rate = robot.action_high
        bin_rad = 2 * math.pi / headings
        moves = [((top, 0.0), cell_m / top, 0)]
        for speed, rate in ((top, max_rate / 2), (top, max_rate), (0.0, max_rate)):
            bins = 1
            if speed:
                bins = max(1, math.floor(cell_m * rate / speed / bin_rad + 1e-9))
            duration = bins * bin_rad / rate
            moves += [((speed, side * rate), duration, side * bins) for side in (1, -1)]
        actions, seconds, turns = zip(*moves, strict=True)
        return cls(
            torch.tensor(actions, dtype=torch.float64),
            torch.tensor(seconds, dtype=torch.float64),
            turns,
        )

    def offsets(self, heading: Tensor, fraction: Tensor) -> Tensor:
        """Return displacements after fractions of each action.

        Args:
            heading: θ in radians, shape [*K].
            fraction: fractions of the duration of actions, shape [N].

        Returns:
            (x, y) in metres, shape [*K, A, N, 2].
        """
        speed, rate = self.actions.T.to(heading)[..., None]
        time = self.seconds.to(heading)[:, None] * fraction
        angle = heading[..., None, None]
        # sin(ωt/2) / (ωt/2) of the chord, along the mean heading.
        chord = speed * time * torch.sinc(rate * time / (2 * math.pi))
        along = angle + rate * time / 2
        return torch.stack((chord * along.cos(), chord * along.sin()), -1)


def headings_of(count: int) -> Tensor:
    """Return the angles of Q headings, float64, shape [Q]."""
    return torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)


@dataclass(frozen=True, kw_only=True)
class Costs(Batch):
    """Costs of driving on maps.

    Args:
        rate: cost of a second of driving with λ = 1, shape [B, H, W].
        open: mask of cells between which values are interpolated, bool, [B, H, W].
        final: cost to go where paths end, negative within the goal's disc; NaN
            elsewhere, shape [B, H, W].
        hazard: hazard of immobilisation per metre, −ln of the survival probability,
            shape [B, H, W]; None for none.
        loss: cost of an immobilised robot, shape [B].
        immobile_s: dwell time for each second of driving with λ = 1, 0 on other
            terrain, shape [B, H, W]; None if nothing immobilises a robot.
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
        value: cost to go, `UNREACHED` without a drive, shape [B, L, Q, H, W]. At level
            l it is the minimum over drives that are still possible after l / L of the
            dwell time that immobilises a robot.
        max_dwell_s: current dwell time of a robot below which that drive reaches the
            goal, of the same shape; None if nothing immobilises a robot.
    """

    value: Tensor
    max_dwell_s: Tensor | None = None


def value_iteration(costs: Costs, moves: Moves, grid: Grid, headings: int) -> CostToGo:
    """Return the minimum cost to go of every state.

    Args:
        costs: costs on B maps.
        moves: actions of the robot.
        grid: grid of the maps.
        headings: Q.
    """
    arcs = _arcs(moves, grid, headings, costs.rate)
    maps = torch.arange(len(costs.rate), device=costs.rate.device).split(_CHUNK_MAPS)
    solved = [_solve(costs.select(chunk), arcs, grid) for chunk in maps]
    dwell = [part.max_dwell_s for part in solved if part.max_dwell_s is not None]
    return CostToGo(
        value=torch.cat([part.value for part in solved]),
        max_dwell_s=torch.cat(dwell) if dwell else None,
    )


@dataclass(frozen=True)
class _Arc:
    """An action at all headings.

    Args:
        seconds: duration.
        metres: length.
        turn: number of headings by which it turns.
        passed: fraction of it in each cell around the first, shape
            [Q, 1, 2R + 1, 2R + 1].
        ends: interpolation weights of the cells around its end, of the same shape.
        points: cells of the points along it, rows and columns, N each of shape [Q].
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
    # Fractions of an arc at which costs are read, and its end.
    fractions = (torch.arange(_POINTS) + 0.5) / _POINTS
    fractions = torch.cat((fractions, torch.ones(1))).double()
    # Shape [Q, A, N + 1, 2].
    offsets = moves.offsets(headings_of(headings), fractions) / grid.resolution_m
    reach = max(1, math.ceil(float(offsets.abs().max()) - 1e-9))
    arcs = []
    for index, (seconds, turn) in enumerate(
        zip(moves.seconds.tolist(), moves.turns, strict=True)
    ):
        passed, ends = (
            torch.zeros(headings, 2 * reach + 1, 2 * reach + 1) for _ in range(2)
        )
        cells_at = offsets[:, index].flip(-1) + reach  # rows and columns
        cells = (cells_at[:, :-1] + 0.5).floor().long()
        for heading in range(headings):
            for row, column in cells[heading].tolist():
                passed[heading, row, column] += 1 / _POINTS
            end = cells_at[heading, -1].tolist()
            row, column = (min(math.floor(part + 1e-9), 2 * reach - 1) for part in end)
            for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
                down_weight = abs(1 - down - (end[0] - row))
                across_weight = abs(1 - across - (end[1] - column))
                weight = down_weight * across_weight
                ends[heading, row + down, column + across] += weight
        metres = float(moves.actions[index, 0].abs()) * seconds
        points = tuple(
            (cells[:, number, 0].tolist(), cells[:, number, 1].tolist())
            for number in range(_POINTS)
        )
        arcs.append(
            _Arc(
                seconds=seconds,
                metres=metres,
                turn=turn,
                passed=passed[:, None].to(like),
                ends=ends[:, None].to(like),
                points=points,
            )
        )
    return arcs


def _solve(costs: Costs, arcs: list[_Arc], grid: Grid) -> CostToGo:
    headings = len(arcs[0].ends)
    frame = (arcs[0].reach,) * 4
    weights = torch.where(costs.open, 1.0, _BARRED)[:, None]
    step_costs, scales, dwells = [], [], []
    survivals: list[Tensor | None] = []
    # Off the map a second costs as much as a missing path, and weights are those of the
    # border.
    rate = pad(costs.rate[:, None], frame, value=UNREACHED)
    framed = pad(weights, frame, mode="replicate")
    for arc in arcs:
        cost = arc.seconds * conv2d(rate, arc.passed)
        scales.append(1 / conv2d(framed, arc.ends))
        survival = None
        if costs.hazard is not None:
            hazard = conv2d(pad(costs.hazard[:, None], frame), arc.passed)
            survival = torch.exp(-arc.metres * hazard)
            cost = cost + (1 - survival) * costs.loss[:, None, None, None]
        step_costs.append(cost)
        survivals.append(survival)
        dwells.append(None if costs.immobile_s is None else _dwell_along(costs, arc))

    def at_end(arc: _Arc, scale: Tensor, values: Tensor) -> Tensor:
        """Interpolate values at the end of an arc."""
        turned = values.roll(-arc.turn, 2)
        if not arc.metres:
            return turned
        inside = pad((turned * weights[:, None]).flatten(0, 1), frame, mode="replicate")
        summed = conv2d(inside, arc.ends, groups=headings).view_as(values)
        return summed * scale[:, None]

    final = costs.final[:, None, None]
    start = torch.where(final.isnan(), UNREACHED, final)
    value = start.expand(-1, costs.levels, headings, -1, -1).clone()
    dwell = None
    if costs.immobile_s is not None:
        dwell = torch.full_like(value, costs.lost_after_s)
    converged = torch.zeros_like(final, dtype=torch.bool)[..., :1, :1]
    for sweep in range(1, _MAX_SWEEPS * max(grid.shape)):
        before, dwell_before = value, dwell
        for index, arc in enumerate(arcs):
            ended = at_end(arc, scales[index], value)
            along = dwells[index]
            ended_dwell = None
            if along is not None:
                assert dwell is not None
                end_dwell = at_end(arc, scales[index], dwell)
                ended, ended_dwell = along.before(ended, end_dwell, costs.lost_after_s)
            survival = survivals[index]
            if survival is not None:
                ended = ended * survival[:, None]
            candidate = ended + step_costs[index][:, None]
            better = final.isnan() & (candidate < value)
            value = torch.where(better, candidate, value)
            if ended_dwell is not None:
                assert dwell is not None
                dwell = torch.where(better, ended_dwell, dwell)
        # A converged map does not change, so that none depends on the others of a
        # chunk.
        value = torch.where(converged, before, value)
        if dwell is not None and dwell_before is not None:
            dwell = torch.where(converged, dwell_before, dwell)
        if sweep % _CHECK_EVERY == 0:
            change = before - value
            if dwell is not None:
                # Between reached and unreached states, values decrease for long, but
                # do not matter.
                change = torch.where(value < _MIXED, change, 0.0)
            largest = change.flatten(1).amax(1)[:, None, None, None, None]
            converged = largest < _TOLERANCE
            if bool(converged.all()):
                break
    return CostToGo(value=value, max_dwell_s=dwell)


@dataclass(frozen=True)
class _Dwell:
    """Dwell time along an arc, from every state.

    Args:
        first_s: until the arc first leaves immobilising terrain, or its whole duration,
            shape [B, Q, H, W].
        last_s: after it last entered such terrain, 0 if it ends elsewhere or never
            leaves it, of the same shape.
        leaves: mask of arcs with a point on other terrain, bool, of the same shape.
        is_lost: mask of arcs that immobilise between both, bool, of the same shape.
    """

    first_s: Tensor
    last_s: Tensor
    leaves: Tensor
    is_lost: Tensor

    def before(
        self, value: Tensor, max_dwell_s: Tensor, lost_after_s: float
    ) -> tuple[Tensor, Tensor]:
        """Return costs to go and dwell times at an arc's beginning, from those at its
        end, [B, L, Q, H, W].
        """
        levels = value.shape[1]
        at_end_s = torch.where(self.leaves[:, None], lost_after_s, max_dwell_s)
        dwell = at_end_s - self.first_s[:, None]
        is_lost = self.is_lost[:, None] | (max_dwell_s <= self.last_s[:, None])
        dwell = torch.where(is_lost, 0.0, dwell)
        # The more dwell time a drive leaves, the more it costs: the first that leaves
        # enough is the cheapest.
        min_dwell_s = [
            max(level * lost_after_s / levels, _MIN_DWELL_S) for level in range(levels)
        ]
        index = torch.stack([(dwell < min_s).sum(1) for min_s in min_dwell_s], 1)
        unreached = torch.full_like(value[:, :1], UNREACHED)
        unlimited = torch.full_like(unreached, lost_after_s)
        values = torch.cat((value, unreached), 1).gather(1, index)
        return values, torch.cat((dwell, unlimited), 1).gather(1, index)


def _dwell_along(costs: Costs, arc: _Arc) -> _Dwell:
    assert costs.immobile_s is not None
    (_, height, width), reach = costs.immobile_s.shape, arc.reach
    around = pad(costs.immobile_s[:, None], (reach,) * 4)[:, 0]
    first = now = torch.zeros(1).to(around)
    leaves = is_lost = torch.zeros(1).to(around).bool()
    for rows, columns in arc.points:
        cells = zip(rows, columns, strict=True)
        passed = [
            around[:, row : row + height, column : column + width]
            for row, column in cells
        ]
        seconds = arc.seconds / _POINTS * torch.stack(passed, 1)
        leaves = leaves | (seconds == 0)
        first = first + torch.where(leaves, 0.0, seconds)
        now = torch.where(seconds > 0, now + seconds, 0.0)
        is_lost = is_lost | (leaves & (now >= costs.lost_after_s))
    return _Dwell(
        first_s=first,
        last_s=torch.where(leaves, now, 0.0),
        leaves=leaves,
        is_lost=is_lost,
    )
