"""Panels with a row for each setting and a panel for each block of a run.

Names are at the left, so that any number of planners, models and risk settings fits.
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

_ROW_IN = 0.145
_GAP_ROWS = 0.6
_PANELS_A_LINE = 4
_SETTING = ["planner", "model", *KNOWLEDGE, "risk"]


def lay_out(
    summary: pd.DataFrame, measures: Sequence[str], legend_in: float = 0.0
) -> tuple[Figure, list[tuple[Axes, pd.DataFrame]]]:
    """Create the panels, with names of settings at the left of each line.

    Args:
        summary: from `summary.summarise`.
        measures: labels of the quantities, a panel each for each block, side by side.
        legend_in: height reserved for a legend, in inches.

    Returns:
        The figure, and for each panel the rows of its block, with the `height` that
        each is drawn at.
    """
    settings = with_names(summary[_SETTING].drop_duplicates())
    # A gap separates planners.
    planner = settings["planner"].factorize()[0]
    settings = settings.assign(gap=_GAP_ROWS * planner).sort_values(
        "gap", kind="stable"
    )
    settings["height"] = np.arange(len(settings)) + settings.pop("gap")
    lowest = settings["height"].max()
    columns = len(measures)
    blocks_of_run = blocks(summary.merge(settings, on=_SETTING, how="left"))
    block_panels = [block for block in blocks_of_run for _ in measures]
    across = columns if columns > 1 else min(len(block_panels), _PANELS_A_LINE)
    tall = _ROW_IN * (lowest + 1.4) + 0.5
    titles = [title for title, _ in block_panels]
    shared = "all" if columns == 1 else "col"
    figure, grid = panel_grid(
        titles, across, tall, 0.2 + legend_in, sharex=shared, sharey=True
    )
    panels = []
    for index, ((panel,), (_, rows)) in enumerate(zip(grid, block_panels, strict=True)):
        panels.append((panel, rows))
        panel.set_axisbelow(True)
        panel.tick_params(axis="y", length=0)
        panel.grid(axis="x", color=GRID)
        if index >= len(block_panels) - across:
            panel.set_xlabel(measures[index % columns])
        for height in sorted(set(settings["height"]) - set(rows["height"])):
            looks: dict[str, Any] = {
                "transform": panel.get_yaxis_transform(),
                "ha": "center",
                "va": "center",
            }
            panel.text(0.5, height, "not run", color="0.5", size=6, **looks)
    first, _ = panels[0]
    first.set_yticks(settings["height"].tolist(), settings["name"].tolist())
    first.set_ylim(lowest + 0.7, -0.7)
    return figure, panels
