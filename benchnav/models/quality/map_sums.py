"""Quality by map: sums from which every score follows (`scores_of_maps`), of one map or
of any number of them.

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
    lower_fifth_and_width,
    pit_counts,
    sparsification,
)
from benchnav.stats.scores import Sums

STEPS = 50  # of a sparsification curve, from no cell left out on


@dataclass(frozen=True, kw_only=True)
class CellScores:
    """What is said of the N observed cells of some maps.

    Args:
        predicted: the distribution in each, of shape [1, N].
        observed: λ, shape [1, N].
        expected: predicted E[λ], shape [1, N].
        transformed: its PIT, shape [1, N].
        maps: which map each is of, int64, shape [N].
        scores: `squares` of E[λ] − λ, `nll`, and `crps`, float64, each of shape [1, N].
        labelled: which cells have a class, bool, shape [N].
        expected_squares: of E[λ] − E[λ] in truth, of the labelled cells, float64.
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
    """Adds up maps, one by one.

    Args:
        classes: number of classes C, 0 of a model without any.
        truth: whether the maps' true distribution of λ is known.
        quantiles: add up what quantiles of every cell are needed for, which take most
            of the time.
    """

    def __init__(self, classes: int, truth: bool, quantiles: bool = True) -> None:
        """Start with no maps."""
        self.classes, self.truth, self.quantiles = classes, truth, quantiles
        self.names = (*_NAMES, *(_OF_QUANTILES if quantiles else ()))
        self.parts: dict[str, list[np.ndarray]] = {}
        self.pit = np.zeros(PIT_BINS, dtype=np.int64)
        self.ranked = np.zeros((2, STEPS))

    def add(self, cells: CellScores | None, count: int) -> None:
        """Adds `count` maps by their observed cells, None where there are none."""
        sums = {name: torch.zeros(count, dtype=torch.float64) for name in self.names}
        if cells is not None:
            scores: dict[str, Tensor] = {
                **cells.scores,
                "cells": torch.ones_like(cells.observed),
            }
            scores["inside"] = (cells.transformed - 0.5).abs() <= LEVEL / 2
            scores |= {
                f"under_{round(100 * level)}": cells.transformed < 1 - level
                for level in TAIL_LEVELS
            }
            if self.quantiles:
                loss, width = lower_fifth_and_width(cells.predicted, cells.observed)
                scores |= {
                    "pinball": loss,
                    "width": width,
                    "areas": self._rank(cells, width[0], count),
                }
            sums |= {
                name: _by_map(values, cells.maps, count)
                for name, values in scores.items()
            }
            self.pit += pit_counts(cells.transformed).numpy()
            if self.truth:
                sums["labelled"] = _by_map(cells.labelled, cells.maps, count)
                sums["expected_squares"] = _by_map(
                    cells.expected_squares, cells.maps[cells.labelled], count
                )
        for name, values in sums.items():
            self._keep(name, values)

    def add_classes(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Adds class probabilities [B, C, H, W] of maps with true classes [B, H, W]."""
        maps, labelled = len(class_id), class_id != UNLABELLED
        where = (self.classes * torch.arange(maps, device=class_id.device))[
            :, None, None
        ].expand_as(class_id)
        found, true, where = (
            layer[labelled] for layer in (probabilities.argmax(1), class_id, where)
        )
        for name, cells in (
            ("true", where + true),
            ("found", where + found),
            ("hits", (where + true)[found == true]),
        ):
            counts = torch.bincount(cells, minlength=maps * self.classes)
            self._keep(name, counts.view(maps, self.classes))

    def sums(self) -> dict[str, np.ndarray]:
        """What was added, by name, of shape [M], of classes [M, C]."""
        return {name: np.concatenate(parts) for name, parts in self.parts.items()}

    def curves(self) -> np.ndarray:
        """Share of cells that is left out; mean error of the rest, ranked by width, and
        by error; shape [3, STEPS].
        """
        cells = sum(float(part.sum()) for part in self.parts["cells"])
        return np.vstack([np.arange(STEPS) / STEPS, self.ranked / cells])

    def _keep(self, name: str, values: Tensor) -> None:
        self.parts.setdefault(name, []).append(values.double().cpu().numpy())

    def _rank(self, cells: CellScores, width: Tensor, count: int) -> Tensor:
        """The AUSE of each cell's own map, [N], while the curves are added to those of
        all maps.
        """
        areas, error = (
            torch.zeros_like(width),
            (cells.expected - cells.observed)[0].abs(),
        )
        for place in range(count):
            here = cells.maps == place
            size = int(here.sum())
            if not size:
                continue
            curves = sparsification(error[here], width[here])
            areas[here] = (curves[0] - curves[1]).mean()
            left = size - 1 - torch.arange(STEPS, device=width.device) * size // STEPS
            self.ranked += size * curves[:, left].cpu().numpy()
        return areas


def _by_map(values: Tensor, maps: Tensor, count: int) -> Tensor:
    """Adds values of N cells up by map, float64, shape [count]."""
    empty = torch.zeros(count, dtype=torch.float64, device=values.device)
    return empty.index_add_(0, maps, values.flatten().double())


_NAMES = (
    *("cells", "squares", "nll", "crps", "inside", "expected_squares", "labelled"),
    *(f"under_{round(100 * level)}" for level in TAIL_LEVELS),
)
_OF_QUANTILES = ("pinball", "width", "areas")


def by_group(sums: Sums, groups: np.ndarray) -> dict[str, np.ndarray]:
    """Adds maps of one group up, as of overlapping ones, which are one unit; those
    without any cell are left out.

    Args:
        sums: of shape [M], of classes [M, C].
        groups: which maps go together: those of one number, shape [M].

    Returns:
        Sums of the units, in the order of their numbers.
    """
    numbers, member = np.unique(groups, return_inverse=True)
    together = {
        name: np.zeros((len(numbers), *values.shape[1:]))
        for name, values in sums.items()
    }
    for name, values in sums.items():
        np.add.at(together[name], member, values)
    return {name: values[together["cells"] > 0] for name, values in together.items()}
