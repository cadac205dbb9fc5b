"""The forest plot: differences of all hypotheses with their intervals and margins, a panel a metric."""

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.eval.experiment.hypotheses import METRICS
from benchnav.eval.report.figure_style import OKABE_ITO, TWO_COLUMNS_IN
from benchnav.eval.report.findings import p_in_words

_ROW_IN, _PANEL_IN = 0.3, 0.55
_COLOUR, _MARGIN = OKABE_ITO[0], "0.88"
_LEGEND_IN = 0.3


def forest_figure(tests: pd.DataFrame) -> Figure:
    """Draws each hypothesis as its difference, with the 95 % interval thin and the 90 % interval thick.

    Filled points are of hypotheses that are supported; the band is where a margin wants the difference to lie.

    Args:
        tests: from `hypotheses.test_hypotheses`.
    """
    numbered = tests.assign(number=range(1, len(tests) + 1))
    panels = [numbered[numbered["metric"] == name] for name in METRICS if (tests["metric"] == name).any()]
    heights = [_PANEL_IN + _ROW_IN * len(rows) for rows in panels]
    figure = Figure(figsize=(TWO_COLUMNS_IN, sum(heights) + _LEGEND_IN), layout="constrained")
    axes = figure.subplots(len(panels), squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for panel, rows in zip(axes, panels, strict=True):
        _draw(panel, rows)
    handles: list[Artist] = [
        Line2D([], [], color=_COLOUR, marker="o", ms=4, lw=0, label="supported"),
        Line2D([], [], color=_COLOUR, marker="o", ms=4, lw=0, mfc="white", label="not supported"),
        Line2D([], [], color=_COLOUR, lw=2.6, label="90 % interval"),
        Line2D([], [], color=_COLOUR, lw=0.9, label="95 % interval"),
    ]
    if (tests["margin"] > 0).any():
        handles.append(Patch(color=_MARGIN, label="within the margin"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _draw(panel: Axes, rows: pd.DataFrame) -> None:
    metric = METRICS[rows["metric"].iloc[0]]
    ends = rows[["low", "high", "difference"]].to_numpy(dtype=float)
    # Where no episode tells anything, a row has no numbers.
    reach = np.nanmax([*np.abs(ends).ravel(), rows["margin"].max(), 1e-9]) * 1.08
    panel.set_xlim(-reach, reach)
    panel.set_ylim(len(rows) - 0.4, -0.6)
    panel.axvline(0, color="0.4", lw=0.6, zorder=1)
    for height, row in enumerate(rows.to_dict("records")):
        if row["margin"] > 0:
            low = -reach if row["direction"] == "lower" else -row["margin"]
            high = reach if row["direction"] == "higher" else row["margin"]
            panel.fill_between([low, high], height - 0.36, height + 0.36, color=_MARGIN, lw=0, zorder=0)
        for suffix, width in (("", 0.9), ("_90", 2.6)):
            span = [row[f"low{suffix}"], row[f"high{suffix}"]]
            panel.plot(span, [height, height], color=_COLOUR, lw=width, solid_capstyle="butt", zorder=2)
        face = _COLOUR if row["supported"] else "white"
        panel.plot(row["difference"], height, "o", color=_COLOUR, ms=4.5, mfc=face, mew=1.0, zorder=3)
        panel.text(
            1.01,
            height,
            p_in_words(row["p_holm"]),
            transform=panel.get_yaxis_transform(),
            va="center",
            fontsize=7,
        )
    names = [f"{row['number']}. {row['names'][0]}\nless {row['names'][1]}" for row in rows.to_dict("records")]
    panel.set_yticks(range(len(rows)), names)
    panel.tick_params(axis="y", length=0)
    panel.grid(axis="x", color="0.93", zorder=0)
    panel.set_axisbelow(True)
    unit = f" [{metric.unit}]" if metric.unit else ""
    panel.set_xlabel(f"Δ {metric.name}{unit}")
    # Which way is better, at the end of the axis where it lies.
    right = metric.better == "higher"
    panel.annotate(
        "better →" if right else "← better", (1 if right else 0, 1), xycoords="axes fraction", va="bottom",
        ha="right" if right else "left", fontsize=6.5, color="0.35",
    )  # fmt: skip
