"""Videos of episodes on one map, at one time base, 16:9.

Of each episode the λ̂ that its planner was given is shown, with what was planned, and changes as a robot learns; beside
these, the λ field, once for
all episodes that drove on the same.
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
from matplotlib.image import AxesImage
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from benchnav.core.errors import ConfigError
from benchnav.core.store import replacing
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.figures.knowledge import known_colours
from benchnav.eval.recording import Recording
from benchnav.eval.words import NAMING, condition_name, differ, joined
from benchnav.viz import maps
from benchnav.viz.style import condition_colours, line_style

SIZE = (1280, 720)  # of a frame: width and height in pixels
FRAMES_A_SECOND = 20
# Seconds of an episode in a second of video.
SPEED = 4.0
HOLD_S = 2.0  # of the last frame, which says how it ended
MOST_CONDITIONS = 6

_DPI = 100
_MARGIN, _GAP, _TOP, _FOOT, _HEADING = 24, 24, 56, 100, 54  # pixels; the last stands over a panel
_BAR = 210  # pixels, of the colour bar and its last number
_TALLEST = 2.0  # of a map, over its width
_TEXT, _HEAD, _LARGE = 12.0, 14.0, 16.0  # points
_MARKS, _PATH = 1.9, 2.6  # over those of a printed figure, and width in points
_MOST_IN_TWO = 12  # entries of the legend that two lines have room for
_SUCCESS, _FAILED = "#00684a", "#a00000"


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
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for done, time_s in enumerate(times, start=1):
            frame = av.VideoFrame.from_ndarray(frames.draw(float(time_s)), format="rgb24")
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
        drivers: robots on panels, first each on its own of `given`.
    """

    def __init__(self, recordings: Sequence[Recording]) -> None:
        """Draws what never changes."""
        self._figure = Figure(figsize=(SIZE[0] / _DPI, SIZE[1] / _DPI), dpi=_DPI)
        self._canvas = FigureCanvasAgg(self._figure)
        first, names, shared = recordings[0], _names(recordings), _alike(recordings)
        colours = condition_colours([own.about["planner"] for own in recordings])
        colours = ["black"] if len(recordings) == 1 else colours
        panels = self._panels(len(recordings) + len(shared), first.grid.height / first.grid.width)
        self.given, self.truths = panels[: len(recordings)], panels[len(recordings) :]
        self.drivers = []
        for place, (own, panel) in enumerate(zip(recordings, self.given, strict=True)):
            blind, learns = own.about["model"] == NOT_USED, bool(own.known)
            words = "λ̂ known by then" if learns else "λ̂ given to the planner"
            words = "true mean of λ; the planner uses no map" if blind else words
            _head(panel, names[place], words, colours[place])
            shown = (
                known_colours(own.known[-1])["risk"]
                if learns
                else maps.predicted_colours(own.predicted, own.free)
            )
            image = maps.show_map(panel, shown, first.grid.extent_m)
            known = _Known(panel, own, image) if learns else None
            state = _over(panel, "", (1, 1), 5, ha="right", weight="bold")
            driver = _Driver(panel, own, colours[place], line_style(place), state, known)
            self.drivers.append(driver)
        for panel, places in zip(self.truths, shared, strict=True):
            own = recordings[places[0]]
            words = ", ".join(names[place] for place in places) if len(shared) > 1 else ""
            if own.field is None:
                shown, heading = maps.shades(own.true_mean), "mean of λ, resampled at each step"
            else:
                shown, heading = maps.field_colours(own.field, own.immobilising), "λ field of the episode"
            _head(panel, heading, words)
            maps.show_map(panel, shown, first.grid.extent_m)
            for place in places:
                self.drivers.append(_Driver(panel, recordings[place], colours[place], line_style(place)))
        for panel in panels:
            panel.set(aspect="auto", xticks=[], yticks=[])
        about = "{data}, {scenario}, map {map}".format(**first.about)
        self._text(_MARGIN, SIZE[1] - 40, f"{about}; {SPEED:g} × as fast as driven", size=_LARGE)
        self._time = self._text(
            SIZE[0] - _MARGIN, SIZE[1] - 40, "", size=_LARGE, ha="right", family="monospace"
        )
        self._explain(recordings)
        self._moving = [self._time, *(artist for driver in self.drivers for artist in driver.moving)]
        for artist in self._moving:
            artist.set_animated(True)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(self._figure.bbox)

    def draw(self, time_s: float) -> np.ndarray:
        """Draws a frame, uint8 of shape [height, width, 3].

        Args:
            time_s: since the episodes began; those that have ended stay as they ended.
        """
        self._canvas.restore_region(self._background)
        self._time.set_text(f"t = {time_s:5.1f} s")
        for driver in self.drivers:
            driver.move(time_s)
        for artist in self._moving:
            self._figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _panels(self, count: int, ratio: float) -> list[Axes]:
        """Panels for maps of a height over width, as large as fits, row by row, in the middle of the frame."""
        wide, high, ratio = SIZE[0] - 2 * _MARGIN, SIZE[1] - _TOP - _FOOT, min(ratio, _TALLEST)
        widths = {}
        for columns in range(1, count + 1):
            rows = -(-count // columns)
            tall = (high + _GAP) / rows - _GAP - _HEADING
            widths[columns] = min((wide + _GAP) / columns - _GAP, tall / ratio)
        columns, width = max(widths.items(), key=lambda item: item[1])
        across, down = width + _GAP, width * ratio + _HEADING + _GAP
        left = (SIZE[0] - columns * across + _GAP) / 2
        top = _FOOT + (high + -(-count // columns) * down + _GAP) / 2
        places = [divmod(place, columns) for place in range(count)]
        return [self._axes(left + x * across, top - (y + 1) * down, width, width * ratio) for y, x in places]

    def _explain(self, recordings: Sequence[Recording]) -> None:
        """Draws below all panels a scale bar, what is what, and the colours of λ."""
        width_m, _ = recordings[0].grid.extent_m
        length_m = maps.scale_length(width_m)
        length = length_m / width_m * self.given[0].get_window_extent().width
        bar = self._axes(_MARGIN, 30, length, 8)
        bar.set(label="scale", xticks=[], yticks=[], facecolor="black")
        self._text(_MARGIN + length / 2, 48, f"{length_m:g} m", ha="center")
        layers = {
            name
            for own in recordings
            for plan in own.own_plans
            for name, lines in plan.lines.items()
            if lines
        }
        ends = dict.fromkeys(maps.end_mark(own.about["outcome"]) for own in recordings)
        handles: list[Artist] = [
            maps.mark_handle(name, 0.8 * _MARKS) for name in ("start", "goal", "robot", *ends)
        ]
        handles += [
            maps.plan_layer(style, scale=_MARKS) for name, style in maps.STYLES.items() if name in layers
        ]
        words = "driven" if len(recordings) == 1 else "driven, in the colour of its title"
        handles.append(Line2D([], [], color="black", lw=_PATH, label=words))
        if any(not own.free.all() for own in recordings):
            handles.append(Patch(color=maps.CLOSED, label="not free"))
        if any(own.immobilising.any() for own in recordings):
            handles.append(Patch(color=maps.IMMOBILISING, label="immobilises a robot"))
        every = [known for own in recordings for known in own.known]
        reaches = any(known.outlines for known in every)
        handles += maps.sensing_handles([known.seen for known in every], reaches, _MARKS)
        lines = 2 if len(handles) <= _MOST_IN_TWO else 3
        columns, between = -(-len(handles) // lines), 0.5 + (length - _BAR) / 2 / SIZE[0]

        def legend(size: float) -> Legend:
            return self._figure.legend(
                handles=handles, loc="center", bbox_to_anchor=(between, 42 / SIZE[1]), ncols=columns, fontsize=size,
                frameon=False, columnspacing=1.2, handlelength=1.4,
            )  # fmt: skip

        if (shrunk := _shrunk(first := legend(_TEXT), SIZE[0] - 2 * _MARGIN - length - _BAR)) < 1:
            first.remove()
            legend(_TEXT * shrunk)
        shown = ScalarMappable(Normalize(0, 1), maps.TRAVERSABILITY_COLOURS)
        bar = self._axes(SIZE[0] - _MARGIN - _BAR, 34, _BAR - 10, 14)
        self._figure.colorbar(shown, cax=bar, orientation="horizontal", ticks=[0, 0.5, 1])
        bar.tick_params(labelsize=_TEXT, length=3)
        bar.set_title("traversability λ, λ̂", fontsize=_TEXT, pad=4)

    def _axes(self, x: float, y: float, width: float, height: float) -> Axes:
        return self._figure.add_axes((x / SIZE[0], y / SIZE[1], width / SIZE[0], height / SIZE[1]))

    def _text(self, x: float, y: float, words: str, size: float = _TEXT, **style: Any) -> Text:
        return self._figure.text(x / SIZE[0], y / SIZE[1], words, fontsize=size, parse_math=False, **style)


def _names(recordings: Sequence[Recording]) -> list[str]:
    """Names of planner and risk setting, and of what else differs."""
    every = [own.about for own in recordings]
    several = [name for name in NAMING if differ(about.get(name, NOT_USED) for about in every)]
    more = [name for name in ("robot", "objective") if name in several]
    return [joined([condition_name(about, several), *(about[name] for name in more)]) for about in every]


def _alike(recordings: Sequence[Recording]) -> list[list[int]]:
    """Places of recordings by the λ that was there, those of one λ together."""
    groups: dict[bytes, list[int]] = {}
    for place, own in enumerate(recordings):
        truth = (own.true_mean,) if own.field is None else (own.field, own.immobilising)
        groups.setdefault(b"".join(part.tobytes() for part in truth), []).append(place)
    return list(groups.values())


def _over(panel: Axes, words: str, corner: tuple[int, int], points: float, **style: Any) -> Text:
    """Text at an upper corner of a panel, so many points above it; smaller over a small panel."""
    size = min(1.0, panel.get_window_extent().width / 380) * style.pop("fontsize", _TEXT)
    looks: dict[str, Any] = {"fontsize": size, "parse_math": False, **style}
    return panel.annotate(
        words, corner, (0, points), xycoords="axes fraction", textcoords="offset points", **looks
    )


def _head(panel: Axes, heading: str, words: str = "", colour: str = "black") -> None:
    """Writes over a panel what it shows, and under that a line that is not as loud."""
    head = _over(panel, heading, (0, 1), 22 if words else 5, fontsize=_HEAD, weight="bold", color=colour)
    head.set_fontsize(float(head.get_fontsize()) * _shrunk(head, panel.get_window_extent().width))
    _over(panel, words, (0, 1), 5, color="0.25")


def _shrunk(words: Text | Legend, room: float) -> float:
    """What the size of letters is multiplied by to fit into so many pixels, which hinting may widen them by."""
    return min(1.0, 0.96 * room / max(words.get_window_extent().width, 1))


class _Known:
    """The map of a robot that learns: what was known of it by a step, and how far the sensors reached.

    Args:
        panel: which it is drawn on.
        recording: with what was known.
        image: of the λ̂ that was known.

    Attributes:
        moving: what is drawn anew in each frame, from the undermost to the topmost.
    """

    def __init__(self, panel: Axes, recording: Recording, image: AxesImage) -> None:
        self._recording, self._image, self._shown = recording, image, -1
        first = recording.known[0]
        self._unseen = maps.unseen_layer(first.seen, recording.resolution_m, _MARKS)
        self._reach = maps.reach_line(first.outline, _MARKS)
        panel.add_collection(self._unseen)
        panel.add_line(self._reach)
        self.moving: list[Artist] = [image, self._unseen, self._reach, *panel.spines.values()]

    def move(self, step: int) -> None:
        """Shows what was known at a step."""
        known = self._recording.known_at(step) or self._recording.known[0]
        if known.step == self._shown:
            return
        self._shown = known.step
        self._image.set_data(known_colours(known)["risk"])
        self._unseen.set_segments(list(maps.hatching(~known.seen, self._recording.resolution_m)))
        self._reach.set_data(*known.outline.T)


class _Driver:
    """A robot on a map: its path, itself, how it ended, and what it planned, where a line says how it fares.

    Args:
        panel: which the map is drawn on.
        recording: its episode.
        colour: of its path.
        style: of its path.
        state: what says the observed λ, and at the end the outcome; without it no plan is drawn.
        known: the map, where what is known of it changes.

    Attributes:
        moving: what is drawn anew in each frame, from the undermost to the topmost.
    """

    def __init__(
        self,
        panel: Axes,
        recording: Recording,
        colour: str,
        style: Any,
        state: Text | None = None,
        known: _Known | None = None,
    ) -> None:
        self.recording, self.state, self._known = recording, state, known
        planned = maps.STYLES if state is not None else {}
        self.layers = {name: maps.plan_layer(look, scale=_MARKS) for name, look in planned.items()}
        for layer in self.layers.values():
            panel.add_collection(layer)
        track = recording.track
        self.path = maps.draw_path(panel, track, _PATH, colour, ls=style, zorder=2)
        places = [
            maps.mark(panel, "start", track[0], _MARKS),
            maps.mark(panel, "goal", recording.goal_m, _MARKS),
        ]
        self.robot = maps.mark(panel, "robot", track[0], _MARKS)
        drive = maps.Drive(track=track, goal_m=recording.goal_m, outcome=recording.about["outcome"])
        self.end = maps.mark_end(panel, drive, _MARKS)
        said = [] if state is None else [state]
        self.moving = [
            *(known.moving if known else ()),
            *self.layers.values(),
            *self.path,
            *places,
            self.robot,
            self.end,
            *said,
        ]

    def move(self, time_s: float) -> None:
        """Puts everything where it is at a time."""
        own = self.recording
        steps = len(own.traversability)
        now = min(int(time_s / own.dt_s + 1e-6), steps)
        has_ended = now == steps
        if self._known:
            self._known.move(now)
        for line in self.path:
            line.set_data(*own.track[: now + 1].T)
        x, y, heading_rad = own.states[now, :3]
        self.robot.set_data([x], [y])
        self.robot.set_marker(maps.robot_marker(heading_rad))
        self.robot.set_visible(not has_ended)
        self.end.set_visible(has_ended)
        plan = own.plan_at(time_s)
        for name, layer in self.layers.items():
            layer.set_segments([] if has_ended else list(plan.lines.get(name, ())))
        if self.state is None:
            return
        if has_ended:
            is_success = own.about["outcome"] == "success"
            self.state.set(
                text=f"{own.outcome}, {own.end_s:.1f} s", color=_SUCCESS if is_success else _FAILED
            )
        else:
            self.state.set(text=f"observed λ = {own.traversability[now]:.2f}", color="0.25")
