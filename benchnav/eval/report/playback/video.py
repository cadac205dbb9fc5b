"""Videos of episodes on one map, at one time base, 16:9.

Of each episode the λ̂ that its planner was given is shown, with what was planned, and
changes as a robot learns; next to these, the λ field, once for all episodes that drove
on the same.
"""

import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

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
from benchnav.viz import maps
from benchnav.viz.style import (
    TEXT,
    condition_colours,
    legend_outside,
    line_style,
    stack_panels,
    styled,
)

SIZE = (1280, 720)  # of a frame: width and height in pixels
FRAMES_A_SECOND = 20
# Seconds of an episode in a second of video.
SPEED = 4.0
HOLD_S = 2.0  # of the last frame, which says how it ended
MOST_CONDITIONS = 6

# a frame is as large as a printed figure, and letters and lines are those of one
_DPI = 160
# heights of what is over and below all maps, and around each row of them
_ENDS_IN, _HEADING_IN = (
    0.8,
    0.6,
)
_BAR_IN = 0.9  # width of the colour bar
_LETTER_IN = 0.068
_MOMENTS = 9  # of an episode, of which the legend names what is drawn


def frame_times(end_s: float) -> np.ndarray:
    """Return times in an episode that frames show, up to its end, which is shown a
    while.

    Args:
        end_s: when the last episode ends.
    """
    moving = np.arange(0.0, end_s, SPEED / FRAMES_A_SECOND)
    return np.append(moving, np.full(round(HOLD_S * FRAMES_A_SECOND), end_s))


def write_video(
    recordings: Sequence[Recording], path: Path
) -> Iterator[tuple[int, int]]:
    """Write a video atomically, yielding (frames done, frames in all); to be iterated
    to the end.

    Args:
        recordings: one, or several of one map.
        path: an `.mp4` file.

    Raises:
        ConfigError: If there are too many to be seen.
    """
    import av

    if len(recordings) > MOST_CONDITIONS:
        raise ConfigError(
            f"Expected at most {MOST_CONDITIONS} conditions side by side, got "
            f"{len(recordings)}."
        )
    frames, times = (
        Frames(recordings),
        frame_times(max(recording.end_s for recording in recordings)),
    )
    faststart = {"movflags": "+faststart"}
    with (
        replacing(path) as partial,
        av.open(str(partial), "w", format="mp4", options=faststart) as container,
    ):
        stream = container.add_stream(
            "libx264", rate=FRAMES_A_SECOND, options={"crf": "20"}
        )
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for done, time_s in enumerate(times, start=1):
            frame = av.VideoFrame.from_ndarray(
                frames.draw(float(time_s)), format="rgb24"
            )
            container.mux(stream.encode(frame))
            yield done, len(times)
        container.mux(stream.encode())


class Frames:
    """Draws episodes at any time.

    Args:
        recordings: at least one, of one map.

    Attributes:
        given: of each recording the panel of the λ̂ that its planner was given.
        truths: the panels of the λ field.
        time: what says the time.
    """

    @styled()
    def __init__(self, recordings: Sequence[Recording]) -> None:
        """Draw what never changes."""
        self._recordings, self._shared = recordings, _alike(recordings)
        self._moving: list[Artist] = []
        count, extent_m = (
            len(recordings) + len(self._shared),
            recordings[0].grid.extent_m,
        )
        self._figure = Figure(
            figsize=(SIZE[0] / _DPI, SIZE[1] / _DPI), dpi=_DPI, layout="constrained"
        )
        self._canvas = FigureCanvasAgg(self._figure)
        columns = _columns(count, extent_m[1] / extent_m[0])
        panels = [panel for (panel,) in stack_panels(self._figure, count, columns)]
        self.given, self.truths = panels[: len(recordings)], panels[len(recordings) :]
        names = episode_names([own.about for own in recordings])
        planners = [own.about["planner"] for own in recordings]
        self._colours = (
            condition_colours(planners) if len(recordings) > 1 else ["black"]
        )
        letters = int(SIZE[0] / _DPI / (columns + 0.4) / _LETTER_IN)
        for own, panel, name, colour in zip(
            recordings, self.given, names, self._colours, strict=True
        ):
            _title(panel, f"{name}\n{moment.known_in_words(own)}", letters, colour)
            if not own.known:
                moment.show_known(panel, own, 0)
        for panel, indices in zip(self.truths, self._shared, strict=True):
            is_field = recordings[indices[0]].field is not None
            heading = (
                "λ field of the episode"
                if is_field
                else "mean of λ, resampled at each step"
            )
            of = (
                "; ".join(names[index] for index in indices)
                if len(self._shared) > 1
                else ""
            )
            _title(panel, f"{heading}\n{of}", letters)
            moment.show_truth(panel, recordings[indices[0]])
        for panel in panels:
            panel.axis("off")
        maps.draw_scale(panels[-1], extent_m)
        about = "{data}, {scenario}, map {map}".format(**recordings[0].about)
        words = f"{about}; {SPEED:g} × as fast as driven"
        self._figure.suptitle(words, x=0.01, ha="left", parse_math=False)
        at: dict[str, float | str] = {
            "x": 0.99,
            "y": 0.985,
            "va": "top",
            "ha": "right",
            "s": "",
        }
        self.time = self._figure.text(**at, family="monospace", animated=True)  # type: ignore[arg-type]
        maps.draw_bar(self._figure, "traversability λ, λ̂", aspect=30)
        for time_s in np.linspace(0, max(own.end_s for own in recordings), _MOMENTS):
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
            time_s: since the episodes began; those that have ended stay as they ended.
        """
        self._canvas.restore_region(self._background)
        self._clear()
        self._put(time_s)
        for artist in [self.time, *sorted(self._moving, key=Artist.get_zorder)]:
            self._figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _clear(self) -> None:
        for artist in self._moving:
            artist.remove()
        self._moving = []

    def _put(self, time_s: float) -> None:
        """Put on the panels what they show at a time."""
        before = {
            artist for panel in self._figure.axes for artist in panel.get_children()
        }
        self.time.set_text(f"t = {time_s:5.1f} s")
        for index, (panel, own) in enumerate(
            zip(self.given, self._recordings, strict=True)
        ):
            step = _step(own, time_s)
            if own.known:
                moment.show_known(panel, own, step)
            moment.draw_plan(panel, own, step)
            self._put_robot(panel, index, step)
            words = (
                "observed λ = "
                f"{own.traversability[min(step, len(own.traversability) - 1)]:.2f}"
                if step
                else ""
            )
            words = (
                f"{own.outcome}, {own.end_s:.1f} s"
                if moment.has_ended(own, step)
                else words
            )
            panel.text(
                1,
                -0.02,
                words,
                transform=panel.transAxes,
                ha="right",
                va="top",
                size=TEXT,
            )
        for panel, indices in zip(self.truths, self._shared, strict=True):
            for index in indices:
                self._put_robot(panel, index, _step(self._recordings[index], time_s))
        after = (
            artist for panel in self._figure.axes for artist in panel.get_children()
        )
        self._moving += [artist for artist in after if artist not in before]

    def _put_robot(self, panel: Axes, index: int, step: int) -> None:
        several = len(self._recordings) > 1
        label = "driven, in the colour of its title" if several else "driven"
        drive = moment.drive_at(self._recordings[index], step)
        maps.draw_drive(
            panel,
            drive,
            1.8,
            colour=self._colours[index],
            ls=line_style(index),
            label=label,
        )


def _step(recording: Recording, time_s: float) -> int:
    """Return the step of an episode at a time; the last once it has ended."""
    return min(int(time_s / recording.dt_s + 1e-6), len(recording.traversability))


def _columns(count: int, ratio: float) -> int:
    """Return how many maps of a height over width stand side by side, so that they are
    as large as possible.
    """
    wide, high = (size / _DPI for size in SIZE)
    widths = {
        columns: min(
            (wide - _BAR_IN) / columns, ((high - _ENDS_IN) / rows - _HEADING_IN) / ratio
        )
        for columns in range(1, count + 1)
        for rows in [-(-count // columns)]
    }
    return max(widths, key=widths.__getitem__)


def _title(panel: Axes, words: str, letters: int, colour: str = "black") -> None:
    """Write over a panel what it shows, in lines of a number of letters."""
    lines = [
        line for part in words.splitlines() for line in textwrap.wrap(part, letters)
    ]
    panel.set_title("\n".join(lines), color=colour, parse_math=False)


def _alike(recordings: Sequence[Recording]) -> list[list[int]]:
    """Indices of recordings by the λ that was there, those of one λ together."""
    groups: dict[bytes, list[int]] = {}
    for index, own in enumerate(recordings):
        groups.setdefault(moment.true_colours(own).tobytes(), []).append(index)
    return list(groups.values())
