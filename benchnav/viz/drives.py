"""Drawing of driven paths on maps, with marks of start, goal, robot and outcome.

Letters in shapes: N positions; W wheels or other contacts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path as MarkerPath
from matplotlib.transforms import Affine2D, ScaledTranslation
from scipy.sparse.csgraph import connected_components

from benchnav.viz.bodies import draw_body
from benchnav.viz.maps import ROBOT


def _polygon(*corners: tuple[float, float]) -> MarkerPath:
    return MarkerPath([*corners, corners[0]], closed=True)


# Shapes of marks, which distinguish outcomes even in greyscale. The arrowhead points
# along x.
_TICK = _polygon(
    (-1, 0.05), (-0.62, 0.43), (-0.25, 0.05), (0.66, 0.95), (1, 0.6), (-0.25, -0.75)
)
_HOURGLASS = _polygon((-0.8, 1), (0.8, 1), (-0.8, -1), (0.8, -1))
_ARROWHEAD = _polygon((1, 0), (-0.8, 0.7), (-0.4, 0), (-0.8, -0.7))
# Marks at a position on a map, by name, as keywords of `Axes.plot`.
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
# Name in `MARKS` by outcome; all other outcomes have the mark `failed`.
_END_MARKS = {
    "success": "success",
    "immobilised": "immobilised",
    **dict.fromkeys(("timeout", "stuck", "stalled"), "out of time"),
}


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A driven path up to a point in time.

    Args:
        track: positions (x, y) in metres, shape [N, 2].
        goal_m: position (x, y) of the goal in metres, shape [2].
        outcome: outcome of the episode; empty before the end of the episode.
        heading_rad: heading of the robot in radians from +x towards +y; used only before
            the end of the episode, or with contacts.
        contacts_m: contacts (x, y) of the robot with the terrain in metres, shape
            [W, 2]; None for a point, which is drawn as an arrowhead.
        ruts_m: depth of each wheel's rut in metres, shape [W]; None if unknown.
    """

    track: np.ndarray
    goal_m: np.ndarray
    outcome: str = ""
    heading_rad: float = 0.0
    contacts_m: np.ndarray | None = None
    ruts_m: np.ndarray | None = None


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
        panel: panel with axes in metres.
        drive: driven path.
        width: width of the path in points.
        scale: factor by which the sizes of marks are multiplied.
        colour: colour of the path.
        **style: further keywords of `Axes.plot` for the path.
    """
    path_style = {"label": "_driven"} | style
    draw_path(panel, drive.track, width, colour, **path_style)
    mark(panel, "start", drive.track[0], scale)
    mark(panel, "goal", drive.goal_m, scale)
    end = drive.track[-1]
    if drive.contacts_m is not None:
        pose = np.append(end, drive.heading_rad)
        draw_body(panel, pose, drive.contacts_m, drive.ruts_m)
    if not drive.outcome:
        if drive.contacts_m is not None:
            return
        mark(panel, "robot", end, scale, marker=robot_marker(drive.heading_rad))
        return
    drawn = mark(panel, end_mark(drive.outcome), end, scale, clip_on=False)
    from_goal = end - drive.goal_m
    if drive.outcome == "success" and from_goal.any():
        # Shift the mark away from the goal's mark, so as not to cover it.
        size_in = 0.9 * drawn.get_markersize() / 72
        right_in, up_in = size_in * from_goal / np.linalg.norm(from_goal)
        figure = panel.get_figure(root=True)
        assert figure is not None
        shift = ScaledTranslation(right_in, up_in, figure.dpi_scale_trans)
        drawn.set_transform(panel.transData + shift)


def draw_path(
    panel: Axes, track: np.ndarray, width: float, colour: Any = "black", **style: Any
) -> list[Line2D]:
    """Draw a path over a map, with a white edge; return the edge and the path.

    Args:
        panel: panel with axes in metres.
        track: positions (x, y) in metres, shape [N, 2].
        width: width of the path in points, without the edge.
        colour: colour of the path.
        **style: further keywords of `Axes.plot` for the path.
    """
    cap: dict[str, Any] = {"solid_capstyle": "round"}
    edge = panel.plot(*track.T, color="white", lw=width + 1.4, zorder=1.9, **cap)
    path = panel.plot(*track.T, color=colour, lw=width, **cap, **style)
    return edge + path


def mark(
    panel: Axes, name: str, position_m: Any, scale: float = 1.0, **style: Any
) -> Line2D:
    """Draw a mark at a position on a map, and return it.

    Args:
        panel: panel with axes in metres.
        name: name in `MARKS`.
        position_m: position (x, y) in metres, shape [2].
        scale: factor by which the mark's size is multiplied.
        **style: keywords of `Axes.plot` that replace those in `MARKS`; the default of
            `label` is the name.
    """
    (drawn,) = panel.plot(*position_m, **_mark_style(name, scale) | style)
    return drawn


def mark_handle(name: str, scale: float = 1.0, **style: Any) -> Line2D:
    """Return a legend entry for a mark; the arguments are those of `mark`."""
    return Line2D([], [], **_mark_style(name, scale) | style)


def _mark_style(name: str, scale: float) -> dict[str, Any]:
    return MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]}


def end_mark(outcome: str) -> str:
    """Return the name in `MARKS` for an outcome, as named in tables of episodes."""
    return _END_MARKS.get(outcome, "failed")


def mark_ends(
    panel: Axes,
    tracks: Sequence[np.ndarray],
    outcomes: Sequence[str],
    colours: Sequence[Any],
) -> None:
    """Mark the outcomes of several episodes on one map.

    Marks that would overlap are arranged on a circle, each with a line to the end of
    its path.

    Args:
        panel: panel with axes in metres.
        tracks: driven path of each episode, positions (x, y) in metres, shape [N, 2].
        outcomes: outcome of each episode.
        colours: colour of each mark.
    """
    ends = np.array([track[-1] for track in tracks], np.float64).reshape(-1, 2)
    figure = panel.get_figure(root=True)
    assert figure is not None
    figure.draw_without_rendering()  # fixes the scale from metres to points
    pixels = panel.transData.transform([(0, 0), (1, 0)])
    metre_px = pixels[1, 0] - pixels[0, 0]
    metre_pt = metre_px * 72 / figure.dpi
    spacing_m = 1.3 * MARKS["immobilised"]["ms"] / metre_pt
    mark_style: dict[str, Any] = {"label": "_end", "clip_on": False}
    dot_style: dict[str, Any] = {"ms": 2.4, "mec": "white", "mew": 0.5, "zorder": 3.7}
    for index, position in enumerate(_spread(ends, spacing_m)):
        colour = colours[index]
        end = ends[index]
        if (position != end).any():
            draw_path(panel, np.stack((end, position)), 0.7, colour, zorder=3.6)
            panel.plot(*end, "o", color=colour, **dot_style)
        mark(panel, end_mark(outcomes[index]), position, color=colour, **mark_style)


def _spread(positions: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return positions, shape [N, 2], after moving close positions apart.

    Each group of positions closer than the spacing is arranged on a circle.
    """
    distances = np.linalg.norm(positions[:, None] - positions, axis=-1)
    _, labels = connected_components(distances < spacing_m)
    spread = positions.copy()
    for label in np.unique(labels):
        group = np.flatnonzero(labels == label)
        count = len(group)
        if count == 1:
            continue
        radius_m = max(1.6 * spacing_m, spacing_m * count / np.pi)
        # Start at the top, since most paths do not come from below.
        angles = 2 * np.pi * np.arange(count) / count + np.pi / 2
        offsets = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        spread[group] = positions[group].mean(axis=0) + radius_m * offsets
    return spread


def robot_marker(heading_rad: float) -> MarkerStyle:
    """Return an arrowhead along a heading, for the argument `marker` of a line."""
    return MarkerStyle(_ARROWHEAD, transform=Affine2D().rotate(float(heading_rad)))
