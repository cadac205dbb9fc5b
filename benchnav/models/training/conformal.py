"""Conformal recalibration on every second map of `valid`; training uses the other maps."""

import numpy as np
import torch
from numpy import ndarray

from benchnav.core import rng
from benchnav.core.errors import expect
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.conformal import ConformalTable, fit_table
from benchnav.models.training.data import VALID

_MIN_MAPS = 4


def stopping_step(conformal: bool) -> int:
    """Return n: early stopping and temperature use every n-th map of `valid`."""
    return 2 if conformal else 1


def scored_maps(count: int) -> range:
    """Return the indices of the maps for scores: every second of `count` maps.

    Early stopping and temperature do not use these maps.
    """
    return range(1, count, 2)


def check_valid(dataset: TerrainDataset) -> None:
    """Check that the split `valid` of a dataset has enough maps for recalibration.

    Raises:
        ConfigError: If the split has too few maps.
    """
    n_maps = dataset.map_count(VALID)
    expect(
        n_maps >= _MIN_MAPS,
        f"at least {_MIN_MAPS} maps in split {VALID} of {dataset.path} for "
        f"`conformal`, got {n_maps}. Every second map is used for scores. With n maps "
        "for scores, the lowest guaranteed level is 1 / (n + 1). Add maps to the split "
        f"{VALID}.",
    )


def conformal_table(
    model: TraversabilityModel, dataset: TerrainDataset, seed: int, device: torch.device
) -> ConformalTable:
    """Fit the conformal table of a model to every second map of `valid`.

    Args:
        model: a model trained and calibrated on other maps.
        dataset: dataset of the maps.
        seed: root seed of the random PIT values within atoms.
        device: device of the computation.
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
    """Return the PIT values of the observed cells of a map, float64, shape [N]."""
    terrain = dataset.terrain(VALID, [index]).to(device)
    observed = terrain.traversability
    with torch.no_grad():
        limits = predict(model, terrain).cdf_limits(observed.nan_to_num())
    lower, upper = (limit.double() for limit in limits)
    key = rng.stream_key(seed, "models", "conformal")
    uniform = rng.uniform(key, np.array([index]), tuple(observed.shape[1:]))
    transformed = torch.lerp(lower, upper, torch.from_numpy(uniform).to(lower))
    return transformed[observed.isfinite()].cpu().numpy()
