"""Figures of a comparison: intervals, calibration, sparsification, and severity.

A model has the same colour, marker and dash in all figures; privileged models are grey.
Each panel shows a measure or a split.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D

from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.compare.report import Comparison
from benchnav.models.quality.figure_data import series_table
from benchnav.models.quality.map_sums import MapTally
from benchnav.models.quality.scores import LEVEL
from benchnav.models.quality.scores_of_maps import COMPARED
from benchnav.viz.figure import Figure, applicable
from benchnav.viz.panels import (
    Curves,
    Looks,
    draw_baseline,
    line_looks,
    panel_grid,
    ticks_of,
)
from benchnav.viz.style import (
    LINE_COLOURS,
    MARKERS,
    TITLE,
    TWO_COLUMNS_IN,
    legend_outside,
    page_width,
)

_GREYS = ("0.35", "0.6")
_MARK_HEIGHT_IN = 0.075
_MIN_ROW_HEIGHT_IN = 0.16
_BY_SEVERITY = ("crps", "pinball")
_MARKED_EVERY = 4  # number of points per marker
_ARROWS = {"higher": " ↑", "lower": " ↓", "": ""}


def model_looks(models: Sequence[str], privileged: Sequence[str]) -> Looks:
    """Return the line style of each model, as keywords of `Axes.plot`."""
    competing = [model for model in models if model not in privileged]
    looks = line_looks(competing)
    for index, model in enumerate(privileged):
        looks[model] = {
            "color": _GREYS[index % len(_GREYS)],
            "marker": "+x|_"[index % 4],
            "ls": ("--", "-.")[index % 2],
        }
    return {model: {**looks[model], "ms": 3, "lw": 1} for model in models}


def _split_panels(
    data: Comparison,
) -> tuple[Drawing, list[tuple[Axes, str, MapTally, Mapping[str, Any]]]]:
    """Create a figure with one panel per split, for one line per model in each panel.

    Returns:
        The figure; and the panel, model, tally and style of each line to draw.
    """
    splits = list(dict.fromkeys(split for split, _ in data.tallies))
    width = page_width(len(splits), 3)
    figure, axes = panel_grid(splits, 3, 1.8, 0.6, width, sharex=True, sharey=True)
    looks = _looks(data)
    panels = {}
    for split, (panel,) in zip(splits, axes, strict=True):
        panel.set_xlim(0, 1)
        panel.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        panel.grid(alpha=0.3)
        panels[split] = panel
    lines = []
    for model in data.models:
        look = looks[model]
        for split in splits:
            tally = data.tallies.get((split, model))
            if tally is not None:
                lines.append((panels[split], model, tally, look))
    return figure, lines


class _Measures(Figure):
    name = "measures"
    title = "Measures with their intervals"
    text = (
        "Each row is a model, each mark a split; lines are 95 % intervals over maps. "
        "↑: higher is better, ↓: lower is better. Grey: privileged models, which "
        "receive part of the truth."
    )

    def draw(self, data: Comparison) -> Drawing:
        models = list(_looks(data))
        splits = list(dict.fromkeys(data.summary["split"]))
        has_values = data.summary.notna().any()
        scores = [score for score in COMPARED if has_values.get(score.name, False)]
        n_columns = 4 if len(scores) > 6 else 3
        marks_height = _MARK_HEIGHT_IN * (len(splits) + 1.5)
        row_height = max(_MIN_ROW_HEIGHT_IN, marks_height)
        height = len(models) * row_height + 0.45
        titles = [score.title + _ARROWS[score.better] for score in scores]
        figure, axes = panel_grid(
            titles, n_columns, height, 0.35, TWO_COLUMNS_IN, sharey=True
        )
        panels = [panel for (panel,) in axes]
        for panel, score in zip(panels, scores, strict=True):
            for index, split in enumerate(splits):
                is_of_split = data.summary["split"] == split
                rows = data.summary[is_of_split].set_index("model").reindex(models)
                position = (index + 0.5) / len(splits)
                offset = 0.7 * (position - 0.5)
                y = np.arange(len(models)) + offset
                value = rows[score.name].to_numpy(float)
                low = rows[f"{score.name}_low"].to_numpy(float)
                high = rows[f"{score.name}_high"].to_numpy(float)
                colour = LINE_COLOURS[index % len(LINE_COLOURS)]
                marker = MARKERS[index % len(MARKERS)]
                panel.hlines(y, low, high, color=colour, lw=1)
                panel.plot(value, y, marker, color=colour, ms=2.8, label=split)
            if score.name == "coverage":
                draw_baseline(panel, LEVEL, "calibrated", horizontal=False)
            panel.grid(axis="x", alpha=0.3)
            panel.margins(x=0.08)
            ticks_of(panel, "x")
        for panel in panels[::n_columns]:
            panel.set_yticks(range(len(models)), models, parse_math=False)
            for label in panel.get_yticklabels():
                is_privileged = label.get_text() in data.privileged
                label.set_color("0.5" if is_privileged else "black")
        panels[0].set_ylim(len(models) - 0.5, -0.5)
        legend_outside(figure, side="upper center", columns=5)
        return figure


class _Calibration(Figure):
    name = "calibration"
    title = "Calibration of the predicted distributions of λ"
    text = (
        "Vertical: fraction of observed λ below a predicted quantile, minus the level "
        "of the quantile. Horizontal: the level. 0 is calibrated. Above 0 at the left: "
        "low λ is more frequent than predicted."
    )

    def draw(self, data: Comparison) -> Drawing:
        figure, lines = _split_panels(data)
        for panel in figure.axes:
            panel.axhline(0, color="0.4", lw=0.8, label="calibrated")
        for panel, model, tally, look in lines:
            levels = np.linspace(0, 1, len(tally.pit) + 1)
            cumulative = np.cumsum(tally.pit) / tally.pit.sum()
            fractions = np.concatenate([[0], cumulative])
            excess = fractions - levels
            panel.plot(levels, excess, label=model, markevery=_MARKED_EVERY, **look)
        figure.supxlabel("level of the quantile")
        figure.supylabel("fraction of λ below\nthe quantile − level", fontsize=TITLE)
        legend_outside(figure, columns=5, side="upper center")
        return figure


class _Sparsification(Figure):
    name = "sparsification"
    title = "Sparsification: uncertainty against error"
    text = (
        "Vertical: mean error |λ − E[λ]| of the remaining cells. Horizontal: fraction "
        "of cells removed, the most uncertain cells first (lines) or the cells with the "
        "largest error first (dotted). The area between both lines is AUSE."
    )

    def draw(self, data: Comparison) -> Drawing:
        figure, lines = _split_panels(data)
        for panel, model, tally, look in lines:
            removed, by_width, by_error = tally.curves()
            panel.plot(
                removed, by_width, label=model, markevery=2 * _MARKED_EVERY, **look
            )
            panel.plot(removed, by_error, color=look["color"], lw=0.8, ls=":")
        panel.set_ylim(bottom=0)  # applies to all panels, whose axes are linked
        figure.supxlabel(
            "fraction of cells removed, those with the widest intervals first"
        )
        figure.supylabel("mean |E[λ] − λ| of remaining cells", fontsize=TITLE)
        label = "largest errors first (best possible order)"
        best = Line2D([], [], color="0.4", lw=0.8, ls=":", label=label)
        legend_outside(figure, [best], 5, side="upper center")
        return figure


class _Severity(Figure):
    name = "severity"
    title = "Quality over the severity of a shift"
    text = (
        "CRPS and pinball loss of the lower fifth over the severity of each scenario: "
        "0 is the training maps, 1 the scenario itself. Vertical lines are 95 % "
        "intervals over maps."
    )

    def is_available(self, data: Comparison) -> bool:
        return bool(find_series(data.splits))

    def draw(self, data: Comparison) -> Drawing:
        series = series_table(data.splits)
        n_scenarios = series["scenario"].nunique()
        summary = data.summary.rename(columns={"model": "line"})
        table = series.merge(summary, on="split")
        table = table.rename(columns={"scenario": "panel", "severity": "x"})
        scores = [score for score in COMPARED if score.name in _BY_SEVERITY]
        curves = Curves(
            table=table,
            measures={score.name: score.title for score in scores},
            looks=_looks(data),
            x_label="severity of the shift",
            across=min(n_scenarios, 3),
            high_in=1.7,
            width_in=page_width(n_scenarios, 3),
            bars=True,
        )
        figure, panels = curves.draw()
        for panel in panels.values():
            ticks_of(panel, "y", 5)
        legend_outside(figure, columns=5, side="upper center")
        return figure


def comparison_figures(comparison: Comparison) -> list[Figure]:
    """Return the figures that apply to a comparison."""
    figures = (_Measures(), _Calibration(), _Sparsification(), _Severity())
    return applicable(figures, comparison)


def _looks(comparison: Comparison) -> Looks:
    models = list(comparison.models)
    return model_looks(models, comparison.privileged)
