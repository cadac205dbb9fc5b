"""Drawing of plans, driven paths and the sensors' range on a map in metres.

Letters in shapes: N positions.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patheffects import AbstractPathEffect, Normal, withStroke

from benchnav.viz.maps import FOOTPRINT, TRAVERSABILITY_COLOURS

_LINE_WIDTH = 0.4  # width of the thinnest line of a plan, in points


class LayerStyle(NamedTuple):
    """Style of a layer of a plan.

    Args:
        label: entry of the legend.
        colour: red, green, blue and opacity, in hexadecimal digits.
        width: width relative to the thinnest line.
        dashes: dashes of the line; a file format without dashes draws a solid line.
        effects: effects of the line, such as a white edge; omitted in file formats that
            do not support them.
    """

    label: str
    colour: str
    width: float
    dashes: Literal["solid", "dashed"] = "solid"
    effects: Sequence[AbstractPathEffect] = ()


_EDGED = (withStroke(linewidth=2.2, foreground="white"), Normal())
# Styles by name of the layer, from the bottom layer to the top layer.
STYLES: Mapping[str, LayerStyle] = {
    "tree": LayerStyle("tree", "#3c3c3c8c", 1),
    "samples": LayerStyle("samples", "#78b4ff6e", 1),
    "reference": LayerStyle("reference path", "#285affff", 3, "dashed", _EDGED),
    "path": LayerStyle("planned", "#00008cff", 3, "solid", _EDGED),
}


def draw_plan(panel: Axes, lines: Mapping[str, Sequence[np.ndarray]]) -> None:
    """Draw a plan on a map.

    Args:
        panel: panel with axes in metres.
        lines: lines by name of a layer in `STYLES`, each line of N positions (x, y) in
            metres, shape [N, 2].
    """
    for name, style in STYLES.items():
        segments = list(lines.get(name, ()))
        if not segments:
            continue
        layer = LineCollection(segments, label=style.label)
        layer.set_color(style.colour)
        layer.set_linewidth(_LINE_WIDTH * style.width)
        layer.set_linestyle(style.dashes)
        layer.set_path_effects(list(style.effects))
        panel.add_collection(layer)


def driven_colours(
    track: np.ndarray, traversability: np.ndarray, width: float
) -> LineCollection:
    """Return a driven path in the colours of observed λ, for a map and a colour bar.

    Args:
        track: positions (x, y) in metres, shape [N, 2].
        traversability: observed λ between consecutive positions, in [0, 1]; the first
            N − 1 values are used.
        width: width of the path in points.
    """
    segments = list(np.stack((track[:-1], track[1:]), axis=1))
    style: dict[str, Any] = {"linewidths": width, "capstyle": "round", "zorder": 2.5}
    path = LineCollection(segments, cmap=TRAVERSABILITY_COLOURS, **style)
    path.set_clim(0, 1)
    path.set_array(traversability[: len(segments)])
    return path


def draw_footprint(panel: Axes, outline_m: np.ndarray) -> None:
    """Draw the outline of the sensors' range on a map.

    Args:
        panel: panel with axes in metres.
        outline_m: positions (x, y) of all lines in metres, with NaN between two lines,
            shape [N, 2].
    """
    edge = [withStroke(linewidth=1.1, foreground="black"), Normal()]
    style: dict[str, Any] = {"lw": 0.6, "path_effects": edge, "zorder": 2.2}
    # Draw a single line with gaps: separate lines' edges would cover other lines.
    panel.plot(*outline_m.T, color=FOOTPRINT, label="footprint of the sensors", **style)
