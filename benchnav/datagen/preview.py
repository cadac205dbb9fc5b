"""Pictures of maps: a sheet for a paper, a row a map, and a contact sheet of a whole split.

Lengths are in inches from the upper left corner and text is in points, as printed over the two columns
of a page. A class has one colour in every map and figure, its own of the class table; of classes that look alike
all but the first are drawn lighter or darker.
Where the classes have soft spots, the ground that may hide them is hatched and outlined.
"""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from benchnav.core.figures import (
    LACKING,
    TEXT,
    TITLE,
    TRAVERSABILITY_COLOURS,
    TWO_COLUMNS_IN,
    frame_map,
    hatching,
    layer_scale,
    legend_outside,
    mark,
    mark_handle,
    show_map,
    styled,
)
from benchnav.core.grid import is_azimuth, outline
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import TerrainClass, look_alike_classes
from benchnav.datagen.schema import UNLABELLED
from benchnav.datagen.synth.appearance import light_direction, shade
from benchnav.datagen.synth.elevation import framed, horn_gradient

FIELDS = ("rgb", "class_id", "elevation_m", "slope_deg", "traversability")
STEEP_DEG = 30.0

_PAGE, _DPI = 9.4, 300.0
_SIDES, _ENDS = 0.7, 1.5  # what is not maps of a sheet's width and height
_LINE, _LETTER, _COLUMN = 0.135, 0.054, 1.15
_TITLE_LETTERS = 20  # of a layer's name in a line, which a column has room for
_HATCH = "//////"
_MOST_THUMBNAILS = 100
_MARK_SIZE = 0.75
_SHADES = matplotlib.colormaps[TRAVERSABILITY_COLOURS].with_extremes(bad=LACKING)
LACKING_PATCH = Patch(facecolor=LACKING, label="not known")


def preview_figure(dataset: TerrainDataset, split: str, indices: Sequence[int]) -> Figure:
    """Draws maps of a split, a row each, layers to the right; the panel of a field has the label `FIELD ROW`.

    Args:
        dataset: where the maps are.
        split: name of a split.
        indices: which maps.

    Returns:
        A figure as wide as a page; narrower where panels shrink to fit a page.

    Raises:
        DatasetError: there is no such split or map, or its data are damaged.
    """
    layers = dataset.layer_names
    maps = dataset.read(split, indices, (*FIELDS, *layers, "start_m", "goal_m"))
    maps["rgb"] = np.moveaxis(maps["rgb"], 1, -1)
    # Heights over each map's lowest point compare between maps; heights over a datum seldom do.
    maps["elevation_m"] -= maps["elevation_m"].min((1, 2), keepdims=True)
    classes, grid = dataset.recipe.classes, dataset.grid
    unlabelled = maps["class_id"] == UNLABELLED
    shown, colours = np.unique(maps["class_id"][~unlabelled]), class_colours(classes)
    maps["class_id"] = np.ma.masked_array(maps["class_id"], unlabelled)
    soft = soft_ground(maps["class_id"], classes)
    relief_m = float(maps["elevation_m"].max()) or 1.0
    levels = np.array(MaxNLocator(9, steps=[1, 2, 2.5, 5, 10]).tick_values(0, relief_m))
    levels = levels[levels <= relief_m]
    kinds = {"cmap": class_shades(colours), "vmin": -0.5, "vmax": len(colours) - 0.5}
    relief = {"cmap": "cividis", "vmin": 0, "vmax": relief_m}
    slopes = {"cmap": "magma_r", "vmin": 0, "vmax": STEEP_DEG}
    shares = {"cmap": _SHADES, "vmin": 0, "vmax": 1}
    contours = f"above the lowest point,\ncontours every {levels[1]:g} m"
    columns = [
        SheetColumn("rgb", "RGB", maps["rgb"]),
        SheetColumn("class_id", "Class", maps["class_id"], kinds),
        SheetColumn("elevation_m", "Elevation [m]", maps["elevation_m"], relief, contours),
        SheetColumn("slope_deg", "Slope [°]", maps["slope_deg"], slopes, "", "max"),
        SheetColumn("traversability", "Traversability λ", maps["traversability"], shares, ""),
        *(layer_column(name, maps[name], dataset.fields[name].unit) for name in layers),
    ]
    names = [f"{number} {classes[number].name.replace('_', ' ')}" for number in shown]
    marks: list[Artist] = [mark_handle(name, scale=_MARK_SIZE) for name in ("start", "goal")]
    if unlabelled.any() or any(np.isnan(maps[name]).any() for name in ("traversability", *layers)):
        marks.append(LACKING_PATCH)
    if soft.any():
        marks.append(Patch(facecolor="white", ec="black", lw=0.5, hatch=_HATCH, label="may hide soft spots"))
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
                x, y, heights, levels=crossed, colors="black", linewidths=0.35, alpha=0.7
            )
        if soft[row].any():
            hatched = LineCollection(list(hatching(soft[row], resolution_m)), colors="black", linewidths=0.4)
            panels[f"class_id {row}"].add_collection(hatched)
            for name in ("class_id", "traversability"):
                _draw_soft_ground(panels[f"{name} {row}"], outline(soft[row], resolution_m))
        for column in columns:
            for name in ("start", "goal"):
                mark(panels[f"{column.name} {row}"], name, maps[f"{name}_m"][row], _MARK_SIZE, clip_on=False)
    panels["elevation_m bar"].vlines(levels, 0, 1, color="black", lw=0.35, alpha=0.7)
    return figure


class SheetColumn(NamedTuple):
    """A column of a sheet of maps.

    Args:
        name: its panels have the label `NAME ROW`, and its colour bar `NAME bar`.
        title: over the column.
        layers: a map a row, shape [R, H, W], or [R, H, W, 3] of colours.
        shades: keywords of `imshow`.
        unit: what stands under the colour bar; None where there is no bar.
        extend: at which ends the bar goes on: neither, max or both.
        most: intervals of the bar.
    """

    name: str
    title: str
    layers: np.ndarray
    shades: Mapping[str, Any] = {}
    unit: str | None = None
    extend: str = "neither"
    most: int = 4


def layer_column(name: str, values: np.ndarray, unit: str) -> SheetColumn:
    """A layer as a column of a sheet, of shape [R, H, W]."""
    words = name.removesuffix(f"_{unit}").replace("_", " ")
    title = words[:1].upper() + words[1:] + {"1": "", "deg": " [°]"}.get(unit, f" [{unit}]")
    title = textwrap.fill(title, _TITLE_LETTERS, break_long_words=False)
    shown = values % 360 if is_azimuth(name) else values
    return SheetColumn(name, title, np.ma.masked_invalid(shown), layer_scale(name, values), "")


@styled()
def sheet_of_maps(
    columns: Sequence[SheetColumn],
    rows: Sequence[str],
    extent_m: tuple[float, float],
    heading: str,
    classes: Sequence[Artist],
    marks: Sequence[Artist] = (),
) -> Figure:
    """Draws maps side by side, a row a map and a column a layer, for the page of a paper.

    Args:
        columns: of R rows each.
        rows: names of the R rows.
        extent_m: size of a map along x and y.
        heading: over everything.
        classes: entries of the legend under everything.
        marks: entries of a legend beside the heading.

    Returns:
        A figure as wide as a page; narrower where panels shrink to fit one, wider where columns are many.
    """
    ratio, across = extent_m[1] / extent_m[0], len(columns)
    widest = max((TWO_COLUMNS_IN - _SIDES) / across, _COLUMN)
    high = min(widest * ratio, 2.0, max((_PAGE - _ENDS) / len(rows), 0.8))
    width = across * max(high / ratio, _COLUMN) + _SIDES
    letters = max((len(str(patch.get_label())) for patch in classes), default=0)
    legend_columns = max(1, int(width / (0.4 + _LETTER * letters)))
    ends = _ENDS + _LINE * -(-len(classes) // legend_columns)
    height = len(rows) * max(high, 0.5) + ends
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    panels = figure.subplots(len(rows), across, squeeze=False, sharex=True, sharey=True)
    for column, below in zip(columns, panels.T, strict=True):
        for row, panel in enumerate(below):
            panel.set(label=f"{column.name} {row}", facecolor=LACKING)
            image = show_map(panel, column.layers[row], extent_m, **column.shades)
            frame_map(panel)
        below[0].set_title(column.title)
        if column.unit is not None:
            bar = figure.colorbar(
                image, ax=list(below), location="bottom", extend=column.extend, aspect=14, panchor=False,
                ticks=MaxNLocator(column.most, steps=[1, 2, 2.5, 5, 10]), format="%g",
            )  # fmt: skip
            bar.set_label(column.unit, size=TEXT)
            bar.ax.set_label(f"{column.name} bar")
    for axis, inches in ((panels[0, 0].xaxis, high / ratio), (panels[0, 0].yaxis, high)):
        # A tick at the very end is left out, as its number would touch the next panel's first.
        most = min(max(int(inches / 0.2), 1), 4)
        axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10], prune="upper"))
    for panel, name in zip(panels[:, 0], rows, strict=True):
        panel.set_ylabel(name, size=TEXT)
    panels[-1, across // 2].set_xlabel("x [m]", size=TEXT)
    figure.supylabel("y [m]", size=TEXT, y=0.5 + (ends / 2 - 0.45) / height)
    figure.suptitle(heading, x=0.01, ha="left", parse_math=False)
    for handles, count, side in ((marks, len(marks), "upper right"), (classes, legend_columns, "lower left")):
        if handles:
            for text in legend_outside(figure, handles, count, side).get_texts():
                text.set_parse_math(False)
    return figure


def contact_sheet_figure(dataset: TerrainDataset, split: str) -> Figure:
    """Draws a thumbnail of the colour image of every map of a split, of its first hundred, in order, row by row.

    Where the classes have soft spots, the ground that may hide them is outlined, and the stored λ stands
    to the right of each image.

    Args:
        dataset: where the maps are.
        split: name of a split.

    Returns:
        A figure about as wide as high; the thumbnails are the images of its one axes.

    Raises:
        DatasetError: there is no such split, or its data are damaged.
    """
    held, grid, classes = dataset.map_count(split), dataset.grid, dataset.recipe.classes
    fields = ("rgb", "class_id", "traversability") if any(item.soft for item in classes) else ("rgb",)
    across = grid.width * (2 if len(fields) > 1 else 1)
    count, ratio, gap = min(held, _MOST_THUMBNAILS), grid.height / across, 0.05
    columns = contact_columns(count, ratio)
    wide = min(max((TWO_COLUMNS_IN - gap) / columns, 0.5 / min(1, ratio)), 2.4) - gap
    high, width = wide * ratio, columns * (wide + gap) + gap
    number = f"{held} maps" if count == held else f"first {count} of {held} maps"
    title = f"{dataset.id}, split {split} (scenario {dataset.splits[split]['scenario']}): {number}"
    lines = textwrap.wrap(title, int(width / _LETTER / 1.25))
    top = 0.1 + _LINE * len(lines)
    height = top + -(-count // columns) * (high + gap)
    # A whole number of dots a cell keeps all cells of one size, unless that takes too many dots.
    dots = max(1, round(_DPI * wide / across)) * across / wide
    figure = Figure(figsize=(width, height), dpi=dots if dots <= 2 * _DPI else _DPI)
    figure.text(gap / width, 1 - 0.05 / height, "\n".join(lines), size=TITLE, va="top", parse_math=False)
    sheet = figure.add_axes((0, 0, 1, 1))
    sheet.set(xlim=(0, width), ylim=(height, 0), autoscale_on=False)
    sheet.axis("off")
    for index in range(count):
        stored = {name: values[0] for name, values in dataset.read(split, [index], fields).items()}
        x, y = gap + index % columns * (wide + gap), top + index // columns * (high + gap)
        image = np.moveaxis(stored["rgb"], 0, -1)
        if "class_id" in stored:
            values = np.ma.masked_invalid(stored["traversability"])
            image = np.concatenate([image, _SHADES(values, bytes=True)[..., :3]], axis=1)
            edges = outline(soft_ground(stored["class_id"], classes), high / grid.height)
            # The page counts inches downward.
            _draw_soft_ground(sheet, edges * (1, -1) + (x, y + high), line=0.2)
        box = (x, x + wide, y + high, y)
        sheet.imshow(image, origin="lower", extent=box, aspect="auto", interpolation="none")
        label = sheet.text(x + 0.03, y + 0.03, str(index), size=TEXT, color="white", va="top")
        label.set_path_effects([withStroke(linewidth=1.4, foreground="black")])
    return figure


def soft_ground(class_id: np.ndarray, classes: Sequence[TerrainClass]) -> np.ndarray:
    """Cells whose class has soft spots, bool, shape of `class_id`."""
    return np.isin(class_id, [number for number, item in enumerate(classes) if item.soft])


def class_colours(classes: Sequence[TerrainClass]) -> np.ndarray:
    """Colours to draw classes in, those of the table but for look-alikes: RGB in [0, 1], shape [C, 3]."""
    colours = np.array([item.colour for item in classes]) / 255
    for alike in set(look_alike_classes(tuple(classes))):
        away = 0.0 if colours[alike[0]].mean() > 0.5 else 1.0
        for place, member in enumerate(alike):
            colours[member] += (away - colours[member]) * 0.7 * place / len(alike)
    return colours


def class_patches(names: Sequence[str], colours: np.ndarray) -> list[Artist]:
    """Entries of a legend for classes, whose colours are of shape [C, 3]."""
    return [Patch(facecolor=c, ec="0.3", lw=0.4, label=n) for c, n in zip(colours, names, strict=True)]


def class_shades(colours: np.ndarray) -> Colormap:
    """The colours of classes, [C, 3], as a colour map; cells that are masked have no class."""
    return ListedColormap(list(colours)).with_extremes(bad=LACKING)


def contact_columns(count: int, ratio: float) -> int:
    """Number of columns that makes a grid about as wide as high, with few places left empty.

    Args:
        count: number of thumbnails.
        ratio: height over width of a thumbnail.
    """
    columns = np.arange(count, 0, -1)
    rows = -(-count // columns)
    uneven = np.abs(np.log(columns / (rows * ratio))) + 2 * (rows * columns / count - 1)
    return int(columns[np.argmin(uneven.round(6))])


def _hillshade(elevation_m: np.ndarray, slope_deg: np.ndarray, resolution_m: float) -> np.ndarray:
    """White and black veils for a light in the north-west, RGBA, shape [B, H, W, 4].

    Level ground gets none, so that it has the colours of the bar. Heights are exaggerated by how steep
    the maps are, all by the same.
    """
    lift = np.clip(0.8 / np.tan(np.radians(np.percentile(slope_deg, 95) + 1e-3)), 0.1, 30)
    light = light_direction(np.array([0.75 * np.pi]), np.array([0.7]))
    ground_m = framed(lift * elevation_m.astype(np.float64))
    lit = shade(*horn_gradient(ground_m, resolution_m), light, 0.0) - light[0, 2]
    white = lit > 0
    return np.stack([white, white, white, 0.7 * np.abs(lit)], axis=-1)


def _draw_soft_ground(panel: Axes, edges: np.ndarray, line: float = 0.4) -> None:
    """Draws edges around ground that may hide soft spots, both ends of each, shape [M, 2, 2], in black on white."""
    for colour, width in (("white", 2.5 * line), ("black", line)):
        panel.add_collection(LineCollection(list(edges), colors=colour, linewidths=width))
