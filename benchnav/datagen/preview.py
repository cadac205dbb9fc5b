"""Pictures of maps: a sheet for a paper, a row a map, and a contact sheet of a whole split.

Lengths are in inches from the upper left corner and text is in points, as printed over the two columns
of a page. A class has one colour in every map and figure, its own of the class table; of classes that look alike
all but the first are drawn lighter or darker.
Where the classes have soft spots, the ground that may hide them is hatched and outlined.
"""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import MaxNLocator

from benchnav.core.errors import ConfigError
from benchnav.core.figures import (
    LACKING,
    TEXT,
    TITLE,
    TRAVERSABILITY_COLOURS,
    TWO_COLUMNS_IN,
    add_axes,
    add_bar,
    legend_at,
    mark,
    mark_handle,
    number_map,
    save,
    write,
)
from benchnav.core.grid import Grid
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import TerrainClass, look_alike_classes
from benchnav.datagen.schema import UNLABELLED
from benchnav.datagen.synth.appearance import light_direction, shade

TITLES = {
    "rgb": "RGB",
    "class_id": "Class",
    "elevation_m": "Elevation [m]",
    "slope_deg": "Slope [°]",
    "traversability": "Traversability λ",
}
STEEP_DEG = 30.0

_PAGE, _DPI = 9.4, 300.0
_LEFT, _RIGHT, _TOP, _FOOT, _GAP = 0.6, 0.06, 0.42, 0.94, 0.12
_LINE, _LETTER = 0.135, 0.054
_HATCH = "//////"
_READ_MAPS = 20
_MARK_SIZE = 0.75


def save_preview(dataset: TerrainDataset, split: str, indices: Sequence[int], path: Path, kind: str) -> None:
    """Writes a `preview_figure` to the file `path` in the format `kind`, such as png or pdf."""
    save(preview_figure(dataset, split, indices), path, kind)


def save_contact_sheet(dataset: TerrainDataset, split: str, path: Path, kind: str, most: int = 100) -> None:
    """Writes a `contact_sheet_figure` to the file `path` in the format `kind`, such as png or pdf."""
    save(contact_sheet_figure(dataset, split, most), path, kind)


def preview_figure(dataset: TerrainDataset, split: str, indices: Sequence[int]) -> Figure:
    """Draws maps of a split, a row each; the panel of a field has the label `FIELD ROW`.

    Args:
        dataset: where the maps are.
        split: name of a split.
        indices: which maps.

    Returns:
        A figure as wide as a page; narrower where panels shrink to fit a page.

    Raises:
        ConfigError: no map is asked for.
        DatasetError: there is no such split or map, or its data are damaged.
    """
    if not len(indices):
        raise ConfigError("Expected `indices` of at least one map, got none. Pass for example [0].")
    maps = dataset.read(split, indices, (*TITLES, "start_m", "goal_m"))
    maps["rgb"] = np.moveaxis(maps["rgb"], 1, -1)
    # Heights over each map's lowest point compare between maps; heights over a datum seldom do.
    maps["elevation_m"] = maps["elevation_m"] - maps["elevation_m"].min((1, 2), keepdims=True)
    classes, grid = dataset.recipe.classes, dataset.grid
    unlabelled = maps["class_id"] == UNLABELLED
    shown, colours = np.unique(maps["class_id"][~unlabelled]), class_colours(classes)
    maps["class_id"] = np.ma.masked_array(maps["class_id"], unlabelled)
    soft = soft_ground(maps["class_id"], classes)
    names = [f"{number} {classes[number].name.replace('_', ' ')}" for number in shown]
    sheet = _lay_out(grid, len(indices), names)
    figure = Figure(figsize=sheet.size, dpi=_DPI)
    relief_m = float(maps["elevation_m"].max()) or 1.0
    scales = _scales(relief_m, colours)
    levels = np.array(MaxNLocator(9, steps=[1, 2, 2.5, 5, 10]).tick_values(0, relief_m))
    levels = levels[levels <= relief_m]
    veils = _hillshade(maps["elevation_m"], maps["slope_deg"], grid.resolution_m)
    extent = (0.0, grid.extent_m[0], 0.0, grid.extent_m[1])
    for row, index in enumerate(indices):
        for column, field in enumerate(TITLES):
            panel = add_axes(figure, sheet.place(row, column), f"{field} {row}")
            _draw_image(panel, maps[field][row], extent, **scales[field])
            if field == "elevation_m":
                _draw_image(panel, veils[row], extent)
                _draw_contours(panel, maps[field][row], levels, grid)
            if field == "class_id":
                _draw_soft_ground(panel, soft[row], extent, hatched=True)
            if field == "traversability":
                _draw_soft_ground(panel, soft[row], extent)
            for name in ("start", "goal"):
                mark(panel, name, maps[f"{name}_m"][row], _MARK_SIZE, clip_on=False)
            number_map(panel, sheet.panel, left=column == 0, bottom=row == len(indices) - 1)
        write(figure, 0.1, sheet.down[row], f"map {index}", rotation=90, ha="center", va="center")
    for centre, title in zip(sheet.across, TITLES.values(), strict=True):
        write(figure, centre, _TOP - 0.05, title, size=TITLE, ha="center", va="bottom")
    write(figure, 0.25, sheet.down.mean(), "y [m]", rotation=90, ha="center", va="center")
    write(figure, sheet.across[2], sheet.bottom + 0.2, "x [m]", ha="center", va="top")
    write(figure, _LEFT, 0.06, f"{dataset.id}, split {split}", size=TITLE, va="top")
    _draw_bars(figure, sheet, levels)
    lacking = bool(unlabelled.any() or np.isnan(maps["traversability"]).any())
    extra = _extra_marks(lacking, bool(soft.any()))
    _draw_legends(figure, sheet, names, colours[shown], extra)
    return figure


def contact_sheet_figure(dataset: TerrainDataset, split: str, most: int = 100) -> Figure:
    """Draws a thumbnail of the colour image of every map of a split, in order, row by row.

    Where the classes have soft spots, the ground that may hide them is outlined, and the stored λ stands
    to the right of each image.

    Args:
        dataset: where the maps are.
        split: name of a split.
        most: of a larger split, the first so many maps are drawn.

    Returns:
        A figure about as wide as high; the thumbnails are the images of its one axes.

    Raises:
        ConfigError: `most` is less than 1.
        DatasetError: there is no such split, or its data are damaged.
    """
    if most < 1:
        raise ConfigError(f"Expected `most` ≥ 1, got {most}.")
    held, grid = dataset.map_count(split), dataset.grid
    classes = dataset.recipe.classes
    paired = any(item.soft for item in classes)
    across = grid.width * (2 if paired else 1)
    count, ratio, gap = min(held, most), grid.height / across, 0.05
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
    write(figure, gap, 0.05, "\n".join(lines), size=TITLE, va="top")
    sheet = add_axes(figure, (0, 0, width, height), "thumbnails")
    sheet.set(xlim=(0, width), ylim=(height, 0), autoscale_on=False)
    sheet.axis("off")
    outline: list[AbstractPathEffect] = [withStroke(linewidth=1.4, foreground="black")]
    for first in range(0, count, _READ_MAPS):
        fields = ("rgb", "class_id", "traversability") if paired else ("rgb",)
        block = dataset.read(split, range(first, min(first + _READ_MAPS, count)), fields)
        for place, rgb in enumerate(np.moveaxis(block["rgb"], 1, -1)):
            index = first + place
            x, y = gap + index % columns * (wide + gap), top + index // columns * (high + gap)
            image = np.concatenate([rgb, _coloured(block["traversability"][place])], 1) if paired else rgb
            _draw_image(sheet, image, (x, x + wide, y + high, y))
            if paired:
                soft = soft_ground(block["class_id"][place], classes)
                _draw_soft_ground(sheet, soft, (x, x + wide / 2, y + high, y), line=0.2)
            label = sheet.text(x + 0.03, y + 0.03, str(index), size=TEXT, color="white", va="top")
            label.set_path_effects(outline)
    return figure


def soft_ground(class_id: np.ndarray, classes: Sequence[TerrainClass]) -> np.ndarray:
    """Cells whose class has soft spots, bool, shape of `class_id`."""
    soft = np.zeros(UNLABELLED + 1, dtype=bool)
    soft[: len(classes)] = [item.soft is not None for item in classes]
    return soft[class_id]


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


def _shades_of_traversability() -> Colormap:
    return matplotlib.colormaps[TRAVERSABILITY_COLOURS].with_extremes(bad=LACKING)


def _coloured(traversability: np.ndarray) -> np.ndarray:
    """λ in the colours of the sheets, from [H, W] to uint8 [H, W, 3]."""
    return _shades_of_traversability()(np.ma.masked_invalid(traversability), bytes=True)[..., :3]


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


@dataclass(frozen=True, kw_only=True)
class _Sheet:
    """Where things stand: sizes of figure, panel and column; middles of columns and rows; the last row's end.

    A panel stands in the middle of its column and row. The class legend stands under the first two
    columns, or, where it is long, under everything.
    """

    size: tuple[float, float]
    panel: tuple[float, float]
    column: float
    across: np.ndarray
    down: np.ndarray
    bottom: float
    legend_top: float
    legend_columns: int

    def place(self, row: int, column: int) -> tuple[float, float, float, float]:
        wide, high = self.panel
        return self.across[column] - wide / 2, self.down[row] - high / 2, wide, high


def _lay_out(grid: Grid, rows: int, names: Sequence[str]) -> _Sheet:
    ratio, columns = grid.height / grid.width, len(TITLES)
    widest = (TWO_COLUMNS_IN - _LEFT - _RIGHT + _GAP) / columns - _GAP
    high = min(widest * ratio, 2.0, max((_PAGE - _TOP - 1.1) / rows - _GAP, 0.8))
    column, row = max(high / ratio, 0.95), max(high, 0.5)
    bottom = _TOP + rows * (row + _GAP) - _GAP
    width = _LEFT + columns * (column + _GAP) - _GAP + _RIGHT
    entry = 0.28 + _LETTER * max(map(len, names))
    narrow, broad = (max(1, int(room / entry)) for room in (2 * column + _GAP, width - _LEFT))
    beneath = len(names) > 6 * narrow
    legend_columns, legend_top = (broad, bottom + _FOOT) if beneath else (narrow, bottom + 0.34)
    lowest = max(bottom + _FOOT, legend_top + _LINE * -(-len(names) // legend_columns) + 0.03)
    return _Sheet(
        size=(width, lowest),
        panel=(high / ratio, high),
        column=column,
        across=_LEFT + column / 2 + np.arange(columns) * (column + _GAP),
        down=_TOP + row / 2 + np.arange(rows) * (row + _GAP),
        bottom=bottom,
        legend_top=legend_top,
        legend_columns=legend_columns,
    )


def _scales(relief_m: float, colours: np.ndarray) -> dict[str, dict[str, Any]]:
    """How each field is drawn: keywords of `imshow`."""
    return {
        "rgb": {},
        "class_id": {"cmap": class_shades(colours), "vmin": -0.5, "vmax": len(colours) - 0.5},
        "elevation_m": {"cmap": "cividis", "vmin": 0, "vmax": relief_m},
        "slope_deg": {"cmap": "magma_r", "vmin": 0, "vmax": STEEP_DEG},
        "traversability": {"cmap": _shades_of_traversability(), "vmin": 0, "vmax": 1},
    }


def _hillshade(elevation_m: np.ndarray, slope_deg: np.ndarray, resolution_m: float) -> np.ndarray:
    """White and black veils for a light in the north-west, RGBA, shape [B, H, W, 4].

    Level ground gets none, so that it has the colours of the bar. Heights are exaggerated by how steep
    the maps are, all by the same.
    """
    lift = np.clip(0.8 / np.tan(np.radians(np.percentile(slope_deg, 95) + 1e-3)), 0.1, 30)
    light = light_direction(np.array([0.75 * np.pi]), np.array([0.7]))
    lit = shade(lift * elevation_m.astype(np.float64), resolution_m, light, 0.0) - light[0, 2]
    colour = np.repeat((lit > 0).astype(np.float64)[..., None], 3, axis=-1)
    return np.concatenate([colour, 0.7 * np.abs(lit)[..., None]], axis=-1)


def _draw_image(
    panel: Axes, values: np.ndarray, extent: tuple[float, float, float, float], **style: Any
) -> None:
    panel.imshow(values, origin="lower", extent=extent, aspect="auto", interpolation="none", **style)


def _draw_contours(panel: Axes, elevation_m: np.ndarray, levels: np.ndarray, grid: Grid) -> None:
    crossed = levels[(levels > elevation_m.min()) & (levels < elevation_m.max())]
    if len(crossed):
        y, x = ((np.arange(cells) + 0.5) * grid.resolution_m for cells in grid.shape)
        panel.contour(x, y, elevation_m, levels=crossed, colors="black", linewidths=0.35, alpha=0.7)


def _draw_soft_ground(
    panel: Axes,
    soft: np.ndarray,
    extent: tuple[float, float, float, float],
    hatched: bool = False,
    line: float = 0.4,
) -> None:
    """Outlines the cells of bool [H, W] that may hide soft spots, by the cells' own edges, in black on white."""
    if not soft.any() or (soft.all() and not hatched):
        return
    left, right, bottom, top = extent
    # Two points a cell, next to its edges, so that contours keep to the edges.
    along_y, along_x = (
        np.repeat(np.arange(cells) / cells, 2) + np.tile([1e-4, 1 - 1e-4], cells) / cells
        for cells in soft.shape
    )
    x, y = left + (right - left) * along_x, bottom + (top - bottom) * along_y
    member = np.repeat(np.repeat(soft, 2, axis=0), 2, axis=1).astype(np.float64)
    if hatched:
        panel.contourf(x, y, member, levels=[0.5, 1.5], colors="none", hatches=[_HATCH])
    if not soft.all():
        panel.contour(x, y, member, levels=[0.5], colors="white", linewidths=2.5 * line)
        panel.contour(x, y, member, levels=[0.5], colors="black", linewidths=line)


def _draw_bars(figure: Figure, sheet: _Sheet, levels: np.ndarray) -> None:
    drawn = {str(panel.get_label()): panel.images[0] for panel in figure.axes}
    wide = sheet.column - 0.12
    # Neither the colour image nor the classes have numbers to read off.
    for field, middle in list(zip(TITLES, sheet.across, strict=True))[2:]:
        place = (middle - wide / 2, sheet.bottom + 0.44, wide, 0.07)
        extend = "max" if field == "slope_deg" else "neither"
        bar = add_bar(figure, drawn[f"{field} 0"], place, f"{field} bar", extend)
        if field == "elevation_m":
            bar.vlines(levels, 0, 1, color="black", lw=0.35, alpha=0.7)
            label = f"above the lowest point,\ncontours every {levels[1]:g} m"
            bar.set_xlabel(label, size=TEXT, labelpad=1.5, linespacing=1.1)


def _extra_marks(lacking: bool, soft: bool) -> list[Artist]:
    """Entries of the legend for what few maps show."""
    marks: list[Artist] = []
    if lacking:
        marks.append(Patch(facecolor=LACKING, label="not known"))
    if soft:
        marks.append(Patch(facecolor="white", ec="black", lw=0.5, hatch=_HATCH, label="may hide soft spots"))
    return marks


def _draw_legends(
    figure: Figure, sheet: _Sheet, names: Sequence[str], colours: np.ndarray, extra: Sequence[Artist]
) -> None:
    """Explains the marks over the panels, and the classes under the first two columns."""
    marks: list[Artist] = [mark_handle(name, scale=_MARK_SIZE) for name in ("start", "goal")]
    marks += extra
    legend_at(figure, marks, (sheet.size[0] - _RIGHT, 0.06), len(marks), "upper right")
    legend_at(figure, class_patches(names, colours), (_LEFT, sheet.legend_top), sheet.legend_columns)
