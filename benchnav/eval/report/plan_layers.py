"""What is drawn over a map, once for figures and playback: plans, ends, and ground that is soft or immobilises a robot.

Letters in shapes: H×W cells, N positions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, withStroke
from matplotlib.transforms import ScaledTranslation

from benchnav.core.figures import MARKS, ROBOT, SKY, TRAVERSABILITY_COLOURS, bytes_of, hatching, layer_scale
from benchnav.core.grid import is_azimuth, outline
from benchnav.eval.recording import KnownMap

# Dark red lies far from all colours of λ, for the colour-blind too.
IMMOBILISING = "#a00000"
SOFT = "white"
CLOSED = "0.25"  # ground that is not free
UNSEEN, VEIL = "0.6", 0.55  # what lies over ground that was not seen, and its opacity
REACH = ROBOT  # how far its sensors reach
SPREAD_COLOURS = "magma"  # what is known is dark
MOST_SPREAD = 0.5  # of what lies in [0, 1]
_SEEN, _SENSED = "0.9", SKY
# Which of `MARKS` stands where an episode ended, by its outcome; `failed` for all others.
_END_MARKS = {
    "success": "arrived",
    "immobilised": "immobilised",
    **dict.fromkeys(("timeout", "stuck", "stalled"), "out of time"),
}
_CAME_CELLS = 2.0  # over which a path shows where it came from

_LINE_WIDTH = 0.4  # of the thinnest line of a plan


@dataclass(frozen=True, kw_only=True)
class LayerStyle:
    """How a layer of a plan is drawn.

    Args:
        label: what a legend calls it.
        colour: red, green, blue and opacity, in hexadecimal digits.
        width: over the thinnest line's.
        dashed: where lines can be.
        edged: on white, which parts it from dark ground, where lines can be.
    """

    label: str
    colour: str
    width: float
    dashed: bool = False
    edged: bool = False


# From the undermost layer to the topmost.
STYLES: Mapping[str, LayerStyle] = {
    "tree": LayerStyle(label="tree", colour="#3c3c3c8c", width=1),
    "samples": LayerStyle(label="samples", colour="#78b4ff6e", width=1),
    "reference": LayerStyle(label="reference path", colour="#285affff", width=3, dashed=True, edged=True),
    "path": LayerStyle(label="planned", colour="#00008cff", width=3, edged=True),
}


def plan_layer(style: LayerStyle, lines: Sequence[np.ndarray] = (), scale: float = 1.0) -> LineCollection:
    """A layer of a plan as lines that can be put on a map, so many times as wide as printed."""
    width = scale * _LINE_WIDTH * style.width
    return LineCollection(
        list(lines),
        colors=[style.colour],
        linewidths=width,
        linestyles="dashed" if style.dashed else "solid",
        label=style.label,
        path_effects=[withStroke(linewidth=width + scale, foreground="white"), Normal()]
        if style.edged
        else None,
    )


def driven_path(width: float) -> LineCollection:
    """A driven path that can be put on a map, empty as yet, of so many points width."""
    path = LineCollection([], cmap=TRAVERSABILITY_COLOURS, linewidths=width, capstyle="round")
    path.set_clim(0, 1)
    return path


def draw_driven(path: LineCollection, track: np.ndarray, traversability: np.ndarray) -> None:
    """Draws a path, positions of shape [N + 1, 2], in the colours of observed λ, of shape [N] or longer."""
    path.set_segments(list(np.stack((track[:-1], track[1:]), axis=1)))
    path.set_array(traversability[: len(track) - 1])


def end_mark(outcome: str) -> str:
    """Which of `MARKS` stands where an episode ended, by its outcome as tables of episodes have it."""
    return _END_MARKS.get(outcome, "failed")


def mark_end(
    panel: Axes,
    outcome: str,
    track: np.ndarray,
    goal_m: np.ndarray,
    resolution_m: float,
    scale: float = 1.0,
    ground: np.ndarray | None = None,
    **style: Any,
) -> list[Artist]:
    """Marks how an episode ended, beside the cell in which it ended, and outlines that cell.

    The mark stands at the side of the path that is farther from the goal.

    Args:
        panel: in metres.
        outcome: as tables of episodes have it.
        track: driven positions, shape [N + 1, 2].
        goal_m: (x, y).
        resolution_m: edge length of a cell.
        scale: of the mark's size.
        ground: colours of the map, uint8 of shape [H, W, 3], that the cell is shown in over the path.
        **style: what differs of the mark, as in `Axes.plot`.

    Returns:
        The cell and the mark.
    """
    name, end = end_mark(outcome), np.asarray(track[-1], np.float64)
    looks = MARKS[name] | {"label": name, "ms": scale * MARKS[name]["ms"]} | style
    column, row = np.floor(end / resolution_m).astype(int)
    corners = resolution_m * np.add([(0, 0), (1, 0), (1, 1), (0, 1)], (column, row))
    face = "none"
    if ground is not None and 0 <= row < ground.shape[0] and 0 <= column < ground.shape[1]:
        face = to_hex(ground[row, column] / 255)
    edge = [withStroke(linewidth=2 * scale, foreground="white"), Normal()]
    (cell,) = panel.fill(*corners.T, fc=face, ec="black", lw=0.7 * scale, zorder=3.9, path_effects=edge)
    away = _beside(track, goal_m, resolution_m)
    right, up = away * (looks["ms"] / 2 + 1.5) / 72
    transform = panel.transData + ScaledTranslation(right, up, panel.figure.dpi_scale_trans)
    # From the middle of a cell to its corners it is 0.7 of its edge.
    middle = corners.mean(axis=0)
    (drawn,) = panel.plot(*(middle + 0.7 * resolution_m * away), **looks, transform=transform, clip_on=False)
    return [cell, drawn]


def end_cell_handle(scale: float = 1.0) -> Line2D:
    """The entry of a legend for the cell in which an episode ended."""
    looks: dict[str, Any] = {
        "marker": "s",
        "ms": 4 * scale,
        "mfc": "none",
        "mec": "black",
        "mew": 0.7 * scale,
    }
    return Line2D([], [], ls="none", label="cell of the end", **looks)


def _beside(track: np.ndarray, goal_m: np.ndarray, resolution_m: float) -> np.ndarray:
    """The direction square to the end of a path that leads away from the goal, of length 1."""
    places = np.asarray(track, np.float64)
    end = places[-1]
    far = places[np.linalg.norm(places - end, axis=1) >= _CAME_CELLS * resolution_m]
    came = end - (far[-1] if len(far) else places[0])
    along = came / np.linalg.norm(came) if came.any() else np.array([1.0, 0.0])
    side = np.array([-along[1], along[0]])
    return side if side @ (goal_m - end) <= 0 else -side


def draw_soft(panel: Axes, soft: np.ndarray, resolution_m: float) -> None:
    """Draws outline and hatching of soft ground, bool of shape [H, W], on a map."""
    for lines in (outline, hatching):
        drawn = LineCollection(list(lines(soft, resolution_m)), colors=[SOFT], linewidths=0.4)
        panel.add_collection(drawn)


def shades(values: np.ndarray, colours: str = TRAVERSABILITY_COLOURS) -> np.ndarray:
    """Colours of λ, or of what else lies in [0, 1], uint8, from any shape to [..., 3]."""
    return np.round(255 * matplotlib.colormaps[colours](values)[..., :3]).astype(np.uint8)


def layer_colours(name: str, layer: np.ndarray) -> np.ndarray:
    """Colours a layer, of shape [H, W], in grey where nothing is known; as `field_colours` does."""
    scale = layer_scale(name, layer)
    shown = layer % 360 if is_azimuth(name) else layer
    share = (np.ma.masked_invalid(shown) - scale["vmin"]) / (scale["vmax"] - scale["vmin"])
    return np.round(255 * scale["cmap"](share)[..., :3]).astype(np.uint8)


def predicted_colours(predicted: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Colours λ̂, of shape [H, W], and in dark grey what is not free, bool of its shape; as `field_colours` does."""
    colours = shades(predicted)
    colours[~free] = bytes_of(CLOSED)[:3]
    return colours


def unseen_layer(seen: np.ndarray, resolution_m: float, scale: float = 1.0) -> LineCollection:
    """Hatching of ground that was not seen, that can be put on a map, so many times as wide as printed."""
    return LineCollection(list(hatching(~seen, resolution_m)), colors="black", linewidths=0.3 * scale)


def unseen_handle() -> Patch:
    """The entry of a legend for ground that was not seen."""
    return Patch(fc=UNSEEN, ec="black", hatch="////", lw=0, label="not seen")


def reach_line(reach: np.ndarray, scale: float = 1.0, label: str = "_reach") -> Line2D:
    """How far sensors reach, from `KnownMap.outline`, that can be put on a map, so many times as wide as printed."""
    edge = [withStroke(linewidth=1.8 * scale, foreground="black"), Normal()]
    # One line with gaps, so that no piece has its edge on another.
    return Line2D(*reach.T, color=REACH, lw=0.9 * scale, path_effects=edge, label=label, zorder=2.2)


def known_colours(known: KnownMap) -> dict[str, np.ndarray]:
    """Colours of what was known, under a veil where the ground was not seen; as `field_colours` does.

    Returns:
        `risk`, λ̂ with what is not free; `mean` and `spread` of the belief; and `seen`, light where the ground was seen
        and blue where λ was sensed.
    """
    veil, seen = np.array(bytes_of(UNSEEN)[:3]), known.seen[..., None]
    maps = {
        "risk": predicted_colours(known.predicted, known.free),
        "mean": shades(known.mean),
        "spread": shades(known.spread / MOST_SPREAD, SPREAD_COLOURS),
    }
    for name, colours in maps.items():
        maps[name] = np.where(seen, colours, (1 - VEIL) * colours + VEIL * veil).round().astype(np.uint8)
    palette = np.array([bytes_of(colour)[:3] for colour in (UNSEEN, _SEEN, _SENSED)], np.uint8)
    # A cell may be sensed that was not seen.
    return maps | {"seen": palette[np.where(known.sensed, 2, known.seen.astype(int))]}


def field_colours(field: np.ndarray, immobilising: np.ndarray) -> np.ndarray:
    """Colours λ as it is, and cells that immobilise a robot in a colour of their own.

    Args:
        field: λ in [0, 1], shape [H, W].
        immobilising: bool, shape [H, W].

    Returns:
        Red, green and blue, uint8, shape [H, W, 3].
    """
    colours = shades(field)
    colours[immobilising] = bytes_of(IMMOBILISING)[:3]
    return colours
