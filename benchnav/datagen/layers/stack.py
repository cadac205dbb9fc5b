"""Application of a recipe's layers in order, with checks of their results.

Letters in shapes: B maps, H×W cells, C classes, K components.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory_error
from benchnav.core.grid import Grid
from benchnav.core.settings import one_line
from benchnav.datagen.layers.layer import DrawnMaps, Layer, Streams
from benchnav.datagen.recipe.classes import ClassTable

# Weights, means and standard deviations of a mixture, each of shape [B, K, H, W].
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
        layers: layers in the recipe's order.
        seed: root seed of the recipe.
        names: name of the split, and number of rejected draws of these maps.
        indices: indices of the maps in the split, shape [B].
        maps: terrain below the layers.

    Returns:
        Values by layer, rounded to float32, as float64, each of shape [B, H, W].

    Raises:
        ConfigError: If a layer raises an exception, or returns a wrong shape or an
            invalid value.
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
    """Return the colours of the terrain with all layers, in full light.

    Args:
        layers: layers in the recipe's order.
        rgb: colours without layers, 0–255, float64, shape [B, 3, H, W].
        values: values by layer, each of shape [B, H, W].
        maps: terrain below the layers.

    Returns:
        RGB in 0–255, float64, shape [B, 3, H, W].

    Raises:
        ConfigError: If a layer raises an exception, or returns a wrong shape or a value
            outside 0–255.
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

    Components without weight, and unlabelled cells, do not change.

    Args:
        layers: layers in the recipe's order.
        truth: true distribution of λ without layers.
        values: values by layer, each of shape [B, H, W].
        maps: terrain below the layers.

    Raises:
        ConfigError: If a layer raises an exception, or returns a wrong shape, a mean
            outside [0, 1] or a standard deviation outside [1e-6, 1].
    """
    layers = [layer for layer in layers if layer.affects()]
    if not layers:
        return truth
    weights, means, stds = (array.copy() for array in truth)
    for component in range(weights.shape[1]):
        has_weight = weights[:, component] > 0
        is_labelled = ~np.isnan(means[:, component])
        cells = has_weight & is_labelled
        for layer in layers:
            mean = means[:, component]
            std = stds[:, component]
            arguments = mean, std, values[layer.name], maps
            result = _call(layer, "affect", layer.affect, *arguments)
            is_pair = isinstance(result, tuple) and len(result) == 2
            kind = type(result).__name__
            expect(
                is_pair,
                f"a pair (mean, std) from `affect` of layer {layer.name!r}, got "
                f"{kind}.",
            )
            new_mean, new_std = result
            new_mean = _checked(
                layer, "means of `affect`", new_mean, mean.shape, (0, 1), cells
            )
            new_std = _checked(
                layer, "stds of `affect`", new_std, std.shape, (1e-6, 1), cells
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
    """Return class probabilities given an image with all layers.

    Args:
        layers: layers in the recipe's order.
        weights: class probabilities given colours without layers, shape [B, C, H, W].
        values: values by layer, each of shape [B, H, W].
        maps: terrain below the layers.

    Returns:
        Weights, float64, shape [B, C, H, W]. If a layer hides colours, they sum to 1
        over C.

    Raises:
        ConfigError: If a layer raises an exception, or returns a wrong shape or a
            weight that is negative or non-finite.
    """
    hiding = [layer for layer in layers if layer.hides()]
    for layer in hiding:
        arguments = weights, values[layer.name], maps
        result = _call(layer, "class_weights", layer.class_weights, *arguments)
        weights = _checked(
            layer, "weights of `class_weights`", result, weights.shape, (0, np.inf)
        )
    if not hiding:
        return weights
    n_classes = weights.shape[1]
    total = sum(weights[:, class_id] for class_id in range(n_classes))
    divisor = np.maximum(total, np.finfo(np.float64).tiny)
    return weights / divisor[:, None]


def _call(
    layer: Layer, method: str, function: Callable[..., Any], *arguments: Any
) -> Any:
    """Call a method of a layer, and convert its exceptions to errors of one line."""
    try:
        return function(*arguments)
    except BenchnavError:
        raise
    except Exception as error:
        text = f"`{method}` of layer {layer.name!r} failed: {one_line(error)}"
        raise out_of_memory_error(error) or ConfigError(text) from error


def _checked(
    layer: Layer,
    description: str,
    result: Any,
    shape: tuple[int, ...],
    limits: tuple[float, float],
    cells: ndarray | None = None,
) -> ndarray:
    """Return the result of a layer's method as float64, after checks.

    Args:
        layer: layer of the method, for messages.
        description: description of the result, for messages.
        result: result to check.
        shape: expected shape.
        limits: smallest and largest valid value.
        cells: mask of the cells to check; None for all.

    Raises:
        ConfigError: If the result is invalid.
    """
    subject = f"{description} of layer {layer.name!r}"
    try:
        array = np.asarray(result, dtype=np.float64)
    except (TypeError, ValueError) as error:
        kind = type(result).__name__
        raise ConfigError(
            f"Expected {subject} as an array of numbers, got {kind}."
        ) from error
    expect(
        array.shape == shape,
        f"{subject} of shape {list(shape)}, got {list(array.shape)}.",
    )
    low, high = limits
    in_range = (array >= low) & (array <= high)
    invalid = ~(in_range & np.isfinite(array))
    if cells is not None:
        invalid &= cells
    if invalid.any():
        is_unbounded = np.isinf(low) and np.isinf(high)
        valid_range = "finite" if is_unbounded else f"in [{low:g}, {high:g}]"
        first = array[invalid][0]
        raise ConfigError(
            f"Expected {subject} {valid_range}, got {first:g} (the first of "
            f"{invalid.sum()} invalid values)."
        )
    return array
