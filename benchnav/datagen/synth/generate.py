"""Generation of maps: each map depends only on recipe, split and index.

Elevation is quantised; slope, shading and λ are computed from the quantised elevation,
in NumPy and float64. Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy import ndarray

from benchnav.core import copula, gridgraph, rng
from benchnav.core.errors import ConfigError
from benchnav.datagen.layers.layer import DrawnMaps, Layer
from benchnav.datagen.layers.spec import LayerSpec
from benchnav.datagen.layers.stack import affect_layers, colour_layers, draw_layers
from benchnav.datagen.noise import fractal_perlin
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.looks import shown_colours
from benchnav.datagen.recipe.places import draw_places
from benchnav.datagen.recipe.recipe import REFERENCE_M, Recipe
from benchnav.datagen.recipe.scenario import Scenario
from benchnav.datagen.schema import TRUTH, Maps, join_maps, quantise
from benchnav.datagen.synth import appearance, elevation

MAX_ATTEMPTS = 200  # maximum number of draws of a map that must be solvable
# Maximum number of maps per chunk. Arrays of a chunk fit in the processor's cache.
_CHUNK = 16
_CHUNK_CELLS = 2**20


def generate(recipe: Recipe, split: str, indices: ndarray) -> Maps:
    """Generate maps of a split.

    Args:
        recipe: recipe of the maps.
        split: name of one of the recipe's splits.
        indices: indices of the maps in the split, ascending integers ≥ 0, shape [B].

    Returns:
        Arrays by name of `recipe.fields`, each of shape [B, *entry shape].

    Raises:
        ConfigError: If the split requires solvable maps, and all draws of a map are
            rejected.
    """
    indices = np.asarray(indices, dtype=np.int64)
    size = min(_CHUNK, recipe.grid.maps_in(_CHUNK_CELLS))
    chunks = []
    for start in range(0, max(len(indices), 1), size):
        chunk = indices[start : start + size]
        chunks.append(_generate_chunk(recipe, split, chunk))
    maps = join_maps(chunks)
    return {
        name: maps[name].astype(field.dtype, copy=False)
        for name, field in recipe.fields.items()
    }


def _generate_chunk(recipe: Recipe, split: str, indices: ndarray) -> Maps:
    maps = Maps()
    pending = np.arange(len(indices))
    for attempt in range(MAX_ATTEMPTS):
        drawn = _draw(recipe, split, indices[pending], attempt)
        if not recipe.splits[split].solvable:
            drawn["reference_time_s"] = np.full(len(indices), np.nan)
            return drawn
        drawn["reference_time_s"] = reference_time_s(recipe, drawn)
        maps = maps or drawn
        for name, values in drawn.items():
            maps[name][pending] = values
        is_solvable = np.isfinite(drawn["reference_time_s"])
        pending = pending[~is_solvable]
        if len(pending) == 0:
            return maps
    unsolvable = int(indices[pending[0]])
    raise ConfigError(
        f"Expected a goal that can be reached on each map of split {split!r}, got no "
        f"such draw of map {unsolvable} in {MAX_ATTEMPTS} draws. Use an easier "
        "scenario, or lower `stuck_threshold`."
    )


def reference_time_s(recipe: Recipe, maps: Maps) -> ndarray:
    """Return grid reference times, the minimum times over cells with E[λ] > λ_stuck.

    The commanded speed is 1 m/s. An episode may be faster, since the grid has only
    eight headings, and λ is replaced by its true expectation.

    Returns:
        Time from start to goal in seconds, infinite if no free path exists, shape [B].
    """
    truth = latent.stored_truth(maps, recipe.classes)
    expected = latent.expected_of(truth)
    free = expected > recipe.stuck_threshold
    costs = gridgraph.travel_time_costs(
        expected, free, recipe.resolution_m, recipe.closed_corners
    )
    map_index = np.arange(len(expected))
    start_row, start_column = recipe.cells_of(maps["start_m"])
    goal_row, goal_column = recipe.cells_of(maps["goal_m"])
    goals = np.zeros(expected.shape, dtype=bool)
    goals[map_index, goal_row, goal_column] = True
    cost, _ = gridgraph.cost_to_go(costs, goals, recipe.grid.shape)
    return cost[map_index, start_row, start_column]


def class_map(
    recipe: Recipe, split: str, indices: ndarray, attempt: int = 0
) -> ndarray:
    """Return the class of each cell, from the classes of the map's environment.

    Map i has environment i mod the number of environments.

    Returns:
        Class indices, shape [B, H, W].
    """
    periods = [period / recipe.resolution_m for period in recipe.class_periods_m]
    names = (split, "class", attempt)
    noise = fractal_perlin(recipe.seed, names, indices, recipe.grid.shape, periods)
    # Classes are assigned to bands in random order, so that neighbours vary.
    order_key = rng.stream_key(recipe.seed, split, "class order", attempt)
    order = rng.permutation(order_key, indices, len(recipe.occupancy))
    table = recipe.environment_classes[indices % recipe.environments]
    shown = np.take_along_axis(table, order, axis=1)
    bands = appearance.class_bands(noise, np.asarray(recipe.occupancy))
    flat_bands = bands.reshape(len(indices), -1)
    class_id = np.take_along_axis(shown, flat_bands, axis=1)
    return class_id.reshape(bands.shape)


def complete(
    recipe: Recipe,
    split: str,
    indices: ndarray,
    class_id: ndarray,
    padded_m: ndarray,
    attempt: int = 0,
    layers: Sequence[LayerSpec] = (),
) -> Maps:
    """Return all fields of maps with given classes and elevation.

    Slope, layers, colours under a random light, start, goal and λ are added.

    Args:
        recipe: recipe with the class table, seed, start and goal.
        split: name of the maps' split, which determines the scenario and the random
            streams.
        indices: indices of the maps in the split, shape [B].
        class_id: class indices, shape [B, H, W].
        padded_m: elevation in metres, padded by one cell of the surrounding terrain,
            NaN if missing, shape [B, H + 2, W + 2]. It is quantised, and other fields
            are computed from the quantised values.
        attempt: number of rejected draws of these maps.
        layers: layers to draw.

    Returns:
        Arrays by field: `schema.FIELDS` except `reference_time_s`, the layers, and
        `schema.TRUTH` if a layer changes λ.
    """
    key = partial(rng.stream_key, recipe.seed, split)
    scenario = recipe.scenarios[recipe.splits[split].scenario]
    padded_m = quantise(padded_m, 13)
    gradient = elevation.horn_gradient(padded_m, recipe.resolution_m)
    slope = quantise(elevation.inclination_deg(*gradient), 10)
    light_key = key("light", attempt)
    turn, height_fraction = rng.uniform(light_key, indices, (2,)).T
    height = _within(scenario.light_height, height_fraction)
    light = appearance.light_direction(2 * np.pi * turn, height)
    noise_key = key("traversability", attempt)
    shape = recipe.grid.shape
    if recipe.synthesis == 1:
        noise = rng.normal(noise_key, indices, shape)
    else:
        length_cells = recipe.correlation_m / recipe.resolution_m
        noise = copula.correlated_normal(noise_key, indices, shape, length_cells)
    elevation_m = padded_m[:, 1:-1, 1:-1]
    below = DrawnMaps(class_id, elevation_m, slope, recipe.grid, recipe.classes)
    stack = [spec.layer for spec in layers]
    values = draw_layers(stack, recipe.seed, (split, attempt), indices, below)
    realised, stored_truth = _realise(stack, values, below, noise)
    brightness = appearance.shade(*gradient, light, scenario.ambient)
    colours = _colour(stack, values, below, scenario)
    if recipe.places is None:
        positions_m = np.array([recipe.start_m, recipe.goal_m], dtype=np.float64)
        start_m, goal_m = np.tile(positions_m[:, None], (1, len(indices), 1))
    else:
        places_key = key("places", attempt)
        start_m, goal_m = draw_places(recipe.places, recipe.grid, places_key, indices)
    return {
        "rgb": appearance.paint(colours, brightness),
        "class_id": class_id,
        "elevation_m": elevation_m,
        "slope_deg": slope,
        "traversability": quantise(realised, 16),
        "environment": indices % recipe.environments,
        "start_m": start_m,
        "goal_m": goal_m,
        **values,
        **stored_truth,
    }


def _realise(
    layers: Sequence[Layer], values: Maps, below: DrawnMaps, noise: ndarray
) -> tuple[ndarray, Maps]:
    """Return λ from standard normal noise, and the fields of `TRUTH`.

    Returns:
        λ, shape [B, H, W]; and arrays by field, empty if no layer changes λ.
    """
    truth = latent.truth(below.class_id, below.slope_deg, below.classes)
    truth = affect_layers(layers, truth, values, below)
    stored: Maps = {}
    if any(layer.affects() for layer in layers):
        _, means, stds = truth
        stored = dict(zip(TRUTH, (means, stds), strict=True))
    realised = latent.quantile_of(truth, noise)
    return realised, stored


def _colour(
    layers: Sequence[Layer], values: Maps, below: DrawnMaps, scenario: Scenario
) -> ndarray:
    """Return the colours of maps in full light, with their layers, shape [B, 3, H, W]."""
    by_class = shown_colours(below.classes, scenario)
    colours = np.take(by_class.T, below.class_id, axis=1)
    colours = np.moveaxis(colours, 0, 1)
    return colour_layers(layers, colours, values, below)


def _draw(recipe: Recipe, split: str, indices: ndarray, attempt: int) -> Maps:
    """Draw maps with the fields of `complete`. The maps may be unsolvable."""
    key = partial(rng.stream_key, recipe.seed, split)
    grid = recipe.grid
    scenario = recipe.scenarios[recipe.splits[split].scenario]
    arguments = key("elevation", attempt), indices, grid.shape, scenario.roughness
    if recipe.synthesis == 1:
        elevation_m = elevation.fractal(*arguments)
    else:
        reference_cells = max(3, round(REFERENCE_M / recipe.resolution_m))
        elevation_m = elevation.open_fractal(*arguments, reference_cells)
    relief_key = key("relief", attempt)
    relief_fraction, crater_draw = rng.uniform(relief_key, indices, (2,)).T
    relief_m = _within(scenario.relief_m, relief_fraction)
    elevation_m *= relief_m[:, None, None]
    low, high = recipe.craters(scenario)
    if high > 0:
        n_choices = high - low + 1
        count = low + np.floor(n_choices * crater_draw)
        craters = elevation.place_craters(
            key("craters", attempt),
            indices,
            grid.extent_m,
            count,
            scenario.crater_radius_m,
            high,
        )
        elevation_m += elevation.crater_elevation(
            *craters, grid.shape, grid.resolution_m, scenario.crater_depth_ratio
        )
    class_id = class_map(recipe, split, indices, attempt)
    padded_m = elevation.pad_missing(elevation_m)
    return complete(recipe, split, indices, class_id, padded_m, attempt, recipe.layers)


def _within(limits: tuple[float, float], fraction: ndarray) -> ndarray:
    low, high = limits
    return low + (high - low) * fraction
