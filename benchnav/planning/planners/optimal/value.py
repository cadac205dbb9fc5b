"""Value iteration over (x, y, θ): the least cost to go of a unicycle on a map of what a second of driving costs.

A robot stands at a cell's centre and looks along one of Q headings. It holds an action for about a cell: full speed
along five arcs, or a turn on the spot by one heading. λ scales speed and turn rate alike, so that an arc is the same
curve on any ground, and takes 1/λ times as long: where arcs end and which cells they pass is the same for all cells of
all maps. So a sweep over all states is a convolution of the values for each arc. Between cells values are interpolated,
bilinearly, over those that are open. Source: Falcone and Ferretti (2013), "Semi-Lagrangian approximation schemes for
linear and Hamilton-Jacobi equations".

Letters in shapes: B maps, H×W cells, Q headings, A actions, N points along an arc, R reach of an arc in cells, L levels
of time held.
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
_BARRED = 1e-9  # weight of a cell that is not free beside one that is
_SETTLED = 1e-3  # least change that counts
_CHECK_EVERY = 10  # sweeps
_MOST_SWEEPS = 40  # for a cell of the longer side
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
        """Those of a unicycle: as far as turns come to whole headings, but at least one, and at most a cell else."""
        (top, most), bin_rad = robot.action_high, 2 * math.pi / headings
        found = [((top, 0.0), cell_m / top, 0)]
        for speed, rate in ((top, most / 2), (top, most), (0.0, most)):
            bins = max(1, math.floor(cell_m * rate / speed / bin_rad + 1e-9)) if speed else 1
            found += [((speed, side * rate), bins * bin_rad / rate, side * bins) for side in (1, -1)]
        actions, seconds, turns = zip(*found, strict=True)
        return cls(
            torch.tensor(actions, dtype=torch.float64), torch.tensor(seconds, dtype=torch.float64), turns
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
        final: cost to go where ways end, under 0 where the robot has arrived before; NaN elsewhere, shape [B, H, W].
        hazard: chance of being lost on a metre, as −ln of that of not being lost, shape [B, H, W]; None for none.
        loss: cost of being lost, shape [B].
        immobile_s: seconds on immobilising ground for each second of driving with λ = 1, 0 where none does, shape
            [B, H, W]; None where nothing immobilises a robot.
        lost_after_s: time on such ground, without a break, after which a robot is lost.
        levels: L, of time held.
    """

    rate: Tensor
    open: Tensor
    final: Tensor
    loss: Tensor
    hazard: Tensor | None = None
    immobile_s: Tensor | None = None
    lost_after_s: float = 1.0
    levels: int = 1

    def level(self, held: Tensor) -> Tensor:
        """Nearest level of a time held, at least 1 where there is any, int64, of the same shape; L is lost."""
        nearest = (held / self.lost_after_s * self.levels + 0.5).floor().long()
        return torch.where(held > 0, nearest.clamp(1, self.levels), 0)


def value_iteration(costs: Costs, moves: Moves, grid: Grid, headings: int) -> Tensor:
    """The least cost to go of every state, shape [B, L, Q, H, W].

    Args:
        costs: of B maps.
        moves: what the robot may do.
        grid: of the maps.
        headings: Q.

    Returns:
        `UNREACHED` where there is no way; at the level l a robot has had l / L of the time after which it is lost.
    """
    arcs = _arcs(moves, grid, headings, costs.rate)
    maps = torch.arange(len(costs.rate), device=costs.rate.device).split(_MAPS_AT_ONCE)
    return torch.cat([_solve(costs.select(some), arcs, grid) for some in maps])


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
    shares = torch.cat(((torch.arange(_POINTS) + 0.5) / _POINTS, torch.ones(1))).double()
    offsets = moves.offsets(headings_of(headings), shares) / grid.resolution_m  # [Q, A, N + 1, 2]
    reach = max(1, math.ceil(float(offsets.abs().max()) - 1e-9))
    found = []
    for place, (seconds, turn) in enumerate(zip(moves.seconds.tolist(), moves.turns, strict=True)):
        passed, ends = (torch.zeros(headings, 2 * reach + 1, 2 * reach + 1) for _ in range(2))
        own = offsets[:, place].flip(-1) + reach  # rows and columns
        cells = (own[:, :-1] + 0.5).floor().long()
        for heading in range(headings):
            for row, column in cells[heading].tolist():
                passed[heading, row, column] += 1 / _POINTS
            end = own[heading, -1].tolist()
            row, column = (min(math.floor(part + 1e-9), 2 * reach - 1) for part in end)
            for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
                beside = abs(1 - down - (end[0] - row)), abs(1 - across - (end[1] - column))
                ends[heading, row + down, column + across] += beside[0] * beside[1]
        metres = float(moves.actions[place, 0].abs()) * seconds
        points = tuple(
            (cells[:, number, 0].tolist(), cells[:, number, 1].tolist()) for number in range(_POINTS)
        )
        found.append(_Arc(seconds, metres, turn, passed[:, None].to(like), ends[:, None].to(like), points))
    return found


def _solve(costs: Costs, arcs: list[_Arc], grid: Grid) -> Tensor:
    headings, levels = len(arcs[0].ends), costs.levels
    frame = (arcs[0].reach,) * 4
    weights = torch.where(costs.open, 1.0, _BARRED)[:, None]
    spent, share, after = [], [], []
    kept: list[Tensor | None] = []
    # Off the map a second costs as much as no way at all, and a cell beyond is as the one at the border.
    rate, framed = pad(costs.rate[:, None], frame, value=UNREACHED), pad(weights, frame, mode="replicate")
    for arc in arcs:
        cost = arc.seconds * conv2d(rate, arc.passed)
        share.append(1 / conv2d(framed, arc.ends))
        keep = None
        if costs.hazard is not None:
            keep = torch.exp(-arc.metres * conv2d(pad(costs.hazard[:, None], frame), arc.passed))
            cost = cost + (1 - keep) * costs.loss[:, None, None, None]
        spent.append(cost)
        kept.append(keep)
        after.append(None if costs.immobile_s is None else _held_after(costs, arc))
    final = costs.final[:, None, None]
    value = torch.where(final.isnan(), UNREACHED, final).expand(-1, levels, headings, -1, -1).clone()
    settled = torch.zeros_like(final, dtype=torch.bool)[..., :1, :1]
    for sweep in range(1, _MOST_SWEEPS * max(grid.shape)):
        before = value
        for number, arc in enumerate(arcs):
            turned = value.roll(-arc.turn, 2)
            if arc.metres:
                inside = pad((turned * weights[:, None]).flatten(0, 1), frame, mode="replicate")
                ended = conv2d(inside, arc.ends, groups=headings).view_as(value) * share[number][:, None]
            else:
                ended = turned
            level = after[number]
            if level is not None:
                lost = torch.full_like(ended[:, :1], UNREACHED)
                ended = torch.cat((ended, lost), 1).gather(1, level)
            keep = kept[number]
            found = (ended if keep is None else ended * keep[:, None]) + spent[number][:, None]
            value = torch.where(final.isnan(), torch.minimum(value, found), final)
        # A map that has settled stays, so that none depends on those beside it.
        value = torch.where(settled, before, value)
        if sweep % _CHECK_EVERY == 0:
            settled = (before - value).flatten(1).amax(1)[:, None, None, None, None] < _SETTLED
            if bool(settled.all()):
                break
    return value


def _held_after(costs: Costs, arc: _Arc) -> Tensor:
    """Levels of time held after an arc, by that before it, L where the robot is lost, int64, shape [B, L, Q, H, W]."""
    assert costs.immobile_s is not None
    (size, height, width), reach = costs.immobile_s.shape, arc.reach
    headings, step = len(arc.ends), arc.seconds / _POINTS
    around = pad(costs.immobile_s[:, None], (reach,) * 4)[:, 0]
    before = torch.arange(costs.levels, device=around.device)[None, :, None, None, None]
    start = before.to(around) * (costs.lost_after_s / costs.levels)
    held = start.expand(size, -1, headings, height, width).clone()
    lost, whole = (torch.full_like(held, value, dtype=torch.bool) for value in (False, True))
    for rows, columns in arc.points:
        seconds = step * torch.stack(
            [
                around[:, row : row + height, column : column + width]
                for row, column in zip(rows, columns, strict=True)
            ],
            1,
        )
        held = torch.where(seconds[:, None] > 0, held + seconds[:, None], 0.0)
        lost |= held >= costs.lost_after_s
        whole &= seconds[:, None] > 0
    # A move that is all on such ground adds a level: else the time of short ones would never add up.
    level = torch.maximum(costs.level(held), torch.where(whole, before + 1, 0))
    return torch.where(lost, costs.levels, level)
