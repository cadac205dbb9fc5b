"""The forest plot of the hypotheses that were fixed before the run."""

from typing import Any

import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.core.quantity import Quantity
from benchnav.eval.experiment.metrics import further_quantities, quantities
from benchnav.eval.figures.data import RunData
from benchnav.eval.words import NOT_YET, p_in_words, reading_names
from benchnav.viz.figure import Figure
from benchnav.viz.panels import GRID, draw_interval
from benchnav.viz.style import BLUE, TWO_COLUMNS_IN, legend_outside

_TEST_IN = 0.3
_METRIC_IN = 0.55
_MARGIN = "0.88"


class Forest(Figure):
    """Paired differences of hypotheses with their intervals and margins."""

    name = "forest"
    text = (
        "Paired differences of the hypotheses that were fixed before the run. Filled "
        "points are supported (p < 0.05 after Holm's correction). Thick lines are "
        "90 %, thin lines 95 % intervals of one difference, not corrected. The grey "
        "band contains the differences that a margin allows."
    )

    def needs(self, data: RunData) -> bool:
        """Return whether the suite has hypotheses."""
        return not data.tests.empty

    def draw(self, data: RunData) -> Drawing:
        """Draw a row a hypothesis and a panel a metric, with a band a margin allows."""
        all_quantities = quantities(further_quantities(data.about))
        numbered = data.tests.assign(number=range(1, len(data.tests) + 1))
        panels = {
            name: numbered[numbered["metric"] == name]
            for name in all_quantities
            if (data.tests["metric"] == name).any()
        }
        heights = [_METRIC_IN + _TEST_IN * len(rows) for rows in panels.values()]
        figure = Drawing(
            figsize=(TWO_COLUMNS_IN, sum(heights) + 0.3), layout="constrained"
        )
        axes = figure.subplots(
            len(panels), squeeze=False, gridspec_kw={"height_ratios": heights}
        )[:, 0]
        for panel, (name, rows) in zip(axes, panels.items(), strict=True):
            _draw_tests(panel, rows, all_quantities[name])
        point: dict[str, Any] = {"marker": "o", "ms": 4, "lw": 0}
        is_tested = data.tests["p_holm"].notna().all()
        looks: dict[str, Any] = {
            **({"supported": point} if is_tested else {}),
            "not supported" if is_tested else NOT_YET: {**point, "mfc": "white"},
            "90 % interval": {"lw": 2.6},
            "95 % interval": {"lw": 0.9},
        }
        handles: list[Artist] = [
            Line2D([], [], color=BLUE, label=label, **look)
            for label, look in looks.items()
        ]
        if (data.tests["margin"] > 0).any():
            handles.append(Patch(color=_MARGIN, label="allowed by the margin"))
        legend_outside(figure, handles, 5)
        return figure


def _draw_tests(panel: Axes, rows: pd.DataFrame, quantity: Quantity) -> None:
    # A difference without episodes is NaN.
    ends = rows[["low", "high", "difference", "margin"]].astype(float).abs()
    reach = max(ends.max().max(), 1e-9) * 1.08
    panel.set(xlim=(-reach, reach), ylim=(len(rows) - 0.4, -0.6))
    panel.axvline(0, color="0.4", lw=0.6, zorder=1)
    names = []
    for height, row in enumerate(rows.to_dict("records")):
        if row["margin"] > 0:
            inner = -row["margin"] if row["kind"] == "superiority" else row["margin"]
            low = -reach if row["direction"] == "lower" else -inner
            high = reach if row["direction"] == "higher" else inner
            panel.fill_between(
                [low, high], height - 0.36, height + 0.36, color=_MARGIN, lw=0, zorder=0
            )
        for suffix, width in (("", 0.9), ("_90", 2.6)):
            draw_interval(
                panel, row[f"low{suffix}"], row[f"high{suffix}"], height, BLUE, width
            )
        face = BLUE if row["supported"] else "white"
        panel.plot(
            row["difference"], height, "o", color=BLUE, ms=4.5, mfc=face, zorder=3
        )
        side = panel.get_yaxis_transform()
        panel.text(1.01, height, p_in_words(row["p_holm"]), transform=side, va="center")
        first, second = map(reading_names, row["names"])
        names.append(f"{row['number']}. {first}\n− {second}")
    panel.set_yticks(range(len(rows)), names)
    panel.tick_params(axis="y", length=0)
    panel.grid(axis="x", color=GRID, zorder=0)
    unit = f" [{quantity.unit}]" if quantity.unit else ""
    panel.set(xlabel=f"Δ {quantity.words}{unit}", axisbelow=True)
    # The better direction, at its end of the axis.
    x, side_name, words = (
        (1, "right", "better →")
        if quantity.better == "higher"
        else (0, "left", "← better")
    )
    if quantity.better != "neither":
        panel.annotate(
            words,
            (x, 1),
            xycoords="axes fraction",
            va="bottom",
            ha=side_name,
            color="0.35",
        )
