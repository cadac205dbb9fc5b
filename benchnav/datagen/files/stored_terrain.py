"""Stored maps as Terrain, with the true distribution of λ in each cell. Letters in shapes: B maps."""

from functools import partial

import numpy as np
import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.classes import ClassTable
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import FIELDS, MAP_FIELDS, OPTIONAL, Maps


def terrain_of(maps: Maps, recipe: Recipe) -> Terrain:
    """Makes Terrain of stored arrays, float32 on the CPU.

    Args:
        maps: the fields of `schema.MAP_FIELDS`, each of shape [B, *entry shape]; what is there beyond the schema's
            other fields are layers.
        recipe: by which they were made.
    """
    slope = maps["slope_deg"].astype(np.float64)
    fields = {name: torch.from_numpy(maps[name]) for name in MAP_FIELDS}
    layers = [name for name in maps if name not in FIELDS | OPTIONAL]
    alike = recipe.synthesis > 1 and (len(recipe.units) < len(recipe.classes) or recipe.has_vegetation)
    truth = latent.truth(maps["class_id"], slope, recipe.classes)
    return Terrain(
        **fields | {"class_id": fields["class_id"].long()},
        truth=_mixture(truth, (0,) * len(truth[0][0])),
        grid=recipe.grid,
        look_alikes=partial(_look_alikes, recipe.classes) if alike else None,
        layers={name: torch.from_numpy(maps[name]) for name in layers},
    )


def _look_alikes(classes: ClassTable, terrain: Terrain) -> TraversabilityMixture:
    slope = terrain.slope_deg.cpu().numpy().astype(np.float64)
    overgrown = None
    if "vegetation_m" in terrain.layers and any(item.vegetation for item in classes):
        overgrown = (terrain.layers["vegetation_m"] > 0).cpu().numpy()
    parameters = latent.look_alikes(terrain.class_id.cpu().numpy(), slope, classes, overgrown)
    group = (number for number, item in enumerate(classes) for _ in range(2 if item.soft else 1))
    return _mixture(parameters, tuple(group)).to(terrain.class_id.device)


def _mixture(parameters: latent.Parameters, group: tuple[int, ...]) -> TraversabilityMixture:
    """In float32."""
    weights, means, stds = (torch.from_numpy(values.astype(np.float32)) for values in parameters)
    return TraversabilityMixture(weights, means, stds, group)
