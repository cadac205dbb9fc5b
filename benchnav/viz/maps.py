"""Maps in metres: colours, marks, paths, and kinds of terrain.

Letters in shapes: H×W cells; N positions; M lines; C colours.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Patch
from matplotlib.path import Path as MarkerPath
from matplotlib.transforms import Affine2D, ScaledTranslation
from scipy.sparse.csgraph import connected_components

from benchnav.core.grid import is_azimuth
from benchnav.viz.style import SKY, bytes_of

TRAVERSABILITY_COLOURS = "viridis"
LAMBDA: dict[str, Any] = {"cmap": TRAVERSABILITY_COLOURS, "vmin": 0, "vmax": 1}
SPREAD_COLOURS = "magma"  # certain cells are dark
MAX_SPREAD = 0.5  # maximum standard deviation of a quantity in [0, 1]
LACKING = "0.7"  # cells without a value
# Dark red differs from all colours of λ, for all kinds of colour vision.
IMMOBILISING = "#a00000"
SOFT = "white"
CLOSED = "0.25"  # non-free cells
UNSEEN, VEIL = "0.6", 0.55  # colour over unobserved cells, and its opacity
ROBOT = "#ff7800"  # not a colour of λ
REACH = ROBOT  # outline of the sensors' range
SEEN, SENSED = "0.9", SKY
_LAYER_COLOURS, _DIRECTION_COLOURS = "YlGnBu", "twilight"
_HATCH_CELLS = 4
_LENGTHS_M = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)  # of scale bars
_SCALE_FRACTION = 0.35  # maximum length of a scale bar over the map's width


def _polygon(*corners: tuple[float, float]) -> MarkerPath:
    return MarkerPath([*corners, corners[0]], closed=True)


# Shapes indicate in greyscale how an episode ended; the arrowhead points along x.
_TICK = _polygon(
    (-1, 0.05), (-0.62, 0.43), (-0.25, 0.05), (0.66, 0.95), (1, 0.6), (-0.25, -0.75)
)
_HOURGLASS = _polygon((-0.8, 1), (0.8, 1), (-0.8, -1), (0.8, -1))
_ARROWHEAD = _polygon((1, 0), (-0.8, 0.7), (-0.4, 0), (-0.8, -0.7))
# Marks at a position on a map, as keywords of `Axes.plot`.
_WHITE_EDGED: dict[str, Any] = {"ls": "none", "mec": "white", "mew": 0.8, "zorder": 3}
_END: dict[str, Any] = {**_WHITE_EDGED, "color": "black", "ms": 6, "zorder": 4}
MARKS: dict[str, dict[str, Any]] = {
    "start": {**_WHITE_EDGED, "marker": "o", "color": "#e61e1e", "ms": 5},
    "goal": {**_WHITE_EDGED, "marker": "*", "color": "#ff00ff", "ms": 9},
    "robot": {
        **_WHITE_EDGED,
        "marker": _ARROWHEAD,
        "color": ROBOT,
        "mec": "black",
        "ms": 8,
        "zorder": 3.5,
    },
    "success": {**_END, "marker": _TICK, "ms": 7},
    "immobilised": {**_END, "marker": "X"},
    "out of time": {**_END, "marker": _HOURGLASS},
    "failed": {**_END, "marker": "s", "ms": 5},
}
# Name in `MARKS` by outcome; `failed` for all others.
_END_MARKS = {
    "success": "success",
    "immobilised": "immobilised",
    **dict.fromkeys(("timeout", "stuck", "stalled"), "out of time"),
}


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A driven path up to a point in time.

    Args:
        track: positions in metres, shape [N, 2].
        goal_m: position of the goal (x, y) in metres.
        outcome: outcome of the episode; empty before its end.
        heading_rad: heading of the robot, before the end.
    """

    track: np.ndarray
    goal_m: np.ndarray
    outcome: str = ""
    heading_rad: float = 0.0


def draw_drive(
    panel: Axes,
    drive: Drive,
    width: float = 1.4,
    scale: float = 1.0,
    colour: Any = "black",
    **style: Any,
) -> None:
    """Draw a driven path with start, goal, and the robot or the mark of the outcome.

    Args:
        panel: panel in metres.
        drive: driven path.
        width: width of the path in points.
        scale: factor of the sizes of marks.
        colour: colour of the path.
        **style: style of the path, as in `Axes.plot`.
    """
    draw_path(panel, drive.track, width, colour, **{"label": "_driven"} | style)
    mark(panel, "start", drive.track[0], scale)
    mark(panel, "goal", drive.goal_m, scale)
    end = drive.track[-1]
    if not drive.outcome:
        mark(panel, "robot", end, scale, marker=robot_marker(drive.heading_rad))
        return
    drawn = mark(panel, end_mark(drive.outcome), end, scale, clip_on=False)
    from_goal = end - drive.goal_m
    if drive.outcome == "success" and from_goal.any():
        # Shift the mark away from the goal, so that it does not cover it.
        size_in = 0.9 * drawn.get_markersize() / 72
        right, up = size_in * from_goal / np.linalg.norm(from_goal)
        figure = panel.get_figure(root=True)
        assert figure is not None
        shift = ScaledTranslation(right, up, figure.dpi_scale_trans)
        drawn.set_transform(panel.transData + shift)


def draw_path(
    panel: Axes, track: np.ndarray, width: float, colour: Any = "black", **style: Any
) -> list[Line2D]:
    """Draw a path over a map, with a white edge; return the edge and the path.

    Args:
        panel: panel in metres.
        track: positions in metres, shape [N, 2].
        width: width in points.
        colour: colour of the path.
        **style: style of the path, as in `Axes.plot`.
    """
    cap: dict[str, Any] = {"solid_capstyle": "round"}
    edge = panel.plot(*track.T, color="white", lw=width + 1.4, zorder=1.9, **cap)
    return edge + panel.plot(*track.T, color=colour, lw=width, **cap, **style)


def mark(
    panel: Axes, name: str, position_m: Any, scale: float = 1.0, **style: Any
) -> Line2D:
    """Draw a mark at a position on a map, and return it.

    Args:
        panel: panel in metres.
        name: name in `MARKS`.
        position_m: position (x, y) in metres.
        scale: factor of the mark's size.
        **style: overriding style, as in `Axes.plot`; by default `label` is the name.
    """
    (drawn,) = panel.plot(*position_m, **_looks(name, scale) | style)
    return drawn


def mark_handle(name: str, scale: float = 1.0, **style: Any) -> Line2D:
    """Return the entry of a legend for a mark."""
    return Line2D([], [], **_looks(name, scale) | style)


def _looks(name: str, scale: float) -> dict[str, Any]:
    return MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]}


def end_mark(outcome: str) -> str:
    """Return the name in `MARKS` for an outcome as in tables of episodes."""
    return _END_MARKS.get(outcome, "failed")


def mark_ends(
    panel: Axes,
    tracks: Sequence[np.ndarray],
    outcomes: Sequence[str],
    colours: Sequence[Any],
) -> None:
    """Mark the outcomes of several episodes on one map.

    Marks that would overlap are arranged on a circle, each with a line to its end.

    Args:
        panel: panel in metres.
        tracks: driven path of each episode, positions in metres, shape [N, 2].
        outcomes: outcome of each episode.
        colours: colour of each mark.
    """
    ends = np.array([track[-1] for track in tracks], np.float64).reshape(-1, 2)
    figure = panel.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()  # fixes the size of a point on the map
    origin_x, unit_x = panel.transData.transform([(0, 0), (1, 0)])[:, 0]
    metre_pt = (unit_x - origin_x) * 72 / figure.dpi
    apart_m = 1.3 * MARKS["immobilised"]["ms"] / metre_pt
    distances = np.linalg.norm(ends[:, None] - ends, axis=-1)
    _, labels = connected_components(distances < apart_m)
    for label in np.unique(labels):
        group = np.flatnonzero(labels == label).tolist()
        n_marks = len(group)
        centre = ends[group].mean(axis=0)
        radius_m = 0.0
        if n_marks > 1:
            radius_m = max(1.6 * apart_m, apart_m * n_marks / np.pi)
        for turn, index in enumerate(group):
            # Start at the top, since most paths do not come from below.
            angle = 2 * np.pi * turn / n_marks + np.pi / 2
            position = centre + radius_m * np.array([np.cos(angle), np.sin(angle)])
            colour = colours[index]
            if n_marks > 1:
                line = np.stack((ends[index], position))
                draw_path(panel, line, 0.7, colour, zorder=3.6)
                dot: dict[str, Any] = {"ms": 2.4, "color": colour, "zorder": 3.7}
                panel.plot(*ends[index], "o", mec="white", mew=0.5, **dot)
            look: dict[str, Any] = {"color": colour, "label": "_end", "clip_on": False}
            mark(panel, end_mark(outcomes[index]), position, **look)


def robot_marker(heading_rad: float) -> MarkerStyle:
    """Return an arrowhead along a heading, as the `marker` of a line."""
    return MarkerStyle(_ARROWHEAD, transform=Affine2D().rotate(float(heading_rad)))


def show_map(panel: Axes, values: Any, extent_m: Iterable[float], **style: Any) -> Any:
    """Draw a map with its first row at the bottom, over the whole panel in metres.

    Args:
        panel: panel to draw on.
        values: values of shape [H, W], or colours of shape [H, W, 3].
        extent_m: width and height in metres.
        **style: style, as in `Axes.imshow`.

    Returns:
        The image.
    """
    width, height = map(float, extent_m)
    panel.set(xlim=(0, width), ylim=(0, height))
    extent = (0, width, 0, height)
    return panel.imshow(
        values, origin="lower", extent=extent, interpolation="none", **style
    )


def draw_bar(
    figure: Figure,
    label: str,
    panels: Any = None,
    scale: tuple[str, float] = (TRAVERSABILITY_COLOURS, 1.0),
    **style: Any,
) -> None:
    """Draw a colour bar to the right of panels.

    Args:
        figure: figure with the panels.
        label: label of the bar.
        panels: panels that it belongs to; if None, all.
        scale: name of the colour map, and the maximum value; the minimum is 0.
        **style: style, as in `Figure.colorbar`.
    """
    colours, maximum = scale
    mappable = ScalarMappable(Normalize(0, maximum), colours)
    panels = figure.axes if panels is None else list(panels)
    figure.colorbar(mappable, ax=panels, fraction=0.03, label=label, **style)


def overlay(
    panel: Axes,
    region: np.ndarray,
    extent_m: Iterable[float],
    colour: Any,
    opacity: float = 1.0,
) -> Any:
    """Draw a region of a map in a single colour, and return the image.

    Args:
        panel: panel in metres.
        region: bool, shape [H, W].
        extent_m: width and height in metres.
        colour: colour of the region.
        opacity: opacity of the colour, in [0, 1].
    """
    values = np.ma.masked_equal(np.asarray(region, float), 0)
    colours = ListedColormap([to_rgba(colour, opacity)])
    return show_map(panel, values, extent_m, cmap=colours)


def frame_map(panel: Axes) -> None:
    """Draw a frame around a map's panel, with tick labels close to it."""
    panel.tick_params(pad=1.5)
    panel.spines[:].set_visible(True)


def name_terrain(panel: Axes, label: str, **look: Any) -> None:
    """Add a kind of terrain to the legend, since images have no entry."""
    panel.fill([], [], label=label, **look)


def name_immobilising(panel: Axes, immobilising: np.ndarray) -> None:
    """Add immobilising cells to the legend, if a map has any."""
    if immobilising.any():
        name_terrain(panel, "immobilises a robot", color=IMMOBILISING)


def scale_length(width_m: float) -> float:
    """Return the length of a scale bar for a map of a given width, in metres."""
    limit_m = max(_SCALE_FRACTION * width_m, 1)
    return max(length for length in _LENGTHS_M if length < limit_m)


def draw_scale(panel: Axes, extent_m: tuple[float, float], size: float = 7.0) -> None:
    """Draw a scale bar below a map without axes.

    Args:
        panel: panel in metres.
        extent_m: width and height of the map in metres.
        size: size of the text in points.
    """
    width, height = extent_m
    length = scale_length(width)
    below = -0.05 * height
    style: dict[str, Any] = {"color": "black", "lw": 2, "solid_capstyle": "butt"}
    panel.plot([0, length], [below, below], clip_on=False, **style)
    panel.text(length + 0.02 * width, below, f"{length:g} m", va="center", size=size)


def hatching(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Compute diagonals through a region.

    Args:
        region: bool, shape [H, W].
        resolution_m: edge length of a cell in metres.

    Returns:
        Ends (x, y) of each diagonal of a cell in metres, float32, shape [M, 2, 2].
    """
    rows, columns = np.nonzero(region)
    is_drawn = (rows - columns) % _HATCH_CELLS == 0
    corners = np.stack((columns[is_drawn], rows[is_drawn]), axis=1)
    ends = np.stack((corners, corners + 1), axis=1)
    return (ends * resolution_m).astype(np.float32)


def draw_lines(
    panel: Axes, lines: np.ndarray, colour: Any, width: float, edge: Any = None
) -> None:
    """Draw lines on a map.

    Args:
        panel: panel in metres.
        lines: ends (x, y) of each line in metres, shape [M, 2, 2].
        colour: colour of the lines.
        width: width in points.
        edge: colour of a wider line below each; if None, there is no edge.
    """
    for line_colour, line_width in ((edge, 2.5 * width), (colour, width)):
        if line_colour is not None:
            panel.add_collection(
                LineCollection(list(lines), colors=[line_colour], linewidths=line_width)
            )


def layer_scale(name: str, values: np.ndarray) -> dict[str, Any]:
    """Return the colour scale of a layer, as keywords of `imshow`.

    It ranges from 0, or the minimum if that is lower, to the maximum; that of an
    azimuth is cyclic.

    Args:
        name: name of the layer; azimuths end in `_azimuth_deg`.
        values: values of any shape, NaN where unknown.
    """
    if is_azimuth(name):
        return {"cmap": with_lacking(_DIRECTION_COLOURS), "vmin": 0.0, "vmax": 360.0}
    finite = values[np.isfinite(values)]
    low = float(np.min(finite, initial=0.0))
    high = float(np.max(finite, initial=0.0))
    if high <= low:
        high = low + 1.0
    return {"cmap": with_lacking(_LAYER_COLOURS), "vmin": low, "vmax": high}


def with_lacking(colours: str | np.ndarray) -> Colormap:
    """Return a colour map with grey for masked cells.

    Args:
        colours: name of a colour map, or its colours of shape [C, 3].
    """
    if isinstance(colours, str):
        return matplotlib.colormaps[colours].with_extremes(bad=LACKING)
    return ListedColormap(list(colours)).with_extremes(bad=LACKING)


def lacking_handle() -> Patch:
    """Return the entry of a legend for cells without a value."""
    return Patch(facecolor=LACKING, label="unknown")


def shades(values: np.ndarray, colours: str = TRAVERSABILITY_COLOURS) -> np.ndarray:
    """Return colours of values in [0, 1], uint8, from any shape to [..., 3]."""
    return _bytes(matplotlib.colormaps[colours](values))


def layer_colours(name: str, layer: np.ndarray) -> np.ndarray:
    """Return colours of a layer, uint8, grey where unknown, [H, W] to [H, W, 3]."""
    scale = layer_scale(name, layer)
    shown = layer % 360 if is_azimuth(name) else layer
    low, high = scale["vmin"], scale["vmax"]
    return _bytes(scale["cmap"]((np.ma.masked_invalid(shown) - low) / (high - low)))


def _bytes(colours: np.ndarray) -> np.ndarray:
    return np.round(255 * colours[..., :3]).astype(np.uint8)


def veiled(colours: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return colours with a veil over unobserved cells, uint8, shape [H, W, 3].

    Args:
        colours: uint8, shape [H, W, 3].
        seen: observed cells, bool, shape [H, W].
    """
    veil = (1 - VEIL) * colours + VEIL * np.array(bytes_of(UNSEEN)[:3])
    return np.where(seen[..., None], colours, veil).round().astype(np.uint8)


def field_colours(field: np.ndarray, immobilising: np.ndarray) -> np.ndarray:
    """Return colours of λ, with immobilising cells in dark red.

    Args:
        field: λ in [0, 1], shape [H, W].
        immobilising: bool, shape [H, W].

    Returns:
        Red, green and blue, uint8, shape [H, W, 3].
    """
    colours = shades(field)
    colours[immobilising] = bytes_of(IMMOBILISING)[:3]
    return colours
