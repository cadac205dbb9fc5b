"""What a robot knew at four moments, from its start to its end."""

from collections.abc import Sequence
from typing import Self

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, withStroke

from benchnav.core.grid import outline
from benchnav.eval.figures.data import RunData, choose_recordings
from benchnav.eval.figures.trajectories import drive_at
from benchnav.eval.recording import KnownMap, Recording
from benchnav.eval.words import contender_names
from benchnav.viz import maps
from benchnav.viz.figure import Figure
from benchnav.viz.style import TWO_COLUMNS_IN, bytes_of, legend_outside

# Of each line of panels its label, its colours, and what has the lightest.
_SHOWN = {
    "mean": ("E[λ]", maps.TRAVERSABILITY_COLOURS, 1.0),
    "spread": ("spread of λ", maps.SPREAD_COLOURS, maps.MAX_SPREAD),
}
_MOMENTS = 4
_SENSED_EDGE = "white"
_THIN = 0.6  # of the width of lines on a larger map


class KnowledgeMaps(Figure):
    """E[λ] of the belief of a robot at four moments, and its spread, one for each of at most four conditions.

    Attributes:
        place: of the recording among those that are shown.
    """

    name = "knowledge"
    trim = True
    place = 0

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return a figure a condition."""
        return self.numbered(len(_learners(data)))

    def caption(self, data: RunData) -> str:
        """Return whose knowledge it is."""
        shown = _learners(data)
        about = shown[self.place].about
        name = contender_names([own.about for own in shown])[self.place]
        return (
            f"What a robot knew of {about['scenario']}, map {about['map']}, during its episode ({name}): E[λ] of its "
            "belief above, and below its spread, half of the range from the 16 % to the 84 % quantile of λ."
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw the recording."""
        return draw_knowledge(_learners(data)[self.place])


def _learners(data: RunData) -> list[Recording]:
    known = [own for own in data.recordings if own.known]
    return choose_recordings(known, list(data.summary["condition"]))


def draw_knowledge(recording: Recording) -> Drawing:
    """Draw what a robot knew, of a recording that has it, as `KnowledgeMaps` does."""
    last = len(recording.traversability)
    steps = sorted({round(step) for step in np.linspace(0, last, _MOMENTS)})
    moments = [(step, recording.known_at(step) or recording.known[0]) for step in steps]
    ratio = min(max(recording.grid.height / recording.grid.width, 0.3), 2.0)
    tall = (TWO_COLUMNS_IN - 0.9) / _MOMENTS * ratio
    figure = Drawing(figsize=(TWO_COLUMNS_IN, 2 * tall + 1.1), layout="compressed")
    panels = figure.subplots(2, len(moments), squeeze=False, sharex=True, sharey=True)
    for row, (name, (label, colours, most)) in zip(panels, _SHOWN.items(), strict=True):
        for panel, (step, known) in zip(row, moments, strict=True):
            values: np.ndarray = getattr(known, name)
            image = maps.show_map(panel, values, recording.grid.extent_m, cmap=colours, vmin=0, vmax=most)
            _draw_known(panel, known, recording)
            maps.draw_drive(panel, drive_at(recording, step), 1.2, 0.8, label="driven")
            maps.frame_map(panel)
        row[0].set_ylabel("y [m]")
        figure.colorbar(image, ax=list(row), fraction=0.03, aspect=20, label=label)
    for (above, below), (step, _) in zip(panels.T, moments, strict=True):
        ended = f"\n{recording.outcome}" if step == last else ""
        above.set_title(f"t = {step * recording.dt_s:.1f} s{ended}", fontsize="small")
        below.set_xlabel("x [m]")
    every = [known for _, known in moments]
    handles: list[Artist] = []
    if any(known.sensed.any() for known in every):
        edge = [withStroke(linewidth=2, foreground="black"), Normal()]
        label = "edge of where λ was sensed"
        handles.append(Line2D([], [], color=_SENSED_EDGE, lw=0.8, path_effects=edge, label=label))
    reaches = any(known.outlines for known in every)
    handles += maps.sensing_handles([known.seen for known in every], reaches, _THIN)
    legend_outside(figure, handles, 5)
    return figure


def _draw_known(panel: Axes, known: KnownMap, recording: Recording) -> None:
    """Veil and hatch what was not seen, outline what was sensed, and draw how far the sensors reached."""
    maps.overlay(panel, ~known.seen, recording.grid.extent_m, maps.UNSEEN, maps.VEIL)
    panel.add_collection(maps.unseen_layer(known.seen, recording.resolution_m))
    maps.draw_lines(panel, outline(known.sensed, recording.resolution_m), _SENSED_EDGE, 0.5)
    panel.add_line(maps.reach_line(known.outline, _THIN))


def known_colours(known: KnownMap) -> dict[str, np.ndarray]:
    """Colour what was known, uint8 of shape [H, W, 3] each, under a veil where the map was not seen.

    Returns:
        `risk`, λ̂ with what is not free; `mean` and `spread` of the belief; and `seen`, light where the map was seen
        and blue where λ was sensed.
    """
    colours = {
        "risk": maps.predicted_colours(known.predicted, known.free),
        "mean": maps.shades(known.mean),
        "spread": maps.shades(known.spread / maps.MAX_SPREAD, maps.SPREAD_COLOURS),
    }
    palette = np.array([bytes_of(colour)[:3] for colour in (maps.UNSEEN, maps.SEEN, maps.SENSED)], np.uint8)
    # A cell may be sensed that was not seen.
    seen = palette[np.where(known.sensed, 2, known.seen.astype(int))]
    return {name: maps.veiled(shown, known.seen) for name, shown in colours.items()} | {"seen": seen}
