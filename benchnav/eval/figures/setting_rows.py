"""Layout of figures with a panel for each block of a run and a row for each setting.

Names are to the left of the rows, so that any number of settings fits.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.eval.experiment.condition import KNOWLEDGE
from benchnav.eval.words import blocks, with_names
from benchnav.viz.panels import GRID, panel_grid
from benchnav.viz.style import TWO_COLUMNS_IN

_ROW_IN = 0.145  # height of a row in inches
_GAP_ROWS = 0.6  # gap between planners, in rows
_MAX_ACROSS = 4  # panels side by side
_MAX_LETTERS = 30  # a single panel with a longer name is two columns wide
_SETTING = ["planner", "model", *KNOWLEDGE, "risk"]


def lay_out(
    summary: pd.DataFrame, measures: Sequence[str], legend_in: float = 0.0
) -> tuple[Figure, list[tuple[Axes, pd.DataFrame]]]:
    """Create the panels, with names of settings to the left of each line of panels.

    Args:
        summary: table from `summary.summarise`.
        measures: axis labels of the quantities; each block has a panel for each
            quantity.
        legend_in: height reserved for a legend, in inches.

    Returns:
        The figure; and each panel with the rows of its block, which have a column
        `height` with their position on the y-axis.
    """
    settings = with_names(summary[_SETTING].drop_duplicates())
    # There is a gap between planners.
    planner, _ = settings["planner"].factorize()
    settings = settings.assign(gap=_GAP_ROWS * planner)
    settings = settings.sort_values("gap", kind="stable")
    settings["height"] = np.arange(len(settings)) + settings.pop("gap")
    lowest = settings["height"].max()
    columns = len(measures)
    blocks_of_run = blocks(summary.merge(settings, on=_SETTING, how="left"))
    block_panels = [block for block in blocks_of_run for _ in measures]
    across = min(len(block_panels), _MAX_ACROSS)
    shared = "all"
    if columns > 1:
        across = columns
        shared = "col"
    panel_height_in = _ROW_IN * (lowest + 1.4) + 0.5
    titles = [title for title, _ in block_panels]
    ends_in = 0.2 + legend_in
    # In one column, long names would leave little space for a single panel.
    is_wide = settings["name"].str.len().max() > _MAX_LETTERS
    width_in = TWO_COLUMNS_IN if is_wide else 0.0
    figure, grid = panel_grid(
        titles, across, panel_height_in, ends_in, width_in, sharex=shared, sharey=True
    )
    panels = []
    for index, (_, rows) in enumerate(block_panels):
        (panel,) = grid[index]
        panels.append((panel, rows))
        panel.set_axisbelow(True)
        panel.tick_params(axis="y", length=0)
        panel.grid(axis="x", color=GRID)
        if index >= len(block_panels) - across:
            panel.set_xlabel(measures[index % columns])
        missing = set(settings["height"]) - set(rows["height"])
        style: dict[str, Any] = {"color": "0.5", "ha": "center", "va": "center"}
        for height in sorted(missing):
            side = panel.get_yaxis_transform()
            panel.text(0.5, height, "not run", size=6, transform=side, **style)
    first, _ = panels[0]
    first.set_yticks(settings["height"].tolist(), settings["name"].tolist())
    first.set_ylim(lowest + 0.7, -0.7)
    return figure, panels
