"""The layout that charts of conditions share: a panel a block of the run, a row a setting.

Any number of planners, models and risk settings fits, since their names stand on the left.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.figure_style import OKABE_ITO, ONE_COLUMN_IN, TWO_COLUMNS_IN, condition_name
from benchnav.eval.stats.best import BLOCK

_ROW_IN, _GAP_ROWS = 0.145, 0.6
_PANELS_A_LINE = 4

Setting = tuple[str, str, str]


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where what is drawn.

    Args:
        figure: with a panel a block.
        panels: of each block its panel, and its rows of the summary.
        heights: of each setting (planner, model, risk) its height in a panel.
    """

    figure: Figure
    panels: tuple[tuple[Axes, pd.DataFrame], ...]
    heights: dict[Setting, float]

    def rows(self, summary: pd.DataFrame) -> Iterator[tuple[float, dict[str, object]]]:
        """Rows of a block with their heights."""
        for row in summary.to_dict("records"):
            yield self.heights[row["planner"], row["model"], row["risk"]], {str(k): v for k, v in row.items()}


def blocks(summary: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Titles and rows of the blocks of a run: by scenario, and by what else of a block differs."""
    keys = [name for name in BLOCK if name == "scenario" or summary[name].nunique() > 1]
    return [(", ".join(map(str, key)), rows) for key, rows in summary.groupby(keys, sort=False)]


def several_models(summary: pd.DataFrame) -> list[str]:
    """The label that names a condition beside planner and risk: its model, where those that look at one differ."""
    return ["model"] if summary.loc[summary["model"] != NOT_USED, "model"].nunique() > 1 else []


def planner_colours(summary: pd.DataFrame) -> dict[str, str]:
    """A colour a planner; grey for those that are blind."""
    blind = set(summary.loc[summary["model"] == NOT_USED, "planner"])
    seeing = [planner for planner in summary["planner"].unique() if planner not in blind]
    colours = {planner: OKABE_ITO[place % len(OKABE_ITO)] for place, planner in enumerate(seeing)}
    return colours | dict.fromkeys(blind, "0.45")


def lay_out(summary: pd.DataFrame, measures: Sequence[str], legend_in: float = 0.0) -> Layout:
    """Makes the panels, with the names of settings at the left of each line of panels.

    Args:
        summary: from `summary.summarise`.
        measures: what is drawn of each block, a panel each and side by side; the layout then lists each block as
            often.
        legend_in: height kept for a legend.
    """
    known, columns = blocks(summary), len(measures)
    heights = _heights(summary)
    across = columns if columns > 1 else min(len(known), _PANELS_A_LINE)
    down = -(-len(known) * columns // across)
    tall = _ROW_IN * (max(heights.values()) + 1.4) + 0.5
    width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    figure = Figure(figsize=(width, tall * down + 0.2 + legend_in), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False, sharex="col" if columns > 1 else True, sharey=True)
    every = [(title, rows) for title, rows in known for _ in range(columns)]
    for panel, (title, _) in zip(axes.flat, every, strict=False):
        panel.set_title(title)
        panel.tick_params(axis="y", length=0, labelsize=6.5)
        panel.grid(axis="x", color="0.9")
        panel.set_axisbelow(True)
    for panel in axes.flat[len(every) :]:
        panel.set_visible(False)
    last = range(max(len(every) - across, 0), len(every))
    for place in last:
        axes.flat[place].tick_params(labelbottom=True)
        axes.flat[place].set_xlabel(measures[place % columns])
    several = several_models(summary)
    names = [
        condition_name(dict(zip(("planner", "model", "risk"), setting, strict=True)), several)
        for setting in heights
    ]
    axes.flat[0].set_yticks(list(heights.values()), names)
    axes.flat[0].set_ylim(max(heights.values()) + 0.7, min(heights.values()) - 0.7)
    panels = tuple((panel, rows) for panel, (_, rows) in zip(axes.flat, every, strict=False))
    return Layout(figure=figure, panels=panels, heights=heights)


def _heights(summary: pd.DataFrame) -> dict[Setting, float]:
    """Height of each setting, planners a little apart."""
    planners = list(summary["planner"].unique())
    rows = summary[["planner", "model", "risk"]].drop_duplicates().itertuples(index=False, name=None)
    ordered = sorted(rows, key=lambda setting: planners.index(setting[0]))
    return {setting: place + _GAP_ROWS * planners.index(setting[0]) for place, setting in enumerate(ordered)}
