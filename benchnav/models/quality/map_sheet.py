"""Map sheets: truth, prediction, error and uncertainty of a few maps side by side, a row a map.

A quantity has one scale in all sheets of an evaluation, so that splits compare. Letters in shapes: B
maps, H×W cells.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from benchnav.core.figures import (
    LACKING,
    TITLE,
    TRAVERSABILITY_COLOURS,
    add_axes,
    add_bar,
    legend_at,
    number_map,
    show_map,
    write,
)
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.preview import class_colours, class_patches, class_shades
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.predictor import AnyModel, ClassModel, EnsembleModel, Oracle, predict
from benchnav.models.probabilities import class_probabilities
from benchnav.models.quality.scores import mutual_information, predictive_entropy

TITLES = {
    "rgb": "Image",
    "class_true": "True class",
    "class_found": "Most likely class",
    "expected_true": "True E[λ]",
    "observed": "Observed λ",
    "expected": "Predicted E[λ]",
    "error_observed": "E[λ] − observed λ",
    "error": "Error of E[λ]",
    "width": "90 % interval of λ",
    "entropy": "Entropy",
    "information": "Mutual information",
}

_UNITS = {
    **dict.fromkeys(("expected_true", "observed", "expected"), "λ"),
    **{"error_observed": "predicted − observed", "error": "predicted − true", "width": "width"},
    **dict.fromkeys(("entropy", "information"), "nats"),
}
_PALETTES = {
    **dict.fromkeys(("error", "error_observed"), "RdBu_r"),
    **dict.fromkeys(("width", "entropy", "information"), "magma"),
}
_PANEL, _GAP = 1.2, 0.1
_LEFT, _RIGHT, _TOP, _FOOT = 0.5, 0.08, 0.45, 0.8
_LEGEND_COLUMNS = 3
_SHOWN_SHARE = 0.995


@dataclass(frozen=True, kw_only=True)
class MapSheet:
    """What a sheet shows.

    Args:
        split: where the maps are from.
        indices: which maps.
        extent_m: size of a map along x and y.
        layers: by the keys of `TITLES`, those that the model has, each of shape [B, H, W]; `rgb` is of
            shape [B, H, W, 3].
    """

    split: str
    indices: tuple[int, ...]
    extent_m: tuple[float, float]
    layers: dict[str, np.ndarray]


def read_sheet(model: AnyModel, dataset: TerrainDataset, split: str, indices: Sequence[int]) -> MapSheet:
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
        mixture = predict(model, terrain)
        known = dataset.truth_of(split) == "generated"
        true = Oracle().predict_terrain(terrain).mean() if known else terrain.traversability
        layers = {"rgb": terrain.rgb.movedim(1, -1)}
        if isinstance(model, ClassModel):
            classes = class_probabilities(mixture, len(model.class_names))
            layers |= {"class_true": terrain.class_id, "class_found": classes.argmax(1)}
        layers |= {
            "expected_true" if known else "observed": true,
            "expected": mixture.mean(),
            "error" if known else "error_observed": mixture.mean() - true,
            "width": mixture.var(0.05) - mixture.var(0.95),
        }
        if isinstance(model, ClassModel):
            layers["entropy"] = predictive_entropy(classes)
        if isinstance(model, EnsembleModel):
            members = model.member_probabilities(terrain.observe())
            layers |= {"information": mutual_information(members)} if len(members) > 1 else {}
    return MapSheet(
        split=split,
        indices=tuple(indices),
        extent_m=terrain.grid.extent_m,
        layers={name: layer.cpu().numpy() for name, layer in layers.items()},
    )


def shared_scales(sheets: Sequence[MapSheet], classes: Sequence[TerrainClass]) -> dict[str, dict[str, Any]]:
    """Finds how each layer is drawn in all sheets: keywords of `imshow`, by layer.

    Scales that are not of a fixed range hold 99.5 % of the cells.

    Args:
        sheets: at least one.
        classes: of the dataset.
    """
    kinds = {"cmap": class_shades(class_colours(classes)), "vmin": -0.5, "vmax": len(classes) - 0.5}
    share = {"cmap": TRAVERSABILITY_COLOURS, "vmin": 0, "vmax": 1}
    scales: dict[str, dict[str, Any]] = {
        "rgb": {},
        **dict.fromkeys(("class_true", "class_found"), kinds),
        **dict.fromkeys(("expected_true", "observed", "expected"), share),
    }
    for name, palette in _PALETTES.items():
        values = [np.abs(sheet.layers[name]).ravel() for sheet in sheets if name in sheet.layers]
        if values:
            shown = np.concatenate(values)
            shown = shown[np.isfinite(shown)]
            most = _round_up(float(np.quantile(shown, _SHOWN_SHARE)) if len(shown) else 0.0)
            scales[name] = {"cmap": palette, "vmin": -most if name.startswith("error") else 0, "vmax": most}
    return scales


def map_sheet_figure(
    sheet: MapSheet, scales: dict[str, dict[str, Any]], classes: Sequence[TerrainClass], title: str
) -> Figure:
    """Draws a sheet, a row a map and a column a layer; the panel of a layer has the label `LAYER ROW`.

    Args:
        sheet: the maps.
        scales: from `shared_scales`.
        classes: of the dataset.
        title: which model and dataset; the split follows.
    """
    names = [name for name in TITLES if name in sheet.layers]
    width_m, height_m = sheet.extent_m
    high = _PANEL * float(np.clip(height_m / width_m, 0.3, 3))
    shown = _shown_classes(sheet)
    lacking = any(bool(np.isnan(layer).any()) for layer in sheet.layers.values())
    legend_rows = -(-(len(shown) + lacking) // _LEGEND_COLUMNS)
    bottom = _TOP + len(sheet.indices) * (high + _GAP) - _GAP
    size = (
        _LEFT + len(names) * (_PANEL + _GAP) - _GAP + _RIGHT,
        bottom + max(_FOOT, 0.42 + 0.14 * legend_rows),
    )
    figure = Figure(figsize=size)
    for column, name in enumerate(names):
        left = _LEFT + column * (_PANEL + _GAP)
        middle = left + _PANEL / 2
        for row, index in enumerate(sheet.indices):
            top = _TOP + row * (high + _GAP)
            panel = add_axes(figure, (left, top, _PANEL, high), f"{name} {row}")
            panel.set_facecolor(LACKING)
            layer = sheet.layers[name][row]
            if name == "class_true":
                layer = np.ma.masked_equal(layer, UNLABELLED)
            image = show_map(panel, layer, sheet.extent_m, aspect="auto", **scales[name])
            number_map(panel, (_PANEL, high), left=column == 0, bottom=row == len(sheet.indices) - 1)
            if column == 0:
                write(figure, 0.1, top + high / 2, f"map {index}", rotation=90, ha="center", va="center")
        write(figure, middle, _TOP - 0.06, TITLES[name], size=TITLE, ha="center", va="bottom")
        write(figure, middle, bottom + 0.2, "x [m]", ha="center", va="top")
        if name in _UNITS:
            signed = name.startswith("error")
            # λ ends at 0 and 1.
            extend = "neither" if _UNITS[name] == "λ" else "both" if signed else "max"
            place = (left + 0.06, bottom + 0.42, _PANEL - 0.12, 0.07)
            add_bar(figure, image, place, f"{name} bar", extend, most=2 if signed else 4)
            write(figure, middle, bottom + 0.64, _UNITS[name], ha="center", va="top")
    write(figure, _LEFT, 0.06, f"{title}, split {sheet.split}", size=TITLE, weight="bold", va="top")
    write(figure, 0.26, (_TOP + bottom) / 2, "y [m]", rotation=90, ha="center", va="center")
    if shown:
        shown_names = [classes[number].name.replace("_", " ") for number in shown]
        patches = class_patches(shown_names, class_colours(classes)[shown])
        if lacking:
            patches.append(Patch(facecolor=LACKING, label="not known"))
        legend_at(figure, patches, (_LEFT, bottom + 0.38), _LEGEND_COLUMNS)
    return figure


def _shown_classes(sheet: MapSheet) -> list[int]:
    layers = [sheet.layers[name] for name in ("class_true", "class_found") if name in sheet.layers]
    return [number for number in np.unique(layers).tolist() if number != UNLABELLED] if layers else []


def _round_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 4, 5, 6, 8 and 10 times a power of ten; 1 for 0."""
    if value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(
        next(step * power for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * power >= 0.999 * value)
    )
