"""Panels with a row a setting and a panel a block of the run.

Any number of planners, models and risk settings fits, since their names stand on the
left.
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

_ROW_IN, _GAP_ROWS = 0.145, 0.6
_PANELS_A_LINE = 4
_SETTING = ["planner", "model", *KNOWLEDGE, "risk"]


def lay_out(
    summary: pd.DataFrame, measures: Sequence[str], legend_in: float = 0.0
) -> tuple[Figure, list[tuple[Axes, pd.DataFrame]]]:
    """Make the panels, with the names of settings at the left of each line of panels.

    Args:
        summary: from `summary.summarise`.
        measures: what is drawn of each block, a panel each and side by side; the panels
            then list each block as often.
        legend_in: height kept for a legend.

    Returns:
        The figure; of each block its panel, and its rows of the summary with the
        `height` that each is drawn at.
    """
    settings = with_names(summary[_SETTING].drop_duplicates())
    # Planners are a little apart.
    planner = settings["planner"].factorize()[0]
    settings = settings.assign(gap=_GAP_ROWS * planner).sort_values(
        "gap", kind="stable"
    )
    settings["height"] = np.arange(len(settings)) + settings.pop("gap")
    lowest, columns = settings["height"].max(), len(measures)
    known = blocks(summary.merge(settings, on=_SETTING, how="left"))
    every = [block for block in known for _ in measures]
    across = columns if columns > 1 else min(len(every), _PANELS_A_LINE)
    tall = _ROW_IN * (lowest + 1.4) + 0.5
    titles = [title for title, _ in every]
    shared = "all" if columns == 1 else "col"
    figure, places = panel_grid(
        titles, across, tall, 0.2 + legend_in, sharex=shared, sharey=True
    )
    panels = []
    for place, ((panel,), (_, rows)) in enumerate(zip(places, every, strict=True)):
        panels.append((panel, rows))
        panel.set_axisbelow(True)
        panel.tick_params(axis="y", length=0)
        panel.grid(axis="x", color=GRID)
        if place >= len(every) - across:
            panel.set_xlabel(measures[place % columns])
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
