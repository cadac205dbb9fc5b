"""The layers of some maps, applied one after another; what a layer returns is checked.

Letters in shapes: B maps, H×W cells, C classes, K components.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory
from benchnav.core.grid import Grid
from benchnav.core.settings import one_line
from benchnav.datagen.layers.layer import DrawnMaps, Layer, Streams
from benchnav.datagen.recipe.classes import ClassTable

# weights, means, standard deviations, each of shape [B, K, H, W]
Parameters = tuple[ndarray, ndarray, ndarray]


def check_layer(
    layer: Layer, grid: Grid, classes: ClassTable, colours: Mapping[str, ndarray]
) -> None:
    """Check that a layer fits a recipe; see `Layer.check`."""
    _call(layer, "check", layer.check, grid, classes, colours)


def draw_layers(
    layers: Iterable[Layer],
    seed: int,
    names: tuple[str, int],
    indices: ndarray,
    maps: DrawnMaps,
) -> dict[str, ndarray]:
    """Draw the values of layers.

    Args:
        layers: in their order.
        seed: root seed of the recipe.
        names: the split, and the number of rejected draws before.
        indices: which maps of the split, shape [B].
        maps: what lies below.

    Returns:
        By layer, values as stored but in float64, shape [B, H, W].

    Raises:
        ConfigError: If a layer raises, or returns another shape or a value that is not
            allowed.
    """
    split, attempt = names
    values = {}
    for layer in layers:
        stream = layer.stream or ("layer", layer.name)
        streams = Streams(seed, (split, *stream, attempt), indices, maps.grid)
        drawn = _call(layer, "draw", layer.draw, streams, maps)
        limits = (layer.minimum, layer.maximum)
        drawn = _checked(layer, "values of `draw`", drawn, maps.class_id.shape, limits)
        values[layer.name] = drawn.astype(np.float32).astype(np.float64)
    return values


def colour_layers(
    layers: Iterable[Layer],
    rgb: ndarray,
    values: Mapping[str, ndarray],
    maps: DrawnMaps,
) -> ndarray:
    """Return the colours in full light that the terrain has with all layers, 0–255,
    shape [B, 3, H, W].

    Args:
        layers: in their order.
        rgb: without them, float64, shape [B, 3, H, W].
        values: by layer, shape [B, H, W].
        maps: what lies below.

    Raises:
        ConfigError: If a layer raises, or returns another shape or a value beyond
            0–255.
    """
    for layer in layers:
        shown = _call(layer, "look", layer.look, rgb, values[layer.name], maps)
        rgb = _checked(layer, "colours of `look`", shown, rgb.shape, (0, 255))
    return rgb


def affect_layers(
    layers: Sequence[Layer],
    truth: Parameters,
    values: Mapping[str, ndarray],
    maps: DrawnMaps,
) -> Parameters:
    """Return the true distribution of λ with all layers.

    Components without weight, and cells whose class is not known, stay as they are.

    Args:
        layers: in their order.
        truth: without them.
        values: by layer, shape [B, H, W].
        maps: what lies below.

    Raises:
        ConfigError: If a layer raises, or returns another shape, a mean beyond [0, 1]
            or a standard deviation beyond (0, 1].
    """
    layers = [layer for layer in layers if layer.affects()]
    if not layers:
        return truth
    weights, means, stds = (array.copy() for array in truth)
    for component in range(weights.shape[1]):
        cells = (weights[:, component] > 0) & ~np.isnan(means[:, component])
        for layer in layers:
            mean, std = means[:, component], stds[:, component]
            result = _call(
                layer, "affect", layer.affect, mean, std, values[layer.name], maps
            )
            is_pair = isinstance(result, tuple) and len(result) == 2
            expect(
                is_pair,
                f"mean and std of `affect` of layer {layer.name!r}, got "
                f"{type(result).__name__}.",
            )
            new_mean = _checked(
                layer, "means of `affect`", result[0], mean.shape, (0, 1), cells
            )
            new_std = _checked(
                layer, "stds of `affect`", result[1], std.shape, (1e-6, 1), cells
            )
            means[:, component] = np.where(cells, new_mean, mean)
            stds[:, component] = np.where(cells, new_std, std)
    return weights, means, stds


def weigh_layers(
    layers: Iterable[Layer],
    weights: ndarray,
    values: Mapping[str, ndarray],
    maps: DrawnMaps,
) -> ndarray:
    """Return the probability of each class by what a picture shows with all layers,
    shape [B, C, H, W].

    Args:
        layers: in their order.
        weights: by colour without them, shape [B, C, H, W].
        values: by layer, shape [B, H, W].
        maps: what lies below.

    Raises:
        ConfigError: If a layer raises, or returns another shape or a weight that is
            negative or not finite.
    """
    hiding = [layer for layer in layers if layer.hides()]
    for layer in hiding:
        changed = _call(
            layer,
            "class_weights",
            layer.class_weights,
            weights,
            values[layer.name],
            maps,
        )
        weights = _checked(
            layer, "weights of `class_weights`", changed, weights.shape, (0, np.inf)
        )
    if not hiding:
        return weights
    total = sum(weights[:, number] for number in range(weights.shape[1]))
    return weights / np.maximum(total, np.finfo(np.float64).tiny)[:, None]


def _call(
    layer: Layer, method: str, function: Callable[..., Any], *arguments: Any
) -> Any:
    """Call a method of a layer; whatever it raises ends in one line."""
    try:
        return function(*arguments)
    except Exception as error:
        if isinstance(error, BenchnavError):
            raise
        raise out_of_memory(error) or ConfigError(
            f"`{method}` of layer {layer.name!r} failed: {one_line(error)}"
        ) from error


def _checked(
    layer: Layer,
    what: str,
    result: Any,
    shape: tuple[int, ...],
    limits: tuple[float, float],
    cells: ndarray | None = None,
) -> ndarray:
    """Return what a layer returned as float64.

    Args:
        layer: which.
        what: what it returned, for messages.
        result: what it returned.
        shape: the shape that it must have.
        limits: the smallest and the largest value allowed.
        cells: where values are used, bool; None for everywhere.
    """
    try:
        array = np.asarray(result, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"Expected {what} of layer {layer.name!r} as an array of numbers, got "
            f"{type(result).__name__}."
        ) from error
    expect(
        array.shape == shape,
        f"{what} of layer {layer.name!r} of shape {list(shape)}, got "
        f"{list(array.shape)}.",
    )
    low, high = limits
    wrong = ~((array >= low) & (array <= high) & np.isfinite(array))
    if cells is not None:
        wrong &= cells
    if wrong.any():
        allowed = (
            "finite" if np.isinf(low) and np.isinf(high) else f"in [{low:g}, {high:g}]"
        )
        raise ConfigError(
            f"Expected {what} of layer {layer.name!r} {allowed}, got "
            f"{array[wrong][0]:g} in {wrong.sum()} cells."
        )
    return array
