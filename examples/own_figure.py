"""A custom figure for reports: times of failures, by scenario and planner."""

import matplotlib.figure
import numpy as np

from benchnav.eval.figures import RunData
from benchnav.viz import (
    Figure,
    legend_outside,
    panel_grid,
    planner_colours,
    planner_name,
)


class WhenFailed(Figure):
    """Histogram of the end times of failed episodes."""

    name = "when-failed"

    def is_available(self, data: RunData) -> bool:
        return not data.failures.empty

    def caption(self, data: RunData) -> str:
        return f"Times at which {len(data.failures)} failed episodes ended."

    def draw(self, data: RunData) -> matplotlib.figure.Figure:
        scenarios = dict(list(data.failures.groupby("scenario")))
        colours = planner_colours(list(data.failures["planner"].unique()))
        bins = np.linspace(0, data.failures["end_time_s"].max(), 21)
        figure, panels = panel_grid(
            list(scenarios), across=3, high_in=1.8, sharex=True, sharey=True
        )
        for (panel,), rows in zip(panels, scenarios.values(), strict=True):
            for planner, episodes in rows.groupby("planner"):
                look = {"color": colours[planner], "label": planner_name(planner)}
                panel.hist(episodes["end_time_s"], bins, histtype="step", **look)
            panel.set(xlabel="end of the episode [s]", ylabel="episodes")
        legend_outside(figure)
        return figure
