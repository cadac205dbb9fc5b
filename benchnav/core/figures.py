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
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path as MarkerPath
from matplotlib.transforms import Affine2D, Bbox, ScaledTranslation

from benchnav.core.grid import is_azimuth
from benchnav.core.store import replacing

# Widths of a journal's column and of a page.
ONE_COLUMN_IN, TWO_COLUMNS_IN = 88 / 25.4, 180 / 25.4
TEXT, TITLE = 7.0, 8.0
_STRIP_IN = 0.2
DPI = 200

_STYLE: dict[Any, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "figure.titlesize"), TITLE),
    **dict.fromkeys(("axes.labelsize", "figure.labelsize"), TITLE),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), TEXT),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width", "grid.linewidth"), 0.5),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 2.0),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("figure.constrained_layout.h_pad", "figure.constrained_layout.w_pad"), 0.03),
    "hatch.linewidth": 0.7,
    "legend.handlelength": 2.2,
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
# Of paths and curves that lie over each other, which grey tells apart by these.
LINE_STYLES: tuple[Any, ...] = (
    "-",
    (0, (3.2, 1.2)),
    (0, (1, 1.1)),
    (0, (5, 1.2, 1, 1.2)),
    (0, (5, 1.2, 1, 1.2, 1, 1.2)),
)
# A tick, an hourglass and an arrowhead along x; a shape says in grey too how an episode ended.
_TICK, _HOURGLASS, _ARROWHEAD = (
    MarkerPath([*corners, corners[0]], closed=True)
    for corners in (
        [(-1, 0.05), (-0.62, 0.43), (-0.25, 0.05), (0.66, 0.95), (1, 0.6), (-0.25, -0.75)],
        [(-0.8, 1), (0.8, 1), (-0.8, -1), (0.8, -1)],
        [(1, 0), (-0.8, 0.7), (-0.4, 0), (-0.8, -0.7)],
    )
)
ROBOT = "#ff7800"  # as no λ is coloured

# What stands at a place on a map, for `Axes.plot`.
_WHITE_EDGED: dict[str, Any] = {"ls": "none", "mec": "white", "mew": 0.8, "zorder": 3}
_END: dict[str, Any] = {**_WHITE_EDGED, "color": "black", "ms": 7, "zorder": 4}
MARKS: dict[str, dict[str, Any]] = {
    "start": {**_WHITE_EDGED, "marker": "o", "color": "#e61e1e", "ms": 5},
    "goal": {**_WHITE_EDGED, "marker": "*", "color": "#ff00ff", "ms": 9},
    "robot": {**_WHITE_EDGED, "marker": _ARROWHEAD, "color": ROBOT, "mec": "black", "ms": 8, "zorder": 3.5},
    "arrived": {**_END, "marker": _TICK, "ms": 8},
    "immobilised": {**_END, "marker": "X"},
    "out of time": {**_END, "marker": _HOURGLASS},
    "failed": {**_END, "marker": "s", "ms": 6},
}

_PLANNERS = {
    "astar_dwa": ("A*+DWA", BLUE),
    "astar_mppi": ("A*+MPPI", PINK),
    "cl_rrt": ("CL-RRT", ORANGE),
    "mppi": ("MPPI", GREEN),
    "optimal": ("optimal", AMBER),
    "near_optimal": ("near-optimal", SKY),
    "straight": ("straight", BLIND),
}

# Of each shipped risk measure its name without a number, and with one.
_RISKS = {
    "mean": ("mean", "mean:{}"),
    "cvar": ("CVaR", "CVaR{lowered}"),
    "var": ("VaR", "VaR{lowered}"),
    "expected-time": ("expected time", "expected time (floor {})"),
    "time-cvar": ("time CVaR", "time CVaR{lowered}"),
    "chance": ("P(λ ≥ bound)", "P(λ ≥ {})"),
    "single-class": ("single class", "single-class CVaR{lowered}"),
}
_NUMBER = re.compile(r"\d+(\.\d+)?")
_LOWERED = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def styled() -> Any:
    """The style of all figures, as a context or as the decorator of a function that draws one."""
    return matplotlib.rc_context(_STYLE)


def planner_name(planner: str) -> str:
    """What figures call a planner, from its label: the name, and its options as they are."""
    name = re.split("[ :]", planner)[0]
    return _PLANNERS[name][0] + planner[len(name) :] if name in _PLANNERS else planner


def risk_name(risk: str) -> str:
    """What tables, figures and videos call a risk setting, from its label: `cvar:0.95` is CVaR₀.₉₅.

    Args:
        risk: a label. One that is not of a shipped measure with at most a number stays as it is.
    """
    measure, colon, number = risk.partition(":")
    if colon and not _NUMBER.fullmatch(number):
        return risk
    named, with_number = _RISKS.get(measure, (measure, f"{measure}:{{}}"))
    return with_number.format(number, lowered=number.translate(_LOWERED)) if colon else named


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


def mark(panel: Axes, name: str, place: Any, scale: float = 1.0, **style: Any) -> Line2D:
    """Marks a place on a map; gives the mark.

    Args:
        panel: in metres.
        name: of `MARKS`.
        place: (x, y).
        scale: of the mark's size.
        **style: what differs, as in `Axes.plot`; a legend calls the mark by its name, unless a `label` is there.
    """
    looks = MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]}
    (drawn,) = panel.plot(*place, **looks | style)
    return drawn


def mark_handle(name: str, scale: float = 1.0) -> Line2D:
    """The entry of a legend for a mark."""
    return Line2D([], [], **MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]})


def line_style(place: int) -> Any:
    """The style of the line that is drawn in this place among others."""
    return LINE_STYLES[place % len(LINE_STYLES)]


def robot_marker(heading_rad: float) -> MarkerStyle:
    """The mark of a robot that heads somewhere, as the `marker` of a line."""
    return MarkerStyle(_ARROWHEAD, transform=Affine2D().rotate(float(heading_rad)))


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


def save(
    figure: Figure,
    path: Path,
    kind: str,
    dpi: float | str = "figure",
    trim: bool = False,
    strip_in: float = 0.0,
) -> None:
    """Writes a figure with its fonts embedded.

    Args:
        figure: what was drawn.
        path: file to write.
        kind: png, pdf, svg or jpg.
        dpi: dots an inch; those of the figure where not given.
        trim: cut white borders away.
        strip_in: height of a strip over the figure that is written too.
    """
    box: Any = "tight" if trim else None
    if strip_in and not trim:
        box = Bbox.from_extents(0, 0, figure.get_figwidth(), figure.get_figheight() + strip_in)
    with matplotlib.rc_context(_SAVED):
        figure.savefig(path, format=kind, dpi=dpi, bbox_inches=box, pad_inches=0.05 if trim else 0)


def save_twice(figure: Figure, path: Path, trim: bool = False, dpi: float = DPI, mark: str = "") -> None:
    """Writes a figure as PNG and, beside it, as PDF; each whole or not at all.

    Args:
        figure: what was drawn.
        path: of the PNG; its folder is made.
        trim: cut white borders away; a figure made for a column keeps its width without.
        dpi: dots an inch.
        mark: a line that is drawn in a strip over the figure; none where empty.
    """
    # Laid out for good, so that both files are drawn alike and no layout is made twice.
    figure.set_dpi(dpi)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    if mark:
        over = figure.dpi_scale_trans + ScaledTranslation(0, figure.get_figheight(), figure.dpi_scale_trans)
        figure.text(
            0.05, 0.04, mark, transform=over, fontsize=TITLE, color=ORANGE, weight="bold", va="bottom"
        )
    for suffix in (".png", ".pdf"):
        with replacing(path.with_suffix(suffix)) as partial:
            save(figure, partial, suffix[1:], dpi, trim, _STRIP_IN if mark else 0.0)


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
