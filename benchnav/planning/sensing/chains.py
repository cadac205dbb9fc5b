"""Labels of look-alike cells given λ: 64 chains, resampled near new observations.

Chains are weighted by the likelihood of new observations and resampled (a particle
filter). Then three kinds of moves change their labels. Sweeps draw unobserved cells
given their neighbours. One proposal changes the label of a whole patch of cells. Open
cells (newly observed, or observed with both labels still likely) are drawn given all
other cells, by the joint density of scores. An earlier observation of λ = 0 or 1, whose
score is an interval, is represented by a Gaussian term of expectation propagation under
the more probable label of its cell. Only cells near new observations are drawn
(`sites`). After resampling, a labelling that no chain has can return only by the moves.
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
    SweepBits,
    connected_to_evidence,
    count_bits,
    packed,
    sweep_labels,
    unpacked,
)
from benchnav.planning.sensing.sites import MIN_CHANGE, Block, Evidence, Sites

_ROUNDS = 6  # number of sweeps in an update
_COUNTED = 3  # number of final sweeps from which probabilities are estimated
_FIRST_COUNTED = _ROUNDS - _COUNTED
_PASSES = 8  # number of passes over observed cells with stored random numbers
# Each time all passes have been used, the stored numbers shift by these numbers of rows
# and columns, with wrap-around.
_STEP = 13, 31
_N_OFFSETS = 4096  # stored random numbers of resamplings


def draw_labels(
    evidence: Evidence, changed: Tensor, strength: float, window: int
) -> Evidence:
    """Draw labels near changed cells, and estimate probabilities of classes there.

    Args:
        evidence: evidence whose scores, but not terms and probabilities, include the
            new observations.
        changed: mask of cells with new observations, one or more in each episode, bool,
            shape [B, H, W].
        strength: β of the Potts field, ≥ 0.
        window: maximum number of observed cells in use, those nearest to the changed
            cells; all changed cells are used even if there are more.

    Returns:
        The evidence with new `p_first`, `labels` and `sweeps`.
    """
    block = Block.around(evidence, changed, strength)
    sites = Sites.of(evidence, changed, block, window)
    shape = block.row.shape
    sweeps = evidence.sweeps
    old_labels = evidence.labels[block.map_index]
    filtered, scores = _weigh_and_resample(old_labels, sites, sweeps, block.torus_size)
    in_reach = block.in_reach.flatten(1)
    labels = torch.where(in_reach, filtered, old_labels).view(shape)
    inverse = torch.cholesky_inverse(sites.factor)
    p_observed = torch.zeros_like(sites.std)
    n_first = torch.zeros_like(block.p_first)
    for sweep_index in range(_ROUNDS):
        bits = block.sweep_bits(sweeps)
        labels = sweep_labels(labels, block.couplings, block.free, block.even, bits)
        if sweep_index == _FIRST_COUNTED:
            labels, scores = _flip_patch(
                labels, scores, sites, block, inverse, bits, sweeps
            )
        if sweep_index >= _FIRST_COUNTED:
            flat = labels.flatten(1)
            flat, scores, p_visited = _draw_observed(
                flat, scores, sites, inverse, sweeps, block.torus_size
            )
            labels = flat.view(shape)
            p_observed = p_observed + p_visited / _COUNTED
            bonded = connected_to_evidence(
                labels, block.couplings, block.evidence, bits
            )
            n_bonded_first = count_bits(labels & bonded)
            n_unbonded = CHAINS - count_bits(bonded)
            # If no bonds join a cell to evidence, either label has probability ½.
            n_first = n_first + n_bonded_first + 0.5 * n_unbonded
        sweeps = sweeps + 1
    labels = labels.flatten(1)
    p_block = (n_first + 0.5) / (CHAINS * _COUNTED + 1)
    has_moved = (p_block - block.p_first).abs() >= MIN_CHANGE
    is_replaced = (block.free != 0) & has_moved
    p_block = torch.where(is_replaced, p_block, block.p_first)
    p_first = evidence.p_first.index_put(block.map_index, p_block.flatten(1))
    # If a patch or the resampling changed the labels of a cell that is not open, its
    # probability is the fraction of chains with the first label.
    site_labels = labels.gather(1, sites.cell)
    p_chains = count_bits(site_labels) / CHAINS
    p_before = block.p_first.flatten(1).gather(1, sites.cell)
    differs_from_chains = (p_chains - p_before).abs() > 1 / CHAINS
    is_flipped = sites.flippable & ~sites.is_open & differs_from_chains
    updated = sites.is_open | is_flipped
    p_sites = torch.where(is_flipped, p_chains, p_observed)
    episode = block.map_index[0].expand_as(sites.cell)
    at = episode[updated], sites.row[updated], sites.column[updated]
    p_first = p_first.index_put(at, p_sites[updated])
    new_labels = evidence.labels.index_put(block.map_index, labels)
    return replace(evidence, p_first=p_first, labels=new_labels, sweeps=sweeps)


def _weigh_and_resample(
    labels: Tensor, sites: Sites, sweeps: Tensor, torus_size: int
) -> tuple[Tensor, Tensor]:
    """Weight chains by the new observations, one after another, and resample them.

    Returns:
        Words of the labels, shape [B, RC], and scores, shape [B, S, N].
    """
    new_sites = sites.is_new
    factor = sites.factor
    scores = sites.scores.clone()
    by_site = scores.transpose(1, 2)
    white = torch.linalg.solve_triangular(factor, by_site, upper=False)
    white = white.transpose(1, 2).contiguous()
    log_weights = torch.zeros_like(scores[:, :, 0])
    n_old = (~new_sites).int().cumprod(1).sum(1)
    begin = int(n_old.min())
    uniforms = _uniforms(sweeps, sites, torus_size, begin)
    for site in range(begin, new_sites.shape[1]):
        is_new = new_sites[:, site, None]
        row = factor[:, site]
        scale = row[:, site, None]
        variance = scale.square()
        product = white[:, :, :site] @ row[:, :site, None]
        mean = product[..., 0]
        site_uniforms = uniforms[:, site - begin]
        first, _, log_density, score = sites.draw(
            site, mean, variance, labels, site_uniforms
        )
        new_white = (score - mean) / scale
        old_white = white[:, :, site]
        white[:, :, site] = torch.where(is_new, new_white, old_white)
        old_score = scores[:, :, site]
        scores[:, :, site] = torch.where(is_new, score, old_score)
        gain = torch.where(is_new, log_density, 0.0)
        log_weights = log_weights + gain
        labels = _put_labels(labels, sites.cell[:, site], first, is_new)
    # Systematic resampling keeps all chains if their weights are equal.
    starts = _resampling_offsets().to(labels.device)
    start = starts[sweeps % _N_OFFSETS, None]
    index = torch.arange(CHAINS, device=labels.device)
    steps = (index + start) / CHAINS
    cumulative = torch.softmax(log_weights, 1).cumsum(1)
    chain = torch.searchsorted(cumulative, steps).clamp(max=CHAINS - 1)
    bits = (labels[..., None] >> chain[:, None]) & 1
    score_index = chain[..., None].expand_as(scores)
    return packed(bits), scores.gather(1, score_index)


def _flip_patch(
    labels: Tensor,
    scores: Tensor,
    sites: Sites,
    block: Block,
    inverse: Tensor,
    bits: SweepBits,
    sweeps: Tensor,
) -> tuple[Tensor, Tensor]:
    """Propose the other label for the patch of the last new cell (Metropolis).

    Moves of single labels can hardly leave a wrong class, since neighbouring scores are
    correlated. A patch is not flipped if any of its cells is out of reach or observed
    as an interval.

    Returns:
        Words of the labels, shape [B, R, C], and scores, shape [B, S, N].
    """
    flippable = sites.flippable
    cell = sites.cell
    flat = labels.flatten(1)
    may_flip = torch.zeros_like(flat, dtype=torch.bool)
    may_flip = may_flip.scatter_reduce(1, cell, flippable, "amax").view_as(labels)
    is_fixed = block.observed & ~may_flip
    barred = (block.pair > 0) & (~block.in_reach | is_fixed)
    last_cell = cell[:, -1:]
    last_bits = -flippable[:, -1:].long()
    seed = torch.zeros_like(flat)
    seed = seed.scatter_(1, last_cell, last_bits).view_as(labels)
    patch = connected_to_evidence(labels, block.couplings, seed, bits)
    in_patch = unpacked(patch.flatten(1))
    barred_cells = barred.flatten(1)[..., None]
    is_barred = (in_patch & barred_cells).any(1)
    site_index = cell[..., None].expand(-1, -1, CHAINS)
    sites_in_patch = in_patch.gather(1, site_index)
    flips = (sites_in_patch & flippable[..., None]).transpose(1, 2)
    site_labels = flat.gather(1, cell)
    first = unpacked(site_labels).transpose(1, 2)
    first_scores = sites.lower[:, :1]
    second_scores = sites.lower[:, 1:]
    flipped_scores = torch.where(first, second_scores, first_scores)
    proposed = torch.where(flips, flipped_scores, scores)
    sign = torch.where(first, 1.0, -1.0)
    density_change = sites.density[:, 1:] - sites.density[:, :1]
    gain = density_change * sign
    log_ratio = torch.where(flips, gain, 0.0).sum(2)
    change = proposed - scores
    quadratic = (change @ inverse) * (proposed + scores)
    log_ratio = log_ratio - 0.5 * quadratic.sum(2)
    last_site = cell.shape[1] - 1
    uniforms = _uniforms(sweeps + 1, sites, block.torus_size, last_site)
    log_uniform = uniforms[:, 0, :, 0].log()
    accepted = ~is_barred & (log_uniform < log_ratio)
    accepted_bits = packed(accepted)[:, None, None]
    new_labels = labels ^ (patch & accepted_bits)
    new_scores = torch.where(accepted[..., None], proposed, scores)
    return new_labels, new_scores


def _draw_observed(
    labels: Tensor,
    scores: Tensor,
    sites: Sites,
    inverse: Tensor,
    sweeps: Tensor,
    torus_size: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw the labels of open cells, each given all other cells.

    Returns:
        Words of the labels [B, RC], scores [B, S, N], and probabilities of the first
        class [B, N].
    """
    scores = scores.clone()
    p_first = torch.zeros_like(sites.std)
    is_open_anywhere = sites.is_open.any(0)
    open_sites = is_open_anywhere.nonzero()[:, 0].flip(0).tolist()
    begin = open_sites[-1]
    uniforms = _uniforms(sweeps, sites, torus_size, begin)
    for site in open_sites:
        is_open = sites.is_open[:, site, None]
        row = inverse[:, site]
        precision = row[:, site, None]
        product = scores @ row[..., None]
        residual = product[..., 0] / precision
        old_score = scores[:, :, site]
        mean = old_score - residual
        # For an interval, `sites.noise` may be the variance of its Gaussian term.
        exact_noise = sites.std[:, site].square()
        noise = exact_noise - sites.noise[:, site]
        variance = (1 / precision + noise[:, None]).clamp(min=1e-12)
        site_uniforms = uniforms[:, site - begin]
        first, p_site, _, score = sites.draw(
            site, mean, variance, labels, site_uniforms
        )
        is_censored = sites.censored[:, site, None]
        is_replaced = is_open & ~is_censored
        scores[:, :, site] = torch.where(is_replaced, score, old_score)
        p_first[:, site] = p_site.mean(1)
        labels = _put_labels(labels, sites.cell[:, site], first, is_open)
    return labels, scores, p_first


def _put_labels(labels: Tensor, cell: Tensor, first: Tensor, is_new: Tensor) -> Tensor:
    """Return words in which the labels of one cell per episode are replaced, [B, RC].

    Args:
        labels: words of the labels, int64, shape [B, RC].
        cell: index of the cell of each episode, int64, shape [B].
        first: mask of chains with the first label in that cell, bool, shape [B, S].
        is_new: mask of episodes whose labels are replaced, bool, shape [B, 1].
    """
    index = cell[:, None]
    old_word = labels.gather(1, index)
    new_word = packed(first)[:, None]
    word = torch.where(is_new, new_word, old_word)
    return labels.scatter(1, index, word)


def _uniforms(passes: Tensor, sites: Sites, torus_size: int, begin: int) -> Tensor:
    """Return two random numbers in [0, 1) for each chain and each site from `begin` on.

    Args:
        passes: number of passes of each episode so far, int64, shape [B].
        sites: the observed cells.
        torus_size: number of rows and of columns of the stored random numbers.
        begin: index of the first site.

    Returns:
        Float64, shape [B, number of these sites, S, 2].
    """
    count = passes[:, None]
    uses = count // _PASSES
    row_step, column_step = _STEP
    row = sites.row[:, begin:] + row_step * uses
    column = sites.column[:, begin:] + column_step * uses
    cell = (row % torus_size) * torus_size + column % torus_size
    bank = _uniform_bank(torus_size).to(row.device)
    return bank[count % _PASSES, cell].double()


@lru_cache(maxsize=2)
def _uniform_bank(torus_size: int) -> Tensor:
    key = rng.stream_key(0, "labels", "cells")
    shape = torus_size**2, CHAINS, 2
    uniform = rng.uniform(key, np.arange(_PASSES), shape)
    return torch.from_numpy(uniform).float()


@lru_cache(maxsize=1)
def _resampling_offsets() -> Tensor:
    key = rng.stream_key(0, "labels", "chains")
    uniform = rng.uniform(key, np.arange(_N_OFFSETS))
    return torch.from_numpy(uniform)
