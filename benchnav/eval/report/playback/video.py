"""Videos of one or several episodes on one map, synchronous in time, in 16:9.

A frame shows the λ̂ of each planner with its plan, and the λ field. Episodes with the
same λ field share one panel of it. Below, a robot with a footprint has a close-up.
"""

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchnav.core.errors import ConfigError
from benchnav.core.store import replacing
from benchnav.eval.figures import moment
from benchnav.eval.recording import Recording
from benchnav.eval.words import episode_names
from benchnav.viz import drives, maps
from benchnav.viz.style import (
    TEXT,
    condition_colours,
    legend_outside,
    line_style,
    stack_panels,
    styled,
)

SIZE = (1280, 720)  # width and height of a frame in pixels
FRAMES_A_SECOND = 20
SPEED = 4.0  # seconds of an episode in a second of video
HOLD_S = 2.0  # duration of the last frame, which shows the outcome
MAX_CONDITIONS = 6

# With this resolution, a frame has the text and line sizes of a printed figure.
_DPI = 160
# Dimensions in inches.
_ENDS_IN = 0.8  # total height above and below all maps
_HEADING_IN = 0.6  # height of the heading of each row of maps
_BAR_IN = 0.9  # width of the colour bar
_LETTER_IN = 0.068  # mean width of a letter of a title
_N_LEGEND_TIMES = 9  # number of times whose contents the legend names


def frame_times(end_s: float) -> np.ndarray:
    """Return the time of each frame in seconds; the last is repeated for `HOLD_S`.

    Args:
        end_s: latest time of the end of an episode, in seconds.
    """
    moving = np.arange(0.0, end_s, SPEED / FRAMES_A_SECOND)
    return np.append(moving, np.full(round(HOLD_S * FRAMES_A_SECOND), end_s))


def write_video(
    recordings: Sequence[Recording], path: Path
) -> Iterator[tuple[int, int]]:
    """Write a video atomically, and yield (frames done, total frames).

    Args:
        recordings: one recording, or several on one map.
        path: an `.mp4` file.

    Raises:
        ConfigError: If there are more than `MAX_CONDITIONS` recordings.
    """
    import av

    if len(recordings) > MAX_CONDITIONS:
        raise ConfigError(
            f"Expected at most {MAX_CONDITIONS} conditions side by side, got "
            f"{len(recordings)}. Select fewer conditions."
        )
    frames = Frames(recordings)
    times = frame_times(max(recording.end_s for recording in recordings))
    faststart = {"movflags": "+faststart"}
    with (
        replacing(path) as partial,
        av.open(str(partial), "w", format="mp4", options=faststart) as container,
    ):
        quality = {"crf": "20"}
        stream = container.add_stream("libx264", FRAMES_A_SECOND, options=quality)
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for done, time_s in enumerate(times, start=1):
            image = frames.draw(float(time_s))
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame))
            yield done, len(times)
        container.mux(stream.encode())


class Frames:
    """Renderer of the frames of a video.

    Args:
        recordings: one recording, or several on one map.

    Attributes:
        given: panel with the planner's λ̂, for each recording.
        truths: panel with λ, for each group of recordings with the same λ.
        close_ups: panel with a close-up of the robot, by index of the recording.
        time: text with the time.
    """

    @styled()
    def __init__(self, recordings: Sequence[Recording]) -> None:
        """Draw the static contents."""
        self._recordings = recordings
        self._groups = _groups_by_truth(recordings)
        self._moving: list[Artist] = []
        count = len(recordings) + len(self._groups)
        extent_m = recordings[0].grid.extent_m
        width_in = SIZE[0] / _DPI
        size_in = (width_in, SIZE[1] / _DPI)
        self._figure = Figure(figsize=size_in, dpi=_DPI, layout="constrained")
        self._canvas = FigureCanvasAgg(self._figure)
        have_contacts = [recording.contacts_m is not None for recording in recordings]
        layers = 2 if any(have_contacts) else 1
        columns = _columns(count, layers * extent_m[1] / extent_m[0])
        stacks = stack_panels(self._figure, count, columns, layers)
        self.close_ups: dict[int, Axes] = {}
        for index, stack in enumerate(stacks):
            if index < len(recordings) and have_contacts[index]:
                self.close_ups[index] = stack[1]
                stack[1].axis("off")
            elif layers > 1:
                stack[1].remove()
        panels = [stack[0] for stack in stacks]
        self.given = panels[: len(recordings)]
        self.truths = panels[len(recordings) :]
        names = episode_names([recording.about for recording in recordings])
        planners = [recording.about["planner"] for recording in recordings]
        self._colours = ["black"]
        if len(recordings) > 1:
            self._colours = condition_colours(planners)
        letters = int(width_in / (columns + 0.4) / _LETTER_IN)
        for index, (recording, panel) in enumerate(
            zip(recordings, self.given, strict=True)
        ):
            title = f"{names[index]}\n{moment.known_in_words(recording)}"
            _title(panel, title, letters, self._colours[index])
            if not recording.known:
                moment.show_known(panel, recording, 0)
        for panel, indices in zip(self.truths, self._groups, strict=True):
            recording = recordings[indices[0]]
            heading = "λ field of the episode"
            if recording.field is None:
                heading = "mean of λ, resampled at each step"
            conditions = ""
            if len(self._groups) > 1:
                conditions = "; ".join(names[index] for index in indices)
            _title(panel, f"{heading}\n{conditions}", letters)
            moment.show_truth(panel, recording)
        for panel in panels:
            panel.axis("off")
        maps.draw_scale(panels[-1], extent_m)
        map_name = "{data}, {scenario}, map {map}".format(**recordings[0].about)
        words = f"{map_name}; {SPEED:g} × as fast as driven"
        self._figure.suptitle(words, x=0.01, ha="left", parse_math=False)
        placement: dict[str, float | str] = {
            "x": 0.99,
            "y": 0.985,
            "va": "top",
            "ha": "right",
            "s": "",
        }
        self.time = self._figure.text(**placement, family="monospace", animated=True)  # type: ignore[arg-type]
        maps.draw_bar(self._figure, "traversability λ, λ̂", aspect=30)
        end_s = max(recording.end_s for recording in recordings)
        for time_s in np.linspace(0, end_s, _N_LEGEND_TIMES):
            self._put(float(time_s))
        legend_outside(self._figure, columns=5)
        engine = self._figure.get_layout_engine()
        assert engine is not None
        engine.execute(self._figure)
        self._figure.set_layout_engine("none")
        self._clear()
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    @styled()
    def draw(self, time_s: float) -> np.ndarray:
        """Draw a frame, uint8 of shape [height, width, 3].

        Args:
            time_s: time since the start in seconds; after its end, an episode remains
                in its last state.
        """
        self._canvas.restore_region(self._background)
        self._clear()
        self._put(time_s)
        by_depth = sorted(self._moving, key=Artist.get_zorder)
        for artist in (self.time, *by_depth):
            self._figure.draw_artist(artist)
        pixels = np.asarray(self._canvas.buffer_rgba())
        return pixels[..., :3].copy()

    def _clear(self) -> None:
        for artist in self._moving:
            artist.remove()
        self._moving = []

    def _put(self, time_s: float) -> None:
        """Draw the contents of all panels at a time."""
        before = set(self._artists())
        self.time.set_text(f"t = {time_s:5.1f} s")
        for index, (panel, recording) in enumerate(
            zip(self.given, self._recordings, strict=True)
        ):
            step = _step(recording, time_s)
            if recording.known:
                moment.show_known(panel, recording, step)
            moment.draw_plan(panel, recording, step)
            self._put_robot(panel, index, step)
            corner: dict[str, Any] = {"transform": panel.transAxes, "ha": "right"}
            words = _state_in_words(recording, step)
            panel.text(1, -0.02, words, va="top", size=TEXT, **corner)
            if index in self.close_ups:
                moment.draw_close_up(self.close_ups[index], recording, step)
                moment.draw_plan(self.close_ups[index], recording, step)
        for panel, indices in zip(self.truths, self._groups, strict=True):
            for index in indices:
                step = _step(self._recordings[index], time_s)
                self._put_robot(panel, index, step)
        new = [artist for artist in self._artists() if artist not in before]
        self._moving += new

    def _artists(self) -> list[Artist]:
        return [
            artist for panel in self._figure.axes for artist in panel.get_children()
        ]

    def _put_robot(self, panel: Axes, index: int, step: int) -> None:
        several = len(self._recordings) > 1
        label = "driven, in the colour of its title" if several else "driven"
        drive = moment.drive_at(self._recordings[index], step)
        look = {"colour": self._colours[index], "ls": line_style(index)}
        drives.draw_drive(panel, drive, 1.8, label=label, **look)


def _step(recording: Recording, time_s: float) -> int:
    """Return the step of an episode at a time; after its end, the last step."""
    step = int(time_s / recording.dt_s + 1e-6)
    return min(step, len(recording.traversability))


def _state_in_words(recording: Recording, step: int) -> str:
    """Return the outcome if the episode has ended, otherwise the observed λ."""
    if moment.has_ended(recording, step):
        return f"{recording.outcome}, {recording.end_s:.1f} s"
    if not step:
        return ""
    return f"observed λ = {recording.traversability[step]:.2f}"


def _columns(count: int, ratio: float) -> int:
    """Return the number of columns for which the maps are largest.

    Args:
        count: number of maps.
        ratio: height of a map divided by its width.
    """
    wide, high = (size / _DPI for size in SIZE)
    widths = {}
    for columns in range(1, count + 1):
        rows = -(-count // columns)
        by_height = ((high - _ENDS_IN) / rows - _HEADING_IN) / ratio
        widths[columns] = min((wide - _BAR_IN) / columns, by_height)
    return max(widths, key=widths.__getitem__)


def _title(panel: Axes, words: str, letters: int, colour: str = "black") -> None:
    """Set the title of a panel, wrapped to a number of letters."""
    lines: list[str] = []
    for line in words.splitlines():
        lines += textwrap.wrap(line, letters)
    panel.set_title("\n".join(lines), color=colour, parse_math=False)


def _groups_by_truth(recordings: Sequence[Recording]) -> list[list[int]]:
    """Return the indices of recordings, grouped by identical true λ."""
    groups: dict[bytes, list[int]] = {}
    for index, recording in enumerate(recordings):
        content = moment.true_colours(recording).tobytes()
        groups.setdefault(content, []).append(index)
    return list(groups.values())
