"""One style for the figures of datasets, models and evaluation: sizes, colours, marks, names, and how they are saved.

Sizes are in inches and points as printed. Colours are distinct to every kind of colour vision. Source: Okabe and
Ito (2008), "Color universal design".
"""

import itertools
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D

from benchnav.core.grid import is_azimuth
from benchnav.core.store import replacing

# Widths of a journal's column and of a page.
ONE_COLUMN_IN, TWO_COLUMNS_IN = 88 / 25.4, 180 / 25.4
TEXT, TITLE = 7.0, 8.0
DPI = 200

_STYLE: dict[Any, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "figure.titlesize"), TITLE),
    **dict.fromkeys(("axes.labelsize", "figure.labelsize"), TITLE),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), TEXT),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width", "grid.linewidth"), 0.5),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 2.0),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("figure.constrained_layout.h_pad", "figure.constrained_layout.w_pad"), 0.03),
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
}
# Type 42 embeds whole fonts, as publishers ask; composed images would be sampled anew in a PDF.
_SAVED: dict[Any, Any] = {"pdf.fonttype": 42, "image.composite_image": False}

BLUE, ORANGE, GREEN, PINK, AMBER, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
# Yellow, the last, is lost on white: lines on white have the others alone.
COLOURS = (BLUE, ORANGE, GREEN, PINK, AMBER, SKY, "#000000", "#F0E442")
LINE_COLOURS = COLOURS[:-1]
BLIND = "0.45"

TRAVERSABILITY_COLOURS = "viridis"
_LAYER_COLOURS, _DIRECTION_COLOURS = "YlGnBu", "twilight"
_HATCH_CELLS = 4
# Of cells of which nothing is known.
LACKING = "0.7"

MARKERS = "osD^vP*X<"
# What stands at a place on a map, for `Axes.plot`.
_WHITE_EDGED: dict[str, Any] = {"ls": "none", "mec": "white", "mew": 0.8, "zorder": 3}
MARKS: dict[str, dict[str, Any]] = {
    "start": {**_WHITE_EDGED, "marker": "o", "color": "#e61e1e", "ms": 5},
    "goal": {**_WHITE_EDGED, "marker": "*", "color": "#ff00ff", "ms": 9},
    "robot": {**_WHITE_EDGED, "marker": "o", "color": "black", "ms": 5},
    "end": {**_WHITE_EDGED, "marker": "X", "color": "black", "ms": 7, "zorder": 4},
}

_PLANNERS = {
    "astar_dwa": ("A* + DWA", BLUE),
    "astar_mppi": ("A* + MPPI", PINK),
    "cl_rrt": ("CL-RRT", ORANGE),
    "mppi": ("MPPI", GREEN),
    "straight": ("straight", BLIND),
}


def styled() -> Any:
    """The style of all figures, as a context or as the decorator of a function that draws one."""
    return matplotlib.rc_context(_STYLE)


def planner_name(planner: str) -> str:
    """What figures call a planner, from its label: the name, and its options as they are."""
    name = re.split("[ :]", planner)[0]
    return _PLANNERS[name][0] + planner[len(name) :] if name in _PLANNERS else planner


def planner_colours(planners: Sequence[str]) -> dict[str, str]:
    """Colours of planners by their labels: a shipped planner has the same one in every figure.

    Args:
        planners: labels; others than the shipped take colours that are left.
    """
    own = {planner: _PLANNERS[planner][1] for planner in planners if planner in _PLANNERS}
    left = [colour for colour in LINE_COLOURS if colour not in own.values()]
    others = [planner for planner in dict.fromkeys(planners) if planner not in own]
    return own | {planner: left[place % len(left)] for place, planner in enumerate(others)}


def condition_colours(planners: Sequence[str], palette: Sequence[str] = COLOURS) -> list[str]:
    """Colours of conditions that are shown together.

    Args:
        planners: of each condition; where no two are alike, each has its planner's colour. Else the conditions take
            those of the palette in turn, but for the blind baseline, which is grey.
        palette: begun anew where it is used up.
    """
    own, turn = planner_colours(planners), itertools.cycle(palette)
    alike = len(own) < len(planners)
    return [own[planner] if not alike or own[planner] == BLIND else next(turn) for planner in planners]


def bytes_of(colour: Any) -> tuple[int, ...]:
    """Red, green, blue and opacity of a colour, in [0, 255]."""
    return tuple(round(255 * value) for value in to_rgba(colour))


def mark(panel: Axes, name: str, place: Any, scale: float = 1.0, **style: Any) -> None:
    """Marks a place on a map.

    Args:
        panel: in metres.
        name: of `MARKS`.
        place: (x, y).
        scale: of the mark's size.
        **style: what differs, as in `Axes.plot`; a legend calls the mark by its name, unless a `label` is there.
    """
    looks = MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]}
    panel.plot(*place, **looks | style)


def mark_handle(name: str, scale: float = 1.0) -> Line2D:
    """The entry of a legend for a mark."""
    return Line2D([], [], **MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]})


def draw_edged(panel: Axes, track: Any, width: float, colour: Any = "black", **style: Any) -> None:
    """Draws a path over a map, on a white edge that parts it from any colour.

    Args:
        panel: in metres.
        track: positions, shape [N, 2].
        width: in points.
        colour: of the path.
        **style: of the path, as in `Axes.plot`.
    """
    panel.plot(*track.T, color="white", lw=width + 1.4, solid_capstyle="round", zorder=1.9)
    panel.plot(*track.T, color=colour, lw=width, solid_capstyle="round", **style)


def show_map(panel: Axes, values: Any, extent_m: Iterable[float], **style: Any) -> Any:
    """Draws a map with its first row at the bottom and its axes in metres, which end where it ends; gives the image.

    Args:
        panel: where.
        values: shape [H, W], or [H, W, 3] of colours.
        extent_m: width and height.
        **style: as in `Axes.imshow`.
    """
    width, height = map(float, extent_m)
    panel.set(xlim=(0, width), ylim=(0, height))
    return panel.imshow(values, origin="lower", extent=(0, width, 0, height), interpolation="none", **style)


def outline(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Finds the edges between cells of a region and those that are not of it, the map's border among them.

    Args:
        region: bool, shape [H, W].
        resolution_m: edge length of a cell.

    Returns:
        Both ends (x, y) of each edge in metres, float32, shape [M, 2, 2].
    """
    framed = np.pad(region, 1)
    rows, columns = np.nonzero(np.diff(framed[:, 1:-1], axis=0))
    along_x = np.stack((columns, rows, columns + 1, rows), axis=1)
    rows, columns = np.nonzero(np.diff(framed[1:-1], axis=1))
    along_y = np.stack((columns, rows, columns, rows + 1), axis=1)
    edges = np.concatenate((along_x, along_y)).reshape(-1, 2, 2)
    return (edges * resolution_m).astype(np.float32)


def hatching(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Draws diagonals through a region, which tell it from what it surrounds.

    Args:
        region: bool, shape [H, W].
        resolution_m: edge length of a cell.

    Returns:
        Both ends (x, y) of each diagonal of a cell in metres, float32, shape [M, 2, 2].
    """
    rows, columns = np.nonzero(region)
    drawn = (rows - columns) % _HATCH_CELLS == 0
    corners = np.stack((columns[drawn], rows[drawn]), axis=1)
    return (np.stack((corners, corners + 1), axis=1) * resolution_m).astype(np.float32)


def stack_panels(figure: Figure, count: int, across: int, layers: int = 1, **shared: Any) -> list[Any]:
    """Divides a figure into places, row by row, each with panels under each other; what is left over is removed.

    Args:
        figure: empty.
        count: number of places.
        across: places side by side, at most `count`.
        layers: panels of a place.
        **shared: as in `Figure.subplots`.

    Returns:
        Of each place its panels, downward.
    """
    down = -(-count // across)
    panels = figure.subplots(layers * down, across, squeeze=False, **shared)
    stacks = [stack for row in np.split(panels, down) for stack in row.T]
    for place in range(count, len(stacks)):
        for panel in stacks[place]:
            panel.remove()
        stacks[place - across][-1].tick_params(labelbottom=True)
    return stacks[:count]


def legend_outside(
    figure: Figure,
    handles: Sequence[Artist] = (),
    columns: int = 4,
    side: Any = "lower center",
) -> Legend:
    """Lays a legend beside the panels, at a side of the figure: what has a label in them, once each, then the handles.

    A figure that has a label of all its x-axes has its legend over the panels, as both would be in one place.
    """
    labelled: dict[str, Artist] = {}
    for panel in figure.axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            labelled.setdefault(label, handle)
    return figure.legend(handles=[*labelled.values(), *handles], loc="outside " + side, ncols=columns)


def frame_map(panel: Axes) -> None:
    """Gives a map's panel a frame all around, and numbers that are close to it."""
    panel.tick_params(pad=1.5)
    panel.spines[:].set_visible(True)


def save(figure: Figure, path: Path, kind: str, dpi: float | str = "figure", trim: bool = False) -> None:
    """Writes a figure with its fonts embedded.

    Args:
        figure: what was drawn.
        path: file to write.
        kind: png, pdf, svg or jpg.
        dpi: dots an inch; those of the figure where not given.
        trim: cut white borders away.
    """
    with matplotlib.rc_context(_SAVED):
        figure.savefig(path, format=kind, dpi=dpi, bbox_inches="tight" if trim else None, pad_inches=0.05)


def save_twice(figure: Figure, path: Path, trim: bool = False, dpi: float = DPI) -> None:
    """Writes a figure as PNG and, beside it, as PDF; each whole or not at all.

    Args:
        figure: what was drawn.
        path: of the PNG; its folder is made.
        trim: cut white borders away; a figure made for a column keeps its width without.
        dpi: dots an inch.
    """
    # Laid out for good, so that both files are drawn alike and no layout is made twice.
    figure.set_dpi(dpi)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    for suffix in (".png", ".pdf"):
        with replacing(path.with_suffix(suffix)) as partial:
            save(figure, partial, suffix[1:], dpi, trim)


def layer_scale(name: str, values: np.ndarray) -> dict[str, Any]:
    """How a layer is coloured, as keywords of `imshow`: from 0 or below to its greatest value, or around the compass.

    Args:
        name: of the layer; one that ends in `_azimuth_deg` holds directions.
        values: of any shape, NaN where nothing is known.
    """
    if is_azimuth(name):
        return {"cmap": _colour_map(_DIRECTION_COLOURS), "vmin": 0.0, "vmax": 360.0}
    low, high = (float(end(values[np.isfinite(values)], initial=0.0)) for end in (np.min, np.max))
    return {"cmap": _colour_map(_LAYER_COLOURS), "vmin": low, "vmax": high if high > low else low + 1.0}


def _colour_map(name: str) -> Colormap:
    return matplotlib.colormaps[name].with_extremes(bad=LACKING)
