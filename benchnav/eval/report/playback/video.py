"""Videos of episodes, side by side, on one map, at one time base.

Each episode is a column: above, the terrain with what is planned and the path driven so far, coloured by the λ
met; below, λ as it was where it stayed so, else the λ̂ that the planner was given.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from benchnav.core.errors import ConfigError
from benchnav.core.figures import MARKS, TRAVERSABILITY_COLOURS, mark, show_map
from benchnav.core.store import replacing
from benchnav.eval.recording import Recording
from benchnav.eval.report.plan_layers import (
    STYLES,
    draw_driven,
    draw_soft,
    driven_path,
    field_colours,
    plan_layer,
    predicted_colours,
)
from benchnav.eval.report.words import condition_name, contender_names

FRAMES_A_SECOND = 20
# Seconds of an episode in a second of video.
SPEED = 4.0
HOLD_S = 2.0  # of the last frame, which says how it ended
MOST_CONDITIONS = 6
ROBOT = "#ff7800"  # as no λ is coloured

_DPI = 100
_PANEL, _GAP, _HEAD, _FOOT = 440, 20, 92, 76  # pixels
_TALLEST = 2.0  # of a map, over its width
_ROBOT_M = np.array([(0.9, 0.0), (-0.6, 0.5), (-0.6, -0.5)])
_MARKS = 1.6  # over those of a printed figure


def frame_times(end_s: float) -> np.ndarray:
    """Times in an episode that frames show, up to its end, which is shown a while.

    Args:
        end_s: when the last episode ends.
    """
    moving = np.arange(0.0, end_s, SPEED / FRAMES_A_SECOND)
    return np.append(moving, np.full(round(HOLD_S * FRAMES_A_SECOND), end_s))


def write_video(recordings: Sequence[Recording], path: Path) -> Iterator[tuple[int, int]]:
    """Writes a video, whole or not at all, yielding (frames done, frames in all); to be iterated to the end.

    Args:
        recordings: one, or several of one map.
        path: an `.mp4` file.

    Raises:
        ConfigError: there are too many to be seen.
    """
    import av

    if len(recordings) > MOST_CONDITIONS:
        raise ConfigError(
            f"Expected at most {MOST_CONDITIONS} conditions side by side, got {len(recordings)}."
        )
    frames, times = Frames(recordings), frame_times(max(recording.end_s for recording in recordings))
    faststart = {"movflags": "+faststart"}
    with replacing(path) as partial, av.open(str(partial), "w", format="mp4", options=faststart) as container:
        stream = container.add_stream("libx264", rate=FRAMES_A_SECOND, options={"crf": "20"})
        stream.width, stream.height = frames.size
        stream.pix_fmt = "yuv420p"
        for done, time_s in enumerate(times, start=1):
            frame = av.VideoFrame.from_ndarray(frames.draw(float(time_s)), format="rgb24")
            container.mux(stream.encode(frame))
            yield done, len(times)
        container.mux(stream.encode())


class Frames:
    """Draws episodes at any time.

    Args:
        recordings: at least one.

    Attributes:
        size: width and height in pixels, both even, as video formats ask for.
    """

    def __init__(self, recordings: Sequence[Recording]) -> None:
        """Draws what never changes."""
        rows, columns = recordings[0].grid.shape
        panel_high = round(_PANEL * min(rows / columns, _TALLEST))
        width = len(recordings) * (_PANEL + _GAP) + _GAP
        height = _HEAD + 2 * panel_high + _GAP + _FOOT
        across, up = self.size = (width + width % 2, height + height % 2)
        self._figure = Figure(figsize=(across / _DPI, up / _DPI), dpi=_DPI)
        self._canvas = FigureCanvasAgg(self._figure)
        panels = self._figure.subplots(
            2, len(recordings), squeeze=False,
            gridspec_kw={
                "left": _GAP / across, "right": (width - _GAP) / across, "wspace": _GAP / _PANEL,
                "bottom": _FOOT / up, "top": (_FOOT + 2 * panel_high + _GAP) / up, "hspace": _GAP / panel_high,
            },
        )  # fmt: skip
        if len(recordings) == 1:
            names = [condition_name(recordings[0].about)]
        else:
            names = contender_names([recording.about for recording in recordings])
        self._columns = [_Column(*column) for column in zip(panels.T, recordings, names, strict=True)]
        bar = self._figure.add_axes((_GAP / across, 44 / up, _PANEL / across, 12 / up))
        shades = ScalarMappable(Normalize(0, 1), TRAVERSABILITY_COLOURS)
        self._figure.colorbar(shades, cax=bar, orientation="horizontal")
        bar.tick_params(labelsize=8, length=2)
        words = ["traversability λ"]
        words += ["hatched: soft ground"] if any(r.soft.any() for r in recordings) else []
        words += ["dark red: immobilises a robot"] if any(r.immobilising.any() for r in recordings) else []
        words += ["grey: not free"] if any(r.field is None for r in recordings) else []
        self._figure.text(_GAP / across, 10 / up, "; ".join(words), fontsize=8)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def draw(self, time_s: float) -> np.ndarray:
        """Draws a frame, uint8 of shape [height, width, 3].

        Args:
            time_s: since the episodes began; those that have ended stay as they ended.
        """
        self._canvas.restore_region(self._background)
        for column in self._columns:
            column.move(time_s)
            for artist in column.moving:
                self._figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


class _Column:
    """One episode: its two panels, and what of them moves."""

    def __init__(self, panels: Sequence[Axes], recording: Recording, name: str) -> None:
        self.panels, self.recording = panels, recording
        above, below = panels
        # In points over the panel.
        over: Any = {"xy": (0, 1), "xycoords": "axes fraction", "textcoords": "offset points"}
        above.annotate(name, xytext=(0, 47.5), fontsize=12, weight="bold", **over)
        self._time = above.annotate("", xytext=(0, 28.8), fontsize=11, family="monospace", **over)
        self._outcome = above.annotate("", xytext=(0, 10.1), fontsize=12, weight="bold", **over)
        self._layers = {name: plan_layer(style) for name, style in STYLES.items()}
        for layer in self._layers.values():
            above.add_collection(layer)
        self._driven = driven_path(3.5)
        self._edges = [
            panel.plot([], [], color=colour, lw=width, solid_capstyle="round")[0]
            for panel, colour, width in ((above, "white", 5.5), (below, "white", 4.5), (below, "black", 2))
        ]
        above.add_collection(self._driven)
        self._robots = [panel.fill(*_ROBOT_M.T, fc=ROBOT, ec="black", lw=0.8)[0] for panel in panels]
        self._crosses = [panel.plot([], [], **MARKS["end"] | {"ms": 13})[0] for panel in panels]
        extent_m = recording.grid.extent_m
        show_map(above, np.moveaxis(recording.rgb, 0, -1), extent_m)
        draw_soft(above, recording.soft, recording.resolution_m)
        if recording.field is not None:
            shown, title = field_colours(recording.field, recording.immobilising), "λ as it was"
        else:
            shown, title = predicted_colours(recording.predicted, recording.free), "λ̂ given to the planner"
        show_map(below, shown, extent_m)
        for panel, words in zip(panels, ("terrain and plan", title), strict=True):
            mark(panel, "start", recording.states[0, :2], _MARKS)
            mark(panel, "goal", recording.goal_m, _MARKS)
            panel.set(aspect="auto", xticks=[], yticks=[])
            panel.text(
                0.02, 0.975, words, transform=panel.transAxes, fontsize=9, va="top",
                bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 2},
            )  # fmt: skip
        self.moving: list[Artist] = [
            *self._layers.values(), *self._edges, self._driven, *self._robots, *self._crosses, self._time,
            self._outcome,
        ]  # fmt: skip
        for artist in self.moving:
            artist.set_animated(True)

    def move(self, time_s: float) -> None:
        """Puts everything where it is at a time."""
        recording = self.recording
        steps = len(recording.traversability)
        now = min(int(time_s / recording.dt_s + 1e-6), steps)
        x, y, heading = recording.states[now, :3]
        track = recording.track[: now + 1]
        draw_driven(self._driven, track, recording.traversability)
        for line in self._edges:
            line.set_data(*track.T)
        turn = np.array(((np.cos(heading), np.sin(heading)), (-np.sin(heading), np.cos(heading))))
        for body in self._robots:
            body.set_xy(_ROBOT_M @ turn + (x, y))
        has_ended = now == steps
        plan = recording.plan_at(time_s)
        for name, layer in self._layers.items():
            layer.set_segments([] if has_ended else list(plan.lines.get(name, ())))
        met = f"{recording.traversability[min(now, steps - 1)]:.2f}" if steps else "–"
        self._time.set_text(f"t = {now * recording.dt_s:5.1f} s   observed λ = {met}")
        self._outcome.set_text(recording.outcome if has_ended else "")
        self._outcome.set_color("#00684a" if recording.about["outcome"] == "success" else "#a00000")
        held = recording.immobilised_at if has_ended else None
        for cross in self._crosses:
            cross.set_data(*(([], []) if held is None else ([held[0]], [held[1]])))
