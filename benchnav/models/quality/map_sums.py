"""Sums of a model's cell scores by map, from which `scores_of_maps` derives scores.

Letters in shapes: B maps of a chunk, M maps of a split, C classes, N cells.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.quality.scores import (
    LEVEL,
    PIT_BINS,
    TAIL_LEVELS,
    pinball_loss_and_width,
    pit_counts,
    sparsification,
)
from benchnav.stats.scores import Sums

# Number of points of a sparsification curve. At the first point, no cell is removed.
STEPS = 50


@dataclass(frozen=True, kw_only=True)
class CellScores:
    """Predictions and scores of the N observed cells of several maps.

    Args:
        predicted: predicted distributions, of shape [1, N].
        observed: observed λ, shape [1, N].
        expected: predicted E[λ], shape [1, N].
        transformed: PIT of observed λ, shape [1, N].
        maps: index of each cell's map, int64, shape [N].
        scores: scores by name: `squares` of E[λ] − λ, `nll` and `crps`, float64, each of
            shape [1, N].
        labelled: mask of cells with a class, bool, shape [N].
        expected_squares: squared differences of E[λ] and the true E[λ], only in the
            labelled cells, float64.
    """

    predicted: TraversabilityDistribution
    observed: Tensor
    expected: Tensor
    transformed: Tensor
    maps: Tensor
    scores: Mapping[str, Tensor]
    labelled: Tensor
    expected_squares: Tensor


class MapTally:
    """Sums of the scores of cells, by map; maps are added in chunks.

    Args:
        classes: number of classes C; 0 for a model without classes.
        truth: whether the true distribution of λ is available.
        quantiles: whether to compute the sums that need quantiles of the predictions,
            which takes most of the time.
    """

    def __init__(self, classes: int, truth: bool, quantiles: bool = True) -> None:
        """Create the tally without maps."""
        self.classes = classes
        self.truth = truth
        self.quantiles = quantiles
        self.names = (*_NAMES, *_OF_QUANTILES) if quantiles else _NAMES
        self.parts: dict[str, list[np.ndarray]] = {}
        self.pit = np.zeros(PIT_BINS, dtype=np.int64)
        self.ranked = np.zeros((2, STEPS))

    def add(self, cells: CellScores | None, count: int) -> None:
        """Add the scores of `count` maps.

        Args:
            cells: observed cells of these maps; None if no cell was observed.
            count: number of maps.
        """
        sums = {name: torch.zeros(count, dtype=torch.float64) for name in self.names}
        if cells is not None:
            sums |= self._sums_of(cells, count)
            self.pit += pit_counts(cells.transformed).numpy()
        for name, values in sums.items():
            self._append(name, values)

    def _sums_of(self, cells: CellScores, count: int) -> dict[str, Tensor]:
        """Return the sums of scores by map, each of shape [count].

        The sparsification curves are added to `ranked`.
        """
        scores = dict(cells.scores)
        scores["cells"] = torch.ones_like(cells.observed)
        scores["inside"] = (cells.transformed - 0.5).abs() <= LEVEL / 2
        for level in TAIL_LEVELS:
            scores[f"under_{round(100 * level)}"] = cells.transformed < 1 - level
        if self.quantiles:
            loss, width = pinball_loss_and_width(cells.predicted, cells.observed)
            scores["pinball"] = loss
            scores["width"] = width
            scores["areas"] = self._rank(cells, width[0], count)
        sums = {}
        for name, values in scores.items():
            sums[name] = _by_map(values, cells.maps, count)
        if self.truth:
            labelled_maps = cells.maps[cells.labelled]
            squares = cells.expected_squares
            sums["labelled"] = _by_map(cells.labelled, cells.maps, count)
            sums["expected_squares"] = _by_map(squares, labelled_maps, count)
        return sums

    def add_classes(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Add class probabilities [B, C, H, W] of maps with true classes [B, H, W]."""
        n_maps = len(class_id)
        labelled = class_id != UNLABELLED
        offsets = self.classes * torch.arange(n_maps, device=class_id.device)
        offset = offsets[:, None, None].expand_as(class_id)[labelled]
        predicted = probabilities.argmax(1)[labelled]
        true = class_id[labelled]
        is_hit = predicted == true
        hits = true[is_hit] + offset[is_hit]
        indices = {"true": offset + true, "predicted": offset + predicted, "hits": hits}
        for name, index in indices.items():
            counts = torch.bincount(index, minlength=n_maps * self.classes)
            self._append(name, counts.view(n_maps, self.classes))

    def sums(self) -> dict[str, np.ndarray]:
        """Return the sums by name, each of shape [M]; sums by class have shape [M, C]."""
        return {name: np.concatenate(parts) for name, parts in self.parts.items()}

    def curves(self) -> np.ndarray:
        """Return the sparsification curves, shape [3, STEPS].

        The rows are the fraction of removed cells, the mean error of the remaining cells
        if the cells with the widest predicted intervals are removed first, and their
        mean error if the cells with the largest errors are removed first.
        """
        n_cells = sum(float(counts.sum()) for counts in self.parts["cells"])
        removed = np.arange(STEPS) / STEPS
        return np.vstack([removed, self.ranked / n_cells])

    def _append(self, name: str, values: Tensor) -> None:
        array = values.double().cpu().numpy()
        self.parts.setdefault(name, []).append(array)

    def _rank(self, cells: CellScores, width: Tensor, count: int) -> Tensor:
        """Return the AUSE of each cell's map, [N]; add the maps' curves to `ranked`."""
        areas = torch.zeros_like(width)
        error = (cells.expected - cells.observed)[0].abs()
        steps = torch.arange(STEPS, device=width.device)
        for index in range(count):
            mask = cells.maps == index
            n_cells = int(mask.sum())
            if not n_cells:
                continue
            curves = sparsification(error[mask], width[mask])
            by_width, by_error = curves
            areas[mask] = (by_width - by_error).mean()
            last_cell = n_cells - 1 - steps * n_cells // STEPS
            self.ranked += n_cells * curves[:, last_cell].cpu().numpy()
        return areas


def _by_map(values: Tensor, maps: Tensor, count: int) -> Tensor:
    """Sum values of N cells by map, float64, shape [count]."""
    zeros = torch.zeros(count, dtype=torch.float64, device=values.device)
    return zeros.index_add_(0, maps, values.flatten().double())


_NAMES = (
    *("cells", "squares", "nll", "crps", "inside", "expected_squares", "labelled"),
    *(f"under_{round(100 * level)}" for level in TAIL_LEVELS),
)
_OF_QUANTILES = ("pinball", "width", "areas")


def by_group(sums: Sums, groups: np.ndarray) -> dict[str, np.ndarray]:
    """Add up the sums of all maps of a group, which counts as one statistical unit.

    For example, overlapping maps are a group. Groups without observed cells are left
    out.

    Args:
        sums: sums by name, each of shape [M]; sums by class have shape [M, C].
        groups: group id of each map, shape [M].

    Returns:
        Sums of the groups by name, in the order of the group ids.
    """
    group_ids, index = np.unique(groups, return_inverse=True)
    totals = {}
    for name, values in sums.items():
        total = np.zeros((len(group_ids), *values.shape[1:]))
        np.add.at(total, index, values)
        totals[name] = total
    has_cells = totals["cells"] > 0
    return {name: values[has_cells] for name, values in totals.items()}
