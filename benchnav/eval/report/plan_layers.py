"""What is drawn over a map, once for figures and playback: plans, and ground that is soft or immobilises a robot.

Letters in shapes: H×W cells, N positions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from benchnav.core.figures import TRAVERSABILITY_COLOURS, bytes_of, hatching, layer_scale, outline
from benchnav.core.grid import is_azimuth

# Dark red lies far from all colours of λ, for the colour-blind too.
IMMOBILISING = "#a00000"
SOFT = "white"

_LINE_WIDTH = 0.4  # of the thinnest line of a plan


@dataclass(frozen=True, kw_only=True)
class LayerStyle:
    """How a layer of a plan is drawn.

    Args:
        label: what a legend calls it.
        colour: red, green, blue and opacity, in hexadecimal digits.
        width: over the thinnest line's.
        dashed: where lines can be.
    """

    label: str
    colour: str
    width: float
    dashed: bool = False


# From the undermost layer to the topmost.
STYLES: Mapping[str, LayerStyle] = {
    "tree": LayerStyle(label="tree", colour="#3c3c3c8c", width=1),
    "samples": LayerStyle(label="samples", colour="#78b4ff6e", width=1),
    "reference": LayerStyle(label="reference path", colour="#285affff", width=3, dashed=True),
    "path": LayerStyle(label="planned", colour="#00008cff", width=3),
}


def plan_layer(style: LayerStyle, lines: Sequence[np.ndarray] = ()) -> LineCollection:
    """A layer of a plan as lines that can be put on a map."""
    return LineCollection(
        list(lines),
        colors=[style.colour],
        linewidths=_LINE_WIDTH * style.width,
        linestyles="dashed" if style.dashed else "solid",
        label=style.label,
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


def draw_soft(panel: Axes, soft: np.ndarray, resolution_m: float) -> None:
    """Draws outline and hatching of soft ground, bool of shape [H, W], on a map."""
    for lines in (outline, hatching):
        drawn = LineCollection(list(lines(soft, resolution_m)), colors=[SOFT], linewidths=0.4)
        panel.add_collection(drawn)


def shades(values: np.ndarray) -> np.ndarray:
    """Colours of λ, uint8, from any shape to [..., 3]."""
    return np.round(255 * matplotlib.colormaps[TRAVERSABILITY_COLOURS](values)[..., :3]).astype(np.uint8)


def layer_colours(name: str, layer: np.ndarray) -> np.ndarray:
    """Colours a layer, of shape [H, W], in grey where nothing is known; as `field_colours` does."""
    scale = layer_scale(name, layer)
    shown = layer % 360 if is_azimuth(name) else layer
    share = (np.ma.masked_invalid(shown) - scale["vmin"]) / (scale["vmax"] - scale["vmin"])
    return np.round(255 * scale["cmap"](share)[..., :3]).astype(np.uint8)


def predicted_colours(predicted: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Colours λ̂, of shape [H, W], and in dark grey what is not free, bool of its shape; as `field_colours` does."""
    colours = shades(predicted)
    colours[~free] = 64
    return colours


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
