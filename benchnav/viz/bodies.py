"""Drawing of robots with a footprint: a rectangle with wheels in the colour of ruts.

Letters in shapes: W wheels or other contacts.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Polygon

from benchnav.viz.maps import ROBOT, name_terrain, shades

# Colours of wheels: white on the terrain, black in a rut from this depth on. With the
# default entrapment, a rut of 3.6 cm holds a wheel.
RUT_COLOURS, MAX_RUT_M = "Greys", 0.05
WHEEL = "white"  # colour of a wheel without a recorded rut

_MIN_FRACTION = 0.055  # smallest length of a robot, as a fraction of the map's width
_WHEEL = (0.4, 0.2)  # length and width of a wheel, as fractions of the rectangle's
_NOSE = 0.35  # length of the line ahead of the rectangle, as a fraction of its length
_UNIT = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) / 2  # corners of a unit square
_EDGE: dict[str, Any] = {"ec": "black", "lw": 0.6}


def rut_colours(ruts_m: np.ndarray) -> np.ndarray:
    """Return red, green and blue of wheels, uint8.

    Args:
        ruts_m: depths of ruts in metres, any shape.

    Returns:
        Colours; their shape is that of `ruts_m` with a further dimension of length 3.
    """
    return shades(np.clip(ruts_m / MAX_RUT_M, 0, 1), RUT_COLOURS)


def rectangle(pose: np.ndarray, contacts_m: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the smallest rectangle along a heading that contains all contacts.

    Args:
        pose: (x, y, θ) in metres and radians, shape [3].
        contacts_m: positions (x, y) of the contacts in metres, shape [W, 2].

    Returns:
        Centre and size (along, across), in the robot's axes, each of shape [2]; and the
        rows of the rotation from these axes to the map's, shape [2, 2].
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    axes = np.array([(cos, sin), (-sin, cos)])
    local = (contacts_m - pose[:2]) @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    return (low + high) / 2, high - low, axes


def draw_body(
    panel: Axes,
    pose: np.ndarray,
    contacts_m: np.ndarray,
    ruts_m: np.ndarray | None = None,
    label: str = "robot",
) -> None:
    """Draw a robot on a map; on a map much wider than the robot, enlarge the robot.

    Args:
        panel: panel with axes in metres.
        pose: (x, y, θ) in metres and radians, shape [3].
        contacts_m: positions (x, y) of the contacts in metres, shape [W, 2].
        ruts_m: depth of each wheel's rut in metres, shape [W]; None if unknown.
        label: entry of the legend, to which an enlarged robot adds a word.
    """
    centre, size, axes = rectangle(pose, contacts_m)
    left, right = panel.get_xlim()
    scale = max(1.0, _MIN_FRACTION * (right - left) / size.max())

    def on_map(points: np.ndarray) -> np.ndarray:
        return pose[:2] + scale * (points @ axes)

    words = label if scale == 1 else f"{label}, enlarged"
    corners = on_map(centre + size * _UNIT)
    panel.add_patch(Polygon(corners, fc=ROBOT, zorder=3.5, label=words, **_EDGE))
    ahead = np.array([size[0] / 2, 0.0])
    nose = on_map(np.stack((centre, centre + (1 + 2 * _NOSE) * ahead)))
    panel.plot(*nose.T, color="black", lw=1, zorder=3.6, label="_nose")
    local = (contacts_m - pose[:2]) @ axes.T
    tyre = size * _WHEEL * _UNIT
    wheels = [on_map(position + tyre) for position in local]
    colours: Any = WHEEL
    if ruts_m is not None:
        colours = rut_colours(ruts_m) / 255
        name_terrain(panel, "wheel, darker in a deeper rut", fc="0.5", **_EDGE)
    shapes = PolyCollection(wheels, fc=colours, zorder=3.7, label="_wheels", **_EDGE)
    panel.add_collection(shapes, autolim=False)
