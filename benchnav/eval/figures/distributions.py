"""T_total and λ̄ of every episode."""

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
_ENDS = {"success": (BLUE, "o"), "failure": (ORANGE, "x")}  # colour and marker of a dot
_SPREAD = 0.32  # of a row's height, to either side


class Distributions(Figure):
    """T_total and mean observed λ of each episode, with median and quartiles."""

    name = "distributions"
    text = (
        "Each dot is an episode. Left: T_total, where a failure counts as T. Right: "
        "λ̄, the mean observed λ. Black: median (tick) and quartiles (line) of all "
        "episodes of a setting."
    )

    def draw(self, data: RunData) -> Drawing:
        """Draw the episodes of each condition at its height."""
        figure, panels = lay_out(
            data.summary, list(_QUANTITIES.values()), legend_in=0.15
        )
        for index, (panel, rows) in enumerate(panels):
            _draw_dots(
                panel, rows, data.episodes, list(_QUANTITIES)[index % len(_QUANTITIES)]
            )
        panels[0][0].set_xlim(left=0)
        panels[1][0].set_xlim(0, 1)
        handles = [
            Line2D([], [], ls="none", ms=3, color=colour, marker=marker, label=label)
            for label, (colour, marker) in _ENDS.items()
        ]
        words = "median and quartiles of all"
        handles.append(
            Line2D([], [], color="black", marker="|", ms=6, lw=1.2, label=words)
        )
        legend_outside(figure, handles)
        return figure


def _draw_dots(
    panel: Axes, rows: pd.DataFrame, episodes: pd.DataFrame, name: str
) -> None:
    """Draw a quantity of all episodes, each condition at its height."""
    dots = rows[["condition", "height"]].merge(episodes, on="condition")
    turn = dots.groupby("condition").cumcount()
    dots["up"] = dots["height"] + jitter(len(dots), _SPREAD)[turn]
    dots = dots[dots[name].notna()]
    for (colour, marker), is_success in zip(_ENDS.values(), (True, False), strict=True):
        group = dots[dots["success"] == is_success]
        size, line = (5, 0.5) if marker == "x" else (3, 0)
        looks: dict[str, Any] = {
            "color": colour,
            "marker": marker,
            "s": size,
            "lw": line,
        }
        panel.scatter(group[name], group["up"], alpha=0.45, rasterized=True, **looks)
    for height, values in dots.groupby("height")[name]:
        low, middle, high = values.quantile([0.25, 0.5, 0.75])
        draw_interval(panel, low, high, height, "black")
        panel.plot(middle, height, "|", color="black", ms=6, mew=1.4)
