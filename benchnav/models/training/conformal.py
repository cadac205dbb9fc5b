"""Halves of `valid` for conformal recalibration: maps for stopping and temperature, and
maps for scores.
"""

import numpy as np
import torch
from numpy import ndarray

from benchnav.core import rng
from benchnav.core.errors import expect
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.conformal import ConformalTable, fit_table
from benchnav.models.training.data import VALID

_LEAST_MAPS = 4


def stopping_every(conformal: bool) -> int:
    """The n of which stopping and temperature see every n-th map of `valid`, from the
    first on.
    """
    return 2 if conformal else 1


def scored_maps(count: int) -> range:
    """Indices of the maps of a split of so many that `stopping_every` leaves out."""
    return range(1, count, 2)


def check_valid(dataset: TerrainDataset) -> None:
    """Refuses a dataset whose split `valid` cannot be halved.

    Raises:
        ConfigError: it has too few maps.
    """
    count = dataset.map_count(VALID)
    expect(
        count >= _LEAST_MAPS,
        f"at least {_LEAST_MAPS} maps in split {VALID} of {dataset.path} for "
        "`conformal`, which takes every second "
        f"one, got {count}. Its least level is 1 / (n + 1) for n maps: give {VALID} "
        "more maps.",
    )


def conformal_table(
    model: TraversabilityModel, dataset: TerrainDataset, seed: int, device: torch.device
) -> ConformalTable:
    """Predicts every second map of `valid` and finds the levels that a model's
    quantiles are to be read at.

    Args:
        model: trained, and calibrated, on other maps.
        dataset: where the maps are.
        seed: root seed of the scores of atoms.
        device: where to compute.
    """
    scores = [
        _scores(model, dataset, index, seed, device)
        for index in scored_maps(dataset.map_count(VALID))
    ]
    return fit_table(scores)


def _scores(
    model: TraversabilityModel,
    dataset: TerrainDataset,
    index: int,
    seed: int,
    device: torch.device,
) -> ndarray:
    """PIT values of the observed cells of a map, float64."""
    terrain = dataset.terrain(VALID, [index]).to(device)
    observed = terrain.traversability
    with torch.no_grad():
        lower, upper = (
            share.double()
            for share in predict(model, terrain).cdf_limits(observed.nan_to_num())
        )
    key = rng.stream_key(seed, "models", "conformal")
    drawn = rng.uniform(key, np.array([index]), tuple(observed.shape[1:]))
    inside = torch.lerp(lower, upper, torch.from_numpy(drawn).to(lower))
    return inside[observed.isfinite()].cpu().numpy()
