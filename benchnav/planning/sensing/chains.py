"""Which of two look-alike classes cells are of, given λ: 64 chains of labels, drawn anew near what was observed.

New observations weigh the chains by how likely they make them, and chains are resampled (a particle filter). Sweeps
over cells that were not observed follow, by their neighbours; one patch of observed and other cells is offered the
other label at once; and observed cells that are new or open are drawn given all others, by the joint density of scores.
Older λ at 0 or 1, whose score is an interval, has a Gaussian term in its place, of expectation propagation at the more
probable label of its cell. Only cells within `_REACH` of what is new are drawn. A labelling that none of the chains
holds comes back by these moves alone.
Letters in shapes: B episodes, H×W cells, R×C cells of a block, N observed cells, S chains.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.planning.sensing import copula
from benchnav.planning.sensing.belief import Law
from benchnav.planning.sensing.gaussian import Cells, Field
from benchnav.planning.sensing.labels import (
    CHAINS,
    Lattice,
    Noise,
    count,
    joined,
    noise,
    packed,
    swept,
    unpacked,
)

_REACH = 12  # cells
_ROUNDS, _TOLD = 6, 3  # sweeps in an update, and how many of the last of them are counted
_SETTLED = 0.005  # probability of a label under which an observed cell is not drawn again
_LEAST_CHANGE = 0.01  # of the probability of a cell that was not observed
_LEAST_PRECISION = 1e-6  # of a term
_PASSES = 8  # over observed cells, of which random numbers are kept; later ones take them from other cells
_STEP = 13, 31  # by how many rows and columns, of the torus
_STARTS = 4096  # of resamplings, of which random numbers are kept


@dataclass(frozen=True, kw_only=True)
class Evidence(Batch):
    """What labels are drawn from, and the labels.

    Args:
        lower: least observed score under the first and the second class, NaN where there is none, shape [B, 2, H, W].
        upper: greatest observed score; where it is the least, the score itself.
        noise_std: standard deviation of the noise of the score, shape [B, H, W].
        density: log f / φ of what was observed under either class, 0 where it is an interval, shape [B, 2, H, W].
        precision: of the Gaussian terms that stand for observations, shape [B, H, W].
        shift: precision times mean of the terms.
        pair: number of the pair of which each cell may be, from 1; 0 for none, int64, shape [B, H, W].
        chance: of the first class given what was observed, float64, shape [B, H, W].
        labels: of the chains; a bit is set for the first class, int64, shape [B, H, W].
        sweeps: how many each episode had, int64, shape [B].
    """

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


def draw_labels(evidence: Evidence, changed: Tensor, law: Law, strength: float, window: int) -> Evidence:
    """Draws labels near what changed, and tells the probabilities of classes there.

    Args:
        evidence: its scores hold what is new, its terms and probabilities what was known before.
        changed: cells of which something new is known, in each episode one or more, bool, shape [B, H, W].
        law: how λ hangs together.
        strength: β of the Potts field.
        window: most observed cells that are looked at, those nearest to what is new; more where more is new.

    Returns:
        The evidence with other `chance`, `labels` and `sweeps`.
    """
    block = _Block.around(evidence, changed, strength)
    sites = _Sites.of(evidence, changed, block, law, window)
    labels = evidence.labels[block.at]
    filtered, scores = _filtered(labels, sites, evidence.sweeps, block.torus)
    labels = torch.where(block.own.flatten(1), filtered, labels)
    inverse, sweeps = torch.cholesky_inverse(sites.factor), evidence.sweeps
    seen, joins = torch.zeros_like(sites.std), torch.zeros_like(block.chance)
    for turn in range(_ROUNDS):
        drawn = block.noise(sweeps)
        labels = swept(labels.view_as(block.row), block.lattice, block.free, block.even, drawn)
        if turn == _ROUNDS - _TOLD:
            labels, scores = _flipped(labels, scores, sites, block, inverse, drawn, sweeps)
        if turn >= _ROUNDS - _TOLD:
            labels, scores, told = _visited(labels.flatten(1), scores, sites, inverse, sweeps, block.torus)
            seen, labels = seen + told / _TOLD, labels.view_as(block.row)
            tied = joined(labels, block.lattice, block.evidence, drawn)
            # Of cells that no ties join to evidence either label is as likely.
            joins = joins + count(labels & tied) + 0.5 * (CHAINS - count(tied))
        sweeps = sweeps + 1
    found = (joins + 0.5) / (CHAINS * _TOLD + 1)
    moved = (block.free != 0) & ((found - block.chance).abs() >= _LEAST_CHANGE)
    chance = evidence.chance.index_put(block.at, torch.where(moved, found, block.chance).flatten(1))
    member = block.at[0].expand_as(sites.cell)
    places = tuple(part[sites.open] for part in (member, sites.cells.row, sites.cells.column))
    chance = chance.index_put(places, seen[sites.open])
    labels = evidence.labels.index_put(block.at, labels.flatten(1))
    return replace(evidence, chance=chance, labels=labels, sweeps=sweeps)


@dataclass(frozen=True, kw_only=True)
class _Block:
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
    def around(cls, evidence: Evidence, changed: Tensor, strength: float) -> "_Block":
        """The block that has all cells in reach of what changed, and their neighbours."""
        first, last = copula._bounds(changed)
        cells, _ = copula._block(first, last, _REACH + 1, (changed.shape[1], changed.shape[2]))
        across = int((cells.row[0] == cells.row[0, 0]).sum())
        at = torch.arange(len(changed), device=changed.device)[:, None], cells.row, cells.column
        row, column, pair, chance, observed = (
            values[at].view(len(changed), -1, across)
            for values in (*places_of(changed), evidence.pair, evidence.chance, ~evidence.noise_std.isnan())
        )
        away = torch.zeros_like(row)
        for place, low, high in zip((row, column), first.T, last.T, strict=True):
            off = torch.maximum(low[:, None, None] - place, place - high[:, None, None])
            away = torch.maximum(away, off)
        # Beyond the neighbours of cells in reach nothing counts: what is there depends on the other episodes.
        pair, own = torch.where(away <= _REACH + 1, pair, 0), away <= _REACH
        lattice = Lattice.of(pair, strength)
        return cls(
            at=at, row=row, column=column, pair=pair, chance=chance, observed=observed, own=own, lattice=lattice,
            degree=lattice.degree(), torus=max(changed.shape[1:]),
        )  # fmt: skip

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
        """All bits set where something is known of the label: observed, or out of reach and told by what is farther."""
        told = ~self.own & ((self.chance - 0.5).abs() > _LEAST_CHANGE)
        return -((self.pair > 0) & (self.observed | told)).long()

    def noise(self, sweeps: Tensor) -> Noise:
        """Random bits of the next sweep."""
        return noise(sweeps, self.row, self.column, self.degree, self.lattice.strength, self.torus)


@dataclass(frozen=True, kw_only=True)
class _Sites:
    """Observed cells, those that are new last, and what is known of them.

    Args:
        cells: where they are, shape [B, N].
        cell: place in the block, int64, shape [B, N].
        near: places of the four cells beside each, int64, shape [B, N, 4].
        tied: all bits set where they hang together with it, int64.
        strength: β.
        lower: least score under either class, shape [B, 2, N].
        upper: greatest score.
        density: log f / φ, 0 of intervals.
        std: of the noise, shape [B, N].
        noise: variance of the noise, or of the term that stands for an interval, shape [B, N].
        factor: Cholesky factor of the covariance of noisy scores, shape [B, N, N].
        scores: noisy scores of each chain, 0 where they are new or empty, shape [B, S, N].
        fresh: which are new, bool, shape [B, N].
        held: which are intervals that have a term.
        open: which are drawn.
        loose: which may be given the other label together with a patch.
    """

    cells: Cells
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
    def of(cls, evidence: Evidence, changed: Tensor, block: _Block, law: Law, window: int) -> "_Sites":
        """The observed cells nearest to what is new."""
        first, last = copula._bounds(changed)
        found, there = copula._nearest(~evidence.noise_std.isnan(), changed, first, last, window)
        cells, there = Cells(row=found.row.flip(1), column=found.column.flip(1)), there.flip(1)
        at = block.at[0], cells.row, cells.column
        top, left, across = block.row[:, 0, :1], block.column[:, 0, :1], block.row.shape[2]
        down, right = cells.row - top, cells.column - left
        inside = there & (down >= 0) & (down < block.row.shape[1]) & (right >= 0) & (right < across)
        cell = torch.where(inside, down * across + right, 0)
        inside &= block.own.flatten(1).gather(1, cell)
        near, tied = _beside(cell, block.lattice)

        def both(values: Tensor) -> Tensor:
            return torch.where(there[:, None], values.transpose(0, 1)[:, *at].transpose(0, 1), 0.0)

        lower, upper, pair = both(evidence.lower), both(evidence.upper), evidence.pair[at] > 0
        std = torch.where(there, evidence.noise_std[at], 1.0)
        fresh, interval = changed[at] & there, (upper > lower)[:, 0]
        held, precision = interval & ~fresh, evidence.precision[at].clamp(min=_LEAST_PRECISION)
        noise = torch.where(held, 1 / precision, std.square())
        covariance = Field.of(law.grid.shape, law.correlation_cells, changed.device).covariance(cells, cells)
        covariance = torch.where(there[:, :, None] & there[:, None], covariance, 0.0)
        covariance.diagonal(dim1=1, dim2=2).copy_(torch.where(there, 1 + noise, 1.0))
        labels = unpacked(evidence.labels[at]).transpose(1, 2)
        scores = torch.where(labels, lower[:, :1], lower[:, 1:])
        scores = torch.where(held[:, None], (evidence.shift[at] / precision)[:, None], scores)
        unsettled = (evidence.chance[at] - 0.5).abs() < 0.5 - _SETTLED
        return cls(
            cells=cells, cell=cell, near=near, tied=torch.where(inside[..., None], tied, 0),
            strength=block.lattice.strength, lower=lower, upper=upper, density=both(evidence.density), std=std,
            noise=noise, factor=torch.linalg.cholesky(covariance),
            scores=torch.where((there & ~fresh)[:, None], scores, 0.0), fresh=fresh, held=held,
            open=fresh | (inside & pair & unsettled), loose=inside & pair & ~interval,
        )  # fmt: skip

    def draw(
        self, place: int, mean: Tensor, variance: Tensor, labels: Tensor, uniforms: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draws the label of one cell of each episode, and a score within it.

        Args:
            place: among the sites.
            mean: of the noisy score given others, shape [B, S].
            variance: as much, shape [B, 1].
            labels: of the block, int64, shape [B, RC].
            uniforms: shape [B, S, 2].

        Returns:
            Whether the label is the first, the probability of that, the log density of what was observed, and the
            score, each of shape [B, S].
        """
        beside = labels.gather(1, self.near[:, place]) & self.tied[:, place]
        odds = self.strength * (unpacked(beside).sum(1) * 2 + self.tied[:, place].sum(1)[:, None])
        lower, upper, density = (own[:, :, place, None] for own in (self.lower, self.upper, self.density))
        number, std, mean = upper <= lower, variance.sqrt()[:, None], mean[:, None]
        low, high = (lower - mean) / std, (upper - mean) / std
        at_number = density - 0.5 * low.square() - std.log() - 0.5 * math.log(2 * math.pi)
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
        inner = torch.where(number, lower, torch.maximum(torch.minimum(inner, upper), lower))
        return first, chance, by_class.logsumexp(1), torch.where(first, inner[:, 0], inner[:, 1])


def _filtered(labels: Tensor, sites: _Sites, sweeps: Tensor, torus: int) -> tuple[Tensor, Tensor]:
    """Labels of a block [B, RC] and scores [B, S, N] of chains that are weighed by new observations, one by one."""
    fresh, factor, scores = sites.fresh, sites.factor, sites.scores.clone()
    white = torch.linalg.solve_triangular(factor, scores.transpose(1, 2), upper=False)
    white, weights = white.transpose(1, 2).contiguous(), torch.zeros_like(scores[:, :, 0])
    begin = int((~fresh).int().cumprod(1).sum(1).min())
    uniforms = _uniforms(sweeps, sites.cells, torus, begin)
    for place in range(begin, fresh.shape[1]):
        new, scale = fresh[:, place, None], factor[:, place, place, None]
        mean = (white[:, :, :place] @ factor[:, place, :place, None])[..., 0]
        toss = uniforms[:, place - begin]
        first, _, told, score = sites.draw(place, mean, scale.square(), labels, toss)
        white[:, :, place] = torch.where(new, (score - mean) / scale, white[:, :, place])
        scores[:, :, place] = torch.where(new, score, scores[:, :, place])
        weights = weights + torch.where(new, told, 0.0)
        labels = _put(labels, sites.cell[:, place], first, new)
    # Systematically, so that chains of one weight all stay.
    steps = (
        torch.arange(CHAINS, device=labels.device) + _starts().to(labels.device)[sweeps % _STARTS, None]
    ) / CHAINS
    chain = torch.searchsorted(torch.softmax(weights, 1).cumsum(1), steps).clamp(max=CHAINS - 1)
    labels = packed((labels[..., None] >> chain[:, None]) & 1)
    return labels, scores.gather(1, chain[..., None].expand_as(scores))


def _flipped(
    labels: Tensor,
    scores: Tensor,
    sites: _Sites,
    block: _Block,
    inverse: Tensor,
    drawn: Noise,
    sweeps: Tensor,
) -> tuple[Tensor, Tensor]:
    """Gives the patch of the last new cell the other label, where what was observed allows it (Metropolis).

    Single labels cannot leave a wrong class, since observed scores are alike. A patch that has cells out of reach, or
    observed as intervals, stays.
    """
    loose, cell, flat = sites.loose, sites.cell, labels.flatten(1)
    takes = torch.zeros_like(flat, dtype=torch.bool).scatter_reduce(1, cell, loose, "amax").view_as(labels)
    barred = (block.pair > 0) & (~block.own | (block.observed & ~takes))
    seed = torch.zeros_like(flat).scatter_(1, cell[:, -1:], -loose[:, -1:].long()).view_as(labels)
    patch = joined(labels, block.lattice, seed, drawn)
    inner = unpacked(patch.flatten(1))
    stays = (inner & barred.flatten(1)[..., None]).any(1)
    among = (inner.gather(1, cell[..., None].expand(-1, -1, CHAINS)) & loose[..., None]).transpose(1, 2)
    first = unpacked(flat.gather(1, cell)).transpose(1, 2)
    proposed = torch.where(among, torch.where(first, sites.lower[:, 1:], sites.lower[:, :1]), scores)
    gain = (sites.density[:, 1:] - sites.density[:, :1]) * torch.where(first, 1.0, -1.0)
    told = torch.where(among, gain, 0.0).sum(2)
    told = told - 0.5 * (((proposed - scores) @ inverse) * (proposed + scores)).sum(2)
    toss = _uniforms(sweeps + 1, sites.cells, block.torus, cell.shape[1] - 1)[:, 0, :, 0]
    taken = ~stays & (toss.log() < told)
    return labels ^ (patch & packed(taken)[:, None, None]), torch.where(taken[..., None], proposed, scores)


def _visited(
    labels: Tensor, scores: Tensor, sites: _Sites, inverse: Tensor, sweeps: Tensor, torus: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Draws open cells given all others: labels [B, RC], scores [B, S, N], and probabilities [B, N]."""
    scores, told = scores.clone(), torch.zeros_like(sites.std)
    places = [int(place) for place in sites.open.any(0).nonzero()[:, 0].flip(0)]
    uniforms = _uniforms(sweeps, sites.cells, torus, places[-1])
    for place in places:
        new, row = sites.open[:, place, None], inverse[:, place]
        share = row[:, place, None]
        mean = scores[:, :, place] - (scores @ row[..., None])[..., 0] / share
        # An interval is one of the score with noise, whatever term stands for it.
        variance = 1 / share + (sites.std[:, place].square() - sites.noise[:, place])[:, None]
        toss = uniforms[:, place - places[-1]]
        first, chance, _, score = sites.draw(place, mean, variance.clamp(min=1e-12), labels, toss)
        score = torch.where(new & ~sites.held[:, place, None], score, scores[:, :, place])
        scores[:, :, place], told[:, place] = score, chance.mean(1)
        labels = _put(labels, sites.cell[:, place], first, new)
    return labels, scores, told


def _beside(cell: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """The four cells beside some of a block, and all bits set where they hang together, each of shape [B, N, 4]."""
    across, most = lattice.right.shape[2], lattice.right[0].numel() - 1
    every = lattice.neighbours(torch.full_like(lattice.right, -1))
    ties = torch.stack([part.flatten(1) for part in every], 2)
    steps = torch.tensor((1, -1, across, -across), device=cell.device)
    return (cell[..., None] + steps).clamp(0, most), ties.gather(1, cell[..., None].expand(-1, -1, 4))


def _put(labels: Tensor, cell: Tensor, first: Tensor, new: Tensor) -> Tensor:
    """Puts the labels of one cell of each episode, where they are new, into those of a block, [B, RC]."""
    word = torch.where(new, packed(first)[:, None], labels.gather(1, cell[:, None]))
    return labels.scatter(1, cell[:, None], word)


def places_of(like: Tensor) -> tuple[Tensor, Tensor]:
    """Row and column of each cell, int64, shape [B, H, W]."""
    row, column = (torch.arange(size, device=like.device) for size in like.shape[1:])
    return row[:, None].expand(like.shape), column.expand(like.shape)


def _uniforms(passed: Tensor, cells: Cells, torus: int, begin: int) -> Tensor:
    """Random numbers of cells from a place on, two a chain, float64, shape [B, N, S, 2]."""
    uses = passed[:, None] // _PASSES
    row, column = (
        (place[:, begin:] + step * uses) % torus
        for place, step in zip((cells.row, cells.column), _STEP, strict=True)
    )
    return _tosses(torus).to(row.device)[passed[:, None] % _PASSES, row * torus + column].double()


@lru_cache(maxsize=2)
def _tosses(torus: int) -> Tensor:
    drawn = rng.uniform(rng.stream_key(0, "labels", "cells"), np.arange(_PASSES), (torus**2, CHAINS, 2))
    return torch.from_numpy(drawn).float()


@lru_cache(maxsize=1)
def _starts() -> Tensor:
    return torch.from_numpy(rng.uniform(rng.stream_key(0, "labels", "chains"), np.arange(_STARTS)))
