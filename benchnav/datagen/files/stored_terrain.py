"""Stored maps as Terrain, with the true distribution of λ in each cell. Letters in shapes: B maps."""

from functools import partial

import numpy as np
import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.classes import ClassTable
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import MAP_FIELDS, Maps


def terrain_of(maps: Maps, recipe: Recipe) -> Terrain:
    """Makes Terrain of stored arrays, float32 on the CPU.

    Args:
        maps: the fields of `schema.MAP_FIELDS`, each of shape [B, *entry shape].
        recipe: by which they were made.
    """
    slope = maps["slope_deg"].astype(np.float64)
    layers = {name: torch.from_numpy(maps[name]) for name in MAP_FIELDS}
    alike = recipe.synthesis > 1 and len(recipe.units) < len(recipe.classes)
    return Terrain(
        **layers | {"class_id": layers["class_id"].long()},
        truth=_mixture(latent.truth(maps["class_id"], slope, recipe.classes), recipe.classes),
        grid=recipe.grid,
        look_alikes=partial(_look_alikes, recipe.classes) if alike else None,
    )


def _look_alikes(
    classes: ClassTable, class_id: torch.Tensor, slope_deg: torch.Tensor
) -> TraversabilityMixture:
    slope = slope_deg.cpu().numpy().astype(np.float64)
    parameters = latent.look_alikes(class_id.cpu().numpy(), slope, classes)
    return _mixture(parameters, classes).to(class_id.device)


def _mixture(parameters: latent.Parameters, classes: ClassTable) -> TraversabilityMixture:
    """In float32; the components of a class, one or with its soft spots two, stand next to one another."""
    weights, means, stds = (torch.from_numpy(values.astype(np.float32)) for values in parameters)
    per_class = 2 if any(item.soft for item in classes) else 1
    group = tuple(k // per_class for k in range(weights.shape[1]))
    return TraversabilityMixture(weights, means, stds, group)
