"""Inputs for drawing labels: cells around new observations, and observed cells nearby.

Letters in shapes: B episodes, H×W cells, R×C cells of a block, N observed cells, S
chains. A word contains the bits of a cell in all chains (`labels`).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from benchnav.core.batch import Batch
from benchnav.planning.sensing.conditioning import bounds, nearest
from benchnav.planning.sensing.gaussian import Field
from benchnav.planning.sensing.labels import Couplings, SweepBits, sweep_bits, unpacked

_REACH = 12  # distance from changed observations up to which labels are drawn, in cells
# Labels of an earlier observed cell are drawn again only if both are more probable.
_SETTLED = 0.005
MIN_CHANGE = 0.01
"""Minimum change of an unobserved cell's P(class); smaller changes are ignored."""
_MIN_PRECISION = 1e-6  # minimum precision of a Gaussian term


@dataclass(frozen=True, kw_only=True)
class Evidence(Batch):
    """Evidence from which labels are drawn, and the labels.

    Args:
        field: correlations of the scores of B episodes.
        lower: minimum observed score under the first and the second class; NaN if not
            observed, shape [B, 2, H, W].
        upper: maximum observed score; for a number, equal to the minimum, shape
            [B, 2, H, W].
        noise_std: standard deviation of the noise of the score, shape [B, H, W].
        density: log f / φ of the observation under either class; 0 for an interval,
            shape [B, 2, H, W].
        precision: precision of the Gaussian terms of observations, shape [B, H, W].
        shift: precision times mean of the terms, shape [B, H, W].
        pair: index of each cell's pair, from 1; 0 without a pair, int64, shape
            [B, H, W].
        p_first: posterior probability of the first class under even prior odds,
            float64, shape [B, H, W].
        labels: words of the labels; a set bit is the first class, int64, shape
            [B, H, W].
        sweeps: number of sweeps of each episode, int64, shape [B].
    """

    field: Field
    lower: Tensor
    upper: Tensor
    noise_std: Tensor
    density: Tensor
    precision: Tensor
    shift: Tensor
    pair: Tensor
    p_first: Tensor
    labels: Tensor
    sweeps: Tensor


@dataclass(frozen=True, kw_only=True)
class Block:
    """Cells of a rectangle around new observations.

    The rectangle of each episode has the same size. Tensors have the shape [B, R, C],
    except `map_index`.

    Args:
        map_index: index of the cells in maps: episode [B, 1], row [B, RC] and column
            [B, RC].
        row: row of each cell, int64.
        column: column of each cell, int64.
        pair: index of each cell's pair, from 1; 0 without a pair, int64.
        p_first: probability of the first class before the update.
        observed: mask of observed cells, bool.
        in_reach: mask of cells whose labels may change, bool.
        couplings: couplings of the cells.
        degree: number of coupled neighbours of each cell, int64.
        torus_size: number of rows and of columns of the stored random numbers: the
            longer side of a map in cells.
    """

    map_index: tuple[Tensor, Tensor, Tensor]
    row: Tensor
    column: Tensor
    pair: Tensor
    p_first: Tensor
    observed: Tensor
    in_reach: Tensor
    couplings: Couplings
    degree: Tensor
    torus_size: int

    @classmethod
    def around(cls, evidence: Evidence, changed: Tensor, strength: float) -> "Block":
        """Return the block of the cells in reach of changed cells, and of neighbours.

        Args:
            evidence: evidence of B episodes.
            changed: mask of cells with new observations, one or more in each episode,
                bool, shape [B, H, W].
            strength: β of the Potts field, ≥ 0.
        """
        device = changed.device
        ends = [bounds(new) for new in changed.cpu().numpy()]
        by_axis = torch.tensor(ends, device=device).permute(1, 2, 0)
        row_ends, column_ends = by_axis
        height, width = changed.shape[1:]
        rows = _indices_around(row_ends, height)
        columns = _indices_around(column_ends, width)
        n_columns = columns.shape[1]
        row = rows[:, :, None].expand(-1, -1, n_columns)
        column = columns[:, None].expand_as(row)
        episode = torch.arange(len(changed), device=device)[:, None]
        map_index = episode, row.flatten(1), column.flatten(1)
        is_observed = ~evidence.noise_std.isnan()
        pair = evidence.pair[map_index].view_as(row)
        p_first = evidence.p_first[map_index].view_as(row)
        observed = is_observed[map_index].view_as(row)
        distance = torch.zeros_like(row)
        for index, (first, last) in ((row, row_ends), (column, column_ends)):
            before = first[:, None, None] - index
            after = index - last[:, None, None]
            outside = torch.maximum(before, after)
            distance = torch.maximum(distance, outside)
        # The size of the block depends on the other episodes of the batch. Results do
        # not, since only cells in reach and their neighbours are coupled.
        pair = torch.where(distance <= _REACH + 1, pair, 0)
        in_reach = distance <= _REACH
        couplings = Couplings.of(pair, strength)
        return cls(
            map_index=map_index,
            row=row,
            column=column,
            pair=pair,
            p_first=p_first,
            observed=observed,
            in_reach=in_reach,
            couplings=couplings,
            degree=couplings.degree(),
            torus_size=max(height, width),
        )

    @property
    def free(self) -> Tensor:
        """Words with all bits set in cells whose labels a sweep draws, [B, R, C]."""
        is_free = (self.pair > 0) & self.in_reach & ~self.observed
        return -is_free.long()

    @property
    def even(self) -> Tensor:
        """Words with all bits set in one colour of the checkerboard, [B, R, C]."""
        return -((self.row + self.column) % 2)

    @property
    def evidence(self) -> Tensor:
        """Words with all bits set in cells with evidence of their label, [B, R, C].

        These cells are observed, or they are out of reach and P(class) differs from ½.
        """
        is_settled = (self.p_first - 0.5).abs() > MIN_CHANGE
        informative = ~self.in_reach & is_settled
        has_evidence = (self.pair > 0) & (self.observed | informative)
        return -has_evidence.long()

    def sweep_bits(self, sweeps: Tensor) -> SweepBits:
        """Return the random bits of the next sweep.

        Args:
            sweeps: number of sweeps of each episode so far, int64, shape [B].
        """
        return sweep_bits(
            sweeps,
            self.row,
            self.column,
            self.degree,
            self.couplings.strength,
            self.torus_size,
        )


@dataclass(frozen=True, kw_only=True)
class Sites:
    """Observed cells of B episodes and their scores; newly observed cells are last.

    Args:
        row: row of each cell, int64, shape [B, N].
        column: column of each cell, int64, shape [B, N].
        cell: index of each cell in its block, int64, shape [B, N].
        neighbours: block indices of the four neighbours, int64, shape [B, N, 4].
        coupled: words with all bits set for neighbours that are coupled to the cell,
            int64, shape [B, N, 4].
        strength: β, ≥ 0.
        lower: minimum score under either class, shape [B, 2, N].
        upper: maximum score under either class, shape [B, 2, N].
        density: log f / φ under either class; 0 for intervals, shape [B, 2, N].
        std: standard deviation of the score's noise, shape [B, N].
        noise: variance of the score's noise; for an interval with a Gaussian term, the
            variance of the term, shape [B, N].
        factor: Cholesky factor of the covariance of noisy scores, shape [B, N, N].
        scores: noisy scores of each chain; 0 if new or padded, shape [B, S, N].
        is_new: mask of new observations, bool, shape [B, N].
        censored: mask of intervals with a Gaussian term, bool, shape [B, N].
        is_open: mask of cells whose labels are drawn, bool, shape [B, N].
        flippable: mask of cells that may change label together with a patch, bool,
            shape [B, N].
    """

    row: Tensor
    column: Tensor
    cell: Tensor
    neighbours: Tensor
    coupled: Tensor
    strength: float
    lower: Tensor
    upper: Tensor
    density: Tensor
    std: Tensor
    noise: Tensor
    factor: Tensor
    scores: Tensor
    is_new: Tensor
    censored: Tensor
    is_open: Tensor
    flippable: Tensor

    @classmethod
    def of(
        cls, evidence: Evidence, changed: Tensor, block: Block, window: int
    ) -> "Sites":
        """Return the observed cells nearest to new observations.

        Args:
            evidence: evidence of B episodes.
            changed: mask of cells with new observations, bool, shape [B, H, W].
            block: block around these cells.
            window: maximum number of cells; all changed cells are returned even if
                there are more.
        """
        row, column, exists = _nearest_cells(evidence, changed, window)
        map_index = block.map_index[0], row, column
        cell, inside = _cells_in_block(row, column, exists, block)
        neighbours, couplings = _neighbours(cell, block.couplings)
        coupled = torch.where(inside[..., None], couplings, 0)

        def by_class(values: Tensor) -> Tensor:
            class_first = values.transpose(0, 1)
            at_sites = class_first[:, *map_index].transpose(0, 1)
            return torch.where(exists[:, None], at_sites, 0.0)

        lower = by_class(evidence.lower)
        upper = by_class(evidence.upper)
        std = torch.where(exists, evidence.noise_std[map_index], 1.0)
        is_new = changed[map_index] & exists
        interval = (upper > lower)[:, 0]
        censored = interval & ~is_new
        precision = evidence.precision[map_index].clamp(min=_MIN_PRECISION)
        noise = torch.where(censored, 1 / precision, std.square())
        row_offset = row[:, :, None] - row[:, None]
        column_offset = column[:, :, None] - column[:, None]
        episode = block.map_index[0][..., None]
        covariance = evidence.field.covariance(episode, row_offset, column_offset)
        both_exist = exists[:, :, None] & exists[:, None]
        covariance = torch.where(both_exist, covariance, 0.0)
        variance = torch.where(exists, 1 + noise, 1.0)
        covariance.diagonal(dim1=1, dim2=2).copy_(variance)
        labels = unpacked(evidence.labels[map_index]).transpose(1, 2)
        first_scores = lower[:, :1]
        second_scores = lower[:, 1:]
        scores = torch.where(labels, first_scores, second_scores)
        term_mean = evidence.shift[map_index] / precision
        scores = torch.where(censored[:, None], term_mean[:, None], scores)
        is_old = exists & ~is_new
        old_scores = torch.where(is_old[:, None], scores, 0.0)
        may_change = inside & (evidence.pair[map_index] > 0)
        unsettled = (evidence.p_first[map_index] - 0.5).abs() < 0.5 - _SETTLED
        return cls(
            row=row,
            column=column,
            cell=cell,
            neighbours=neighbours,
            coupled=coupled,
            strength=block.couplings.strength,
            lower=lower,
            upper=upper,
            density=by_class(evidence.density),
            std=std,
            noise=noise,
            factor=torch.linalg.cholesky(covariance),
            scores=old_scores,
            is_new=is_new,
            censored=censored,
            is_open=is_new | (may_change & unsettled),
            flippable=may_change & ~interval,
        )

    def draw(
        self,
        site: int,
        mean: Tensor,
        variance: Tensor,
        labels: Tensor,
        uniforms: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw the label of one site of each episode, and a score under it.

        Args:
            site: index of the site.
            mean: mean of the noisy score given other sites, shape [B, S].
            variance: variance of the noisy score given other sites, shape [B, 1].
            labels: labels of the block, int64, shape [B, RC].
            uniforms: random numbers in [0, 1), shape [B, S, 2].

        Returns:
            Mask of chains with the first label (bool), probability of the first label,
            log density of the observation, and score, each of shape [B, S].
        """
        coupled = self.coupled[:, site]
        neighbour_labels = labels.gather(1, self.neighbours[:, site]) & coupled
        n_first = unpacked(neighbour_labels).sum(1)
        # Coupled neighbours are −1, so that the sum is minus their number.
        minus_n_coupled = coupled.sum(1)[:, None]
        log_odds = self.strength * (n_first * 2 + minus_n_coupled)
        lower = self.lower[:, :, site, None]
        upper = self.upper[:, :, site, None]
        density = self.density[:, :, site, None]
        is_number = upper <= lower
        std = variance.sqrt()[:, None]
        mean = mean[:, None]
        low = (lower - mean) / std
        high = (upper - mean) / std
        half_log_tau = 0.5 * math.log(2 * math.pi)
        log_density = density - 0.5 * low.square() - std.log() - half_log_tau
        # Upper tails are mirrored to the lower tail, where Φ loses no digits.
        mirrored = low + high > 0
        lower_z = torch.where(mirrored, -high, low)
        upper_z = torch.where(mirrored, -low, high)
        log_upper = torch.special.log_ndtr(upper_z)
        log_lower = torch.special.log_ndtr(lower_z)
        log_ratio = (log_lower - log_upper).clamp(max=-1e-300)
        log_mass = log_upper + torch.log(-torch.expm1(log_ratio))
        log_evidence = torch.where(is_number, log_density, log_mass)
        first_evidence, second_evidence = log_evidence.unbind(1)
        p_first = torch.sigmoid(log_odds + first_evidence - second_evidence)
        both_log_odds = torch.stack((log_odds, -log_odds), 1)
        log_prior = torch.nn.functional.logsigmoid(both_log_odds)
        log_total = (log_evidence + log_prior).logsumexp(1)
        is_first = uniforms[..., 0] < p_first
        # Draw a score within the interval by inversion of its CDF.
        p_low = torch.special.ndtr(lower_z)
        p_interval = torch.special.ndtr(upper_z) - p_low
        rank = p_low + p_interval * uniforms[:, None, :, 1]
        quantile = torch.special.ndtri(rank.clamp(min=1e-300))
        within = mean + std * torch.where(mirrored, -quantile, quantile)
        within = torch.maximum(torch.minimum(within, upper), lower)
        score = torch.where(is_number, lower, within)
        score = torch.where(is_first, score[:, 0], score[:, 1])
        return is_first, p_first, log_total, score


def _indices_around(ends: tuple[Tensor, Tensor], size: int) -> Tensor:
    """Return the rows or columns of the blocks, which have one length.

    Args:
        ends: first and last row or column of changed cells, int64, each of shape [B].
        size: number of rows or columns of the map.

    Returns:
        Indices of rows or columns, int64, shape [B, length].
    """
    first, last = ends
    margin = _REACH + 1
    extent = int((last - first).max()) + 1
    length = min(extent + 2 * margin, size)
    begin = (first - margin).clamp(min=0).clamp(max=size - length)
    steps = torch.arange(length, device=first.device)
    return begin[:, None] + steps


def _nearest_cells(
    evidence: Evidence, changed: Tensor, window: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the observed cells nearest to changed cells, changed cells last.

    Episodes with fewer cells are padded in front.

    Returns:
        Rows, columns, and a mask of cells that are not padding, each of shape [B, N].
    """
    is_observed = (~evidence.noise_std.isnan()).cpu().numpy()
    is_new = changed.cpu().numpy()
    rows = []
    columns = []
    for observed, new in zip(is_observed, is_new, strict=True):
        cells = nearest(observed, new, window)
        rows.append(torch.from_numpy(cells[0]))
        columns.append(torch.from_numpy(cells[1]))
    is_cell = [row >= 0 for row in rows]
    row = _padded(rows).to(changed.device)
    column = _padded(columns).to(changed.device)
    exists = _padded(is_cell).to(changed.device)
    return row, column, exists


def _padded(sequences: list[Tensor]) -> Tensor:
    """Return reversed sequences as the rows of a tensor, padded in front by 0."""
    return pad_sequence(sequences, batch_first=True).flip(1)


def _cells_in_block(
    row: Tensor, column: Tensor, exists: Tensor, block: Block
) -> tuple[Tensor, Tensor]:
    """Return the block indices of cells, and a mask of those in reach, each [B, N]."""
    height, width = block.row.shape[1:]
    down = row - block.row[:, 0, :1]
    right = column - block.column[:, 0, :1]
    in_rows = (down >= 0) & (down < height)
    in_columns = (right >= 0) & (right < width)
    inside = exists & in_rows & in_columns
    cell = torch.where(inside, down * width + right, 0)
    inside &= block.in_reach.flatten(1).gather(1, cell)
    return cell, inside


def _neighbours(cell: Tensor, couplings: Couplings) -> tuple[Tensor, Tensor]:
    """Return the four neighbours of some cells of a block, and their couplings.

    Returns:
        Block indices of the neighbours, and words with all bits set for coupled
        neighbours, both int64 and of shape [B, N, 4].
    """
    width = couplings.right.shape[2]
    last = couplings.right[0].numel() - 1
    all_bits = torch.full_like(couplings.right, -1)
    words = [word.flatten(1) for word in couplings.neighbours(all_bits)]
    coupled_bits = torch.stack(words, 2)
    steps = torch.tensor((1, -1, width, -width), device=cell.device)
    index = cell[..., None]
    neighbours = (index + steps).clamp(0, last)
    coupled = coupled_bits.gather(1, index.expand(-1, -1, 4))
    return neighbours, coupled
