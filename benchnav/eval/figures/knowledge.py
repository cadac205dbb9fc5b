"""Belief of a robot at four times, from its start to its end."""

from collections.abc import Sequence
from typing import Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.patheffects import Normal, withStroke

from benchnav.core.grid import outline
from benchnav.eval.figures import moment
from benchnav.eval.figures.data import RunData, choose_recordings
from benchnav.eval.recording import Recording
from benchnav.eval.words import contender_names
from benchnav.viz import drives, maps
from benchnav.viz.figure import Figure
from benchnav.viz.style import TWO_COLUMNS_IN, legend_outside

# Label, colours and maximum of each line of panels.
_SHOWN = {
    "mean": ("E[λ]", maps.TRAVERSABILITY_COLOURS, 1.0),
    "spread": ("spread of λ", maps.SPREAD_COLOURS, maps.MAX_SPREAD),
}
_N_TIMES = 4


class KnowledgeMaps(Figure):
    """E[λ] and spread of a robot's belief at four times, for up to four conditions.

    Attributes:
        index: index of the shown recording among the chosen ones.
    """

    name = "knowledge"
    trim = True
    index = 0

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return one figure per condition."""
        return self.numbered(len(_learners(data)))

    def caption(self, data: RunData) -> str:
        """Return a caption that names the condition and explains the maps."""
        shown = _learners(data)
        labels = shown[self.index].about
        name = contender_names([recording.about for recording in shown])[self.index]
        return (
            f"Belief of a robot on {labels['scenario']}, map {labels['map']}, during "
            f"its episode ({name}). Above: E[λ]. Below: spread of λ, half of the range "
            "from the 16 % to the 84 % quantile."
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw the recording."""
        return draw_knowledge(_learners(data)[self.index])


def _learners(data: RunData) -> list[Recording]:
    learning = [recording for recording in data.recordings if recording.known]
    return choose_recordings(learning, list(data.summary["condition"]))


def draw_knowledge(recording: Recording) -> Drawing:
    """Draw the belief of a robot that learns, from its recording."""
    last = len(recording.traversability)
    steps = sorted({round(step) for step in np.linspace(0, last, _N_TIMES)})
    ratio = min(max(recording.grid.height / recording.grid.width, 0.3), 2.0)
    panel_height_in = (TWO_COLUMNS_IN - 0.9) / _N_TIMES * ratio
    figsize = (TWO_COLUMNS_IN, 2 * panel_height_in + 1.1)
    figure = Drawing(figsize=figsize, layout="compressed")
    panels = figure.subplots(2, len(steps), squeeze=False, sharex=True, sharey=True)
    for row, (name, look) in zip(panels, _SHOWN.items(), strict=True):
        label, colours, maximum = look
        for panel, step in zip(row, steps, strict=True):
            _draw_belief(panel, recording, step, name)
        row[0].set_ylabel("y [m]")
        maps.draw_bar(figure, label, row, (colours, maximum), aspect=20)
    for (above, below), step in zip(panels.T, steps, strict=True):
        ended = f"\n{recording.outcome}" if step == last else ""
        above.set_title(f"t = {step * recording.dt_s:.1f} s{ended}", fontsize="small")
        below.set_xlabel("x [m]")
    legend_outside(figure, columns=5)
    return figure


def _draw_belief(panel: Axes, recording: Recording, step: int, name: str) -> None:
    """Draw a map of the belief at a step, with the cells whose λ was measured."""
    moment.show_known(panel, recording, step, name)
    known_map = recording.known_at(step)
    if known_map is not None and known_map.sensed.any():
        edge = outline(known_map.sensed, recording.resolution_m)
        maps.draw_lines(panel, edge, "white", 0.5)
        stroke = [withStroke(linewidth=1.5, foreground="black"), Normal()]
        words = "edge of cells with measured λ"
        panel.plot([], [], color="white", lw=0.5, path_effects=stroke, label=words)
    drive = moment.drive_at(recording, step)
    drives.draw_drive(panel, drive, width=1.2, scale=0.8, label="driven")
    maps.frame_map(panel)
