"""The forest plot of the hypotheses that were fixed before the run."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.core.quantity import Quantity
from benchnav.eval.experiment.metrics import further_quantities, quantities
from benchnav.eval.figures.data import RunData
from benchnav.eval.words import (
    NOT_YET,
    display_names,
    p_in_words,
)
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.viz.figure import Figure
from benchnav.viz.panels import GRID, draw_interval
from benchnav.viz.style import BLUE, TEXT, TWO_COLUMNS_IN, legend_outside

_TEST_IN = 0.3  # height of a row for a hypothesis, in inches
_METRIC_IN = 0.55  # height of a panel without rows, in inches
_MARGIN = "0.88"  # colour of the band that a margin allows
_THIN, _THICK = 0.9, 2.6  # widths of 95 % and 90 % intervals, in points
_POINT: dict[str, Any] = {"marker": "o", "ms": 4, "lw": 0}


class Forest(Figure):
    """Paired differences of hypotheses with their intervals and margins."""

    name = "forest"

    def is_available(self, data: RunData) -> bool:
        """Return whether the suite has hypotheses."""
        return not data.tests.empty

    def caption(self, data: RunData) -> str:
        """Return a caption that explains the drawn points, lines and bands."""
        tests = data.tests
        sentences = [
            "Paired differences of the hypotheses that were fixed before the run.",
            "Filled points are supported (p < 0.05 after Holm's correction).",
        ]
        if tests["low"].notna().any():
            sentences.append(
                "Thick lines are 90 % intervals and thin lines 95 % intervals of single "
                "differences, without correction."
            )
        if tests["low"].isna().any():
            sentences.append(
                f"With fewer than {LEAST_MAPS} maps, or groups of maps, only "
                "differences in success have an interval, since a bootstrap is not "
                "reliable."
            )
        if (tests["margin"] > 0).any():
            sentences.append(
                "The grey band contains the differences that a margin allows."
            )
        return " ".join(sentences)

    def draw(self, data: RunData) -> Drawing:
        """Draw a panel for each metric, with a row for each hypothesis."""
        all_quantities = quantities(further_quantities(data.about))
        numbered = data.tests.assign(number=range(1, len(data.tests) + 1))
        panels = {
            name: numbered[numbered["metric"] == name]
            for name in all_quantities
            if (data.tests["metric"] == name).any()
        }
        heights = [_METRIC_IN + _TEST_IN * len(rows) for rows in panels.values()]
        size = (TWO_COLUMNS_IN, sum(heights) + 0.3)
        figure = Drawing(figsize=size, layout="constrained")
        ratios = {"height_ratios": heights}
        axes = figure.subplots(len(panels), squeeze=False, gridspec_kw=ratios)[:, 0]
        for panel, (name, rows) in zip(axes, panels.items(), strict=True):
            _draw_tests(panel, rows, all_quantities[name])
        legend_outside(figure, _handles(data.tests), 5)
        return figure


def _handles(tests: pd.DataFrame) -> list[Artist]:
    """Return the entries of the legend for the drawn points, lines and bands."""
    open_point = {**_POINT, "mfc": "white"}
    looks: dict[str, Any] = {NOT_YET: open_point}
    if tests["p_holm"].notna().all():
        looks = {"supported": _POINT, "not supported": open_point}
    if tests["low"].notna().any():
        looks["90 % interval"] = {"lw": _THICK}
        looks["95 % interval"] = {"lw": _THIN}
    handles: list[Artist] = [
        Line2D([], [], color=BLUE, label=label, **look) for label, look in looks.items()
    ]
    if (tests["margin"] > 0).any():
        handles.append(Patch(color=_MARGIN, label="allowed by the margin"))
    return handles


def _draw_tests(panel: Axes, rows: pd.DataFrame, quantity: Quantity) -> None:
    # Without episodes, a difference is NaN, and so is the maximum below.
    ends = rows[["low", "high", "difference", "margin"]].astype(float).abs()
    reach = max(ends.max().max(), 1e-9) * 1.08
    panel.set(xlim=(-reach, reach), ylim=(len(rows) - 0.4, -0.6))
    panel.axvline(0, color="0.4", lw=0.6, zorder=1)
    side = panel.get_yaxis_transform()
    names = []
    for height, row in enumerate(rows.to_dict("records")):
        if row["margin"] > 0:
            _draw_margin(panel, row, height, reach)
        if np.isnan(row["low"]):
            _explain_missing_interval(panel, row["difference"], height)
        for suffix, width in (("", _THIN), ("_90", _THICK)):
            low = row[f"low{suffix}"]
            high = row[f"high{suffix}"]
            draw_interval(panel, low, high, height, BLUE, width)
        look: dict[str, Any] = {"ms": 4.5, "mfc": BLUE if row["supported"] else "white"}
        panel.plot(row["difference"], height, "o", color=BLUE, zorder=3, **look)
        p = p_in_words(row["p_holm"])
        panel.text(1.01, height, p, transform=side, va="center", size=TEXT)
        first, second = map(display_names, row["names"])
        names.append(f"{row['number']}. {first}\n− {second}")
    panel.set_yticks(range(len(rows)), names)
    panel.tick_params(axis="y", length=0)
    panel.grid(axis="x", color=GRID, zorder=0)
    unit = f" [{quantity.unit}]" if quantity.unit else ""
    panel.set(xlabel=f"Δ {quantity.words}{unit}", axisbelow=True)
    # Each note is at the end of the axis to which its arrow points.
    style: dict[str, Any] = {"transform": panel.transAxes, "color": "0.35"}
    if quantity.better == "higher":
        panel.text(1, 1, "better →", va="bottom", ha="right", **style)
    elif quantity.better == "lower":
        panel.text(0, 1, "← better", va="bottom", ha="left", **style)


def _draw_margin(
    panel: Axes, row: Mapping[Any, Any], height: float, reach: float
) -> None:
    """Draw the band of the differences that a margin allows."""
    inner = -row["margin"] if row["kind"] == "superiority" else row["margin"]
    low = -reach if row["direction"] == "lower" else -inner
    high = reach if row["direction"] == "higher" else inner
    bottom, top = height - 0.36, height + 0.36
    panel.fill_between([low, high], bottom, top, color=_MARGIN, lw=0, zorder=0)


def _explain_missing_interval(panel: Axes, difference: float, height: float) -> None:
    """Write the reason for a missing interval next to a point, towards zero."""
    if np.isnan(difference):
        return
    words = f"no interval: fewer than {LEAST_MAPS} maps"
    is_right = difference > 0
    panel.annotate(
        words,
        (difference, height),
        xytext=(-6 if is_right else 6, 0),
        textcoords="offset points",
        ha="right" if is_right else "left",
        va="center",
        color="0.35",
        size=TEXT,
    )
