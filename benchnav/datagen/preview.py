"""Figures of maps: a sheet with a row for each map, and a contact sheet of a split.

Lengths are in inches, and positions are from the upper left corner. Sizes of text are
in points, for a figure that spans two columns of a page. A class has the same colour in
all maps and figures: the colour of the class table. In each group of look-alike
classes, the colours of all but the first are made lighter or darker. Terrain of classes
with soft spots is hatched or outlined.
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

    Additional layers of the dataset are in the rightmost columns. The panel of a field
    has the label `FIELD ROW`.

    Args:
        dataset: dataset of the maps.
        split: name of a split.
        indices: indices of the maps.

    Returns:
        A figure as wide as a page, or narrower if its panels are shrunk to the height
        of a page.

    Raises:
        DatasetError: If the split or a map does not exist, or its data are damaged.
    """
    layers = dataset.layer_names
    maps = dataset.read(split, indices, (*FIELDS, *layers, "start_m", "goal_m"))
    classes = dataset.recipe.classes
    grid = dataset.grid
    resolution_m = grid.resolution_m
    unlabelled = maps["class_id"] == UNLABELLED
    shown = np.unique(maps["class_id"][~unlabelled])
    colours = class_colours(classes)
    class_id = np.ma.masked_array(maps["class_id"], unlabelled)
    soft = soft_ground(class_id, classes)
    slope_deg = maps["slope_deg"]
    traversability = maps["traversability"]
    # Heights are relative to each map's lowest point, since elevations of different
    # maps may differ too much for the same scale.
    elevation_m = maps["elevation_m"]
    elevation_m -= elevation_m.min((1, 2), keepdims=True)
    relief_m = float(elevation_m.max()) or 1.0
    locator = MaxNLocator(9, steps=[1, 2, 2.5, 5, 10])
    levels = np.array(locator.tick_values(0, relief_m))
    levels = levels[levels <= relief_m]
    relief = {"cmap": "cividis", "vmin": 0, "vmax": relief_m}
    slopes = {"cmap": "magma_r", "vmin": 0, "vmax": STEEP_DEG}
    contours = f"above the lowest point,\ncontours every {levels[1]:g} m"
    columns = [
        SheetColumn("rgb", "RGB", np.moveaxis(maps["rgb"], 1, -1)),
        SheetColumn("class_id", "Class", class_id, class_scale(colours)),
        SheetColumn("elevation_m", "Elevation [m]", elevation_m, relief, contours),
        SheetColumn("slope_deg", "Slope [°]", slope_deg, slopes, "", "max"),
        SheetColumn(
            "traversability", "Traversability λ", traversability, FRACTIONS, ""
        ),
    ]
    for name in layers:
        unit = dataset.fields[name].unit
        columns.append(layer_column(name, maps[name], unit))
    names = []
    for number in shown:
        name = classes[number].name.replace("_", " ")
        names.append(f"{number} {name}")
    marks: list[Artist] = [
        mark_handle(name, scale=_MARK_SIZE) for name in ("start", "goal")
    ]
    is_incomplete = unlabelled.any()
    for name in ("traversability", *layers):
        is_incomplete |= np.isnan(maps[name]).any()
    if is_incomplete:
        marks.append(missing_handle())
    if soft.any():
        label = "may hide soft spots"
        patch = Patch(facecolor="white", ec="black", lw=0.5, hatch=_HATCH, label=label)
        marks.append(patch)
    figure = sheet_of_maps(
        columns,
        [f"map {index}" for index in indices],
        grid.extent_m,
        f"{dataset.id}, split {split}",
        class_patches(names, colours[shown]),
        marks,
    )
    panels = {str(panel.get_label()): panel for panel in figure.axes}
    hillshade_overlays = _hillshade(elevation_m, slope_deg, resolution_m)
    lines = {"colors": "black", "linewidths": 0.35, "alpha": 0.7}
    y, x = ((np.arange(cells) + 0.5) * resolution_m for cells in grid.shape)
    for row in range(len(indices)):
        panel = panels[f"elevation_m {row}"]
        show_map(panel, hillshade_overlays[row], grid.extent_m)
        heights = elevation_m[row]
        is_crossed = (levels > heights.min()) & (levels < heights.max())
        if is_crossed.any():
            panel.contour(x, y, heights, levels=levels[is_crossed], **lines)
        if soft[row].any():
            hatch = hatching(soft[row], resolution_m)
            draw_lines(panels[f"class_id {row}"], hatch, "black", 0.4)
            edges = outline(soft[row], resolution_m)
            for name in ("class_id", "traversability"):
                draw_lines(panels[f"{name} {row}"], edges, "black", 0.4, "white")
        for column in columns:
            panel = panels[f"{column.name} {row}"]
            for name in ("start", "goal"):
                position_m = maps[f"{name}_m"][row]
                mark(panel, name, position_m, _MARK_SIZE, clip_on=False)
    panels["elevation_m bar"].vlines(levels, 0, 1, color="black", lw=0.35, alpha=0.7)
    return figure


def contact_sheet_figure(dataset: TerrainDataset, split: str) -> Figure:
    """Return a figure of thumbnails of up to 100 maps of a split, in order.

    If classes have soft spots, terrain of these classes is outlined, and the stored λ
    is drawn to the right of each image.

    Args:
        dataset: dataset of the maps.
        split: name of a split.

    Returns:
        A roughly square figure with a single `Axes`, whose images are the thumbnails.

    Raises:
        DatasetError: If the split does not exist, or its data are damaged.
    """
    n_maps = dataset.map_count(split)
    grid = dataset.grid
    classes = dataset.recipe.classes
    has_soft_spots = any(item.soft for item in classes)
    fields = ["rgb"]
    cells_across = grid.width
    if has_soft_spots:
        fields += ["class_id", "traversability"]
        cells_across = 2 * grid.width
    count = min(n_maps, _MAX_THUMBNAILS)
    ratio = grid.height / cells_across
    gap = 0.05
    columns = contact_columns(count, ratio)
    rows = -(-count // columns)
    min_pitch = 0.5 / min(1, ratio)
    pitch_x = min(max((TWO_COLUMNS_IN - gap) / columns, min_pitch), 2.4)
    image_width = pitch_x - gap
    image_height = image_width * ratio
    width = columns * (image_width + gap) + gap
    number = f"{n_maps} maps" if count == n_maps else f"first {count} of {n_maps} maps"
    scenario = dataset.splits[split]["scenario"]
    title = f"{dataset.id}, split {split} (scenario {scenario}): {number}"
    lines = textwrap.wrap(title, int(width / LETTER / 1.25))
    top = 0.1 + LINE * len(lines)
    height = top + rows * (image_height + gap)
    # With an integer number of dots per cell, all cells have the same size. If this
    # requires too high a resolution, the default resolution is used.
    dots_per_cell = max(1, round(_DPI * image_width / cells_across))
    dpi = dots_per_cell * cells_across / image_width
    if dpi > 2 * _DPI:
        dpi = _DPI
    figure = Figure(figsize=(width, height), dpi=dpi)
    title_x = gap / width
    title_y = 1 - 0.05 / height
    text = "\n".join(lines)
    figure.text(title_x, title_y, text, size=TITLE, va="top", parse_math=False)
    sheet = figure.add_axes((0, 0, 1, 1))
    sheet.set(xlim=(0, width), ylim=(height, 0), autoscale_on=False)
    sheet.axis("off")
    for index in range(count):
        maps = dataset.read(split, [index], fields)
        row, column = divmod(index, columns)
        x = gap + column * (image_width + gap)
        y = top + row * (image_height + gap)
        right = x + image_width
        lower = y + image_height
        image = np.moveaxis(maps["rgb"][0], 0, -1)
        if has_soft_spots:
            values = np.ma.masked_invalid(maps["traversability"][0])
            coloured = FRACTIONS["cmap"](values, bytes=True)
            image = np.concatenate([image, coloured[..., :3]], axis=1)
            soft = soft_ground(maps["class_id"][0], classes)
            edges = outline(soft, image_height / grid.height)
            # The y axis of the page points downward.
            draw_lines(sheet, edges * (1, -1) + (x, lower), "black", 0.2, "white")
        box = (x, right, lower, y)
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

    They are the colours of the class table. In each group of look-alike classes, the
    colours of all but the first are made lighter or darker.
    """
    colours = np.array([item.colour for item in classes]) / 255
    for alike in set(look_alike_classes(tuple(classes))):
        is_bright = colours[alike[0]].mean() > 0.5
        contrast = 0.0 if is_bright else 1.0
        for rank, member in enumerate(alike):
            difference = contrast - colours[member]
            colours[member] += difference * 0.7 * rank / len(alike)
    return colours


def contact_columns(count: int, ratio: float) -> int:
    """Return the number of columns of a grid that is nearly square and has few gaps.

    Args:
        count: number of thumbnails.
        ratio: ratio of height to width of a thumbnail.
    """
    columns = np.arange(count, 0, -1)
    rows = -(-count // columns)
    elongation = np.abs(np.log(columns / (rows * ratio)))
    gaps = rows * columns / count - 1
    cost = elongation + 2 * gaps
    best = np.argmin(cost.round(6))
    return int(columns[best])


def _hillshade(
    elevation_m: np.ndarray, slope_deg: np.ndarray, resolution_m: float
) -> np.ndarray:
    """Return white and black overlays for a light in the north-west, [B, H, W, 4].

    Level terrain has no overlay, so it keeps the colours of the scale. Heights of all
    maps are exaggerated by the same factor, which depends on their slopes.
    """
    steep_deg = np.percentile(slope_deg, 95) + 1e-3
    steep = np.tan(np.radians(steep_deg))
    exaggeration = np.clip(0.8 / steep, 0.1, 30)
    light = light_direction(np.array([0.75 * np.pi]), np.array([0.7]))
    height_of_light = light[0, 2]
    heights_m = pad_missing(exaggeration * elevation_m.astype(np.float64))
    gradient = horn_gradient(heights_m, resolution_m)
    contrast = shade(*gradient, light, 0.0) - height_of_light
    white = contrast > 0
    opacity = 0.7 * np.abs(contrast)
    return np.stack([white, white, white, opacity], axis=-1)
