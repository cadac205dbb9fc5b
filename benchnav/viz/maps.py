"""Maps in metres, once for datasets, models, runs, playback and pages: colours, marks,
paths, and kinds of terrain.

Letters in shapes: H×W cells, N positions, M lines.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

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
from matplotlib.patheffects import AbstractPathEffect, Normal, withStroke
from matplotlib.transforms import Affine2D, ScaledTranslation
from scipy.sparse.csgraph import connected_components

from benchnav.core.grid import is_azimuth
from benchnav.viz.style import SKY, bytes_of

TRAVERSABILITY_COLOURS = "viridis"
LAMBDA: dict[str, Any] = {"cmap": TRAVERSABILITY_COLOURS, "vmin": 0, "vmax": 1}
SPREAD_COLOURS = "magma"  # certain cells are dark
MAX_SPREAD = 0.5  # of what lies in [0, 1]
LACKING = "0.7"  # cells without a value
# Dark red lies far from all colours of λ, for the colour-blind too.
IMMOBILISING = "#a00000"
SOFT = "white"
CLOSED = "0.25"  # cells that are not free
UNSEEN, VEIL = "0.6", 0.55  # over cells that were not seen, and its opacity
ROBOT = "#ff7800"  # as no λ is coloured
REACH = ROBOT  # how far its sensors reach
SEEN, SENSED = "0.9", SKY
_LAYER_COLOURS, _DIRECTION_COLOURS = "YlGnBu", "twilight"
_HATCH_CELLS = 4
_LENGTHS_M = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)  # of scale bars
_SCALE_FRACTION = 0.35  # of a map's width, which a scale bar stays under

# A tick, an hourglass and an arrowhead along x; a shape says in grey too how an episode
# ended.
_TICK, _HOURGLASS, _ARROWHEAD = (
    MarkerPath([*corners, corners[0]], closed=True)
    for corners in (
        [
            (-1, 0.05),
            (-0.62, 0.43),
            (-0.25, 0.05),
            (0.66, 0.95),
            (1, 0.6),
            (-0.25, -0.75),
        ],
        [(-0.8, 1), (0.8, 1), (-0.8, -1), (0.8, -1)],
        [(1, 0), (-0.8, 0.7), (-0.4, 0), (-0.8, -0.7)],
    )
)
# What stands at a position on a map, for `Axes.plot`.
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
# Which of `MARKS` stands where an episode ended, by its outcome; `failed` for all
# others.
_END_MARKS = {
    **{name: name for name in ("success", "immobilised")},
    **dict.fromkeys(("timeout", "stuck", "stalled"), "out of time"),
}
_LINE_WIDTH = 0.4  # of the thinnest line of a plan


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A driven path up to a moment.

    Args:
        track: positions in metres, shape [N, 2].
        goal_m: (x, y).
        outcome: how it ended; empty while the robot drives.
        heading_rad: of the robot, while it drives.
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
    """Draw a driven path with its start, its goal, and the robot or how the episode
    ended.

    Args:
        panel: in metres.
        drive: the path.
        width: of the path in points.
        scale: of the marks' sizes.
        colour: of the path.
        **style: of the path, as in `Axes.plot`.
    """
    draw_path(panel, drive.track, width, colour, **{"label": "_driven"} | style)
    mark(panel, "start", drive.track[0], scale)
    mark(panel, "goal", drive.goal_m, scale)
    end = drive.track[-1]
    if not drive.outcome:
        mark(panel, "robot", end, scale, marker=robot_marker(drive.heading_rad))
        return
    drawn = mark(panel, end_mark(drive.outcome), end, scale, clip_on=False)
    away = end - drive.goal_m
    if drive.outcome == "success" and away.any():
        # On the side away from the goal, which stays in sight.
        right, up = 0.9 * drawn.get_markersize() / 72 * away / np.linalg.norm(away)
        figure = panel.get_figure(root=True)
        assert figure is not None
        drawn.set_transform(
            panel.transData + ScaledTranslation(right, up, figure.dpi_scale_trans)
        )


def draw_path(
    panel: Axes, track: np.ndarray, width: float, colour: Any = "black", **style: Any
) -> list[Line2D]:
    """Draw a path over a map, on a white edge that parts it from any colour.

    Args:
        panel: in metres.
        track: positions, shape [N, 2].
        width: in points.
        colour: of the path.
        **style: of the path, as in `Axes.plot`.

    Returns:
        The edge and the path.
    """
    edge = panel.plot(
        *track.T, color="white", lw=width + 1.4, solid_capstyle="round", zorder=1.9
    )
    return edge + panel.plot(
        *track.T, color=colour, lw=width, solid_capstyle="round", **style
    )


def mark(
    panel: Axes, name: str, position_m: Any, scale: float = 1.0, **style: Any
) -> Line2D:
    """Mark a position on a map; return the mark.

    Args:
        panel: in metres.
        name: of `MARKS`.
        position_m: (x, y).
        scale: of the mark's size.
        **style: what differs, as in `Axes.plot`; a legend calls the mark by its name if
            `label` is not given.
    """
    (drawn,) = panel.plot(*position_m, **_looks(name, scale) | style)
    return drawn


def mark_handle(name: str, scale: float = 1.0, **style: Any) -> Line2D:
    """Return the entry of a legend for a mark."""
    return Line2D([], [], **_looks(name, scale) | style)


def _looks(name: str, scale: float) -> dict[str, Any]:
    return MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]}


def end_mark(outcome: str) -> str:
    """Return which of `MARKS` stands where an episode ended, by its outcome as tables
    of episodes have it.
    """
    return _END_MARKS.get(outcome, "failed")


def mark_ends(
    panel: Axes,
    tracks: Sequence[np.ndarray],
    outcomes: Sequence[str],
    colours: Sequence[Any],
) -> None:
    """Mark how several episodes on one map ended; marks that would overlap stand
    around, with a line to their end.

    Args:
        panel: in metres.
        tracks: of each, positions of shape [N, 2].
        outcomes: of each.
        colours: of each mark.
    """
    ends = np.array([track[-1] for track in tracks], np.float64).reshape(-1, 2)
    figure = panel.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()  # so that the size of a point on the map is known
    metre_pt = (
        np.diff(panel.transData.transform([(0, 0), (1, 0)])[:, 0])[0] * 72 / figure.dpi
    )
    apart_m = 1.3 * MARKS["immobilised"]["ms"] / metre_pt
    distances = np.linalg.norm(ends[:, None] - ends, axis=-1)
    _, labels = connected_components(distances < apart_m)
    for label in np.unique(labels):
        group = np.flatnonzero(labels == label).tolist()
        centre = ends[group].mean(axis=0)
        radius_m = (
            0.0 if len(group) == 1 else max(1.6 * apart_m, apart_m * len(group) / np.pi)
        )
        for turn, index in enumerate(group):
            # Beginning above, where most paths do not come from below.
            angle = 2 * np.pi * turn / len(group) + np.pi / 2
            position = centre + radius_m * np.array([np.cos(angle), np.sin(angle)])
            if len(group) > 1:
                draw_path(
                    panel,
                    np.stack((ends[index], position)),
                    0.7,
                    colours[index],
                    zorder=3.6,
                )
                panel.plot(
                    *ends[index],
                    "o",
                    ms=2.4,
                    color=colours[index],
                    mec="white",
                    mew=0.5,
                    zorder=3.7,
                )
            looks: dict[str, Any] = {
                "color": colours[index],
                "label": "_end",
                "clip_on": False,
            }
            mark(panel, end_mark(outcomes[index]), position, **looks)


def robot_marker(heading_rad: float) -> MarkerStyle:
    """Return the mark of a robot with a heading, as the `marker` of a line."""
    return MarkerStyle(_ARROWHEAD, transform=Affine2D().rotate(float(heading_rad)))


def show_map(panel: Axes, values: Any, extent_m: Iterable[float], **style: Any) -> Any:
    """Draw a map with its first row at the bottom and its axes in metres, which end
    where it ends.

    Args:
        panel: where.
        values: shape [H, W], or [H, W, 3] of colours.
        extent_m: width and height.
        **style: as in `Axes.imshow`.

    Returns:
        The image.
    """
    width, height = map(float, extent_m)
    panel.set(xlim=(0, width), ylim=(0, height))
    return panel.imshow(
        values,
        origin="lower",
        extent=(0, width, 0, height),
        interpolation="none",
        **style,
    )


def draw_bar(
    figure: Figure,
    label: str,
    panels: Any = None,
    scale: tuple[str, float] = (TRAVERSABILITY_COLOURS, 1.0),
    **style: Any,
) -> None:
    """Draw a colour bar at the right of panels.

    Args:
        figure: with the panels.
        label: of the bar.
        panels: that it is of; None for all.
        scale: colours, and the value of the lightest; the darkest is 0.
        **style: as in `Figure.colorbar`.
    """
    colours, most = scale
    shown = ScalarMappable(Normalize(0, most), colours)
    panels = figure.axes if panels is None else list(panels)
    figure.colorbar(shown, ax=panels, fraction=0.03, label=label, **style)


def overlay(
    panel: Axes,
    region: np.ndarray,
    extent_m: Iterable[float],
    colour: Any,
    opacity: float = 1.0,
) -> Any:
    """Draw a region of a map, bool of shape [H, W], in one colour over what is there;
    return the image.
    """
    shown = np.ma.masked_equal(np.asarray(region, float), 0)
    return show_map(
        panel, shown, extent_m, cmap=ListedColormap([to_rgba(colour, opacity)])
    )


def frame_map(panel: Axes) -> None:
    """Give a map's panel a frame all around, and numbers that are close to it."""
    panel.tick_params(pad=1.5)
    panel.spines[:].set_visible(True)


def name_terrain(panel: Axes, label: str, **look: Any) -> None:
    """Give a kind of terrain an entry in the legend, which images do not have."""
    panel.fill([], [], label=label, **look)


def name_immobilising(panel: Axes, immobilising: np.ndarray) -> None:
    """Give cells that immobilise a robot their entry in the legend, where a map has
    some.
    """
    if immobilising.any():
        name_terrain(panel, "immobilises a robot", color=IMMOBILISING)


def scale_length(width_m: float) -> float:
    """Return the length of a scale bar for a map of a width, in metres."""
    return max(
        length for length in _LENGTHS_M if length < max(_SCALE_FRACTION * width_m, 1)
    )


def draw_scale(panel: Axes, extent_m: tuple[float, float], size: float = 7.0) -> None:
    """Draw a scale bar below a map without axes.

    Args:
        panel: in metres.
        extent_m: width and height of the map.
        size: of the text in points.
    """
    width, height = extent_m
    length, below = scale_length(width), -0.05 * height
    panel.plot(
        [0, length],
        [below, below],
        color="black",
        lw=2,
        solid_capstyle="butt",
        clip_on=False,
    )
    panel.text(length + 0.02 * width, below, f"{length:g} m", va="center", size=size)


def hatching(region: np.ndarray, resolution_m: float) -> np.ndarray:
    """Compute diagonals through a region.

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


def draw_lines(
    panel: Axes, lines: np.ndarray, colour: Any, width: float, edge: Any = None
) -> None:
    """Draw lines on a map.

    Args:
        panel: in metres.
        lines: both ends of each, shape [M, 2, 2].
        colour: of the lines.
        width: in points.
        edge: colour of a wider line below each; None for none.
    """
    for look, line_width in ((edge, 2.5 * width), (colour, width)):
        if look is not None:
            panel.add_collection(
                LineCollection(list(lines), colors=[look], linewidths=line_width)
            )


def layer_scale(name: str, values: np.ndarray) -> dict[str, Any]:
    """Return how a layer is coloured, as keywords of `imshow`: from 0 or below to its
    maximum, or around the compass.

    Args:
        name: of the layer; one that ends in `_azimuth_deg` has directions.
        values: of any shape, NaN where unknown.
    """
    if is_azimuth(name):
        return {"cmap": with_lacking(_DIRECTION_COLOURS), "vmin": 0.0, "vmax": 360.0}
    low, high = (
        float(end(values[np.isfinite(values)], initial=0.0)) for end in (np.min, np.max)
    )
    return {
        "cmap": with_lacking(_LAYER_COLOURS),
        "vmin": low,
        "vmax": high if high > low else low + 1.0,
    }


def with_lacking(colours: str | np.ndarray) -> Colormap:
    """Return a colour map, by its name or by its colours of shape [C, 3], in which
    masked cells are grey.
    """
    named = (
        matplotlib.colormaps[colours]
        if isinstance(colours, str)
        else ListedColormap(list(colours))
    )
    return named.with_extremes(bad=LACKING)


def lacking_handle() -> Patch:
    """Return the entry of a legend for cells without a value."""
    return Patch(facecolor=LACKING, label="unknown")


class LayerStyle(NamedTuple):
    """How a layer of a plan is drawn.

    Args:
        label: what a legend calls it.
        colour: red, green, blue and opacity, in hexadecimal digits.
        width: over the thinnest line's.
        dashes: of the line, where lines can be dashed.
        effects: of the line, where it can have such: a white edge parts it from dark
            terrain.
    """

    label: str
    colour: str
    width: float
    dashes: str = "solid"
    effects: Sequence[AbstractPathEffect] = ()


_EDGED = (withStroke(linewidth=2.2, foreground="white"), Normal())
# From the undermost layer to the topmost.
STYLES: Mapping[str, LayerStyle] = {
    "tree": LayerStyle("tree", "#3c3c3c8c", 1),
    "samples": LayerStyle("samples", "#78b4ff6e", 1),
    "reference": LayerStyle("reference path", "#285affff", 3, "dashed", _EDGED),
    "path": LayerStyle("planned", "#00008cff", 3, "solid", _EDGED),
}


def draw_plan(panel: Axes, lines: Mapping[str, Sequence[np.ndarray]]) -> None:
    """Draw a plan on a map, of each layer of `STYLES` its lines."""
    for name, style in STYLES.items():
        if len(lines.get(name, ())):
            layer = LineCollection(
                list(lines[name]),
                colors=[style.colour],
                linewidths=_LINE_WIDTH * style.width,
                linestyles=style.dashes,
                label=style.label,
                path_effects=list(style.effects),
            )
            panel.add_collection(layer)


def driven_colours(
    track: np.ndarray, traversability: np.ndarray, width: float
) -> LineCollection:
    """Return a driven path, positions of shape [N, 2], in the colours of observed λ,
    shape [N − 1] or longer.

    It can be put on a map, and on a colour bar.
    """
    pieces = list(np.stack((track[:-1], track[1:]), axis=1))
    path = LineCollection(
        pieces,
        cmap=TRAVERSABILITY_COLOURS,
        linewidths=width,
        capstyle="round",
        zorder=2.5,
    )
    path.set_clim(0, 1)
    path.set_array(traversability[: len(pieces)])
    return path


def shades(values: np.ndarray, colours: str = TRAVERSABILITY_COLOURS) -> np.ndarray:
    """Colour λ, or what else lies in [0, 1]: uint8, from any shape to [..., 3]."""
    return np.round(255 * matplotlib.colormaps[colours](values)[..., :3]).astype(
        np.uint8
    )


def layer_colours(name: str, layer: np.ndarray) -> np.ndarray:
    """Colour a layer of shape [H, W], grey where unknown, as `field_colours` does."""
    scale = layer_scale(name, layer)
    shown = layer % 360 if is_azimuth(name) else layer
    fraction = (np.ma.masked_invalid(shown) - scale["vmin"]) / (
        scale["vmax"] - scale["vmin"]
    )
    return np.round(255 * scale["cmap"](fraction)[..., :3]).astype(np.uint8)


def veiled(colours: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Lay a veil over colours, uint8 of shape [H, W, 3], where the map was not seen,
    bool of shape [H, W].
    """
    veil = (1 - VEIL) * colours + VEIL * np.array(bytes_of(UNSEEN)[:3])
    return np.where(seen[..., None], colours, veil).round().astype(np.uint8)


def draw_reach(panel: Axes, outline_m: np.ndarray) -> None:
    """Draw how far sensors reach, lines of shape [N, 2] with NaN between them, on a
    map.
    """
    edge = [withStroke(linewidth=1.1, foreground="black"), Normal()]
    # One line with gaps, so that no piece has its edge on another.
    panel.plot(
        *outline_m.T,
        color=REACH,
        lw=0.6,
        path_effects=edge,
        label="reach of the sensors",
        zorder=2.2,
    )


def field_colours(field: np.ndarray, immobilising: np.ndarray) -> np.ndarray:
    """Colour λ, and in dark red the cells that immobilise a robot.

    Args:
        field: λ in [0, 1], shape [H, W].
        immobilising: bool, shape [H, W].

    Returns:
        Red, green and blue, uint8, shape [H, W, 3].
    """
    colours = shades(field)
    colours[immobilising] = bytes_of(IMMOBILISING)[:3]
    return colours
