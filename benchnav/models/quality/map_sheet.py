"""Map sheets: truth, prediction, error and uncertainty of a few maps side by side, a
row a map.

A quantity has one scale in all sheets of an evaluation, so that splits compare. Letters
in shapes: B maps, H×W cells.
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
from benchnav.viz.maps import LAMBDA, TRAVERSABILITY_COLOURS, lacking_handle
from benchnav.viz.sheet import SheetColumn, class_patches, class_scale, sheet_of_maps

# Of each layer its title, what stands under its colour bar, and its colours; classes
# and images have no bar.
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
_SHOWN_SHARE = 0.995


class MapSheet(NamedTuple):
    """What a sheet shows.

    Args:
        split: where the maps are from.
        indices: which maps.
        extent_m: size of a map along x and y.
        layers: by the keys of `_LAYERS`, those that the model has, each of shape [B, H,
            W]; `rgb` is of shape [B, H, W, 3].
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
    """Predicts some maps of a split.

    Args:
        model: any model.
        dataset: where the maps are.
        split: name of a split.
        indices: which maps.

    Raises:
        DatasetError: there is no such split or map, or its data are damaged.
    """
    terrain = dataset.terrain(split, indices)
    with torch.inference_mode():
        predicted = predict(model, terrain)
        known = dataset.truth_of(split) == "generated"
        true = (
            Oracle().predict_terrain(terrain).mean()
            if known
            else terrain.traversability
        )
        layers = {"rgb": terrain.rgb.movedim(1, -1)}
        if model.class_names:
            classes = predicted.class_probabilities(len(model.class_names))
            layers |= {"class_true": terrain.class_id, "class_found": classes.argmax(1)}
            layers["entropy"] = predictive_entropy(classes)
        layers |= {
            "expected_true" if known else "observed": true,
            "expected": predicted.mean(),
            "error" if known else "error_observed": predicted.mean() - true,
            "width": predicted.var(0.05) - predicted.var(0.95),
        }
        members = model.member_probabilities(terrain.observe())
        if members is not None and len(members) > 1:
            layers["information"] = mutual_information(members)
    arrays = {name: layer.cpu().numpy() for name, layer in layers.items()}
    return MapSheet(split, tuple(indices), terrain.grid.extent_m, arrays)


def shared_scales(
    sheets: Sequence[MapSheet], classes: Sequence[TerrainClass]
) -> dict[str, dict[str, Any]]:
    """Finds how each layer is drawn in all sheets: keywords of `imshow`, by layer.

    Scales that are not of a fixed range hold 99.5 % of the cells.

    Args:
        sheets: at least one.
        classes: of the dataset.
    """
    kinds = class_scale(class_colours(classes))
    scales: dict[str, dict[str, Any]] = {
        "rgb": {},
        "class_true": kinds,
        "class_found": kinds,
    }
    for name, (_, unit, palette) in _LAYERS.items():
        values = [
            sheet.layers[name].ravel()
            for sheet in sheets
            if name in sheet.layers and unit
        ]
        if unit == "λ":
            scales[name] = LAMBDA
        elif values:
            shown = np.abs(np.concatenate(values))
            shown = shown[np.isfinite(shown)]
            most = _round_up(
                float(np.quantile(shown, _SHOWN_SHARE)) if len(shown) else 0.0
            )
            scales[name] = {
                "cmap": palette,
                "vmin": -most if name.startswith("error") else 0,
                "vmax": most,
            }
    return scales


def map_sheet_figure(
    sheet: MapSheet,
    scales: dict[str, dict[str, Any]],
    classes: Sequence[TerrainClass],
    title: str,
) -> Figure:
    """Draws a sheet, a row a map and a column a layer; the panel of a layer has the
    label `LAYER ROW`.

    Args:
        sheet: the maps.
        scales: from `shared_scales`.
        classes: of the dataset.
        title: which model and dataset; the split follows.
    """
    columns = []
    for name in (name for name in _LAYERS if name in sheet.layers):
        title_of, unit, _ = _LAYERS[name]
        layers, is_error = sheet.layers[name], name.startswith("error")
        columns.append(
            SheetColumn(
                name=name,
                title=title_of,
                layers=np.ma.masked_equal(layers, UNLABELLED)
                if name == "class_true"
                else layers,
                shades=scales[name],
                unit=unit or None,
                # λ ends at 0 and 1.
                extend="neither" if unit == "λ" else "both" if is_error else "max",
                max_intervals=2 if is_error else 4,
            )
        )
    kinds = [
        sheet.layers[name]
        for name in ("class_true", "class_found")
        if name in sheet.layers
    ]
    shown = np.setdiff1d(kinds, UNLABELLED).astype(int)
    patches = class_patches(
        [classes[number].name.replace("_", " ") for number in shown],
        class_colours(classes)[shown],
    )
    if patches and any(bool(np.isnan(layer).any()) for layer in sheet.layers.values()):
        patches.append(lacking_handle())
    rows = [f"map {index}" for index in sheet.indices]
    return sheet_of_maps(
        columns, rows, sheet.extent_m, f"{title}, split {sheet.split}", patches
    )


def _round_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 4, 5, 6, 8 and 10 times a power of ten; 1 for 0."""
    if value <= 0:
        return 1.0
    steps = 10.0 ** np.floor(np.log10(value)) * np.array([1, 1.5, 2, 3, 4, 5, 6, 8, 10])
    return float(steps[steps >= 0.999 * value][0])
