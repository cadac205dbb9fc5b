"""Pictures of maps: a sheet for a paper, a row a map, and a contact sheet of a whole split.

Lengths are in inches from the upper left corner and text is in points, as printed over the two columns
of a page. A class has one colour in every map and figure. The earth tones of the class table look too
alike, so their order from dark to light is kept and stretched, and every other class is drawn blue.
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
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from benchnav.datagen.appearance import light_direction, shade
from benchnav.datagen.latent import TerrainClass
from benchnav.datagen.store import TerrainDataset
from benchnav.errors import ConfigError
from benchnav.terrain import Grid

PANELS = {
    "rgb": "RGB",
    "class_id": "Class",
    "elevation_m": "Elevation [m]",
    "slope_deg": "Slope [°]",
    "traversability": "Traversability λ",
}
STEEP_DEG = 30.0

_WIDTH, _PAGE, _DPI = 7.2, 9.4, 300.0
_LEFT, _TOP, _GAP, _FOOT = 0.6, 0.42, 0.12, 0.85
_TEXT, _TITLE, _LINE, _LETTER = 7.0, 8.0, 0.14, 0.062
_UNOBSERVED = "0.7"
_READ_MAPS = 20
_MARKS: dict[str, dict[str, Any]] = {
    "start": {"marker": "o", "ms": 3.6, "mfc": "white", "mec": "black", "mew": 0.8, "ls": "none"},
    "goal": {"marker": "*", "ms": 6.5, "mfc": "white", "mec": "black", "mew": 0.7, "ls": "none"},
}
# Ladders of equal lightness in Oklab; brown against blue is told apart by every kind of colour vision.
_EARTH = LinearSegmentedColormap.from_list("earth", ["#472400", "#8d591d", "#cc9967", "#ffe0bf"])
_BLUE = LinearSegmentedColormap.from_list("blue", ["#092f52", "#35699d", "#79a9db", "#caecff"])


def save_preview(dataset: TerrainDataset, split: str, indices: Sequence[int], path: Path, kind: str) -> None:
    """Writes `preview_figure` to the file `path` in the format `kind`, such as png or pdf."""
    _save(preview_figure(dataset, split, indices), path, kind)


def save_contact_sheet(dataset: TerrainDataset, split: str, path: Path, kind: str, most: int = 100) -> None:
    """Writes `contact_sheet_figure` to the file `path` in the format `kind`, such as png or pdf."""
    _save(contact_sheet_figure(dataset, split, most), path, kind)


def preview_figure(dataset: TerrainDataset, split: str, indices: Sequence[int]) -> Figure:
    """Draws maps of a split, a row each; a panel has the label `FIELD ROW`.

    Args:
        dataset: where the maps are.
        split: name of a split.
        indices: which maps.

    Returns:
        A figure 7.2 inches wide; narrower where panels shrink to fit a page.

    Raises:
        ConfigError: no map is asked for.
        DatasetError: there is no such split or map, or its data are damaged.
    """
    if not len(indices):
        raise ConfigError("Expected `indices` of at least one map, got none. Pass for example [0].")
    maps = dataset.read(split, indices, (*PANELS, "start_m", "goal_m"))
    # Heights above each map's lowest point compare between maps; heights above a datum seldom do.
    maps["elevation_m"] = maps["elevation_m"] - maps["elevation_m"].min((1, 2), keepdims=True)
    classes, grid = dataset.recipe.classes, dataset.grid
    shown = np.unique(maps["class_id"])
    names = [f"{number} {classes[number].name.replace('_', ' ')}" for number in shown]
    sheet = _lay_out(grid, len(indices), names)
    figure = Figure(figsize=(sheet.width, sheet.height), dpi=_DPI)
    colours = class_colours(classes)
    scales = _scales(float(maps["elevation_m"].max()), colours)
    levels = MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]).tick_values(0, scales["elevation_m"]["vmax"])
    hills = _hillshade(maps["elevation_m"], maps["slope_deg"], grid.resolution_m)
    images: dict[str, AxesImage] = {}
    for row, index in enumerate(indices):
        for column, field in enumerate(PANELS):
            panel = _add_axes(figure, *sheet.place(row, column), label=f"{field} {row}")
            values = np.moveaxis(maps["rgb"][row], 0, -1) if field == "rgb" else maps[field][row]
            images[field] = _draw(panel, values, grid, **scales[field])
            if field == "elevation_m":
                _draw(panel, hills[row], grid)
                _draw_contours(panel, values, levels, grid)
            for name, style in _MARKS.items():
                panel.plot(*maps[f"{name}_m"][row], **style)
            _tick(panel, sheet, left=column == 0, bottom=row == len(indices) - 1)
        _write(figure, 0.1, sheet.middle(row), f"map {index}", rotation=90, va="center", ha="center")
    for column, title in enumerate(PANELS.values()):
        _write(figure, sheet.centre(column), _TOP - 0.05, title, ha="center", va="bottom", size=_TITLE)
    _write(figure, 0.27, (_TOP + sheet.bottom) / 2, "y [m]", rotation=90, ha="center", va="center")
    _write(figure, sheet.centre(2), sheet.bottom + 0.2, "x [m]", ha="center", va="top")
    _write(figure, _LEFT, 0.06, f"{dataset.id}, split {split}", va="top", size=_TITLE)
    _draw_bars(figure, sheet, images, levels)
    _draw_legends(figure, sheet, names, colours[shown], bool(np.isnan(maps["traversability"]).any()))
    return figure


def contact_sheet_figure(dataset: TerrainDataset, split: str, most: int = 100) -> Figure:
    """Draws a thumbnail of the colour image of every map of a split, in order, row by row.

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
    count, ratio, gap = min(held, most), grid.height / grid.width, 0.05
    columns = contact_columns(count, ratio)
    wide = min(max((_WIDTH - gap) / columns, 0.5 / min(1, ratio)), 2.4) - gap
    high, width = wide * ratio, columns * (wide + gap) + gap
    number = f"{held} maps" if count == held else f"first {count} of {held} maps"
    title = f"{dataset.id}, split {split} (scenario {dataset.splits[split]['scenario']}): {number}"
    lines = textwrap.wrap(title, int(width / _LETTER / 1.15))
    top = 0.1 + _LINE * len(lines)
    height = top + -(-count // columns) * (high + gap)
    # A whole number of dots a cell keeps the cells of a thumbnail of one size.
    dots = max(1, round(_DPI * wide / grid.width)) * grid.width / wide
    figure = Figure(figsize=(width, height), dpi=dots if dots <= 2 * _DPI else _DPI)
    _write(figure, gap, 0.05, "\n".join(lines), va="top", size=_TITLE)
    sheet = _add_axes(figure, 0, 0, width, height, label="thumbnails")
    sheet.set(xlim=(0, width), ylim=(height, 0), autoscale_on=False)
    sheet.axis("off")
    outline = [withStroke(linewidth=1.4, foreground="black")]
    for first in range(0, count, _READ_MAPS):
        block = dataset.read(split, range(first, min(first + _READ_MAPS, count)), ("rgb",))["rgb"]
        for index, rgb in enumerate(block, start=first):
            x, y = gap + index % columns * (wide + gap), top + index // columns * (high + gap)
            place = {"extent": (x, x + wide, y + high, y), "origin": "lower", "aspect": "auto"}
            sheet.imshow(np.moveaxis(rgb, 0, -1), interpolation="none", **place)
            style = {"size": _TEXT, "color": "white", "va": "top", "path_effects": outline}
            sheet.text(x + 0.03, y + 0.03, str(index), **style)
    return figure


def class_colours(classes: Sequence[TerrainClass]) -> np.ndarray:
    """Colours to draw classes in: RGB in [0, 1], in the table's order from dark to light, shape [C, 3]."""
    luminance = np.array([item.colour for item in classes]) @ (0.2126, 0.7152, 0.0722)
    rank = np.argsort(np.argsort(luminance, kind="stable"), kind="stable")
    place = rank / max(len(classes) - 1, 1)
    return np.where((rank % 2 == 0)[:, None], _EARTH(place), _BLUE(place))[:, :3]


def contact_columns(count: int, ratio: float) -> int:
    """Columns that make a grid about as wide as high with few places empty.

    Args:
        count: number of thumbnails.
        ratio: height over width of a thumbnail.
    """
    columns = np.arange(1, count + 1)
    rows = -(-count // columns)
    uneven = np.abs(np.log(columns / (rows * ratio)))
    return int(columns[::-1][np.argmin((uneven + 2 * (rows * columns / count - 1))[::-1])])


@dataclass(frozen=True, kw_only=True)
class _Sheet:
    """Where things stand on a preview.

    Args:
        panel: width and height of a panel, which is centred in its column and row.
        column: width of a column.
        row: height of a row.
        rows: number of rows.
        legend_columns: columns of the class legend, which stands under the first two columns.
        height: of the figure.
    """

    panel: tuple[float, float]
    column: float
    row: float
    rows: int
    legend_columns: int
    height: float

    @property
    def width(self) -> float:
        return self.left(len(PANELS)) - _GAP + 0.06

    @property
    def bottom(self) -> float:
        return _TOP + self.rows * (self.row + _GAP) - _GAP

    def left(self, column: int) -> float:
        return _LEFT + column * (self.column + _GAP)

    def centre(self, column: int) -> float:
        return self.left(column) + self.column / 2

    def middle(self, row: int) -> float:
        return _TOP + row * (self.row + _GAP) + self.row / 2

    def place(self, row: int, column: int) -> tuple[float, float, float, float]:
        wide, high = self.panel
        return self.centre(column) - wide / 2, self.middle(row) - high / 2, wide, high


def _lay_out(grid: Grid, rows: int, names: Sequence[str]) -> _Sheet:
    ratio = grid.height / grid.width
    widest = (_WIDTH - _LEFT - 0.06 + _GAP) / len(PANELS) - _GAP
    high = min(widest * ratio, 2.0, max((_PAGE - _TOP - _FOOT) / rows - _GAP, 0.8))
    column, row = max(high / ratio, 0.95), max(high, 0.5)
    across = max(1, int((2 * column + _GAP) / (0.3 + _LETTER * max(map(len, names)))))
    foot = max(_FOOT, 0.35 + _LINE * -(-len(names) // across))
    height = _TOP + rows * (row + _GAP) - _GAP + foot
    return _Sheet(
        panel=(high / ratio, high), column=column, row=row, rows=rows, legend_columns=across, height=height
    )


def _scales(relief_m: float, colours: np.ndarray) -> dict[str, dict[str, Any]]:
    """How each field is drawn: keywords of `imshow`."""
    seen = matplotlib.colormaps["viridis"].with_extremes(bad=_UNOBSERVED)
    return {
        "rgb": {},
        "class_id": {"cmap": ListedColormap(list(colours)), "vmin": -0.5, "vmax": len(colours) - 0.5},
        "elevation_m": {"cmap": "cividis", "vmin": 0, "vmax": relief_m or 1},
        "slope_deg": {"cmap": "magma_r", "vmin": 0, "vmax": STEEP_DEG},
        "traversability": {"cmap": seen, "vmin": 0, "vmax": 1},
    }


def _hillshade(elevation_m: np.ndarray, slope_deg: np.ndarray, resolution_m: float) -> np.ndarray:
    """Veils, shape [B, H, W, 4], that darken what faces away from a light in the north-west; and back.

    Level ground gets none, so that it has the colours of the bar. Heights are exaggerated by how steep
    all maps are, alike on all.
    """
    lift = np.clip(0.8 / np.tan(np.radians(np.percentile(slope_deg, 95) + 1e-3)), 0.1, 30)
    light = light_direction(np.array([0.75 * np.pi]), np.array([0.7]))
    lit = shade(lift * elevation_m.astype(np.float64), resolution_m, light, 0.0) - 0.7
    veils = np.repeat((lit > 0)[..., None].astype(np.float64), 4, axis=-1)
    veils[..., 3] = np.where(lit > 0, 0.9, 0.7) * np.abs(lit)
    return veils


def _draw(panel: Axes, values: np.ndarray, grid: Grid, **style: Any) -> AxesImage:
    wide, high = grid.extent_m
    return panel.imshow(values, origin="lower", extent=(0, wide, 0, high), interpolation="none", **style)


def _draw_contours(panel: Axes, elevation_m: np.ndarray, levels: np.ndarray, grid: Grid) -> None:
    crossed = levels[(levels > elevation_m.min()) & (levels < elevation_m.max())]
    if len(crossed):
        y, x = ((np.arange(cells) + 0.5) * grid.resolution_m for cells in grid.shape)
        panel.contour(x, y, elevation_m, levels=crossed, colors="black", linewidths=0.35, alpha=0.7)


def _tick(panel: Axes, sheet: _Sheet, left: bool, bottom: bool) -> None:
    for axis, inches in zip((panel.xaxis, panel.yaxis), sheet.panel, strict=True):
        # The last tick is left out where it would touch the next panel's first.
        bins = int(np.clip(inches / 0.3, 1, 4))
        axis.set_major_locator(MaxNLocator(bins, steps=[1, 2, 5, 10], prune="upper"))
    panel.tick_params(labelsize=_TEXT, length=2, width=0.5, pad=1.5, labelleft=left, labelbottom=bottom)
    panel.spines[:].set_linewidth(0.5)


def _draw_bars(figure: Figure, sheet: _Sheet, images: dict[str, AxesImage], levels: np.ndarray) -> None:
    """Draws a colour bar under each column that has a scale in units."""
    for column, field in enumerate(PANELS):
        if field in ("rgb", "class_id"):
            continue
        bar = _add_axes(figure, sheet.left(column), sheet.bottom + 0.46, sheet.column, 0.07, f"{field} bar")
        over = "max" if field == "slope_deg" else "neither"
        figure.colorbar(images[field], cax=bar, orientation="horizontal", extend=over)
        bar.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
        bar.tick_params(labelsize=_TEXT, length=2, width=0.5, pad=1.5)
        if field == "elevation_m":
            bar.vlines(levels, 0, 1, color="black", lw=0.35, alpha=0.7)
            bar.set_xlabel("above the lowest point", size=_TEXT, labelpad=1.5)


def _draw_legends(
    figure: Figure, sheet: _Sheet, names: Sequence[str], colours: np.ndarray, unobserved: bool
) -> None:
    """Explains the marks over the panels, and the classes under the first two columns."""
    marks: list[Artist] = [Line2D([], [], label=name, **style) for name, style in _MARKS.items()]
    if unobserved:
        marks.append(Patch(facecolor=_UNOBSERVED, label="unobserved"))
    classes = [Patch(facecolor=c, ec="0.3", lw=0.4, label=n) for n, c in zip(names, colours, strict=True)]
    right = sheet.left(len(PANELS)) - _GAP
    for handles, corner, x, y, columns in (
        (marks, "upper right", right, 0.06, len(marks)),
        (classes, "upper left", _LEFT, sheet.bottom + 0.32, sheet.legend_columns),
    ):
        legend = figure.legend(
            handles=handles, loc=corner, bbox_to_anchor=(x / sheet.width, 1 - y / sheet.height), ncols=columns,
            fontsize=_TEXT, frameon=False, borderpad=0, borderaxespad=0, handlelength=1.1, handletextpad=0.4,
            columnspacing=1, labelspacing=0.3,
        )  # fmt: skip
        for text in legend.get_texts():
            text.set_parse_math(False)


def _add_axes(figure: Figure, left: float, top: float, wide: float, high: float, label: str) -> Axes:
    width, height = figure.get_size_inches()
    place = (left / width, 1 - (top + high) / height, wide / width, high / height)
    return figure.add_axes(place, label=label)


def _write(figure: Figure, left: float, top: float, text: str, size: float = _TEXT, **style: Any) -> None:
    width, height = figure.get_size_inches()
    figure.text(left / width, 1 - top / height, text, size=size, parse_math=False, **style)


def _save(figure: Figure, path: Path, kind: str) -> None:
    # Type 42 embeds whole fonts, as publishers ask; composed images would be sampled anew in a PDF.
    with matplotlib.rc_context({"pdf.fonttype": 42, "image.composite_image": False}):
        figure.savefig(path, format=kind, dpi="figure")
