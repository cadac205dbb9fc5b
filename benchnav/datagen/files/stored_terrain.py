"""Stored maps as Terrain, with the true distribution of λ. B maps in shapes."""

from functools import partial

import numpy as np
import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.layers.layer import DrawnMaps
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import KNOWN, MAP_FIELDS, TRUTH, Maps


def terrain_of(maps: Maps, recipe: Recipe) -> Terrain:
    """Return stored arrays as Terrain, float32 on the CPU.

    Args:
        maps: the fields of `schema.MAP_FIELDS`, each of shape [B, *entry shape]. Arrays
            that are not fields of the schema are layers.
        recipe: recipe of the maps.
    """
    fields = {name: torch.from_numpy(maps[name]) for name in MAP_FIELDS}
    fields["class_id"] = fields["class_id"].long()
    layers = [name for name in maps if name not in (*KNOWN, *TRUTH)]
    shares_colours = len(recipe.units) < len(recipe.classes)
    is_hidden = shares_colours or any(spec.hides for spec in recipe.layers)
    has_look_alikes = recipe.synthesis > 1 and is_hidden
    truth = latent.stored_truth(maps, recipe.classes)
    return Terrain(
        **fields,
        truth=_mixture(truth, (0,) * len(truth[0][0])),
        grid=recipe.grid,
        look_alikes=partial(_look_alikes, recipe) if has_look_alikes else None,
        layers={name: torch.from_numpy(maps[name]) for name in layers},
    )


def _look_alikes(recipe: Recipe, terrain: Terrain) -> TraversabilityMixture:
    maps = DrawnMaps(
        terrain.class_id.cpu().numpy(),
        _to_float64(terrain.elevation_m),
        _to_float64(terrain.slope_deg),
        recipe.grid,
        recipe.classes,
    )
    specs = [
        spec
        for spec in recipe.layers
        if spec.name in terrain.layers and (spec.hides or spec.affects)
    ]
    values = {spec.name: _to_float64(terrain.layers[spec.name]) for spec in specs}
    parameters = latent.look_alikes(maps, [spec.layer for spec in specs], values)
    group: list[int] = []
    for class_id, item in enumerate(recipe.classes):
        group += [class_id] * (2 if item.soft else 1)
    return _mixture(parameters, tuple(group)).to(terrain.class_id.device)


def _to_float64(tensor: torch.Tensor) -> np.ndarray:
    return tensor.cpu().numpy().astype(np.float64)


def _mixture(
    parameters: latent.Parameters, group: tuple[int, ...]
) -> TraversabilityMixture:
    """Return the mixture in float32."""
    weights, means, stds = (
        torch.from_numpy(values.astype(np.float32)) for values in parameters
    )
    return TraversabilityMixture(weights, means, stds, group)
