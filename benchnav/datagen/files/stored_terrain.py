"""Conversion of stored maps to Terrain, with the true distribution of λ.

Letters in shapes: B maps.
"""

from functools import partial

import numpy as np
import torch

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.layers.layer import DrawnMaps
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.classes import ClassTable
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import KNOWN, MAP_FIELDS, TRUTH, Maps


def terrain_of(maps: Maps, recipe: Recipe) -> Terrain:
    """Return stored arrays as Terrain, float32 on the CPU.

    Args:
        maps: arrays by field: those of `schema.MAP_FIELDS` and, optionally, of
            `schema.TRUTH`, each of shape [B, *entry shape]. Arrays that are not fields
            of the schema are layers.
        recipe: recipe of the maps.
    """
    fields = {name: torch.from_numpy(maps[name]) for name in MAP_FIELDS}
    fields["class_id"] = fields["class_id"].long()
    layer_names = [name for name in maps if name not in (*KNOWN, *TRUTH)]
    layers = {name: torch.from_numpy(maps[name]) for name in layer_names}
    has_look_alikes = len(recipe.units) < len(recipe.classes)
    is_hidden = has_look_alikes or any(spec.hides for spec in recipe.layers)
    look_alikes = None
    if recipe.synthesis > 1 and is_hidden:
        look_alikes = partial(_look_alikes, recipe)
    parameters = latent.stored_truth(maps, recipe.classes)
    weights = parameters[0]
    n_components = len(weights[0])
    return Terrain(
        **fields,
        truth=_mixture(parameters, (0,) * n_components),
        grid=recipe.grid,
        look_alikes=look_alikes,
        slope_law=partial(_slope_law, recipe.classes),
        layers=layers,
    )


def _look_alikes(recipe: Recipe, terrain: Terrain) -> TraversabilityMixture:
    """Return the best prediction of λ from images; see `latent.look_alikes`."""
    maps = DrawnMaps(
        terrain.class_id.cpu().numpy(),
        _to_float64(terrain.elevation_m),
        _to_float64(terrain.slope_deg),
        recipe.grid,
        recipe.classes,
    )
    layers = []
    values = {}
    for spec in recipe.layers:
        if spec.name in terrain.layers and (spec.hides or spec.affects):
            layers.append(spec.layer)
            values[spec.name] = _to_float64(terrain.layers[spec.name])
    parameters = latent.look_alikes(maps, layers, values)
    group: list[int] = []
    for class_id, item in enumerate(recipe.classes):
        n_components = 2 if item.soft else 1
        group += [class_id] * n_components
    return _mixture(parameters, tuple(group)).to(terrain.class_id.device)


def _slope_law(classes: ClassTable, slope_deg: torch.Tensor) -> torch.Tensor:
    """Return f_c(ψ) of each class, float64, shape [C, N]; see `latent.latent_mean`."""
    class_id = np.arange(len(classes))[:, None]
    mean = latent.latent_mean(class_id, _to_float64(slope_deg), classes)
    return torch.from_numpy(mean)


def _to_float64(tensor: torch.Tensor) -> np.ndarray:
    return tensor.cpu().numpy().astype(np.float64)


def _mixture(
    parameters: latent.Parameters, group: tuple[int, ...]
) -> TraversabilityMixture:
    """Return a mixture in float32; `group` is the class index of each component."""
    tensors = [torch.from_numpy(values.astype(np.float32)) for values in parameters]
    weights, means, stds = tensors
    return TraversabilityMixture(weights, means, stds, group)
