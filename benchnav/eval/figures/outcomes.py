"""Fractions of outcomes, one bar per condition."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure as Drawing

from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.setting_rows import lay_out
from benchnav.eval.words import outcome_in_words
from benchnav.viz.figure import Figure
from benchnav.viz.style import AMBER, BLUE, GREEN, ORANGE, PINK, SKY, legend_outside

# Colour and white hatching of each failure. The hatching distinguishes outcomes of equal
# lightness in grey. Failures caused by terrain come before errors of code.
LOOKS = {
    "immobilised": (ORANGE, ""),
    "stuck": (AMBER, "/////"),
    "timeout": (BLUE, "...."),
    "stalled": (SKY, "|||||"),
    "out_of_bounds": (PINK, "xxxx"),
    "rollover": ("#8C510A", "***"),
    "planner_failure": (GREEN, "-----"),
    "planner_error": ("#000000", ""),
    "model_error": ("#7F7F7F", "\\\\\\\\\\"),
    "sensor_error": ("#4D4D4D", "ooo"),
    "belief_error": ("#A6A6A6", "+++++"),
}
SUCCESS_COLOUR = "#E4E4E4"
_BAR = 0.78  # thickness of a bar divided by the distance of rows


class Outcomes(Figure):
    """Fractions of outcomes, in the same order for all conditions; success is last."""

    name = "outcomes"
    text = "Outcomes of the episodes."

    def draw(self, data: RunData) -> Drawing:
        """Draw one bar per condition."""
        occurring = [name for name in LOOKS if data.summary[f"{name}_count"].sum()]
        legend_lines = 1 + len(occurring) // 3
        label = "fraction of episodes [%]"
        figure, panels = lay_out(data.summary, [label], 0.15 * legend_lines)
        for panel, rows in panels:
            heights = rows["height"]
            offset = np.zeros(len(rows))
            for name in occurring:
                fraction = 100 * rows[f"{name}_count"] / rows["n_episodes"]
                colour, hatch = LOOKS[name]
                look: dict[str, Any] = {"fc": colour, "hatch": hatch, "ec": "white"}
                words = outcome_in_words(name)
                panel.barh(heights, fraction, _BAR, offset, label=words, lw=0, **look)
                offset = offset + fraction
            look = {"color": SUCCESS_COLOUR, "lw": 0}
            panel.barh(heights, 100 - offset, _BAR, offset, label="success", **look)
        panel.set_xlim(0, 100)
        legend_outside(figure, columns=6)
        return figure
