"""Map sheets: truth, prediction, error and uncertainty of maps, one row per map.

A quantity has the same scale in all sheets of an evaluation, so that splits can be
compared. Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.preview import class_colours
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.predictor import Oracle
from benchnav.models.quality.scores import mutual_information, predictive_entropy
from benchnav.viz.maps import LAMBDA, TRAVERSABILITY_COLOURS, missing_handle
from benchnav.viz.sheet import SheetColumn, class_patches, class_scale, sheet_of_maps

# Title, label of the colour bar, and colours of each layer; classes and images have no
# colour bar.
_LAYERS: dict[str, tuple[str, str, str]] = {
    "rgb": ("Image", "", ""),
    "class_true": ("True class", "", ""),
    "class_found": ("Most likely class", "", ""),
    "expected_true": ("True E[λ]", "λ", TRAVERSABILITY_COLOURS),
    "observed": ("Observed λ", "λ", TRAVERSABILITY_COLOURS),
    "expected": ("Predicted E[λ]", "λ", TRAVERSABILITY_COLOURS),
    "error_observed": ("E[λ] − observed λ", "predicted − observed", "RdBu_r"),
    "error": ("Error of E[λ]", "predicted − true", "RdBu_r"),
    "width": ("90 % interval of λ", "width", "magma"),
    "entropy": ("Entropy", "nats", "magma"),
    "information": ("Mutual information", "nats", "magma"),
}
_SCALE_LEVEL = 0.995  # fraction of the cells whose values a scale covers
_ROUND_NUMBERS = np.array([1, 1.5, 2, 3, 4, 5, 6, 8, 10])


class MapSheet(NamedTuple):
    """Layers of a map sheet.

    Args:
        split: split of the maps.
        indices: indices of the maps.
        extent_m: size of a map along x and y in metres.
        layers: available layers, by keys of `_LAYERS`, each of shape [B, H, W]; `rgb` has
            the shape [B, H, W, 3].
    """

    split: str
    indices: tuple[int, ...]
    extent_m: tuple[float, float]
    layers: dict[str, np.ndarray]


def read_sheet(
    model: TraversabilityModel,
    dataset: TerrainDataset,
    split: str,
    indices: Sequence[int],
) -> MapSheet:
    """Predict maps of a split, and return the layers of their map sheet.

    Args:
        model: any model.
        dataset: dataset of the maps.
        split: name of a split.
        indices: indices of the maps.

    Raises:
        DatasetError: If the split or a map does not exist, or its data are damaged.
    """
    terrain = dataset.terrain(split, indices)
    has_truth = dataset.truth_of(split) == "generated"
    layers = {"rgb": terrain.rgb.movedim(1, -1)}
    with torch.inference_mode():
        predicted = predict(model, terrain)
        if model.class_names:
            classes = predicted.class_probabilities(len(model.class_names))
            layers["class_true"] = terrain.class_id
            layers["class_found"] = classes.argmax(1)
            layers["entropy"] = predictive_entropy(classes)
        layers["expected"] = predicted.mean()
        if has_truth:
            truth = Oracle().predict_terrain(terrain)
            true_mean = truth.mean()
            layers["expected_true"] = true_mean
            layers["error"] = layers["expected"] - true_mean
        else:
            layers["observed"] = terrain.traversability
            layers["error_observed"] = layers["expected"] - terrain.traversability
        layers["width"] = predicted.var(0.05) - predicted.var(0.95)
        members = model.member_probabilities(terrain.observe())
        if members is not None and len(members) > 1:
            layers["information"] = mutual_information(members)
    arrays = {name: layer.cpu().numpy() for name, layer in layers.items()}
    return MapSheet(split, tuple(indices), terrain.grid.extent_m, arrays)


def shared_scales(
    sheets: Sequence[MapSheet], classes: Sequence[TerrainClass]
) -> dict[str, dict[str, Any]]:
    """Return keywords of `imshow` for each layer, which all sheets share.

    If the range of a scale is not fixed, it covers 99.5 % of the cells.

    Args:
        sheets: all sheets of an evaluation, at least one.
        classes: classes of the dataset.
    """
    class_keywords = class_scale(class_colours(classes))
    scales: dict[str, dict[str, Any]] = {
        "rgb": {},
        "class_true": class_keywords,
        "class_found": class_keywords,
    }
    for name, (_, unit, palette) in _LAYERS.items():
        if name in scales:
            continue
        with_layer = [sheet for sheet in sheets if name in sheet.layers]
        values = [sheet.layers[name].ravel() for sheet in with_layer]
        if unit == "λ":
            scales[name] = LAMBDA
        elif values:
            sizes = np.abs(np.concatenate(values))
            sizes = sizes[np.isfinite(sizes)]
            quantile = 0.0
            if len(sizes):
                quantile = np.quantile(sizes, _SCALE_LEVEL)
            vmax = _round_up(float(quantile))
            vmin = -vmax if name.startswith("error") else 0
            scales[name] = {"cmap": palette, "vmin": vmin, "vmax": vmax}
    return scales


def map_sheet_figure(
    sheet: MapSheet,
    scales: dict[str, dict[str, Any]],
    classes: Sequence[TerrainClass],
    title: str,
) -> Figure:
    """Draw a sheet with a row per map and a column per layer.

    Each panel has the label `LAYER ROW`.

    Args:
        sheet: layers of the maps.
        scales: keywords of `imshow` by layer, the result of `shared_scales`.
        classes: classes of the dataset.
        title: names of model and dataset, followed by the split.
    """
    names = [name for name in _LAYERS if name in sheet.layers]
    columns = [_column(name, sheet.layers[name], scales[name]) for name in names]
    class_names = [name for name in ("class_true", "class_found") if name in names]
    class_layers = [sheet.layers[name] for name in class_names]
    class_ids = np.setdiff1d(class_layers, UNLABELLED).astype(int)
    labels = [classes[class_id].name.replace("_", " ") for class_id in class_ids]
    colours = class_colours(classes)
    patches = class_patches(labels, colours[class_ids])
    has_gaps = any(bool(np.isnan(layer).any()) for layer in sheet.layers.values())
    if patches and has_gaps:
        patches.append(missing_handle())
    rows = [f"map {index}" for index in sheet.indices]
    full_title = f"{title}, split {sheet.split}"
    return sheet_of_maps(columns, rows, sheet.extent_m, full_title, patches)


def _column(name: str, layers: np.ndarray, shades: dict[str, Any]) -> SheetColumn:
    """Return the column of a layer, with its colour scale."""
    title, unit, _ = _LAYERS[name]
    is_error = name.startswith("error")
    if name == "class_true":
        layers = np.ma.masked_equal(layers, UNLABELLED)
    extend = "both" if is_error else "max"
    if unit == "λ":  # λ ends at 0 and 1
        extend = "neither"
    return SheetColumn(
        name=name,
        title=title,
        layers=layers,
        shades=shades,
        unit=unit or None,
        extend=extend,
        max_intervals=2 if is_error else 4,
    )


def _round_up(value: float) -> float:
    """Round up to 1, 1.5, 2, 3, 4, 5, 6, 8 or 10 times a power of ten; 1 for 0."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    candidates = power * _ROUND_NUMBERS
    is_enough = candidates >= 0.999 * value
    return float(candidates[is_enough][0])
