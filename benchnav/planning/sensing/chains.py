"""Labels of look-alike cells given λ: 64 chains, resampled near new observations.

New observations weigh the chains by their likelihood, and chains are resampled (a
particle filter). Three kinds of moves follow. Sweeps draw cells that were not observed,
given their neighbours. One patch of observed and other cells is proposed the other
label as a whole. Observed cells that are new or open are drawn given all others, by the
joint density of scores. An older observation of λ = 0 or 1, whose score is an interval,
is represented by a Gaussian term of expectation propagation at the more probable label
of its cell. Only cells near new observations are drawn (`sites`). A labelling that is
in none of the chains can return only by these moves.
Letters in shapes: B episodes, H×W cells, R×C cells of a block, N observed cells, S
chains.
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
    connected_to_evidence,
    count_bits,
    packed,
    sweep_labels,
    unpacked,
)
from benchnav.planning.sensing.sites import MIN_CHANGE, Block, Evidence, Sites

_ROUNDS = 6  # sweeps in an update
_COUNTED = 3  # the last of them, which estimate probabilities
# Passes over observed cells with stored random numbers; later passes take those of
# other cells.
_PASSES = 8
_STEP = 13, 31  # offset of these cells in rows and columns, on the torus
_STARTS = 4096  # stored random numbers of resamplings


def draw_labels(
    evidence: Evidence, changed: Tensor, strength: float, window: int
) -> Evidence:
    """Draw labels near changed cells, and estimate probabilities of classes there.

    Args:
        evidence: scores include new observations; terms and probabilities do not.
        changed: mask of cells with new observations, one or more in each episode, bool,
            shape [B, H, W].
        strength: β of the Potts field.
        window: maximum number of observed cells that are used, those nearest to the
            changed ones; more if more have changed.

    Returns:
        The evidence with new `p_first`, `labels` and `sweeps`.
    """
    block = Block.around(evidence, changed, strength)
    sites = Sites.of(evidence, changed, block, window)
    labels = evidence.labels[block.at]
    filtered, scores = _filtered(labels, sites, evidence.sweeps, block.torus)
    labels = torch.where(block.in_reach.flatten(1), filtered, labels)
    inverse = torch.cholesky_inverse(sites.factor)
    sweeps = evidence.sweeps
    shape = block.row.shape
    p_observed = torch.zeros_like(sites.std)
    n_first = torch.zeros_like(block.p_first)
    for turn in range(_ROUNDS):
        drawn = block.noise(sweeps)
        labels = sweep_labels(
            labels.view(shape), block.lattice, block.free, block.even, drawn
        )
        if turn == _ROUNDS - _COUNTED:
            labels, scores = _flip_patch(
                labels, scores, sites, block, inverse, drawn, sweeps
            )
        if turn >= _ROUNDS - _COUNTED:
            labels, scores, p_visited = _draw_observed(
                labels.flatten(1), scores, sites, inverse, sweeps, block.torus
            )
            labels = labels.view(shape)
            p_observed = p_observed + p_visited / _COUNTED
            bonded = connected_to_evidence(labels, block.lattice, block.evidence, drawn)
            # Cells that no bonds join to evidence have either label with probability ½.
            n_unbonded = CHAINS - count_bits(bonded)
            n_first = n_first + count_bits(labels & bonded) + 0.5 * n_unbonded
        sweeps = sweeps + 1
    estimate = (n_first + 0.5) / (CHAINS * _COUNTED + 1)
    moved = (block.free != 0) & ((estimate - block.p_first).abs() >= MIN_CHANGE)
    block_p = torch.where(moved, estimate, block.p_first).flatten(1)
    p_first = evidence.p_first.index_put(block.at, block_p)
    member = block.at[0].expand_as(sites.cell)
    # A settled cell that a patch, or its chains, took to the other label has the
    # probability of the first among its chains.
    p_chains = count_bits(labels.flatten(1).gather(1, sites.cell)) / CHAINS
    p_before = block.p_first.flatten(1).gather(1, sites.cell)
    turned = sites.flippable & ~sites.open & ((p_chains - p_before).abs() > 1 / CHAINS)
    updated = sites.open | turned
    at = member[updated], sites.row[updated], sites.column[updated]
    p_sites = torch.where(turned, p_chains, p_observed)[updated]
    p_first = p_first.index_put(at, p_sites)
    labels = evidence.labels.index_put(block.at, labels.flatten(1))
    return replace(evidence, p_first=p_first, labels=labels, sweeps=sweeps)


def _filtered(
    labels: Tensor, sites: Sites, sweeps: Tensor, torus: int
) -> tuple[Tensor, Tensor]:
    """Weigh and resample chains by new observations, one by one.

    Returns:
        Labels of a block, [B, RC], and scores, [B, S, N].
    """
    fresh = sites.fresh
    factor = sites.factor
    scores = sites.scores.clone()
    white = torch.linalg.solve_triangular(factor, scores.transpose(1, 2), upper=False)
    white = white.transpose(1, 2).contiguous()
    log_weights = torch.zeros_like(scores[:, :, 0])
    begin = int((~fresh).int().cumprod(1).sum(1).min())
    uniforms = _uniforms(sweeps, sites, torus, begin)
    for site in range(begin, fresh.shape[1]):
        new = fresh[:, site, None]
        scale = factor[:, site, site, None]
        mean = (white[:, :, :site] @ factor[:, site, :site, None])[..., 0]
        first, _, log_density, score = sites.draw(
            site, mean, scale.square(), labels, uniforms[:, site - begin]
        )
        white[:, :, site] = torch.where(new, (score - mean) / scale, white[:, :, site])
        scores[:, :, site] = torch.where(new, score, scores[:, :, site])
        log_weights = log_weights + torch.where(new, log_density, 0.0)
        labels = _put(labels, sites.cell[:, site], first, new)
    # Systematic resampling, which keeps all chains if their weights are equal.
    start = _starts().to(labels.device)[sweeps % _STARTS, None]
    steps = (torch.arange(CHAINS, device=labels.device) + start) / CHAINS
    cumulative = torch.softmax(log_weights, 1).cumsum(1)
    chain = torch.searchsorted(cumulative, steps).clamp(max=CHAINS - 1)
    labels = packed((labels[..., None] >> chain[:, None]) & 1)
    return labels, scores.gather(1, chain[..., None].expand_as(scores))


def _flip_patch(
    labels: Tensor,
    scores: Tensor,
    sites: Sites,
    block: Block,
    inverse: Tensor,
    drawn: Noise,
    sweeps: Tensor,
) -> tuple[Tensor, Tensor]:
    """Propose the other label for the patch of the last new cell (Metropolis).

    Single labels cannot leave a wrong class, since neighbouring scores are correlated.
    A patch with cells that are out of reach, or observed as intervals, is not flipped.
    """
    flippable = sites.flippable
    cell = sites.cell
    flat = labels.flatten(1)
    may_flip = torch.zeros_like(flat, dtype=torch.bool)
    may_flip = may_flip.scatter_reduce(1, cell, flippable, "amax").view_as(labels)
    barred = (block.pair > 0) & (~block.in_reach | (block.observed & ~may_flip))
    seed = torch.zeros_like(flat)
    seed = seed.scatter_(1, cell[:, -1:], -flippable[:, -1:].long()).view_as(labels)
    patch = connected_to_evidence(labels, block.lattice, seed, drawn)
    in_patch = unpacked(patch.flatten(1))
    is_barred = (in_patch & barred.flatten(1)[..., None]).any(1)
    sites_in_patch = in_patch.gather(1, cell[..., None].expand(-1, -1, CHAINS))
    flips = (sites_in_patch & flippable[..., None]).transpose(1, 2)
    first = unpacked(flat.gather(1, cell)).transpose(1, 2)
    flipped_scores = torch.where(first, sites.lower[:, 1:], sites.lower[:, :1])
    proposed = torch.where(flips, flipped_scores, scores)
    sign = torch.where(first, 1.0, -1.0)
    gain = (sites.density[:, 1:] - sites.density[:, :1]) * sign
    log_ratio = torch.where(flips, gain, 0.0).sum(2)
    quadratic = ((proposed - scores) @ inverse) * (proposed + scores)
    log_ratio = log_ratio - 0.5 * quadratic.sum(2)
    uniforms = _uniforms(sweeps + 1, sites, block.torus, cell.shape[1] - 1)
    accepted = ~is_barred & (uniforms[:, 0, :, 0].log() < log_ratio)
    labels = labels ^ (patch & packed(accepted)[:, None, None])
    return labels, torch.where(accepted[..., None], proposed, scores)


def _draw_observed(
    labels: Tensor,
    scores: Tensor,
    sites: Sites,
    inverse: Tensor,
    sweeps: Tensor,
    torus: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw the labels of open cells given all others.

    Returns:
        Labels [B, RC], scores [B, S, N], and probabilities of the first class [B, N].
    """
    scores = scores.clone()
    p_first = torch.zeros_like(sites.std)
    open_sites = [int(site) for site in sites.open.any(0).nonzero()[:, 0].flip(0)]
    begin = open_sites[-1]
    uniforms = _uniforms(sweeps, sites, torus, begin)
    for site in open_sites:
        new = sites.open[:, site, None]
        row = inverse[:, site]
        precision = row[:, site, None]
        mean = scores[:, :, site] - (scores @ row[..., None])[..., 0] / precision
        # An interval bounds the score with noise, whatever term stands for it.
        noise = sites.std[:, site].square() - sites.noise[:, site]
        variance = (1 / precision + noise[:, None]).clamp(min=1e-12)
        first, p_site, _, score = sites.draw(
            site, mean, variance, labels, uniforms[:, site - begin]
        )
        replaces = new & ~sites.censored[:, site, None]
        scores[:, :, site] = torch.where(replaces, score, scores[:, :, site])
        p_first[:, site] = p_site.mean(1)
        labels = _put(labels, sites.cell[:, site], first, new)
    return labels, scores, p_first


def _put(labels: Tensor, cell: Tensor, first: Tensor, new: Tensor) -> Tensor:
    """Return the labels of a block, [B, RC], with those of one cell of each episode
    replaced where they are new.
    """
    word = torch.where(new, packed(first)[:, None], labels.gather(1, cell[:, None]))
    return labels.scatter(1, cell[:, None], word)


def _uniforms(passes: Tensor, sites: Sites, torus: int, begin: int) -> Tensor:
    """Return two random numbers for each chain and each site from `begin` on.

    Float64, shape [B, N, S, 2].
    """
    uses = passes[:, None] // _PASSES
    row = (sites.row[:, begin:] + _STEP[0] * uses) % torus
    column = (sites.column[:, begin:] + _STEP[1] * uses) % torus
    bank = _tosses(torus).to(row.device)
    return bank[passes[:, None] % _PASSES, row * torus + column].double()


@lru_cache(maxsize=2)
def _tosses(torus: int) -> Tensor:
    key = rng.stream_key(0, "labels", "cells")
    uniform = rng.uniform(key, np.arange(_PASSES), (torus**2, CHAINS, 2))
    return torch.from_numpy(uniform).float()


@lru_cache(maxsize=1)
def _starts() -> Tensor:
    key = rng.stream_key(0, "labels", "chains")
    return torch.from_numpy(rng.uniform(key, np.arange(_STARTS)))
