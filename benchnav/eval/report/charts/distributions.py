"""The figure of distributions: time and λ̄ of every episode of each condition."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.eval.report.charts.panels import lay_out

_QUANTITIES = {"total_time_s": "T_total [s], a failure counts as T", "traversability": "λ̄, mean observed λ"}
_SUCCESS, _FAILURE = "#0072B2", "#D55E00"
_SPREAD = 0.32  # of a row's height, to either side


def distribution_figure(summary: pd.DataFrame, episodes: pd.DataFrame) -> Figure:
    """Draws a dot an episode, with median and quartiles: T_total on the left, λ̄ on the right, a line a block.

    Args:
        summary: from `summary.summarise`.
        episodes: the rows it was made of.
    """
    groups = dict(list(episodes.groupby("condition", sort=False)))
    layout = lay_out(summary, list(_QUANTITIES.values()), legend_in=0.15)
    names = list(_QUANTITIES)
    for place, (panel, rows) in enumerate(layout.panels):
        name = names[place % len(names)]
        _draw(panel, [(height, groups[row["condition"]]) for height, row in layout.rows(rows)], name)
    layout.panels[0][0].set_xlim(left=0)
    layout.panels[1][0].set_xlim(0, 1)
    handles = [
        Line2D([], [], marker="o", ls="none", ms=3, color=colour, label=label)
        for colour, label in ((_SUCCESS, "success"), (_FAILURE, "failure"))
    ]
    handles.append(
        Line2D([], [], color="black", marker="|", ms=6, lw=1.2, label="median and quartiles of all")
    )
    layout.figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return layout.figure


def _draw(panel: Axes, rows: Sequence[tuple[float, pd.DataFrame]], name: str) -> None:
    """Draws a quantity of the episodes of several conditions, each condition at its height; all dots at once."""
    dots, middles = [], []
    for height, episodes in rows:
        values = episodes[name].to_numpy(dtype=float)
        known = ~np.isnan(values)
        if not known.any():
            continue
        shift = np.random.default_rng(0).uniform(-_SPREAD, _SPREAD, len(values))
        colours = np.where(episodes["success"].to_numpy(dtype=bool), _SUCCESS, _FAILURE)
        dots.append((values[known], height + shift[known], colours[known]))
        middles.append((height, *np.percentile(values[known], (25, 50, 75))))
    if not dots:
        return
    across, up, colours = (np.concatenate(part) for part in zip(*dots, strict=True))
    panel.scatter(across, up, s=2.5, c=colours, alpha=0.35, lw=0, rasterized=True)
    heights, low, median, high = np.transpose(middles)
    panel.plot([low, high], [heights, heights], color="black", lw=1.2, solid_capstyle="butt")
    panel.plot(median, heights, "|", color="black", ms=6, mew=1.4)
