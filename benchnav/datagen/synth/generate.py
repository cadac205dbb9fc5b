"""From a recipe to maps: each map is a pure function of (recipe, split, index).

Elevation is quantised first; slope, shading and λ are derived from what is stored.
Batched NumPy in
float64. Letters in shapes: B maps, H×W cells.
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

MOST_ATTEMPTS = 200
# maps at a time, so that what is worked on stays in the processor's cache; of large
# maps fewer
_PIECE = 16
_PIECE_CELLS = 2**20


def generate(recipe: Recipe, split: str, indices: ndarray) -> Maps:
    """Makes some maps of a split.

    Args:
        recipe: what to make.
        split: name of one of its splits.
        indices: which maps, ascending integers ≥ 0, shape [B].

    Returns:
        The fields of `recipe.fields`, each of shape [B, *entry shape].

    Raises:
        ConfigError: a split asks for solvable maps and the recipe yields none for some
            index.
    """
    indices = np.asarray(indices, dtype=np.int64)
    size = min(_PIECE, recipe.grid.maps_in(_PIECE_CELLS))
    starts = range(0, max(len(indices), 1), size)
    maps = join_maps(
        [
            _generate_piece(recipe, split, indices[start : start + size])
            for start in starts
        ]
    )
    return {
        name: maps[name].astype(field.dtype, copy=False)
        for name, field in recipe.fields.items()
    }


def _generate_piece(recipe: Recipe, split: str, indices: ndarray) -> Maps:
    maps, pending = Maps(), np.arange(len(indices))
    for attempt in range(MOST_ATTEMPTS):
        drawn = _draw(recipe, split, indices[pending], attempt)
        if not recipe.splits[split].solvable:
            return {**drawn, "reference_time_s": np.full(len(indices), np.nan)}
        drawn["reference_time_s"] = reference_time_s(recipe, drawn)
        maps = maps or drawn
        for name, values in drawn.items():
            maps[name][pending] = values
        pending = pending[~np.isfinite(drawn["reference_time_s"])]
        if len(pending) == 0:
            return maps
    raise ConfigError(
        f"Expected split {split!r} to have maps whose goal can be reached; "
        f"{MOST_ATTEMPTS} draws gave none "
        f"for map {int(indices[pending[0]])}. Ease its scenario or lower "
        "`stuck_threshold`."
    )


def reference_time_s(recipe: Recipe, maps: Maps) -> ndarray:
    """Grid reference time: least time from start to goal over truly free cells at a
    commanded 1 m/s.

    A reference, not a bound: the grid has eight headings, and noise is at its mean.

    Returns:
        Seconds, infinite where no free path joins start and goal, shape [B].
    """
    expected = latent.expected_of(latent.stored_truth(maps, recipe.classes))
    free = expected > recipe.stuck_threshold
    costs = gridgraph.travel_time_costs(
        expected, free, recipe.resolution_m, recipe.closed_corners
    )
    every = np.arange(len(expected))
    goals = np.zeros(expected.shape, dtype=bool)
    goals[(every, *recipe.cells_of(maps["goal_m"]))] = True
    cost, _ = gridgraph.cost_to_go(costs, goals, recipe.grid.shape)
    return cost[(every, *recipe.cells_of(maps["start_m"]))]


def class_map(
    recipe: Recipe, split: str, indices: ndarray, attempt: int = 0
) -> ndarray:
    """Lays out the classes of each map's environment; maps show the environments in
    turns.

    Returns:
        Class indices, shape [B, H, W].
    """
    periods = [period / recipe.resolution_m for period in recipe.class_periods_m]
    noise = fractal_perlin(
        recipe.seed, (split, "class", attempt), indices, recipe.grid.shape, periods
    )
    # Which class takes which band differs from map to map, so no two classes are
    # neighbours always.
    order_key = rng.stream_key(recipe.seed, split, "class order", attempt)
    order = rng.permutation(order_key, indices, len(recipe.occupancy))
    table = recipe.environment_classes[indices % recipe.environments]
    shown = np.take_along_axis(table, order, axis=1)
    bands = appearance.class_bands(noise, np.asarray(recipe.occupancy))
    return np.take_along_axis(shown, bands.reshape(len(indices), -1), axis=1).reshape(
        bands.shape
    )


def complete(
    recipe: Recipe,
    split: str,
    indices: ndarray,
    class_id: ndarray,
    framed_m: ndarray,
    attempt: int = 0,
    layers: Sequence[LayerSpec] = (),
) -> Maps:
    """Derives all else from classes and elevation: slope, layers, colour under a random
    light, λ.

    Args:
        recipe: class table, seed, start and goal.
        split: name of the maps' split, for their scenario's light and their random
            streams.
        indices: which maps of the split, shape [B].
        class_id: shape [B, H, W].
        framed_m: elevation, with one cell of the ground beyond, NaN where that is not
            known, shape [B, H + 2, W + 2]; it is quantised first, and everything
            follows what is stored.
        attempt: how many draws of these maps were rejected before.
        layers: those that are drawn.

    Returns:
        The fields of `schema.FIELDS` but `reference_time_s`, those of the layers, and
        those of `schema.TRUTH` if a layer changes λ.
    """
    key = partial(rng.stream_key, recipe.seed, split)
    scenario = recipe.scenarios[recipe.splits[split].scenario]
    ground = quantise(framed_m, 13)
    gradient = elevation.horn_gradient(ground, recipe.resolution_m)
    slope = quantise(elevation.inclination_deg(*gradient), 10)
    azimuth, lift = rng.uniform(key("light", attempt), indices, (2,)).T
    light = appearance.light_direction(
        2 * np.pi * azimuth, _within(scenario.light_height, lift)
    )
    noise_key, shape = key("traversability", attempt), recipe.grid.shape
    if recipe.synthesis == 1:
        noise = rng.normal(noise_key, indices, shape)
    else:
        cells = recipe.correlation_m / recipe.resolution_m
        noise = copula.correlated_normal(noise_key, indices, shape, cells)
    below = DrawnMaps(
        class_id, ground[:, 1:-1, 1:-1], slope, recipe.grid, recipe.classes
    )
    stack = [spec.layer for spec in layers]
    values = draw_layers(stack, recipe.seed, (split, attempt), indices, below)
    realised, stored_truth = _realise(stack, values, below, noise)
    brightness = appearance.shade(*gradient, light, scenario.ambient)
    if recipe.places is None:
        ends = np.array([recipe.start_m, recipe.goal_m], dtype=np.float64)
        start_m, goal_m = np.tile(ends[:, None], (1, len(indices), 1))
    else:
        start_m, goal_m = draw_places(
            recipe.places, recipe.grid, key("places", attempt), indices
        )
    return {
        "rgb": appearance.paint(_colour(stack, values, below, scenario), brightness),
        "class_id": class_id,
        "elevation_m": below.elevation_m,
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
    """Return λ [B, H, W] by standard normal numbers, and the fields of `schema.TRUTH`
    if a layer changes λ.
    """
    truth = affect_layers(
        layers,
        latent.truth(below.class_id, below.slope_deg, below.classes),
        values,
        below,
    )
    is_affected = any(layer.affects() for layer in layers)
    return latent.quantile_of(truth, noise), dict(
        zip(TRUTH, truth[1:], strict=True)
    ) if is_affected else {}


def _colour(
    layers: Sequence[Layer], values: Maps, below: DrawnMaps, scenario: Scenario
) -> ndarray:
    """Return the colours of maps in full light, with their layers, shape [B, 3, H, W]."""
    by_class = shown_colours(below.classes, scenario)
    colours = np.moveaxis(np.take(by_class.T, below.class_id, axis=1), 0, 1)
    return colour_layers(layers, colours, values, below)


def _draw(recipe: Recipe, split: str, indices: ndarray, attempt: int) -> Maps:
    """Draws maps that may or may not be solvable; see `complete`."""
    key = partial(rng.stream_key, recipe.seed, split)
    grid, scenario = recipe.grid, recipe.scenarios[recipe.splits[split].scenario]
    surface = key("elevation", attempt), indices, grid.shape, scenario.roughness
    if recipe.synthesis == 1:
        ground = elevation.fractal(*surface)
    else:
        ground = elevation.open_fractal(
            *surface, max(3, round(REFERENCE_M / recipe.resolution_m))
        )
    relief, crowding = rng.uniform(key("relief", attempt), indices, (2,)).T
    ground *= _within(scenario.relief_m, relief)[:, None, None]
    low, high = recipe.craters(scenario)
    if high > 0:
        count = low + np.floor((high - low + 1) * crowding)
        craters = elevation.place_craters(
            key("craters", attempt),
            indices,
            grid.extent_m,
            count,
            scenario.crater_radius_m,
            high,
        )
        ground += elevation.crater_elevation(
            *craters, grid.shape, grid.resolution_m, scenario.crater_depth_ratio
        )
    class_id = class_map(recipe, split, indices, attempt)
    return complete(
        recipe,
        split,
        indices,
        class_id,
        elevation.framed(ground),
        attempt,
        recipe.layers,
    )


def _within(limits: tuple[float, float], share: ndarray) -> ndarray:
    return limits[0] + (limits[1] - limits[0]) * share
