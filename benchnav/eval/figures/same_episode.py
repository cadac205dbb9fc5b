"""The same episode in several worlds, side by side."""

import textwrap
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.figures import moment
from benchnav.eval.figures.data import MAX_PANELS, RunData
from benchnav.eval.recording import MAP, Recording
from benchnav.eval.words import condition_name, world_names
from benchnav.viz import drives, maps
from benchnav.viz.bodies import MAX_RUT_M
from benchnav.viz.figure import Figure
from benchnav.viz.panels import GRID
from benchnav.viz.style import BLUE, ORANGE, TWO_COLUMNS_IN, legend_outside

_LETTER_IN = 0.055  # mean width of a letter of a title
_SERIES = 0.42  # height of a time series divided by that of a map
_OTHER_LABELS = [name for name in (*LABELS, *MAP) if name != "world"]


class SameEpisode(Figure):
    """One episode in up to four worlds, on the map on which its outcomes differ most."""

    name = "same-episode"
    trim = True

    def is_available(self, data: RunData) -> bool:
        """Return whether a robot with a footprint was recorded in several worlds."""
        return bool(_chosen(data))

    def caption(self, data: RunData) -> str:
        """Return a caption that names the episode and explains the rows."""
        shown = _chosen(data)
        labels = shown[0].about
        return (
            f"The same episode ({condition_name(labels)}; {labels['scenario']}, map "
            f"{labels['map']}) in {len(shown)} worlds. Above: the λ field, the same in "
            "all worlds, and the driven path. Middle: the robot in its size, at the end "
            "or, if it succeeded, where it observed the smallest λ; lines are the "
            "tracks of its wheels. Below: observed λ and, if ruts were recorded, the "
            "depth of the deepest one."
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw a column for each world."""
        return draw_same_episode(_chosen(data))


def _chosen(data: RunData) -> list[Recording]:
    if data.summary.empty:
        return []
    return same_episodes(data.recordings, list(data.summary["condition"]))


def same_episodes(
    recordings: Sequence[Recording], conditions: Sequence[str]
) -> list[Recording]:
    """Choose recordings that differ only in their world, up to `MAX_PANELS`.

    Among such episodes of robots with a footprint, those with most different outcomes
    are chosen, then those in most worlds, then the first. Without such an episode, the
    list is empty.

    Args:
        recordings: all recordings.
        conditions: ids of conditions, in the order in which worlds are shown.
    """
    groups: dict[tuple[str, ...], list[Recording]] = defaultdict(list)
    for condition in conditions:
        for recording in recordings:
            is_next = recording.about["condition"] == condition
            if is_next and recording.contacts_m is not None:
                key = tuple(recording.about.get(name, "") for name in _OTHER_LABELS)
                groups[key].append(recording)
    chosen: list[Recording] = []
    for group in groups.values():
        if len(group) > 1 and _rank(group) > _rank(chosen):
            chosen = group
    return chosen[:MAX_PANELS]


def _rank(group: Sequence[Recording]) -> tuple[int, int]:
    outcomes = {recording.outcome for recording in group}
    return len(outcomes), len(group)


def draw_same_episode(recordings: Sequence[Recording]) -> Drawing:
    """Draw recordings side by side: the path, a close-up, and λ over time."""
    count = len(recordings)
    width_m = moment.CLOSE_UP_M
    map_in = (TWO_COLUMNS_IN - 1.0) / count
    ratio = recordings[0].grid.height / recordings[0].grid.width
    heights = [ratio, 1.0, _SERIES]
    size = (TWO_COLUMNS_IN, map_in * sum(heights) + 1.7)
    figure = Drawing(figsize=size, layout="constrained")
    panels = figure.subplots(3, count, squeeze=False, height_ratios=heights)
    names = world_names([recording.about["world"] for recording in recordings])
    letters = int(map_in / _LETTER_IN)
    for index, (recording, column) in enumerate(zip(recordings, panels.T, strict=True)):
        field, close_up, series = column
        last = len(recording.traversability)
        moment.show_truth(field, recording)
        drives.draw_drive(field, moment.drive_at(recording, last), label="driven path")
        outcome = f"{recording.outcome} after {recording.end_s:.1f} s"
        title = textwrap.wrap(names[recording.about["world"]], letters)
        field.set_title("\n".join([*title, outcome]))
        step = _shown_step(recording)
        moment.draw_close_up(close_up, recording, step)
        close_up.set_title(f"t = {step * recording.dt_s:.1f} s, {width_m:g} m wide")
        for panel in (field, close_up):
            panel.set(xticks=[], yticks=[])
            maps.frame_map(panel)
        maps.draw_scale(field, recording.grid.extent_m)
        _draw_series(series, recording)
        series.axvline(step * recording.dt_s, color="0.4", lw=0.6, ls=":")
        if index:
            series.tick_params(labelleft=False)
        else:
            series.set_ylabel("observed λ", color=BLUE)
    maps.draw_bar(figure, "traversability λ", panels[:2].ravel(), aspect=40)
    legend_outside(figure, columns=5)
    return figure


def _shown_step(recording: Recording) -> int:
    """Return the step of the close-up: the end, or the least λ of a success."""
    if recording.about["outcome"] == "success" and len(recording.traversability):
        return int(np.argmin(recording.traversability))
    return len(recording.traversability)


def _draw_series(panel: Axes, recording: Recording) -> None:
    """Draw observed λ and the depth of the deepest rut over time."""
    times_s = np.arange(len(recording.traversability)) * recording.dt_s
    panel.plot(times_s, recording.traversability, color=BLUE, lw=0.9)
    panel.set(ylim=(0, 1.02), xlim=(0, max(recording.end_s, 1)), xlabel="t [s]")
    panel.grid(color=GRID)
    if recording.ruts_m is None:
        return
    deepest_cm = 100 * recording.ruts_m.max(axis=1)
    depth = panel.twinx()
    times_s = np.arange(len(deepest_cm)) * recording.dt_s
    depth.plot(times_s, deepest_cm, color=ORANGE, lw=1.1, ls=(0, (3.2, 1.2)))
    depth.set_ylim(0, max(1.02 * deepest_cm.max(), 100 * MAX_RUT_M))
    depth.set_ylabel("deepest rut [cm]", color=ORANGE)
    depth.spines["right"].set_visible(True)
