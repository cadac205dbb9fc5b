"""What labels of look-alike classes are drawn from: the cells around what is new, and
the nearest observed ones.

Letters in shapes: B episodes, H×W cells, R×C cells of a block, N observed cells, S
chains.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from benchnav.core.batch import Batch
from benchnav.planning.sensing.copula import bounds, nearest
from benchnav.planning.sensing.gaussian import Field
from benchnav.planning.sensing.labels import Lattice, Noise, noise, unpacked

_REACH = 12  # cells
_SETTLED = (
    0.005  # probability of a label under which an observed cell is not drawn again
)
LEAST_CHANGE = 0.01
"""Of the probability of a cell that was not observed."""
_LEAST_PRECISION = 1e-6  # of a term


@dataclass(frozen=True, kw_only=True)
class Evidence(Batch):
    """What labels are drawn from, and the labels.

    Args:
        field: how the scores hang together, B of them.
        lower: least observed score under the first and the second class, NaN where
            there is none, shape [B, 2, H, W].
        upper: greatest observed score; where it is the least, the score itself.
        noise_std: standard deviation of the noise of the score, shape [B, H, W].
        density: log f / φ of what was observed under either class, 0 where it is an
            interval, shape [B, 2, H, W].
        precision: of the Gaussian terms that stand for observations, shape [B, H, W].
        shift: precision times mean of the terms.
        pair: number of the pair of which each cell may be, from 1; 0 for none, int64,
            shape [B, H, W].
        chance: of the first class given what was observed, float64, shape [B, H, W].
        labels: of the chains; a bit is set for the first class, int64, shape [B, H, W].
        sweeps: how many each episode had, int64, shape [B].
    """

    field: Field
    lower: Tensor
    upper: Tensor
    noise_std: Tensor
    density: Tensor
    precision: Tensor
    shift: Tensor
    pair: Tensor
    chance: Tensor
    labels: Tensor
    sweeps: Tensor


@dataclass(frozen=True, kw_only=True)
class Block:
    """The cells of a rectangle around what is new.

    Args:
        at: indices into maps, shapes [B, 1] and twice [B, RC].
        row: int64, shape [B, R, C].
        column: int64.
        pair: number of the pair of which they may be, int64.
        chance: of the first class, as it was known.
        observed: which are, bool.
        own: which are in reach; the others keep their labels, bool.
        lattice: of these cells.
        degree: how many neighbours hang together with each.
        torus: length of a side of a map, by which random numbers are kept.
    """

    at: tuple[Tensor, Tensor, Tensor]
    row: Tensor
    column: Tensor
    pair: Tensor
    chance: Tensor
    observed: Tensor
    own: Tensor
    lattice: Lattice
    degree: Tensor
    torus: int

    @classmethod
    def around(cls, evidence: Evidence, changed: Tensor, strength: float) -> "Block":
        """The block that has all cells in reach of what changed, and their neighbours."""
        ends = torch.tensor(
            [bounds(new) for new in changed.cpu().numpy()], device=changed.device
        )
        lines = []
        for (low, high), size in zip(
            ends.permute(1, 2, 0), changed.shape[1:], strict=True
        ):
            most = min(int((high - low).max()) + 1 + 2 * (_REACH + 1), size)
            begin = (low - _REACH - 1).clamp(min=0).clamp(max=size - most)
            lines.append(begin[:, None] + torch.arange(most, device=low.device))
        row = lines[0][:, :, None].expand(-1, -1, lines[1].shape[1])
        column = lines[1][:, None].expand_as(row)
        at = (
            torch.arange(len(changed), device=changed.device)[:, None],
            row.flatten(1),
            column.flatten(1),
        )
        pair, chance, observed = (
            values[at].view_as(row)
            for values in (evidence.pair, evidence.chance, ~evidence.noise_std.isnan())
        )
        away = torch.zeros_like(row)
        for place, (low, high) in zip(
            (row, column), ends.permute(1, 2, 0), strict=True
        ):
            off = torch.maximum(low[:, None, None] - place, place - high[:, None, None])
            away = torch.maximum(away, off)
        # Beyond the neighbours of cells in reach nothing counts: what is there depends
        # on the other episodes.
        pair, own = torch.where(away <= _REACH + 1, pair, 0), away <= _REACH
        lattice = Lattice.of(pair, strength)
        return cls(
            at=at,
            row=row,
            column=column,
            pair=pair,
            chance=chance,
            observed=observed,
            own=own,
            lattice=lattice,
            degree=lattice.degree(),
            torus=max(changed.shape[1:]),
        )

    @property
    def free(self) -> Tensor:
        """All bits set where a sweep draws labels."""
        return -((self.pair > 0) & self.own & ~self.observed).long()

    @property
    def even(self) -> Tensor:
        """All bits set on one colour of the checkerboard."""
        return -((self.row + self.column) % 2)

    @property
    def evidence(self) -> Tensor:
        """All bits set where something is known of the label: observed, or out of reach
        and told by what is farther.
        """
        told = ~self.own & ((self.chance - 0.5).abs() > LEAST_CHANGE)
        return -((self.pair > 0) & (self.observed | told)).long()

    def noise(self, sweeps: Tensor) -> Noise:
        """Random bits of the next sweep."""
        return noise(
            sweeps,
            self.row,
            self.column,
            self.degree,
            self.lattice.strength,
            self.torus,
        )


@dataclass(frozen=True, kw_only=True)
class Sites:
    """Observed cells, those that are new last, and what is known of them.

    Args:
        row: where they are, int64, shape [B, N].
        column: int64.
        cell: place in the block, int64, shape [B, N].
        near: places of the four cells beside each, int64, shape [B, N, 4].
        tied: all bits set where they hang together with it, int64.
        strength: β.
        lower: least score under either class, shape [B, 2, N].
        upper: greatest score.
        density: log f / φ, 0 of intervals.
        std: of the noise, shape [B, N].
        noise: variance of the noise, or of the term that stands for an interval, shape
            [B, N].
        factor: Cholesky factor of the covariance of noisy scores, shape [B, N, N].
        scores: noisy scores of each chain, 0 where they are new or empty, shape [B, S,
            N].
        fresh: which are new, bool, shape [B, N].
        held: which are intervals that have a term.
        open: which are drawn.
        loose: which may be given the other label together with a patch.
    """

    row: Tensor
    column: Tensor
    cell: Tensor
    near: Tensor
    tied: Tensor
    strength: float
    lower: Tensor
    upper: Tensor
    density: Tensor
    std: Tensor
    noise: Tensor
    factor: Tensor
    scores: Tensor
    fresh: Tensor
    held: Tensor
    open: Tensor
    loose: Tensor

    @classmethod
    def of(
        cls, evidence: Evidence, changed: Tensor, block: Block, window: int
    ) -> "Sites":
        """The observed cells nearest to what is new."""
        found = [
            nearest(known, new, window)
            for known, new in zip(
                (~evidence.noise_std.isnan()).cpu().numpy(),
                changed.cpu().numpy(),
                strict=True,
            )
        ]
        row, column, there = (
            pad_sequence([torch.from_numpy(own) for own in each], batch_first=True)
            .flip(1)
            .to(changed.device)
            for each in zip(
                *((row, column, row >= 0) for row, column in found), strict=True
            )
        )
        at = block.at[0], row, column
        top, left, across = (
            block.row[:, 0, :1],
            block.column[:, 0, :1],
            block.row.shape[2],
        )
        down, right = row - top, column - left
        inside = (
            there
            & (down >= 0)
            & (down < block.row.shape[1])
            & (right >= 0)
            & (right < across)
        )
        cell = torch.where(inside, down * across + right, 0)
        inside &= block.own.flatten(1).gather(1, cell)
        near, tied = _beside(cell, block.lattice)

        def both(values: Tensor) -> Tensor:
            return torch.where(
                there[:, None], values.transpose(0, 1)[:, *at].transpose(0, 1), 0.0
            )

        lower, upper, pair = (
            both(evidence.lower),
            both(evidence.upper),
            evidence.pair[at] > 0,
        )
        std = torch.where(there, evidence.noise_std[at], 1.0)
        fresh, interval = changed[at] & there, (upper > lower)[:, 0]
        held, precision = (
            interval & ~fresh,
            evidence.precision[at].clamp(min=_LEAST_PRECISION),
        )
        noise = torch.where(held, 1 / precision, std.square())
        apart = (place[:, :, None] - place[:, None] for place in (row, column))
        covariance = evidence.field.covariance(block.at[0][..., None], *apart)
        covariance = torch.where(there[:, :, None] & there[:, None], covariance, 0.0)
        covariance.diagonal(dim1=1, dim2=2).copy_(torch.where(there, 1 + noise, 1.0))
        labels = unpacked(evidence.labels[at]).transpose(1, 2)
        scores = torch.where(labels, lower[:, :1], lower[:, 1:])
        scores = torch.where(
            held[:, None], (evidence.shift[at] / precision)[:, None], scores
        )
        unsettled = (evidence.chance[at] - 0.5).abs() < 0.5 - _SETTLED
        return cls(
            row=row,
            column=column,
            cell=cell,
            near=near,
            tied=torch.where(inside[..., None], tied, 0),
            strength=block.lattice.strength,
            lower=lower,
            upper=upper,
            density=both(evidence.density),
            std=std,
            noise=noise,
            factor=torch.linalg.cholesky(covariance),
            scores=torch.where((there & ~fresh)[:, None], scores, 0.0),
            fresh=fresh,
            held=held,
            open=fresh | (inside & pair & unsettled),
            loose=inside & pair & ~interval,
        )

    def draw(
        self,
        place: int,
        mean: Tensor,
        variance: Tensor,
        labels: Tensor,
        uniforms: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draws the label of one cell of each episode, and a score within it.

        Args:
            place: among the sites.
            mean: of the noisy score given others, shape [B, S].
            variance: as much, shape [B, 1].
            labels: of the block, int64, shape [B, RC].
            uniforms: shape [B, S, 2].

        Returns:
            Whether the label is the first, the probability of that, the log density of
            what was observed, and the score, each of shape [B, S].
        """
        beside = labels.gather(1, self.near[:, place]) & self.tied[:, place]
        odds = self.strength * (
            unpacked(beside).sum(1) * 2 + self.tied[:, place].sum(1)[:, None]
        )
        lower, upper, density = (
            own[:, :, place, None] for own in (self.lower, self.upper, self.density)
        )
        number, std, mean = upper <= lower, variance.sqrt()[:, None], mean[:, None]
        low, high = (lower - mean) / std, (upper - mean) / std
        at_number = (
            density - 0.5 * low.square() - std.log() - 0.5 * math.log(2 * math.pi)
        )
        # An interval on the side where Φ is small, so that nothing is lost to rounding.
        mirrored = low + high > 0
        low, high = torch.where(mirrored, -high, low), torch.where(mirrored, -low, high)
        log_high = torch.special.log_ndtr(high)
        apart = (torch.special.log_ndtr(low) - log_high).clamp(max=-1e-300)
        told = torch.where(number, at_number, log_high + torch.log(-torch.expm1(apart)))
        chance = torch.sigmoid(odds + told[:, 0] - told[:, 1])
        by_class = told + torch.nn.functional.logsigmoid(torch.stack((odds, -odds), 1))
        first, below = uniforms[..., 0] < chance, torch.special.ndtr(low)
        rank = below + (torch.special.ndtr(high) - below) * uniforms[:, None, :, 1]
        inner = torch.special.ndtri(rank.clamp(min=1e-300))
        inner = mean + std * torch.where(mirrored, -inner, inner)
        inner = torch.where(
            number, lower, torch.maximum(torch.minimum(inner, upper), lower)
        )
        return (
            first,
            chance,
            by_class.logsumexp(1),
            torch.where(first, inner[:, 0], inner[:, 1]),
        )


def _beside(cell: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """The four cells beside some of a block, and all bits set where they hang together,
    each of shape [B, N, 4].
    """
    across, most = lattice.right.shape[2], lattice.right[0].numel() - 1
    every = lattice.neighbours(torch.full_like(lattice.right, -1))
    ties = torch.stack([part.flatten(1) for part in every], 2)
    steps = torch.tensor((1, -1, across, -across), device=cell.device)
    return (cell[..., None] + steps).clamp(0, most), ties.gather(
        1, cell[..., None].expand(-1, -1, 4)
    )
