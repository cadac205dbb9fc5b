"""Pictures of an episode from above, and the window that shows them.

Letters in shapes: H×W cells of the map, N×N cells of the crop, P positions.
"""

import os
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.env.view import CHANNELS
from benchnav.viz import drives, maps

SIZE = (640, 480)  # width and height in pixels
_DPI = 100
_FIGSIZE = (SIZE[0] / _DPI, SIZE[1] / _DPI)
# Squares: the map, and to its right two channels of the policy's observation.
_PANELS = {
    "width_ratios": (424, 176),
    "wspace": 16 / 300,
    "hspace": 48 / 176,
    "left": 16 / 640,
    "right": 632 / 640,
    "bottom": 16 / 480,
    "top": 440 / 480,
}
_UNSEEN = 0.35  # brightness of unobserved terrain, relative to observed terrain
_TEXT = 8.5  # font size in points
_MARKS = 1.3  # scale of the markers


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Contents of a picture.

    Args:
        rgb: colours of the map, uint8, shape [3, H, W].
        seen: mask of observed cells, bool, shape [H, W].
        crop: crop that the policy observes, shape [4, N, N].
        corners_m: corners of the crop on the map, in metres, shape [4, 2].
        behind: fraction of the crop's length that is behind the robot, in [0, 1).
        state: state of the robot, beginning with (x, y, θ), shape [S].
        goal_m: position (x, y) of the goal in metres, shape [2].
        track: positions (x, y) of the robot so far, in metres, shape [P, 2].
        time_s: time since the start of the episode, in seconds.
        observed: λ observed in the last step.
        outcome: `running`, or the outcome of the episode.
    """

    rgb: np.ndarray
    seen: np.ndarray
    crop: np.ndarray
    corners_m: np.ndarray
    behind: float
    state: np.ndarray
    goal_m: np.ndarray
    track: np.ndarray
    time_s: float
    observed: float
    outcome: str


class Picture:
    """Renderer of scenes on maps of one grid.

    Args:
        grid: grid of the maps.
    """

    def __init__(self, grid: Grid) -> None:
        """Prepare an empty figure."""
        self._grid = grid
        self._figure = Figure(figsize=_FIGSIZE, dpi=_DPI)
        self._canvas = FigureCanvasAgg(self._figure)

    def draw(self, scene: Scene) -> np.ndarray:
        """Return the image of a scene, uint8, shape [480, 640, 3]."""
        self._figure.clear()
        layout: list[Any] = [["map", "risk"], ["map", "spread"]]
        panels = self._figure.subplot_mosaic(layout, gridspec_kw=_PANELS)
        for panel in panels.values():
            panel.set(xticks=[], yticks=[])
        self._draw_map(panels["map"], scene)
        channels = (
            ("risk", "λ̂ ahead", maps.TRAVERSABILITY_COLOURS),
            ("spread", "spread of λ", maps.SPREAD_COLOURS),
        )
        for channel, title, colours in channels:
            self._draw_crop(panels[channel], scene, channel, title, colours)
        self._canvas.draw()
        rgba = np.asarray(self._canvas.buffer_rgba())
        return rgba[..., :3].copy()

    def _draw_map(self, panel: Axes, scene: Scene) -> None:
        light = np.where(scene.seen, 1.0, _UNSEEN)[..., None]
        image = scene.rgb.transpose(1, 2, 0) * light
        maps.show_map(panel, image.astype(np.uint8), self._grid.extent_m)
        for colour, width in (("black", 2.4), ("white", 1.2)):
            outline = Polygon(
                scene.corners_m, closed=True, fill=False, ec=colour, lw=width
            )
            panel.add_patch(outline)
        outcome = scene.outcome.replace("running", "")
        track = np.vstack((scene.track, scene.state[:2]))
        drive = drives.Drive(
            track=track,
            goal_m=scene.goal_m,
            outcome=outcome,
            heading_rad=scene.state[2],
        )
        drives.draw_drive(panel, drive, 1.6, _MARKS)
        title = f"t = {scene.time_s:.1f} s    λ = {scene.observed:.2f}    "
        title += outcome.replace("_", " ")
        panel.set_title(title, fontsize=_TEXT + 1, loc="left", pad=5)

    def _draw_crop(
        self, panel: Axes, scene: Scene, channel: str, title: str, colours: str
    ) -> None:
        values = scene.crop[CHANNELS.index(channel)]
        seen = scene.crop[CHANNELS.index("known")]
        spread = scene.crop[CHANNELS.index("spread")]
        light = np.where(seen > 0, 1.0, _UNSEEN)[..., None]
        rgba = matplotlib.colormaps[colours](values)
        image = rgba[..., :3] * light
        is_off_map = (seen <= 0) & (spread == 0) & (scene.crop[0] == 0)
        image[is_off_map] = to_rgb(maps.MISSING)
        cells = len(values)
        # In the image, the robot faces up, and its left is on the left.
        image = image.transpose(1, 0, 2)[:, ::-1]
        maps.show_map(panel, image, (cells, cells))
        ahead = drives.robot_marker(np.pi / 2)
        robot = (cells / 2, scene.behind * cells)
        drives.mark(panel, "robot", robot, _MARKS, marker=ahead)
        panel.set_title(title, fontsize=_TEXT, loc="left", pad=4)
        bar = panel.inset_axes((0.72, 1.03, 0.2, 0.06), xticks=[], yticks=[])
        bar.imshow(np.linspace(0, 1, 32)[None], cmap=colours, aspect="auto")
        for x, end, side in ((-0.1, "0", "right"), (1.1, "1", "left")):
            bar.text(
                x, 0.4, end, size=_TEXT, ha=side, va="center", transform=bar.transAxes
            )


class Window:
    """Window that shows images of the size `SIZE`."""

    def __init__(self) -> None:
        """Open the window.

        Raises:
            ConfigError: If there is no display, and `MPLBACKEND` does not name a
                backend that works without one.
        """
        # pyplot is imported here, since the import searches for a display.
        from matplotlib import pyplot

        self._pyplot: Any = pyplot
        is_chosen = bool(os.environ.get("MPLBACKEND"))
        if pyplot.get_backend().lower() == "agg" and not is_chosen:
            raise ConfigError(
                'Expected a display for `render_mode` "human", got no display that '
                'Matplotlib can use. Pass "rgb_array". If there is a display, install '
                "a GUI toolkit that Matplotlib supports, such as PyQt6."
            )
        self._figure = pyplot.figure("benchnav", figsize=_FIGSIZE, dpi=_DPI)
        panel = self._figure.add_axes((0, 0, 1, 1))
        panel.set_axis_off()
        width, height = SIZE
        blank = np.full((height, width, 3), 255, np.uint8)
        self._image = panel.imshow(blank)

    def show(self, image: np.ndarray) -> None:
        """Show an image, uint8, shape [480, 640, 3], instead of the last image."""
        self._image.set_data(image)
        if self._pyplot.get_backend().lower() != "agg":
            self._figure.show()
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        """Close the window; repeated calls are allowed."""
        self._pyplot.close(self._figure)
