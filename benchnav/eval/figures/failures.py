"""Sheets of failures: maps of predicted λ̂, with the driven path and its end."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchnav.eval.failures import FailedLine
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.moment import drive_at
from benchnav.eval.recording import Recording
from benchnav.eval.words import outcome_in_words
from benchnav.viz import drives, maps
from benchnav.viz.figure import Figure
from benchnav.viz.style import ONE_COLUMN_IN, TWO_COLUMNS_IN, legend_outside

_LIGHT = 0.5  # opacity of a map under marks and dark red
_LETTER_IN = 0.048  # mean width of a letter of a title
_LINE_IN = 0.12  # height of a line of a title


class Failures(Figure):
    """Failures of the best and the worst condition of a block, one line per condition.

    Attributes:
        index: index of the shown sheet among the run's sheets.
    """

    name = "failures"
    index = 0

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return one figure per block."""
        return self.numbered(len(data.sheets.shown))

    def caption(self, data: RunData) -> str:
        """Return a caption that describes which failures are shown."""
        title, _ = data.sheets.shown[self.index]
        return (
            "Failures of the settings with the highest and the lowest success rate, "
            f"{title}: predicted λ̂ (colour), driven path and its end. In the titles, "
            "λ̂ is the prediction for the last cell, and observed λ is the mean over "
            "the last 2 s."
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw a line of panels for each condition, with one panel per failure."""
        _, lines = data.sheets.shown[self.index]
        n_columns = max(len(line.recordings) for line in lines)
        height, width = lines[0].recordings[0].grid.shape
        page_in = TWO_COLUMNS_IN if n_columns > 2 else ONE_COLUMN_IN
        panel_in = page_in / (n_columns + 0.9)
        letters = int(panel_in / _LETTER_IN)
        titles = [_titles(line, letters) for line in lines]
        all_titles = [title for line_titles in titles for title in line_titles]
        title_in = _LINE_IN * max(title.count("\n") + 1 for title in all_titles)
        map_in = panel_in * min(height / width, 2.0)
        tall_in = (map_in + title_in + 0.16) * len(lines) + 0.6
        figure = Drawing(figsize=(page_in, tall_in), layout="constrained")
        panels = figure.subplots(len(lines), n_columns, squeeze=False)
        for panel in panels.flat:
            panel.set_visible(False)
        for line_panels, line, line_titles in zip(panels, lines, titles, strict=True):
            n_shown = len(line.recordings)
            shown_panels = line_panels[:n_shown]
            for panel, recording, title in zip(
                shown_panels, line.recordings, line_titles, strict=True
            ):
                _draw_failure(panel, recording)
                panel.set_title(title, fontsize="small")
            name = textwrap.fill(line.name, int(map_in / _LETTER_IN))
            count = f"({len(line.failures)} of {line.total} failures)"
            line_panels[0].set_ylabel(f"{name}\n{count}", fontsize="small")
        maps.draw_scale(panels[-1, 0], lines[-1].recordings[0].grid.extent_m)
        maps.draw_bar(figure, "predicted λ̂", aspect=30, alpha=_LIGHT)
        legend_outside(figure, columns=6)
        return figure


def _titles(line: FailedLine, letters: int) -> list[str]:
    """Return the title of each panel of a line, wrapped to a number of letters."""
    rows = line.failures.to_dict("records")
    titles = []
    for recording, row in zip(line.recordings, rows, strict=False):
        parts = [_ending(row), _traversability(recording, row)]
        wrapped = [textwrap.fill(part, letters) for part in parts]
        titles.append("\n".join(wrapped))
    return titles


def _ending(row: Mapping[Any, Any]) -> str:
    outcome = outcome_in_words(row["outcome"])
    map_name = _unbroken(f"{row['scenario']}, map {row['map']}:")
    end = _unbroken(f"{outcome}, {row['end_time_s']:.0f} s")
    return f"{map_name} {end}"


def _traversability(recording: Recording, row: Mapping[Any, Any]) -> str:
    predicted = recording.predicted_at_end
    observed = row["last_traversability"]
    words = [f"λ̂ = {predicted:.2f}"]
    if np.isnan(predicted):
        words = ["outside the map"]
    if not np.isnan(observed):
        words.append(f"observed λ = {observed:.2f}")
    return ", ".join(map(_unbroken, words))


def _unbroken(words: str) -> str:
    """Return text with non-breaking spaces, so that it stays in one line of a title."""
    return words.replace(" ", "\N{NO-BREAK SPACE}")


def _draw_failure(panel: Axes, recording: Recording) -> None:
    panel.set_visible(True)
    extent_m = recording.grid.extent_m
    drive = drive_at(recording, len(recording.traversability))
    maps.show_map(panel, recording.predicted, extent_m, alpha=_LIGHT, **maps.LAMBDA)
    maps.overlay(panel, recording.immobilising, extent_m, maps.IMMOBILISING, 0.75)
    maps.name_immobilising(panel, recording.immobilising)
    drives.draw_drive(panel, drive, width=1.1, scale=0.9, label="driven")
    panel.spines[:].set_visible(False)
    panel.set(xticks=[], yticks=[])
