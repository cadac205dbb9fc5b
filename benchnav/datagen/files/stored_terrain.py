"""Stored maps as Terrain, with the true distribution of λ in each cell. Letters in
shapes: B maps.
"""

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
    """Makes Terrain of stored arrays, float32 on the CPU.

    Args:
        maps: the fields of `schema.MAP_FIELDS`, each of shape [B, *entry shape]; what
            is there beyond the schema's other fields are layers.
        recipe: by which they were made.
    """
    fields = {name: torch.from_numpy(maps[name]) for name in MAP_FIELDS}
    layers = [name for name in maps if name not in (*KNOWN, *TRUTH)]
    is_hidden = len(recipe.units) < len(recipe.classes) or any(
        spec.hides for spec in recipe.layers
    )
    alike = recipe.synthesis > 1 and is_hidden
    truth = latent.stored_truth(maps, recipe.classes)
    return Terrain(
        **fields | {"class_id": fields["class_id"].long()},
        truth=_mixture(truth, (0,) * len(truth[0][0])),
        grid=recipe.grid,
        look_alikes=partial(_look_alikes, recipe) if alike else None,
        layers={name: torch.from_numpy(maps[name]) for name in layers},
    )


def _look_alikes(recipe: Recipe, terrain: Terrain) -> TraversabilityMixture:
    elevation_m, slope_deg = (
        tensor.cpu().numpy().astype(np.float64)
        for tensor in (terrain.elevation_m, terrain.slope_deg)
    )
    maps = DrawnMaps(
        terrain.class_id.cpu().numpy(),
        elevation_m,
        slope_deg,
        recipe.grid,
        recipe.classes,
    )
    specs = [
        spec
        for spec in recipe.layers
        if spec.name in terrain.layers and (spec.hides or spec.affects)
    ]
    values = {
        spec.name: terrain.layers[spec.name].cpu().numpy().astype(np.float64)
        for spec in specs
    }
    parameters = latent.look_alikes(maps, [spec.layer for spec in specs], values)
    group = (
        number
        for number, item in enumerate(recipe.classes)
        for _ in range(2 if item.soft else 1)
    )
    return _mixture(parameters, tuple(group)).to(terrain.class_id.device)


def _mixture(
    parameters: latent.Parameters, group: tuple[int, ...]
) -> TraversabilityMixture:
    """In float32."""
    weights, means, stds = (
        torch.from_numpy(values.astype(np.float32)) for values in parameters
    )
    return TraversabilityMixture(weights, means, stds, group)
