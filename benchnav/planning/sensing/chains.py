"""Which of two look-alike classes cells are of, given λ: 64 chains of labels, drawn
anew near what was observed.

New observations weigh the chains by how likely they make them, and chains are resampled
(a particle filter). Sweeps over cells that were not observed follow, by their
neighbours; one patch of observed and other cells is offered the other label at once;
and observed cells that are new or open are drawn given all others, by the joint density
of scores. Older λ at 0 or 1, whose score is an interval, has a Gaussian term in its
place, of expectation propagation at the more probable label of its cell. Only cells
near what is new are drawn (`sites`). A labelling that none of the chains holds comes
back by these moves alone.
Letters in shapes: B episodes, H×W cells, R×C cells of a block, N observed cells, S
chains.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.planning.sensing.labels import (
    CHAINS,
    Noise,
    joined,
    packed,
    swept,
    tally,
    unpacked,
)
from benchnav.planning.sensing.sites import LEAST_CHANGE, Block, Evidence, Sites

# sweeps in an update, and how many of the last of them are counted
_ROUNDS, _TOLD = (
    6,
    3,
)
# over observed cells, of which random numbers are kept; later ones take them from other
# cells
_PASSES = 8
_STEP = 13, 31  # by how many rows and columns, of the torus
_STARTS = 4096  # of resamplings, of which random numbers are kept


def draw_labels(
    evidence: Evidence, changed: Tensor, strength: float, window: int
) -> Evidence:
    """Draws labels near what changed, and tells the probabilities of classes there.

    Args:
        evidence: its scores hold what is new, its terms and probabilities what was
            known before.
        changed: cells of which something new is known, in each episode one or more,
            bool, shape [B, H, W].
        strength: β of the Potts field.
        window: most observed cells that are looked at, those nearest to what is new;
            more where more is new.

    Returns:
        The evidence with other `chance`, `labels` and `sweeps`.
    """
    block = Block.around(evidence, changed, strength)
    sites = Sites.of(evidence, changed, block, window)
    labels = evidence.labels[block.at]
    filtered, scores = _filtered(labels, sites, evidence.sweeps, block.torus)
    labels = torch.where(block.own.flatten(1), filtered, labels)
    inverse, sweeps = torch.cholesky_inverse(sites.factor), evidence.sweeps
    seen, joins = torch.zeros_like(sites.std), torch.zeros_like(block.chance)
    for turn in range(_ROUNDS):
        drawn = block.noise(sweeps)
        labels = swept(
            labels.view_as(block.row), block.lattice, block.free, block.even, drawn
        )
        if turn == _ROUNDS - _TOLD:
            labels, scores = _flipped(
                labels, scores, sites, block, inverse, drawn, sweeps
            )
        if turn >= _ROUNDS - _TOLD:
            labels, scores, told = _visited(
                labels.flatten(1), scores, sites, inverse, sweeps, block.torus
            )
            seen, labels = seen + told / _TOLD, labels.view_as(block.row)
            tied = joined(labels, block.lattice, block.evidence, drawn)
            # Of cells that no ties join to evidence either label is as likely.
            joins = joins + tally(labels & tied) + 0.5 * (CHAINS - tally(tied))
        sweeps = sweeps + 1
    found = (joins + 0.5) / (CHAINS * _TOLD + 1)
    moved = (block.free != 0) & ((found - block.chance).abs() >= LEAST_CHANGE)
    chance = evidence.chance.index_put(
        block.at, torch.where(moved, found, block.chance).flatten(1)
    )
    member = block.at[0].expand_as(sites.cell)
    # Of a settled cell that a patch, or its chains, took to the other label, as many as
    # hold it.
    share = tally(labels.flatten(1).gather(1, sites.cell)) / CHAINS
    turned = (
        sites.loose
        & ~sites.open
        & ((share - block.chance.flatten(1).gather(1, sites.cell)).abs() > 1 / CHAINS)
    )
    told = sites.open | turned
    places = tuple(part[told] for part in (member, sites.row, sites.column))
    chance = chance.index_put(places, torch.where(turned, share, seen)[told])
    labels = evidence.labels.index_put(block.at, labels.flatten(1))
    return replace(evidence, chance=chance, labels=labels, sweeps=sweeps)


def _filtered(
    labels: Tensor, sites: Sites, sweeps: Tensor, torus: int
) -> tuple[Tensor, Tensor]:
    """Labels of a block [B, RC] and scores [B, S, N] of chains that are weighed by new
    observations, one by one.
    """
    fresh, factor, scores = sites.fresh, sites.factor, sites.scores.clone()
    white = torch.linalg.solve_triangular(factor, scores.transpose(1, 2), upper=False)
    white, weights = (
        white.transpose(1, 2).contiguous(),
        torch.zeros_like(scores[:, :, 0]),
    )
    begin = int((~fresh).int().cumprod(1).sum(1).min())
    uniforms = _uniforms(sweeps, sites, torus, begin)
    for place in range(begin, fresh.shape[1]):
        new, scale = fresh[:, place, None], factor[:, place, place, None]
        mean = (white[:, :, :place] @ factor[:, place, :place, None])[..., 0]
        toss = uniforms[:, place - begin]
        first, _, told, score = sites.draw(place, mean, scale.square(), labels, toss)
        white[:, :, place] = torch.where(
            new, (score - mean) / scale, white[:, :, place]
        )
        scores[:, :, place] = torch.where(new, score, scores[:, :, place])
        weights = weights + torch.where(new, told, 0.0)
        labels = _put(labels, sites.cell[:, place], first, new)
    # Systematically, so that chains of one weight all stay.
    steps = (
        torch.arange(CHAINS, device=labels.device)
        + _starts().to(labels.device)[sweeps % _STARTS, None]
    ) / CHAINS
    chain = torch.searchsorted(torch.softmax(weights, 1).cumsum(1), steps).clamp(
        max=CHAINS - 1
    )
    labels = packed((labels[..., None] >> chain[:, None]) & 1)
    return labels, scores.gather(1, chain[..., None].expand_as(scores))


def _flipped(
    labels: Tensor,
    scores: Tensor,
    sites: Sites,
    block: Block,
    inverse: Tensor,
    drawn: Noise,
    sweeps: Tensor,
) -> tuple[Tensor, Tensor]:
    """Gives the patch of the last new cell the other label, where what was observed
    allows it (Metropolis).

    Single labels cannot leave a wrong class, since observed scores are alike. A patch
    that has cells out of reach, or observed as intervals, stays.
    """
    loose, cell, flat = sites.loose, sites.cell, labels.flatten(1)
    takes = (
        torch.zeros_like(flat, dtype=torch.bool)
        .scatter_reduce(1, cell, loose, "amax")
        .view_as(labels)
    )
    barred = (block.pair > 0) & (~block.own | (block.observed & ~takes))
    seed = (
        torch.zeros_like(flat)
        .scatter_(1, cell[:, -1:], -loose[:, -1:].long())
        .view_as(labels)
    )
    patch = joined(labels, block.lattice, seed, drawn)
    inner = unpacked(patch.flatten(1))
    stays = (inner & barred.flatten(1)[..., None]).any(1)
    among = (
        inner.gather(1, cell[..., None].expand(-1, -1, CHAINS)) & loose[..., None]
    ).transpose(1, 2)
    first = unpacked(flat.gather(1, cell)).transpose(1, 2)
    proposed = torch.where(
        among, torch.where(first, sites.lower[:, 1:], sites.lower[:, :1]), scores
    )
    gain = (sites.density[:, 1:] - sites.density[:, :1]) * torch.where(first, 1.0, -1.0)
    told = torch.where(among, gain, 0.0).sum(2)
    told = told - 0.5 * (((proposed - scores) @ inverse) * (proposed + scores)).sum(2)
    toss = _uniforms(sweeps + 1, sites, block.torus, cell.shape[1] - 1)[:, 0, :, 0]
    taken = ~stays & (toss.log() < told)
    return labels ^ (patch & packed(taken)[:, None, None]), torch.where(
        taken[..., None], proposed, scores
    )


def _visited(
    labels: Tensor,
    scores: Tensor,
    sites: Sites,
    inverse: Tensor,
    sweeps: Tensor,
    torus: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Draws open cells given all others: labels [B, RC], scores [B, S, N], and
    probabilities [B, N].
    """
    scores, told = scores.clone(), torch.zeros_like(sites.std)
    places = [int(place) for place in sites.open.any(0).nonzero()[:, 0].flip(0)]
    uniforms = _uniforms(sweeps, sites, torus, places[-1])
    for place in places:
        new, row = sites.open[:, place, None], inverse[:, place]
        share = row[:, place, None]
        mean = scores[:, :, place] - (scores @ row[..., None])[..., 0] / share
        # An interval is one of the score with noise, whatever term stands for it.
        variance = (
            1 / share + (sites.std[:, place].square() - sites.noise[:, place])[:, None]
        )
        toss = uniforms[:, place - places[-1]]
        first, chance, _, score = sites.draw(
            place, mean, variance.clamp(min=1e-12), labels, toss
        )
        score = torch.where(
            new & ~sites.held[:, place, None], score, scores[:, :, place]
        )
        scores[:, :, place], told[:, place] = score, chance.mean(1)
        labels = _put(labels, sites.cell[:, place], first, new)
    return labels, scores, told


def _put(labels: Tensor, cell: Tensor, first: Tensor, new: Tensor) -> Tensor:
    """Puts the labels of one cell of each episode, where they are new, into those of a
    block, [B, RC].
    """
    word = torch.where(new, packed(first)[:, None], labels.gather(1, cell[:, None]))
    return labels.scatter(1, cell[:, None], word)


def _uniforms(passed: Tensor, sites: Sites, torus: int, begin: int) -> Tensor:
    """Random numbers of cells from a place on, two a chain, float64, shape [B, N, S,
    2].
    """
    uses = passed[:, None] // _PASSES
    row, column = (
        (place[:, begin:] + step * uses) % torus
        for place, step in zip((sites.row, sites.column), _STEP, strict=True)
    )
    return (
        _tosses(torus)
        .to(row.device)[passed[:, None] % _PASSES, row * torus + column]
        .double()
    )


@lru_cache(maxsize=2)
def _tosses(torus: int) -> Tensor:
    drawn = rng.uniform(
        rng.stream_key(0, "labels", "cells"), np.arange(_PASSES), (torus**2, CHAINS, 2)
    )
    return torch.from_numpy(drawn).float()


@lru_cache(maxsize=1)
def _starts() -> Tensor:
    return torch.from_numpy(
        rng.uniform(rng.stream_key(0, "labels", "chains"), np.arange(_STARTS))
    )
