"""The figure of outcomes: how the episodes of each condition ended, as shares of a bar."""

import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from benchnav.eval.report.charts.panels import lay_out
from benchnav.planning.world.outcome import FAILURES

# From what the ground did to what the code did; success is light, each failure has a colour of its own.
COLOURS = {
    "immobilised": "#D55E00",
    "stuck": "#E69F00",
    "timeout": "#0072B2",
    "stalled": "#56B4E9",
    "out_of_bounds": "#CC79A7",
    "planner_failure": "#009E73",
    "planner_error": "#000000",
    "model_error": "#7F7F7F",
}
SUCCESS_COLOUR = "#E4E4E4"


def outcome_figure(summary: pd.DataFrame) -> Figure:
    """Draws the shares of outcomes, a bar a condition, in one order for all: failures first, then success.

    Args:
        summary: from `summary.summarise`.
    """
    met = [name for name in COLOURS if summary[f"{name}_count"].sum()]
    layout = lay_out(summary, ["share of episodes [%]"], legend_in=0.15 + 0.15 * (len(met) // 3))
    for panel, rows in layout.panels:
        for height, row in layout.rows(rows):
            left, count = 0.0, float(str(row["n_episodes"]))
            for name in met:
                share = 100 * float(str(row[f"{name}_count"])) / count
                panel.barh(height, share, 0.78, left, color=COLOURS[name], lw=0)
                left += share
            panel.barh(height, 100 - left, 0.78, left, color=SUCCESS_COLOUR, lw=0)
    layout.panels[0][0].set_xlim(0, 100)
    handles = [Patch(color=COLOURS[name], label=name.replace("_", " ")) for name in met]
    layout.figure.legend(
        handles=[*handles, Patch(color=SUCCESS_COLOUR, label="success")],
        loc="outside lower center",
        ncols=3 if layout.figure.get_figwidth() < 5 else 6,
    )
    return layout.figure


assert set(COLOURS) == {outcome.name.lower() for outcome in FAILURES}
