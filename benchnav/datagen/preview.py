"""Figures of maps: a sheet with a row for each map, and a contact sheet of a split.

Lengths are in inches from the upper left corner; text is in points, as printed over the
two columns of a page. A class has the same colour in all maps and figures, that of the
class table; among look-alike classes, all except the first are lighter or darker. If
classes have soft spots, terrain that may hide them is hatched and outlined.
"""

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from benchnav.core.grid import outline
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import TerrainClass, look_alike_classes
from benchnav.datagen.schema import UNLABELLED
from benchnav.datagen.synth.appearance import light_direction, shade
from benchnav.datagen.synth.elevation import horn_gradient, pad_missing
from benchnav.viz.drives import mark, mark_handle
from benchnav.viz.maps import draw_lines, hatching, missing_handle, show_map
from benchnav.viz.sheet import (
    FRACTIONS,
    LETTER,
    LINE,
    SheetColumn,
    class_patches,
    class_scale,
    layer_column,
    sheet_of_maps,
)
from benchnav.viz.style import TEXT, TITLE, TWO_COLUMNS_IN

FIELDS = ("rgb", "class_id", "elevation_m", "slope_deg", "traversability")
STEEP_DEG = 30.0

_DPI = 300.0
_HATCH = "//////"
_MAX_THUMBNAILS = 100
_MARK_SIZE = 0.75


def preview_figure(
    dataset: TerrainDataset, split: str, indices: Sequence[int]
) -> Figure:
    """Return a figure of maps of a split, with a row for each map.

    Layers are to the right. The panel of a field has the label `FIELD ROW`.

    Args:
        dataset: dataset of the maps.
        split: name of a split.
        indices: indices of the maps.

    Returns:
        A figure as wide as a page; narrower if panels shrink to fit a page.

    Raises:
        DatasetError: If there is no such split or map, or its data are damaged.
    """
    layers = dataset.layer_names
    maps = dataset.read(split, indices, (*FIELDS, *layers, "start_m", "goal_m"))
    maps["rgb"] = np.moveaxis(maps["rgb"], 1, -1)
    # Heights above each map's lowest point are comparable between maps; heights above a
    # datum often are not.
    maps["elevation_m"] -= maps["elevation_m"].min((1, 2), keepdims=True)
    classes, grid = dataset.recipe.classes, dataset.grid
    unlabelled = maps["class_id"] == UNLABELLED
    shown, colours = np.unique(maps["class_id"][~unlabelled]), class_colours(classes)
    maps["class_id"] = np.ma.masked_array(maps["class_id"], unlabelled)
    soft = soft_ground(maps["class_id"], classes)
    relief_m = float(maps["elevation_m"].max()) or 1.0
    levels = np.array(MaxNLocator(9, steps=[1, 2, 2.5, 5, 10]).tick_values(0, relief_m))
    levels = levels[levels <= relief_m]
    relief = {"cmap": "cividis", "vmin": 0, "vmax": relief_m}
    slopes = {"cmap": "magma_r", "vmin": 0, "vmax": STEEP_DEG}
    contours = f"above the lowest point,\ncontours every {levels[1]:g} m"
    columns = [
        SheetColumn("rgb", "RGB", maps["rgb"]),
        SheetColumn("class_id", "Class", maps["class_id"], class_scale(colours)),
        SheetColumn(
            "elevation_m", "Elevation [m]", maps["elevation_m"], relief, contours
        ),
        SheetColumn("slope_deg", "Slope [°]", maps["slope_deg"], slopes, "", "max"),
        SheetColumn(
            "traversability", "Traversability λ", maps["traversability"], FRACTIONS, ""
        ),
        *(layer_column(name, maps[name], dataset.fields[name].unit) for name in layers),
    ]
    names = [f"{number} {classes[number].name.replace('_', ' ')}" for number in shown]
    marks: list[Artist] = [
        mark_handle(name, scale=_MARK_SIZE) for name in ("start", "goal")
    ]
    if unlabelled.any() or any(
        np.isnan(maps[name]).any() for name in ("traversability", *layers)
    ):
        marks.append(missing_handle())
    if soft.any():
        marks.append(
            Patch(
                facecolor="white",
                ec="black",
                lw=0.5,
                hatch=_HATCH,
                label="may hide soft spots",
            )
        )
    figure = sheet_of_maps(
        columns,
        [f"map {index}" for index in indices],
        grid.extent_m,
        f"{dataset.id}, split {split}",
        class_patches(names, colours[shown]),
        marks,
    )
    panels = {str(panel.get_label()): panel for panel in figure.axes}
    resolution_m = grid.resolution_m
    veils = _hillshade(maps["elevation_m"], maps["slope_deg"], resolution_m)
    y, x = ((np.arange(cells) + 0.5) * resolution_m for cells in grid.shape)
    for row in range(len(indices)):
        show_map(panels[f"elevation_m {row}"], veils[row], grid.extent_m)
        heights = maps["elevation_m"][row]
        crossed = levels[(levels > heights.min()) & (levels < heights.max())]
        if len(crossed):
            panels[f"elevation_m {row}"].contour(
                x,
                y,
                heights,
                levels=crossed,
                colors="black",
                linewidths=0.35,
                alpha=0.7,
            )
        if soft[row].any():
            draw_lines(
                panels[f"class_id {row}"],
                hatching(soft[row], resolution_m),
                "black",
                0.4,
            )
            for name in ("class_id", "traversability"):
                draw_lines(
                    panels[f"{name} {row}"],
                    outline(soft[row], resolution_m),
                    "black",
                    0.4,
                    "white",
                )
        for column in columns:
            for name in ("start", "goal"):
                mark(
                    panels[f"{column.name} {row}"],
                    name,
                    maps[f"{name}_m"][row],
                    _MARK_SIZE,
                    clip_on=False,
                )
    panels["elevation_m bar"].vlines(levels, 0, 1, color="black", lw=0.35, alpha=0.7)
    return figure


def contact_sheet_figure(dataset: TerrainDataset, split: str) -> Figure:
    """Return a figure of thumbnails of up to 100 maps of a split, in order.

    If classes have soft spots, terrain that may hide them is outlined, and the stored λ
    is drawn to the right of each image.

    Args:
        dataset: dataset of the maps.
        split: name of a split.

    Returns:
        A figure about as wide as high; the thumbnails are the images of its only axes.

    Raises:
        DatasetError: If there is no such split, or its data are damaged.
    """
    n_maps = dataset.map_count(split)
    grid = dataset.grid
    classes = dataset.recipe.classes
    fields = (
        ("rgb", "class_id", "traversability")
        if any(item.soft for item in classes)
        else ("rgb",)
    )
    across = grid.width * (2 if len(fields) > 1 else 1)
    count = min(n_maps, _MAX_THUMBNAILS)
    ratio = grid.height / across
    gap = 0.05
    columns = contact_columns(count, ratio)
    wide = min(max((TWO_COLUMNS_IN - gap) / columns, 0.5 / min(1, ratio)), 2.4) - gap
    high, width = wide * ratio, columns * (wide + gap) + gap
    number = f"{n_maps} maps" if count == n_maps else f"first {count} of {n_maps} maps"
    title = (
        f"{dataset.id}, split {split} (scenario "
        f"{dataset.splits[split]['scenario']}): {number}"
    )
    lines = textwrap.wrap(title, int(width / LETTER / 1.25))
    top = 0.1 + LINE * len(lines)
    height = top + -(-count // columns) * (high + gap)
    # With an integer number of dots per cell, all cells have one size. It is not used
    # if it requires too many dots.
    dots = max(1, round(_DPI * wide / across)) * across / wide
    figure = Figure(figsize=(width, height), dpi=dots if dots <= 2 * _DPI else _DPI)
    figure.text(
        gap / width,
        1 - 0.05 / height,
        "\n".join(lines),
        size=TITLE,
        va="top",
        parse_math=False,
    )
    sheet = figure.add_axes((0, 0, 1, 1))
    sheet.set(xlim=(0, width), ylim=(height, 0), autoscale_on=False)
    sheet.axis("off")
    for index in range(count):
        stored = {
            name: values[0]
            for name, values in dataset.read(split, [index], fields).items()
        }
        x, y = (
            gap + index % columns * (wide + gap),
            top + index // columns * (high + gap),
        )
        image = np.moveaxis(stored["rgb"], 0, -1)
        if "class_id" in stored:
            values = np.ma.masked_invalid(stored["traversability"])
            image = np.concatenate(
                [image, FRACTIONS["cmap"](values, bytes=True)[..., :3]], axis=1
            )
            edges = outline(
                soft_ground(stored["class_id"], classes), high / grid.height
            )
            # Inches of the page increase downward.
            draw_lines(sheet, edges * (1, -1) + (x, y + high), "black", 0.2, "white")
        box = (x, x + wide, y + high, y)
        sheet.imshow(
            image, origin="lower", extent=box, aspect="auto", interpolation="none"
        )
        label = sheet.text(
            x + 0.03, y + 0.03, str(index), size=TEXT, color="white", va="top"
        )
        label.set_path_effects([withStroke(linewidth=1.4, foreground="black")])
    return figure


def soft_ground(class_id: np.ndarray, classes: Sequence[TerrainClass]) -> np.ndarray:
    """Return a mask of cells whose class has soft spots, shape of `class_id`."""
    soft_ids = [index for index, item in enumerate(classes) if item.soft]
    return np.isin(class_id, soft_ids)


def class_colours(classes: Sequence[TerrainClass]) -> np.ndarray:
    """Return the colours in which classes are drawn, RGB in [0, 1], shape [C, 3].

    They are those of the class table, except for look-alike classes.
    """
    colours = np.array([item.colour for item in classes]) / 255
    for alike in set(look_alike_classes(tuple(classes))):
        contrast = 0.0 if colours[alike[0]].mean() > 0.5 else 1.0
        for rank, member in enumerate(alike):
            colours[member] += (contrast - colours[member]) * 0.7 * rank / len(alike)
    return colours


def contact_columns(count: int, ratio: float) -> int:
    """Return the number of columns of a grid about as wide as high with few gaps.

    Args:
        count: number of thumbnails.
        ratio: height over width of a thumbnail.
    """
    columns = np.arange(count, 0, -1)
    rows = -(-count // columns)
    uneven = np.abs(np.log(columns / (rows * ratio))) + 2 * (rows * columns / count - 1)
    return int(columns[np.argmin(uneven.round(6))])


def _hillshade(
    elevation_m: np.ndarray, slope_deg: np.ndarray, resolution_m: float
) -> np.ndarray:
    """Return white and black overlays for a light in the north-west, [B, H, W, 4].

    Level terrain has no overlay, and shows the colours of the bar. Heights are
    exaggerated by one factor, which depends on the steepness of the maps.
    """
    lift = np.clip(
        0.8 / np.tan(np.radians(np.percentile(slope_deg, 95) + 1e-3)), 0.1, 30
    )
    light = light_direction(np.array([0.75 * np.pi]), np.array([0.7]))
    ground_m = pad_missing(lift * elevation_m.astype(np.float64))
    lit = shade(*horn_gradient(ground_m, resolution_m), light, 0.0) - light[0, 2]
    white = lit > 0
    return np.stack([white, white, white, 0.7 * np.abs(lit)], axis=-1)
