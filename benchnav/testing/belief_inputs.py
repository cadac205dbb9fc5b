"""Predictions and measurements for the check of beliefs.

Letters in shapes: B episodes; H×W cells.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.grid import Grid
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, quantiles_at
from benchnav.planning.sensing.belief import CovarianceModel, draw_scores
from benchnav.planning.sensing.sensor import Measurement
from benchnav.testing.breaches import SEED

KEYS = (3, 14, 15, 92)
"""Stream keys of the four episodes."""
UNOBSERVED = 3
"""Index of the episode without measurements."""
_STEPS = 3
_STD = 0.1  # standard deviation of measurement noise, in normal scores


def measure(values: Tensor, prior: TraversabilityDistribution) -> Measurement:
    """Return a measurement of λ with noise.

    Args:
        values: λ; NaN in cells without a measurement, shape [B, H, W].
        prior: prediction; the measurement takes its dtype and device.
    """
    values = values.to(dtype=prior.dtype, device=prior.device)
    std = torch.full_like(values, _STD)
    return Measurement(traversability=values, std=std)


def no_measurement(prior: TraversabilityDistribution) -> Measurement:
    """Return a measurement of no cell."""
    return measure(torch.full(prior.shape, torch.nan), prior)


def measurements(
    prior: TraversabilityDistribution, covariance: CovarianceModel
) -> Iterator[Measurement]:
    """Yield measurements of λ along a path from left to right, with λ of 0 and 1.

    The second episode has no measurement in the first step. The last episode has none
    in any step.

    Args:
        prior: prediction from which λ is sampled.
        covariance: covariance model of the λ field.
    """
    score = draw_scores(covariance, 1, KEYS)[:, 0].to(prior.device)
    field = prior.from_normal(score.to(prior.dtype))
    height, width = covariance.grid.shape
    row = height // 2
    rows = slice(row - 1, row + 1)
    for step in range(_STEPS):
        begin = step * width // (_STEPS + 1)
        end = (step + 1) * width // (_STEPS + 1)
        values = torch.full_like(field, torch.nan)
        values[:, rows, begin:end] = field[:, rows, begin:end]
        values[0, row, begin] = 0.0
        values[2, row, begin] = 1.0
        values[UNOBSERVED] = torch.nan
        if step == 0:
            values[1] = torch.nan
        yield measure(values, prior)


def create_predictions(
    height: int, width: int, by_quantiles: bool, device: torch.device
) -> tuple[CovarianceModel, TraversabilityDistribution, TraversabilityDistribution]:
    """Return a covariance model and two different predictions of λ of four maps.

    Args:
        height: number of rows.
        width: number of columns.
        by_quantiles: whether predictions are quantiles instead of mixtures.
        device: device of the predictions.
    """
    statistics = GroundStatistics(
        weights=(0.3, 0.7),
        means=(0.1, 0.7),
        stds=(0.1, 0.15),
        layer_means={"rgb": (120.0, 110.0, 90.0)},
        look_alikes=(("firm", "soft"),),
        potts_strength=0.8,
    )
    covariance = CovarianceModel(
        grid=Grid(height, width, 0.5),
        correlation_m=1.0,
        statistics=statistics,
        class_names=("firm", "soft", "sand"),
    )
    generator = torch.Generator().manual_seed(SEED)
    min_weights = torch.tensor([0.5, 0.3, 0.1], device=device).view(-1, 1, 1)
    min_means = torch.tensor([0.75, 0.05, 0.45], device=device).view(-1, 1, 1)

    def predict() -> TraversabilityDistribution:
        uniform = torch.rand(3, len(KEYS), 3, height, width, generator=generator)
        uniform = uniform.to(device)
        weights = min_weights + 0.2 * uniform[0]
        weights = weights / weights.sum(1, keepdim=True)
        means = min_means + 0.1 * uniform[1]
        stds = 0.08 + 0.05 * uniform[2]
        mixture = TraversabilityMixture(weights, means, stds, (0, 1, 2))
        if by_quantiles:
            return quantiles_at(mixture, LEVELS)
        return mixture

    return covariance, predict(), predict()
