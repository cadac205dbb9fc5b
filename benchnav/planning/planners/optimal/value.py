"""Value iteration over (x, y, θ): the least cost to go of a unicycle on a map of what a
second of driving costs.

A robot stands at a cell's centre and looks along one of Q headings. It holds an action
for about a cell: full speed along five arcs, or a turn on the spot by one heading. λ
scales speed and turn rate alike, so that an arc is the same curve on any ground, and
takes 1/λ times as long: where arcs end and which cells they pass is the same for all
cells of all maps. So a sweep over all states is a convolution of the values for each
arc. Between cells values are interpolated, bilinearly, over those that are open.
Source: Falcone and Ferretti (2013), "Semi-Lagrangian approximation schemes for linear
and Hamilton-Jacobi equations".

Where terrain immobilises a robot after some dwell time, a state has several costs to
go: the least of all drives, and those of drives that can still be begun after more and
more dwell time. With each stands the dwell time up to which it can be begun, without
rounding, so that moves add up exactly.
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
UNREACHED = 1e6  # cost to go before a way is found, and where there is none
# from there on a cost to go is for the most part of what is not reached
_MIXED = UNREACHED / 100
_BARRED = 1e-9  # weight of a cell that is not free beside one that is
_SETTLED = 1e-3  # least change that counts
_CHECK_EVERY = 10  # sweeps
_MOST_SWEEPS = 40  # for a cell of the longer side
_LEAST_DWELL_S = 1e-6  # a drive that leaves no more than that cannot be begun
_MAPS_AT_ONCE = 8  # so that what is worked on stays near the cache


@dataclass(frozen=True)
class Moves:
    """What a robot may do for about a cell, with λ = 1.

    Args:
        actions: (v, ω), shape [A, 2].
        seconds: how long it is held, shape [A].
        turns: by how many headings it turns, A of them.
    """

    actions: Tensor
    seconds: Tensor
    turns: tuple[int, ...]

    @classmethod
    def of(cls, robot: Unicycle, cell_m: float, headings: int) -> "Moves":
        """Those of a unicycle: as far as turns come to whole headings, but at least
        one, and at most a cell else.
        """
        (top, most), bin_rad = robot.action_high, 2 * math.pi / headings
        found = [((top, 0.0), cell_m / top, 0)]
        for speed, rate in ((top, most / 2), (top, most), (0.0, most)):
            bins = (
                max(1, math.floor(cell_m * rate / speed / bin_rad + 1e-9))
                if speed
                else 1
            )
            found += [
                ((speed, side * rate), bins * bin_rad / rate, side * bins)
                for side in (1, -1)
            ]
        actions, seconds, turns = zip(*found, strict=True)
        return cls(
            torch.tensor(actions, dtype=torch.float64),
            torch.tensor(seconds, dtype=torch.float64),
            turns,
        )

    def offsets(self, heading: Tensor, share: Tensor) -> Tensor:
        """How far a robot is from where it was, after some share of each action.

        Args:
            heading: θ, shape [*K].
            share: of the time that actions are held, shape [N].

        Returns:
            (x, y) in metres, shape [*K, A, N, 2].
        """
        speed, rate = self.actions.T.to(heading)[..., None]
        time = self.seconds.to(heading)[:, None] * share
        angle = heading[..., None, None]
        # sin(ωt/2) / (ωt/2) of the chord, along the mean heading.
        chord = speed * time * torch.sinc(rate * time / (2 * math.pi))
        along = angle + rate * time / 2
        return torch.stack((chord * along.cos(), chord * along.sin()), -1)


def headings_of(count: int) -> Tensor:
    """Angles of Q headings, float64, shape [Q]."""
    return torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)


@dataclass(frozen=True, kw_only=True)
class Costs(Batch):
    """What driving on maps costs.

    Args:
        rate: cost of a second of driving with λ = 1, shape [B, H, W].
        open: cells between which values are interpolated, bool, shape [B, H, W].
        final: cost to go where ways end, under 0 where the robot has arrived before;
            NaN elsewhere, shape [B, H, W].
        hazard: chance of being lost on a metre, as −ln of that of not being lost, shape
            [B, H, W]; None for none.
        loss: cost of being lost, shape [B].
        immobile_s: dwell time for each second of driving with λ = 1, 0 on other
            terrain, shape [B, H, W]; None where nothing immobilises a robot.
        lost_after_s: dwell time after which a robot is lost.
        levels: L, of dwell time.
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
    """The least cost to go of every state.

    Args:
        value: cost to go, `UNREACHED` where there is no drive, shape [B, L, Q, H, W].
            At level l it is the least of drives that a robot can still begin after l /
            L of the dwell time after which it is lost.
        max_dwell_s: dwell time of the robot under which that drive reaches the goal, of
            the same shape; None where nothing immobilises a robot.
    """

    value: Tensor
    max_dwell_s: Tensor | None = None


def value_iteration(costs: Costs, moves: Moves, grid: Grid, headings: int) -> CostToGo:
    """Return the least cost to go of every state.

    Args:
        costs: of B maps.
        moves: what the robot may do.
        grid: of the maps.
        headings: Q.
    """
    arcs = _arcs(moves, grid, headings, costs.rate)
    maps = torch.arange(len(costs.rate), device=costs.rate.device).split(_MAPS_AT_ONCE)
    solved = [_solve(costs.select(chunk), arcs, grid) for chunk in maps]
    dwell = [each.max_dwell_s for each in solved if each.max_dwell_s is not None]
    return CostToGo(
        value=torch.cat([each.value for each in solved]),
        max_dwell_s=torch.cat(dwell) if dwell else None,
    )


@dataclass(frozen=True)
class _Arc:
    """An action at all headings.

    Args:
        seconds: for how long it is held.
        metres: how far it leads.
        turn: by how many headings.
        passed: share of it in each cell around the first, shape [Q, 1, 2R + 1, 2R + 1].
        ends: weights of the cells between which it ends, of the same shape.
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
        """R."""
        return self.ends.shape[-1] // 2


def _arcs(moves: Moves, grid: Grid, headings: int, like: Tensor) -> list[_Arc]:
    # Where along an arc ground is looked at, and its end.
    shares = torch.cat(
        ((torch.arange(_POINTS) + 0.5) / _POINTS, torch.ones(1))
    ).double()
    # [Q, A, N + 1, 2]
    offsets = moves.offsets(headings_of(headings), shares) / grid.resolution_m
    reach = max(1, math.ceil(float(offsets.abs().max()) - 1e-9))
    found = []
    for place, (seconds, turn) in enumerate(
        zip(moves.seconds.tolist(), moves.turns, strict=True)
    ):
        passed, ends = (
            torch.zeros(headings, 2 * reach + 1, 2 * reach + 1) for _ in range(2)
        )
        own = offsets[:, place].flip(-1) + reach  # rows and columns
        cells = (own[:, :-1] + 0.5).floor().long()
        for heading in range(headings):
            for row, column in cells[heading].tolist():
                passed[heading, row, column] += 1 / _POINTS
            end = own[heading, -1].tolist()
            row, column = (min(math.floor(part + 1e-9), 2 * reach - 1) for part in end)
            for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
                beside = (
                    abs(1 - down - (end[0] - row)),
                    abs(1 - across - (end[1] - column)),
                )
                ends[heading, row + down, column + across] += beside[0] * beside[1]
        metres = float(moves.actions[place, 0].abs()) * seconds
        points = tuple(
            (cells[:, number, 0].tolist(), cells[:, number, 1].tolist())
            for number in range(_POINTS)
        )
        found.append(
            _Arc(
                seconds,
                metres,
                turn,
                passed[:, None].to(like),
                ends[:, None].to(like),
                points,
            )
        )
    return found


def _solve(costs: Costs, arcs: list[_Arc], grid: Grid) -> CostToGo:
    headings, levels = len(arcs[0].ends), costs.levels
    frame = (arcs[0].reach,) * 4
    weights = torch.where(costs.open, 1.0, _BARRED)[:, None]
    spent, share, dwells = [], [], []
    kept: list[Tensor | None] = []
    # Off the map a second costs as much as no way at all, and a cell beyond is as the
    # one at the border.
    rate, framed = (
        pad(costs.rate[:, None], frame, value=UNREACHED),
        pad(weights, frame, mode="replicate"),
    )
    for arc in arcs:
        cost = arc.seconds * conv2d(rate, arc.passed)
        share.append(1 / conv2d(framed, arc.ends))
        keep = None
        if costs.hazard is not None:
            keep = torch.exp(
                -arc.metres * conv2d(pad(costs.hazard[:, None], frame), arc.passed)
            )
            cost = cost + (1 - keep) * costs.loss[:, None, None, None]
        spent.append(cost)
        kept.append(keep)
        dwells.append(None if costs.immobile_s is None else _dwell_along(costs, arc))

    def at_end(arc: _Arc, share: Tensor, values: Tensor) -> Tensor:
        """Values between the cells and headings where an arc ends."""
        turned = values.roll(-arc.turn, 2)
        if not arc.metres:
            return turned
        inside = pad((turned * weights[:, None]).flatten(0, 1), frame, mode="replicate")
        return (
            conv2d(inside, arc.ends, groups=headings).view_as(values) * share[:, None]
        )

    final = costs.final[:, None, None]
    value = (
        torch.where(final.isnan(), UNREACHED, final)
        .expand(-1, levels, headings, -1, -1)
        .clone()
    )
    dwell = (
        None if costs.immobile_s is None else torch.full_like(value, costs.lost_after_s)
    )
    settled = torch.zeros_like(final, dtype=torch.bool)[..., :1, :1]
    for sweep in range(1, _MOST_SWEEPS * max(grid.shape)):
        before, dwell_before = value, dwell
        for number, arc in enumerate(arcs):
            ended, along = at_end(arc, share[number], value), dwells[number]
            ended_dwell = None
            if along is not None:
                assert dwell is not None
                ended, ended_dwell = along.before(
                    ended, at_end(arc, share[number], dwell), costs.lost_after_s
                )
            keep = kept[number]
            found = (ended if keep is None else ended * keep[:, None]) + spent[number][
                :, None
            ]
            better = final.isnan() & (found < value)
            value = torch.where(better, found, value)
            if ended_dwell is not None:
                assert dwell is not None
                dwell = torch.where(better, ended_dwell, dwell)
        # A map that has settled stays, so that none depends on those beside it.
        value = torch.where(settled, before, value)
        if dwell is not None and dwell_before is not None:
            dwell = torch.where(settled, dwell_before, dwell)
        if sweep % _CHECK_EVERY == 0:
            change = before - value
            if dwell is not None:
                # Between states with a way and without, values go down for long, and
                # mean nothing.
                change = torch.where(value < _MIXED, change, 0.0)
            settled = change.flatten(1).amax(1)[:, None, None, None, None] < _SETTLED
            if bool(settled.all()):
                break
    return CostToGo(value=value, max_dwell_s=dwell)


@dataclass(frozen=True)
class _Dwell:
    """Dwell time along an arc, from every state.

    Args:
        first_s: until the arc first leaves immobilising terrain, or of all of it, shape
            [B, Q, H, W].
        last_s: after it last left it, 0 where it never does, of the same shape.
        leaves: whether a point of it lies on other terrain, bool, of the same shape.
        is_lost: whether a robot is lost between both, bool, of the same shape.
    """

    first_s: Tensor
    last_s: Tensor
    leaves: Tensor
    is_lost: Tensor

    def before(
        self, value: Tensor, max_dwell_s: Tensor, lost_after_s: float
    ) -> tuple[Tensor, Tensor]:
        """Return costs to go and their dwell times at an arc's beginning, from those at
        its end, [B, L, Q, H, W].
        """
        levels = value.shape[1]
        dwell = (
            torch.where(self.leaves[:, None], lost_after_s, max_dwell_s)
            - self.first_s[:, None]
        )
        is_lost = self.is_lost[:, None] | (max_dwell_s <= self.last_s[:, None])
        dwell = torch.where(is_lost, 0.0, dwell)
        # The more dwell time a drive leaves, the more it costs: the first that leaves
        # enough is the cheapest.
        least_s = [
            max(level * lost_after_s / levels, _LEAST_DWELL_S)
            for level in range(levels)
        ]
        index = torch.stack([(dwell < least).sum(1) for least in least_s], 1)
        none = torch.full_like(value[:, :1], UNREACHED)
        unlimited = torch.full_like(none, lost_after_s)
        return (
            torch.cat((value, none), 1).gather(1, index),
            torch.cat((dwell, unlimited), 1).gather(1, index),
        )


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
