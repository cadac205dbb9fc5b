"""Predictions of look-alike classes, and looks at them, for tests of the belief that
learns which ground is of.
"""

import torch
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.sensing.belief import CovarianceModel
from benchnav.planning.sensing.class_state import ClassesState
from benchnav.planning.sensing.classes import Classes
from benchnav.planning.sensing.sensor import Measurement

NAMES = ("packed", "crusted", "rock", "firm", "drift")
MEANS, STDS = (0.75, 0.5, 0.3, 0.9, 0.5), (0.15, 0.15, 0.2, 0.13, 0.15)
PAIRS = (("packed", "crusted"), ("firm", "drift"))


def covariance_of(
    height: int,
    width: int,
    correlation_m: float = 1.0,
    strength: float = 0.8,
    pairs: tuple[tuple[str, str], ...] = PAIRS,
) -> CovarianceModel:
    statistics = GroundStatistics(
        weights=(1.0,),
        means=(0.5,),
        stds=(0.2,),
        layer_means={},
        look_alikes=pairs,
        potts_strength=strength,
    )
    return CovarianceModel(
        grid=Grid(height, width, 0.5),
        correlation_m=correlation_m,
        statistics=statistics,
        class_names=NAMES,
    )


def prediction(weights: Tensor) -> TraversabilityMixture:
    """A component a class, from weights of shape [B, 5, H, W]."""
    means, stds = (
        torch.tensor(own).double()[:, None, None].expand_as(weights)
        for own in (MEANS, STDS)
    )
    return TraversabilityMixture(weights, means, stds, (0, 1, 2, 3, 4))


def even(batch: int, height: int, width: int) -> TraversabilityMixture:
    """Ground of the first pair everywhere, of either class alike."""
    weights = torch.zeros(batch, 5, height, width, dtype=torch.float64)
    weights[:, :2] = 0.5
    return prediction(weights)


def mixed(batch: int, height: int, width: int, seed: int = 0) -> TraversabilityMixture:
    """All classes with some weight: left of the first pair, right of the second, rock
    below.
    """
    generator = torch.Generator().manual_seed(seed)
    weights = 0.005 + 0.02 * torch.rand(
        batch, 5, height, width, generator=generator, dtype=torch.float64
    )
    weights[:, :2, :-2, : width // 2] += 0.4
    weights[:, 3:, :-2, width // 2 :] += 0.4
    weights[:, 2, -2:] += 0.9
    return prediction(weights / weights.sum(1, keepdim=True))


def looked(
    shape: tuple[int, ...], values: dict[tuple[int, int], float], std: float = 0.1
) -> Measurement:
    found = torch.full(shape, torch.nan, dtype=torch.float64)
    for (row, column), value in values.items():
        found[:, row, column] = value
    return Measurement(traversability=found, std=torch.full_like(found, std))


def after(
    belief: Classes,
    prior: TraversabilityMixture,
    covariance: CovarianceModel,
    *looks: Measurement,
) -> ClassesState:
    state = belief.init(prior, covariance)
    for sensed in looks:
        state = belief.update(state, sensed)
    return state
