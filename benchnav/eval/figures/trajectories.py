"""Episodes side by side: terrain, λ̂ of the planner, and the λ field.

The layout follows Fig. 2 of the paper.
"""

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchnav.core.grid import outline
from benchnav.eval.figures import moment
from benchnav.eval.figures.data import RunData, choose_recordings
from benchnav.eval.recording import Recording
from benchnav.eval.words import chosen_in_words, episode_names
from benchnav.viz import drives, maps, plans
from benchnav.viz.figure import Figure
from benchnav.viz.style import (
    ONE_COLUMN_IN,
    TWO_COLUMNS_IN,
    legend_outside,
    stack_panels,
)

_MAX_ACROSS = 4  # recordings side by side
_UNIT = "\N{NO-BREAK SPACE}s"  # seconds, in the same line of a title as the number
_LETTER_IN = 0.048  # mean width of a letter of a title


class Trajectories(Figure):
    """Up to four conditions on the map where outcomes differ most."""

    name = "trajectories"
    trim = True

    def _shown(self, data: RunData) -> Sequence[Recording]:
        return data.on_one_map or choose_recordings(
            data.recordings, list(data.summary["condition"])
        )

    def is_available(self, data: RunData) -> bool:
        """Return whether there are recordings, or steps from which to create them."""
        return bool(self._shown(data))

    def caption(self, data: RunData) -> str:
        """Return a caption that names the map and the choice of conditions."""
        shown = self._shown(data)
        labels = [recording.about for recording in shown]
        map_names = {f"{label['scenario']}, map {label['map']}" for label in labels}
        where = ""
        if len(map_names) == 1:
            where = f" on {map_names.pop()}"
        subject = "Driven paths"
        if any(recording.own_plans for recording in shown):
            subject = "Plans and driven paths"
        caption = (
            f"{subject}{where}, over the terrain and over λ̂, which the planner was "
            "given."
        )
        if any(recording.field is not None for recording in shown):
            caption += " Below: complete driven path over the λ field."
        if data.on_one_map and data.driven:
            caption += chosen_in_words(len(shown), len(data.driven.rows))
        return caption

    def draw(self, data: RunData) -> Drawing:
        """Draw the terrain with the plan above, and the planner's map below.

        If λ was constant, a third row shows the λ field with the driven path.
        """
        return draw_trajectories(self._shown(data))


def draw_trajectories(recordings: Sequence[Recording]) -> Drawing:
    """Draw one or more recordings side by side, with the layout of `Trajectories`."""
    lines = -(-len(recordings) // _MAX_ACROSS)
    across = -(-len(recordings) // lines)  # equally many recordings per line
    layers = 2 if all(recording.field is None for recording in recordings) else 3
    width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    panel_in = (width - 0.9) / across - 0.1
    grids = [recording.grid for recording in recordings]
    max_ratio = max(grid.height / grid.width for grid in grids)
    panel_height_in = panel_in * min(max(max_ratio, 0.3), 2.0) + 0.35
    size = (width, (layers * panel_height_in + 0.2) * lines + 0.8)
    figure = Drawing(figsize=size, layout="compressed")
    stacks = stack_panels(figure, len(recordings), across, layers)
    headings = _headings(recordings)
    letters = int(panel_in / _LETTER_IN)
    for index, (recording, stack) in enumerate(zip(recordings, stacks, strict=True)):
        _draw_terrain(stack[0], recording, headings[index])
        _draw_predicted(stack[1], recording)
        if recording.field is not None:
            _draw_field(stack[2], recording)
        elif len(stack) > 2:
            stack.pop().remove()
        is_leftmost = index % across == 0
        for panel in stack:
            maps.frame_map(panel)
            panel.tick_params(labelleft=is_leftmost, labelbottom=panel is stack[-1])
            panel.set_ylabel("y [m]" if is_leftmost else "")
            title_lines = panel.get_title().splitlines()
            wrapped = [textwrap.fill(line, letters) for line in title_lines]
            panel.set_title("\n".join(wrapped), fontsize="small")
        stack[-1].set_xlabel("x [m]")
    legend_outside(figure)
    shrink = min(1.0, 4 / figure.get_figheight())
    maps.draw_bar(figure, "traversability λ", aspect=40, shrink=shrink, anchor=(0, 1))
    return figure


def _headings(recordings: Sequence[Recording]) -> list[str]:
    """Return titles with the labels that differ, the shown time and the outcome."""
    names = episode_names([recording.about for recording in recordings])
    labels = [recording.about for recording in recordings]
    map_names = [f", {label['scenario']}, map {label['map']}" for label in labels]
    if len(set(map_names)) == 1:
        map_names = [""] * len(recordings)
    headings = []
    for recording, name, map_name in zip(recordings, names, map_names, strict=True):
        shown = f"{recording.outcome} after {recording.end_s:g}{_UNIT}"
        if not moment.has_ended(recording, recording.now):
            time_s = recording.now * recording.dt_s
            shown = f"t = {time_s:g}{_UNIT}; {shown}"
        headings.append(f"{name}{map_name}\n{shown}")
    return headings


def _draw_terrain(panel: Axes, recording: Recording, title: str) -> None:
    """Draw the terrain, and the path up to the shown step in colours of observed λ."""
    maps.show_map(panel, np.moveaxis(recording.rgb, 0, -1), recording.grid.extent_m)
    if recording.field is not None and recording.soft.any():
        for lines_of in (outline, maps.hatching):
            lines = lines_of(recording.soft, recording.resolution_m)
            maps.draw_lines(panel, lines, maps.SOFT, 0.4)
        look = {"fc": "0.45", "ec": maps.SOFT, "hatch": "////"}
        maps.name_terrain(panel, "soft terrain, which no image shows", **look)
    moment.draw_plan(panel, recording, recording.now)
    drive = moment.drive_at(recording, recording.now)
    drives.draw_drive(panel, drive, 2)
    panel.add_collection(plans.driven_colours(drive.track, recording.traversability, 2))
    panel.set_title(title)


def _draw_predicted(panel: Axes, recording: Recording) -> None:
    """Draw the planner's λ̂ at the shown step, with the plan and the driven path."""
    moment.show_known(panel, recording, recording.now)
    moment.draw_plan(panel, recording, recording.now)
    words = "driven path; in the top row, its colour is the observed λ"
    drives.draw_drive(panel, moment.drive_at(recording, recording.now), label=words)
    panel.set_title(moment.known_in_words(recording))


def _draw_field(panel: Axes, recording: Recording) -> None:
    """Draw the λ field and the driven path."""
    moment.show_truth(panel, recording)
    drives.draw_drive(panel, moment.drive_at(recording, len(recording.traversability)))
    panel.set_title("complete path over the λ field")
