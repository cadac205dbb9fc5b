"""T_total and λ̄ of every episode."""

import itertools
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D

from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.setting_rows import lay_out
from benchnav.viz.figure import Figure
from benchnav.viz.panels import draw_interval, jitter
from benchnav.viz.style import BLUE, ORANGE, legend_outside

_QUANTITIES = {
    "total_time_s": "T_total [s], a failure counts as T",
    "traversability": "λ̄, mean observed λ",
}
_DOTS = {"success": (BLUE, "o"), "failure": (ORANGE, "x")}  # colour and marker of a dot
_MAX_OFFSET = 0.32  # maximum offset of a dot from its row, in rows


class Distributions(Figure):
    """T_total and mean observed λ of each episode, with median and quartiles."""

    name = "distributions"
    text = (
        "Each dot is an episode. Left: T_total, where a failure counts as T. Right: "
        "λ̄, the mean observed λ. Black: median (tick) and quartiles (line) of all "
        "episodes of a setting."
    )

    def draw(self, data: RunData) -> Drawing:
        """Draw the episodes of each condition in the condition's row."""
        labels = list(_QUANTITIES.values())
        figure, panels = lay_out(data.summary, labels, legend_in=0.15)
        columns = itertools.cycle(_QUANTITIES)
        for (panel, rows), column in zip(panels, columns, strict=False):
            _draw_dots(panel, rows, data.episodes, column)
        (time_panel, _), (traversability_panel, _) = panels[:2]
        time_panel.set_xlim(left=0)
        traversability_panel.set_xlim(0, 1)
        legend_outside(figure, _handles())
        return figure


def _handles() -> list[Line2D]:
    handles = []
    for label, (colour, marker) in _DOTS.items():
        look: dict[str, Any] = {"ls": "none", "ms": 3, "marker": marker}
        handles.append(Line2D([], [], color=colour, label=label, **look))
    look = {"marker": "|", "ms": 6, "lw": 1.2}
    words = "median and quartiles of all"
    handles.append(Line2D([], [], color="black", label=words, **look))
    return handles


def _draw_dots(
    panel: Axes, rows: pd.DataFrame, episodes: pd.DataFrame, name: str
) -> None:
    """Draw a quantity of all episodes, each at the height of its condition."""
    dots = rows[["condition", "height"]].merge(episodes, on="condition")
    index_in_condition = dots.groupby("condition").cumcount()
    offsets = jitter(len(dots), _MAX_OFFSET)
    dots["up"] = dots["height"] + offsets[index_in_condition]
    dots = dots[dots[name].notna()]
    is_success = dots["success"].astype(bool)
    groups = (dots[is_success], dots[~is_success])
    for (colour, marker), group in zip(_DOTS.values(), groups, strict=True):
        is_cross = marker == "x"
        look: dict[str, Any] = {
            "color": colour,
            "marker": marker,
            "s": 5 if is_cross else 3,
            "lw": 0.5 if is_cross else 0,
        }
        panel.scatter(group[name], group["up"], alpha=0.45, rasterized=True, **look)
    for height, values in dots.groupby("height")[name]:
        low, middle, high = values.quantile([0.25, 0.5, 0.75])
        draw_interval(panel, low, high, height, "black")
        panel.plot(middle, height, "|", color="black", ms=6, mew=1.4)
