"""Sheets of failures: what was predicted, the path driven on it, and where it ended."""

from collections.abc import Sequence
from typing import Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.moment import drive_at
from benchnav.eval.recording import Recording
from benchnav.eval.words import outcome_in_words
from benchnav.viz import maps
from benchnav.viz.figure import Figure
from benchnav.viz.style import ONE_COLUMN_IN, TWO_COLUMNS_IN, legend_outside

_LIGHT = 0.5  # opacity of a map under marks and dark red


class Failures(Figure):
    """Failures of the best setting of a block and of the worst, a line a condition.

    Attributes:
        index: index of the sheet among those of the run.
    """

    name = "failures"
    index = 0

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return a figure a block."""
        return self.numbered(len(data.sheets.shown))

    def caption(self, data: RunData) -> str:
        """Return which failures are shown."""
        title, _ = data.sheets.shown[self.index]
        return (
            "Failures of the settings with the highest and the lowest success rate, "
            f"{title}: predicted λ̂ (colour), driven path and its end. λ̂ in the titles "
            "is that of the last cell, observed λ the mean of the last 2 s."
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw a line a condition, a panel a failure."""
        _, lines = data.sheets.shown[self.index]
        across = max(len(line.recordings) for line in lines)
        height, width = lines[0].recordings[0].grid.shape
        page = TWO_COLUMNS_IN if across > 2 else ONE_COLUMN_IN
        tall = page / (across + 0.9) * min(height / width, 2.0) + 0.4
        figure = Drawing(figsize=(page, tall * len(lines) + 0.6), layout="constrained")
        panels = figure.subplots(len(lines), across, squeeze=False)
        for panel in panels.flat:
            panel.set_visible(False)
        for row_of_panels, line in zip(panels, lines, strict=True):
            rows = line.failures.to_dict("records")
            for panel, recording, row in zip(
                row_of_panels, line.recordings, rows, strict=False
            ):
                _draw_failure(panel, recording)
                predicted = recording.predicted_at_end
                words = [
                    "outside the map" if np.isnan(predicted) else f"λ̂ = {predicted:.2f}"
                ]
                if not np.isnan(row["last_traversability"]):
                    words.append(f"observed λ = {row['last_traversability']:.2f}")
                ended = f"{outcome_in_words(row['outcome'])}, {row['end_time_s']:.0f} s"
                panel.set_title(
                    f"{row['scenario']}, map {row['map']}: {ended}\n{', '.join(words)}",
                    fontsize="small",
                )
            count = f"({len(line.failures)} of {line.among} failures)"
            row_of_panels[0].set_ylabel(f"{line.name}\n{count}", fontsize="small")
        maps.draw_scale(panels[-1, 0], lines[-1].recordings[0].grid.extent_m)
        maps.draw_bar(figure, "predicted λ̂", aspect=30, alpha=_LIGHT)
        legend_outside(figure, columns=6)
        return figure


def _draw_failure(panel: Axes, recording: Recording) -> None:
    panel.set_visible(True)
    extent_m = recording.grid.extent_m
    maps.show_map(panel, recording.predicted, extent_m, alpha=_LIGHT, **maps.LAMBDA)
    maps.overlay(panel, recording.immobilising, extent_m, maps.IMMOBILISING, 0.75)
    maps.name_immobilising(panel, recording.immobilising)
    maps.draw_drive(
        panel,
        drive_at(recording, len(recording.traversability)),
        1.1,
        0.9,
        label="driven",
    )
    panel.spines[:].set_visible(False)
    panel.set(xticks=[], yticks=[])
