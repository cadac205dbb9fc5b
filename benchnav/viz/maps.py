"""Drawing of maps in metres: colours, regions, lines, legends and scale bars.

Letters in shapes: H×W cells; N positions; M lines; C colours.
"""

from collections.abc import Iterable
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from benchnav.core.grid import is_azimuth
from benchnav.viz.style import SKY, bytes_of

TRAVERSABILITY_COLOURS = "viridis"
LAMBDA: dict[str, Any] = {"cmap": TRAVERSABILITY_COLOURS, "vmin": 0, "vmax": 1}
SPREAD_COLOURS = "magma"  # colour map of spreads; cells with a small spread are dark
MAX_SPREAD = 0.5  # maximum standard deviation of a quantity in [0, 1]
MISSING = "0.7"  # colour of cells without a value
# Colour of immobilising cells. With any kind of colour vision, dark red differs from all
# colours of λ.
IMMOBILISING = "#a00000"
SOFT = "white"  # colour of soft spots
CLOSED = "0.25"  # colour of non-free cells
UNSEEN, VEIL = "0.6", 0.55  # colour over unobserved cells, and its opacity
ROBOT = "#ff7800"  # differs from all colours of λ
FOOTPRINT = ROBOT  # colour of the outline of the sensors' range
SEEN, SENSED = "0.9", SKY  # colours of observed cells, and of cells with measured λ
_LAYER_COLOURS, _DIRECTION_COLOURS = "YlGnBu", "twilight"  # colour maps
_HATCH_CELLS = 4  # distance between hatching lines, in cells
_LENGTHS_M = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)  # lengths of scale bars
_SCALE_FRACTION = 0.35  # maximum length of a scale bar divided by the map's width


def show_map(panel: Axes, values: Any, extent_m: Iterable[float], **style: Any) -> Any:
    """Draw a map that fills a panel, with axes in metres and the first row at the bottom.

    Args:
        panel: panel to draw on.
        values: values of shape [H, W], or colours of shape [H, W, 3].
        extent_m: width and height of the map in metres.
        **style: further keywords of `Axes.imshow`.

    Returns:
        The image.
    """
    width, height = map(float, extent_m)
    panel.set(xlim=(0, width), ylim=(0, height))
    placement: dict[str, Any] = {"origin": "lower", "extent": (0, width, 0, height)}
    return panel.imshow(values, interpolation="none", **placement, **style)


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
        panels: panels that the bar belongs to; if None, all panels.
        scale: name of the colour map, and the maximum value; the minimum is 0.
        **style: further keywords of `Figure.colorbar`.
    """
    colours, maximum = scale
    mappable = ScalarMappable(Normalize(0, maximum), colours)
    if panels is None:
        panels = figure.axes
    figure.colorbar(mappable, ax=list(panels), fraction=0.03, label=label, **style)


def overlay(
    panel: Axes,
    region: np.ndarray,
    extent_m: Iterable[float],
    colour: Any,
    opacity: float = 1.0,
) -> Any:
    """Draw a region of a map in a single colour, and return the image.

    Args:
        panel: panel with axes in metres.
        region: mask of the region, bool, shape [H, W].
        extent_m: width and height of the map in metres.
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
    """Add an entry for a kind of terrain to the legend, since images add none.

    Args:
        panel: panel to which the legend belongs.
        label: text of the entry.
        **look: keywords of `Axes.fill` for the entry's patch.
    """
    panel.fill([], [], label=label, **look)


def name_immobilising(panel: Axes, immobilising: np.ndarray) -> None:
    """Add an entry for immobilising cells to the legend, if a mask contains any."""
    if immobilising.any():
        name_terrain(panel, "immobilises a robot", color=IMMOBILISING)


def scale_length(width_m: float) -> float:
    """Return the length of a scale bar for a map of a given width, in metres."""
    limit_m = max(_SCALE_FRACTION * width_m, 1)
    shorter = [length for length in _LENGTHS_M if length < limit_m]
    return max(shorter)


def draw_scale(panel: Axes, extent_m: tuple[float, float], size: float = 7.0) -> None:
    """Draw a scale bar below a map without axes.

    Args:
        panel: panel with axes in metres.
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
    """Compute the lines that hatch a region: diagonals of its cells.

    Args:
        region: mask of the region, bool, shape [H, W].
        resolution_m: edge length of a cell in metres.

    Returns:
        Both ends (x, y) of each line in metres, float32, shape [M, 2, 2].
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
        panel: panel with axes in metres.
        lines: both ends (x, y) of each line in metres, shape [M, 2, 2].
        colour: colour of the lines.
        width: width of the lines in points.
        edge: colour of a wider line below each line; if None, lines have no edge.
    """
    segments = list(lines)
    if edge is not None:
        below = LineCollection(segments, colors=[edge], linewidths=2.5 * width)
        panel.add_collection(below)
    above = LineCollection(segments, colors=[colour], linewidths=width)
    panel.add_collection(above)


def layer_scale(name: str, values: np.ndarray) -> dict[str, Any]:
    """Return the colour scale of a layer, as keywords of `Axes.imshow`.

    The scale ranges from 0, or from the minimum if it is below 0, to the maximum. The
    scale of an azimuth is cyclic, from 0 to 360.

    Args:
        name: name of the layer; names of azimuths end in `_azimuth_deg`.
        values: values of the layer, NaN in cells without a value, any shape.
    """
    if is_azimuth(name):
        return {"cmap": with_missing(_DIRECTION_COLOURS), "vmin": 0.0, "vmax": 360.0}
    finite = values[np.isfinite(values)]
    low = float(np.min(finite, initial=0.0))
    high = float(np.max(finite, initial=0.0))
    if high <= low:
        high = low + 1.0
    return {"cmap": with_missing(_LAYER_COLOURS), "vmin": low, "vmax": high}


def with_missing(colours: str | np.ndarray) -> Colormap:
    """Return a colour map with grey for masked cells.

    Args:
        colours: name of a colour map, or the colours of a new one, shape [C, 3].
    """
    if isinstance(colours, str):
        return matplotlib.colormaps[colours].with_extremes(bad=MISSING)
    return ListedColormap(list(colours)).with_extremes(bad=MISSING)


def missing_handle() -> Patch:
    """Return the legend entry for cells without a value."""
    return Patch(facecolor=MISSING, label="unknown")


def shades(values: np.ndarray, colours: str = TRAVERSABILITY_COLOURS) -> np.ndarray:
    """Return red, green and blue of values in [0, 1], uint8.

    Args:
        values: values in [0, 1], any shape.
        colours: name of a colour map.

    Returns:
        Colours; their shape is that of `values` with a further dimension of length 3.
    """
    return _bytes(matplotlib.colormaps[colours](values))


def layer_colours(name: str, layer: np.ndarray) -> np.ndarray:
    """Return red, green and blue of a layer, uint8, shape [H, W, 3]; NaN is grey.

    Args:
        name: name of the layer, which determines its colour scale.
        layer: values of the layer, shape [H, W].
    """
    scale = layer_scale(name, layer)
    shown = layer % 360 if is_azimuth(name) else layer
    low = scale["vmin"]
    fraction = (np.ma.masked_invalid(shown) - low) / (scale["vmax"] - low)
    return _bytes(scale["cmap"](fraction))


def _bytes(colours: np.ndarray) -> np.ndarray:
    return np.round(255 * colours[..., :3]).astype(np.uint8)


def veiled(colours: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return colours blended with grey in unobserved cells, uint8, shape [H, W, 3].

    Args:
        colours: red, green and blue, uint8, shape [H, W, 3].
        seen: mask of observed cells, bool, shape [H, W].
    """
    grey = np.array(bytes_of(UNSEEN)[:3])
    blended = (1 - VEIL) * colours + VEIL * grey
    shown = np.where(seen[..., None], colours, blended)
    return shown.round().astype(np.uint8)


def field_colours(field: np.ndarray, immobilising: np.ndarray) -> np.ndarray:
    """Return the colours of a λ field, with immobilising cells in dark red.

    Args:
        field: λ in [0, 1], shape [H, W].
        immobilising: mask of immobilising cells, bool, shape [H, W].

    Returns:
        Red, green and blue, uint8, shape [H, W, 3].
    """
    colours = shades(field)
    colours[immobilising] = bytes_of(IMMOBILISING)[:3]
    return colours
