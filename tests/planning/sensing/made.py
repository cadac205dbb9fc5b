"""Maps of known λ for tests of sensing."""

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.planning.sensing.belief import CovarianceModel


def mixture(
    batch: int, height: int, width: int, seed: int = 0, atoms: bool = True
) -> TraversabilityMixture:
    """Two components a cell, of which the lower reaches under 0 and the upper over 1."""
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, 1, height, width)
    share = 0.1 + 0.3 * torch.rand(shape, generator=generator, dtype=torch.float64)
    low = 0.05 + 0.1 * torch.rand(shape, generator=generator, dtype=torch.float64)
    high = 0.6 + 0.3 * torch.rand(shape, generator=generator, dtype=torch.float64)
    stds = torch.full_like(torch.cat((low, high), 1), 0.1 if atoms else 0.005)
    return TraversabilityMixture(
        torch.cat((share, 1 - share), 1), torch.cat((low, high), 1), stds
    )


def covariance(
    height: int, width: int, correlation_m: float = 1.0, resolution_m: float = 0.5
) -> CovarianceModel:
    return CovarianceModel(
        grid=Grid(height, width, resolution_m), correlation_m=correlation_m
    )


def terrain(
    truth: TraversabilityMixture, field: Tensor, resolution_m: float = 0.5
) -> Terrain:
    batch, height, width = truth.shape
    maps = torch.zeros(batch, height, width)
    return Terrain(
        rgb=torch.zeros(batch, 3, height, width, dtype=torch.uint8), class_id=maps.long(), elevation_m=maps,
        slope_deg=maps, truth=truth, traversability=field, grid=Grid(height, width, resolution_m),
    )  # fmt: skip


def scores(covariance: CovarianceModel, count: int, seed: int = 0) -> Tensor:
    """Normal scores as the world draws them, shape [count, H, W]."""
    key = rng.stream_key(seed, "scores")
    drawn = correlated_normal(
        key, np.arange(count), covariance.grid.shape, covariance.correlation_cells
    )
    return torch.from_numpy(drawn)
