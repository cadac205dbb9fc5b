"""The figure of success rates."""

from collections.abc import Collection

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.charts.panels import lay_out, planner_colours


def success_figure(summary: pd.DataFrame, marked: Collection[str] = ()) -> Figure:
    """Draws the success rate of every condition with its 95 % interval, a panel a block of the run.

    A planner that is blind is drawn as a line through its panel, the floor that others are
    seen against.

    Args:
        summary: from `summary.summarise`.
        marked: conditions whose points are filled, as `best_marked` of `best.against_best` has them.
    """
    layout, colours = lay_out(summary, ["success [%]"]), planner_colours(summary)
    for panel, rows in layout.panels:
        for height, row in layout.rows(rows):
            _draw(panel, height, row, colours[str(row["planner"])], row["condition"] in marked)
        panel.set_xticks(np.arange(0, 101, 25))
    layout.panels[0][0].set_xlim(-4, 104)
    return layout.figure


def _draw(panel: Axes, height: float, row: dict[str, object], colour: str, filled: bool) -> None:
    rate, low, high = (100 * float(str(row[f"success_{name}"])) for name in ("rate", "low", "high"))
    panel.plot([low, high], [height, height], color=colour, lw=1.2, solid_capstyle="butt")
    panel.plot(rate, height, "o", color=colour, ms=4, mfc=colour if filled else "white", mew=1.0)
    if row["model"] == NOT_USED:  # The clairvoyant has a model, and no risk.
        panel.axvline(rate, color=colour, lw=0.8, ls="--", zorder=0)
        panel.axvspan(low, high, color=colour, alpha=0.12, lw=0, zorder=0)
