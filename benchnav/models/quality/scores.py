"""Scores of predicted probabilities: of distributions of traversability, and of classes.

Calibration of λ is read off the probability integral transform (PIT) of what was observed: uniform
when the predicted distributions are right. Where λ was clipped the distribution has an atom, and the
PIT is drawn uniformly within it, so it is uniform there too. Sources: Gneiting and Raftery (2007),
"Strictly proper scoring rules" (CRPS, Brier score); Czado et al. (2009), "Predictive model assessment
for count data" (randomised PIT); Guo et al. (2017), "On calibration of modern neural networks"
(reliability, ECE). Letters in shapes: K components, C classes, H×W cells, *B any leading dimensions.
"""

import math

import numpy as np
import torch
from torch import Tensor
from torchmetrics import Metric

from benchnav.core.mixture import TraversabilityMixture

LEVEL = 0.9
CONFIDENCE_BINS = 15
PIT_BINS = 20

_QUADRATURE_NODES = 48
_SMALLEST_STD = 1e-9
_UNDER_1 = 1 - 2**-53  # the largest float64 under 1


def crps(mixture: TraversabilityMixture, observed: Tensor) -> Tensor:
    """Continuous ranked probability score: ∫₀¹ (F(x) − 1[observed ≤ x])² dx.

    As ∫₀¹ F² dx − 2·∫_observed^1 F dx + 1 − observed: the second integral is of closed form, and the
    first is smooth, so that Gauss-Legendre quadrature with 48 nodes is off by less than 10⁻⁵ for
    components with standard deviations from 0.03, and by up to 0.02 for much narrower ones.

    Args:
        mixture: predicted, parameters of shape [*B, K, H, W], whose dtype the nodes are computed in.
        observed: λ in [0, 1], shape [*B, H, W].

    Returns:
        Shape [*B, H, W]; 0 is perfect.
    """
    stds = mixture.stds.clamp(min=_SMALLEST_STD)
    narrowness = 1 / (stds * math.sqrt(2))
    nodes, shares = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
    squared = torch.zeros_like(observed, dtype=stds.dtype)
    for node, share in zip((nodes + 1) / 2, shares / 2, strict=True):
        weighted = torch.erf_((node - mixture.means) * narrowness).mul_(mixture.weights)
        squared += share * (0.5 + 0.5 * weighted.sum(-3)) ** 2
    at = observed.double()
    above = _integrated_cdf(mixture, torch.ones_like(at)) - _integrated_cdf(mixture, at)
    return (squared - 2 * above + 1 - at).clamp(min=0).to(observed.dtype)


def pit(mixture: TraversabilityMixture, observed: Tensor, generator: torch.Generator) -> Tensor:
    """Randomised probability integral transform of what was observed.

    Args:
        mixture: predicted, parameters of shape [*B, K, H, W].
        observed: λ in [0, 1], shape [*B, H, W].
        generator: of the draws within the atoms at 0 and 1, on the CPU.

    Returns:
        Shape [*B, H, W]; uniform on [0, 1] when the prediction is right.
    """
    inside = mixture.cdf(observed.double().clamp(max=_UNDER_1))
    lower = torch.where(observed <= 0, 0.0, inside)
    upper = torch.where(observed >= 1, 1.0, inside)
    drawn = torch.rand(observed.shape, generator=generator).to(observed.device)
    return lower + drawn * (upper - lower)


def coverage(transformed: Tensor, share: float = 0.9) -> float:
    """Share of observations in the central interval that should hold `share` of them.

    Args:
        transformed: from `pit`, any shape.
        share: of the central interval.
    """
    return float(((transformed - 0.5).abs() <= share / 2).double().mean())


def tail_rate(transformed: Tensor, level: float = LEVEL) -> float:
    """Share of observations under the VaR at `level`; ideally 1 − level.

    Where the VaR is 0 or 1 it lies on an atom, and the draw within the atom decides.

    Args:
        transformed: from `pit`, any shape.
        level: α in [0, 1).
    """
    return float((transformed < 1 - level).double().mean())


def pit_counts(transformed: Tensor) -> Tensor:
    """Counts observations in 20 equal bins of the PIT.

    Args:
        transformed: from `pit`, any shape.

    Returns:
        int64 on the CPU, shape [20].
    """
    place = (transformed.double() * PIT_BINS).floor().long().clamp(0, PIT_BINS - 1)
    return torch.bincount(place.flatten(), minlength=PIT_BINS).cpu()


class BrierScore(Metric):
    """Mean over cells of Σ_c (p_c − y_c)², y being 1 at the class that is there (Brier, 1950)."""

    full_state_update = False
    total: Tensor
    cells: Tensor

    def __init__(self) -> None:
        """Starts with no cells."""
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("cells", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Adds maps: class probabilities [B, C, H, W] and true classes [B, H, W]."""
        right = probabilities.gather(1, class_id.unsqueeze(1)).squeeze(1)
        self.total += (probabilities.square().sum(1) - 2 * right + 1).double().sum()
        self.cells += class_id.numel()

    def compute(self) -> Tensor:
        """The score of all cells so far."""
        return self.total / self.cells


class ReliabilityCurve(Metric):
    """How often the most likely class is right, by how likely it was said to be, in 15 equal bins.

    Unlike torchmetrics' calibration error it keeps sums a bin rather than every cell.
    """

    full_state_update = False
    sums: Tensor

    def __init__(self) -> None:
        """Starts with no cells."""
        super().__init__()
        self.add_state("sums", torch.zeros(3, CONFIDENCE_BINS, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, probabilities: Tensor, class_id: Tensor) -> None:
        """Adds maps: class probabilities [B, C, H, W] and true classes [B, H, W]."""
        confidence, found = probabilities.max(1)
        place = (confidence * CONFIDENCE_BINS).floor().long().clamp(0, CONFIDENCE_BINS - 1).flatten()
        terms = torch.stack([torch.ones_like(confidence), confidence, found == class_id]).double().flatten(1)
        self.sums.index_add_(1, place, terms)

    def compute(self) -> Tensor:
        """Cells, mean confidence and accuracy of each bin, float64, shape [3, 15]; 0 in empty bins."""
        cells, confidence, right = self.sums
        filled = cells.clamp(min=1)
        return torch.stack([cells, confidence / filled, right / filled])


def calibration_error(curve: Tensor) -> float:
    """Expected calibration error: |accuracy − confidence| averaged over cells.

    Args:
        curve: of `ReliabilityCurve`, shape [3, 15].
    """
    cells, confidence, accuracy = curve
    return float((cells * (accuracy - confidence).abs()).sum() / cells.sum())


def _integrated_cdf(mixture: TraversabilityMixture, value: Tensor) -> Tensor:
    """∫_{−∞}^value F of the mixture before clipping, float64."""
    weights, means, stds = (t.double() for t in (mixture.weights, mixture.means, mixture.stds))
    stds = stds.clamp(min=_SMALLEST_STD)
    z = (value.unsqueeze(-3) - means) / stds
    density = torch.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    return (weights * stds * (z * torch.special.ndtr(z) + density)).sum(-3)
