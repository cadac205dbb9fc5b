"""From a recipe to maps: each map is a pure function of (recipe, split, index).

Elevation is quantised first; slope, shading and λ are derived from what is stored. Batched NumPy in
float64. Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Callable

import numpy as np
import torch

from benchnav import gridgraph, rng
from benchnav.datagen import appearance, elevation, latent
from benchnav.datagen.noise import fractal_perlin
from benchnav.datagen.scenario import Recipe, Scenario
from benchnav.datagen.schema import FIELDS, quantise
from benchnav.errors import ConfigError
from benchnav.mixture import TraversabilityMixture

MOST_ATTEMPTS = 200

Maps = dict[str, np.ndarray]


def generate(recipe: Recipe, split: str, indices: np.ndarray) -> Maps:
    """Makes some maps of a split.

    Args:
        recipe: what to make.
        split: name of one of its splits.
        indices: which maps, ascending integers ≥ 0, shape [B].

    Returns:
        The fields of `schema.FIELDS`, each of shape [B, *entry shape].

    Raises:
        ConfigError: a split asks for solvable maps and the recipe yields none for some index.
    """
    indices = np.asarray(indices, dtype=np.int64)
    if not recipe.splits[split].solvable:
        maps = _attempt(recipe, split, indices, 0)
        maps["reference_time_s"] = np.full(len(indices), np.nan)
        return _cast(maps)
    pending = np.arange(len(indices))
    maps = {}
    for attempt in range(MOST_ATTEMPTS):
        drawn = _attempt(recipe, split, indices[pending], attempt)
        drawn["reference_time_s"] = reference_time_s(recipe, drawn)
        for name, values in drawn.items():
            maps.setdefault(name, np.empty((len(indices), *values.shape[1:]), values.dtype))[pending] = values
        pending = pending[~np.isfinite(drawn["reference_time_s"])]
        if len(pending) == 0:
            return _cast(maps)
    raise ConfigError(
        f"Expected split {split!r} to have maps whose goal can be reached; {MOST_ATTEMPTS} draws gave none "
        f"for map {int(indices[pending[0]])}. Ease its scenario or lower `stuck_threshold`."
    )


def expected_traversability(mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """E[λ] of the clipped Gaussian N(mean, std), shape of `mean`, [B, H, W]."""
    means, stds = (
        torch.from_numpy(np.ascontiguousarray(a, dtype=np.float64)).unsqueeze(1) for a in (mean, std)
    )
    return TraversabilityMixture(torch.ones_like(means), means, stds).mean().numpy()


def reference_time_s(recipe: Recipe, maps: Maps) -> np.ndarray:
    """Grid reference time: least time from start to goal over truly free cells at a commanded 1 m/s.

    A yardstick, not a bound: the grid has eight headings, and noise is at its mean.

    Returns:
        Seconds, infinite where no free path joins start and goal, shape [B].
    """
    mean = latent.latent_mean(maps["class_id"], maps["slope_deg"], recipe.classes)
    expected = expected_traversability(mean, latent.latent_std(maps["class_id"], recipe.classes))
    costs = gridgraph.travel_time_costs(expected, expected > recipe.stuck_threshold, recipe.resolution_m)
    (start_column, start_row), (goal_column, goal_row) = (
        (int(value / recipe.resolution_m) for value in position)
        for position in (recipe.start_m, recipe.goal_m)
    )
    goals = np.zeros(expected.shape, dtype=bool)
    goals[:, goal_row, goal_column] = True
    cost, _ = gridgraph.cost_to_go(costs, goals, recipe.grid.shape)
    return cost[:, start_row, start_column]


def _attempt(recipe: Recipe, split: str, indices: np.ndarray, attempt: int) -> Maps:
    scenario = recipe.scenarios[recipe.splits[split].scenario]
    shape = recipe.grid.shape

    def key(purpose: str) -> int:
        return rng.stream_key(recipe.seed, split, purpose, attempt)

    environment = indices % recipe.environments
    class_id = _class_map(recipe, (split, "class", attempt), key("class order"), indices, environment)
    height = quantise(_elevation(recipe, scenario, key, indices), 13)
    slope = quantise(elevation.slope_deg(height, recipe.resolution_m), 10)
    mean = latent.latent_mean(class_id, slope, recipe.classes)
    noise = latent.latent_std(class_id, recipe.classes) * rng.normal(key("traversability"), indices, shape)
    direction = rng.uniform(key("light"), indices, (2,))
    light = appearance.light_direction(
        2 * np.pi * direction[:, 0], _within(scenario.light_height, direction[:, 1])
    )
    brightness = appearance.shade(height, recipe.resolution_m, light, scenario.ambient)
    colours = np.array([c.colour for c in recipe.classes], dtype=np.float64)
    return {
        "rgb": appearance.paint(class_id, colours, brightness),
        "class_id": class_id,
        "elevation_m": height,
        "slope_deg": slope,
        "traversability": quantise(np.clip(mean + noise, 0, 1), 16),
        "environment": environment,
        "start_m": np.tile(np.asarray(recipe.start_m, np.float64), (len(indices), 1)),
        "goal_m": np.tile(np.asarray(recipe.goal_m, np.float64), (len(indices), 1)),
    }


def _class_map(
    recipe: Recipe, names: tuple[rng.Name, ...], order_key: int, indices: np.ndarray, environment: np.ndarray
) -> np.ndarray:
    periods = [period / recipe.resolution_m for period in recipe.class_periods_m]
    noise = fractal_perlin(recipe.seed, names, indices, recipe.grid.shape, periods)
    # Which class takes which band differs from map to map, so no two classes are neighbours always.
    order = rng.permutation(order_key, indices, len(recipe.occupancy))
    table = np.stack([recipe.environment_classes(e) for e in range(recipe.environments)])
    shown = np.take_along_axis(table[environment], order, axis=1)
    bands = appearance.class_bands(noise, np.asarray(recipe.occupancy))
    return np.take_along_axis(shown, bands.reshape(len(indices), -1), axis=1).reshape(bands.shape)


def _elevation(
    recipe: Recipe, scenario: Scenario, key: Callable[[str], int], indices: np.ndarray
) -> np.ndarray:
    draws = rng.uniform(key("relief"), indices, (2,))
    ground = elevation.fractal(key("elevation"), indices, recipe.grid.shape, scenario.roughness)
    ground = ground * _within(scenario.relief_m, draws[:, 0])[:, None, None]
    low, high = (round(value) for value in scenario.crater_count)
    count = low + np.floor((high - low + 1) * draws[:, 1])
    centres, radii = elevation.place_craters(
        key("craters"), indices, recipe.grid.extent_m, count, scenario.crater_radius_m, high
    )
    return ground + elevation.crater_elevation(
        centres, radii, recipe.grid.shape, recipe.resolution_m, scenario.crater_depth_ratio
    )


def _within(limits: tuple[float, float], share: np.ndarray) -> np.ndarray:
    return limits[0] + (limits[1] - limits[0]) * share


def _cast(maps: Maps) -> Maps:
    return {name: maps[name].astype(field.dtype) for name, field in FIELDS.items()}
