"""Figures of a comparison: measures with intervals, calibration, sparsification, and
quality over severity.

A model has one colour, marker and dash in every figure; privileged ones are grey. A
panel is a measure or a split.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D

from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.compare.report import Comparison
from benchnav.models.quality.figures import series_table
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
_LINE_IN, _ROW_IN = 0.075, 0.16  # of a mark, and at least of a model
_AT_SEVERITY = ("crps", "pinball")
_MARKED_EVERY = 4
_ARROWS = {"higher": " ↑", "lower": " ↓", "": ""}


def model_looks(models: Sequence[str], privileged: Sequence[str]) -> Looks:
    """Return how the lines of each model are drawn, as keywords of `Axes.plot`;
    privileged ones are grey.
    """
    looks = line_looks([model for model in models if model not in privileged])
    for place, model in enumerate(privileged):
        grey, marker, dash = (
            _GREYS[place % len(_GREYS)],
            "+x|_"[place % 4],
            ("--", "-.")[place % 2],
        )
        looks[model] = {"color": grey, "marker": marker, "ls": dash}
    return {model: {**looks[model], "ms": 3, "lw": 1} for model in models}


def _draw_tallies(
    data: Comparison,
) -> tuple[Drawing, list[tuple[Axes, str, MapTally, Mapping[str, Any]]]]:
    """Make a panel a split; return the figure, and the panel, name, tally and look of
    each line.
    """
    splits = list(dict.fromkeys(split for split, _ in data.tallies))
    width = page_width(len(splits), 3)
    figure, places = panel_grid(splits, 3, 1.8, 0.6, width, sharex=True, sharey=True)
    panels = {split: panel for split, (panel,) in zip(splits, places, strict=True)}
    for panel in panels.values():
        panel.set_xlim(0, 1)
        panel.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        panel.grid(alpha=0.3)
    known = [
        (split, model)
        for model in data.models
        for split in splits
        if (split, model) in data.tallies
    ]
    looks = _looks(data)
    return figure, [
        (panels[split], model, data.tallies[split, model], looks[model])
        for split, model in known
    ]


class _Measures(Figure):
    name, title = "measures", "Measures with their intervals"
    text = (
        "Each row is a model, each mark a split; lines are 95 % intervals over maps. "
        "↑: higher is better, ↓: lower "
        "is better. Grey: privileged models, which are given part of the truth."
    )

    def draw(self, data: Comparison) -> Drawing:
        looks = _looks(data)
        shown = [
            score
            for score in COMPARED
            if score.name in data.summary and data.summary[score.name].notna().any()
        ]
        models, splits = list(looks), list(dict.fromkeys(data.summary["split"]))
        across = 4 if len(shown) > 6 else 3
        high = len(models) * max(_ROW_IN, _LINE_IN * (len(splits) + 1.5)) + 0.45
        titles = [score.title + _ARROWS[score.better] for score in shown]
        figure, places = panel_grid(
            titles, across, high, 0.35, TWO_COLUMNS_IN, sharey=True
        )
        panels = [panel for (panel,) in places]
        for panel, score in zip(panels, shown, strict=True):
            name = score.name
            for place, split in enumerate(splits):
                rows = (
                    data.summary[data.summary["split"] == split]
                    .set_index("model")
                    .reindex(models)
                )
                y = np.arange(len(models)) + 0.7 * ((place + 0.5) / len(splits) - 0.5)
                value, low, high_end = (
                    rows[own].to_numpy(float)
                    for own in (name, f"{name}_low", f"{name}_high")
                )
                colour = LINE_COLOURS[place % len(LINE_COLOURS)]
                panel.hlines(y, low, high_end, color=colour, lw=1)
                panel.plot(
                    value,
                    y,
                    MARKERS[place % len(MARKERS)],
                    color=colour,
                    ms=2.8,
                    label=split,
                )
            if name == "coverage":
                draw_baseline(panel, LEVEL, "calibrated", horizontal=False)
            panel.grid(axis="x", alpha=0.3)
            panel.margins(x=0.08)
            ticks_of(panel, "x")
        for panel in panels[::across]:
            panel.set_yticks(range(len(models)), models, parse_math=False)
            for label in panel.get_yticklabels():
                label.set_color(
                    "0.5" if label.get_text() in data.privileged else "black"
                )
        panels[0].set_ylim(len(models) - 0.5, -0.5)
        legend_outside(figure, side="upper center", columns=5)
        return figure


class _Calibration(Figure):
    name, title = "calibration", "Calibration of the predicted distributions of λ"
    text = (
        "Fraction of observed λ below a predicted quantile, less the level of the "
        "quantile, over that level. 0 is "
        "calibrated. Above 0 at the left: low λ is more frequent than predicted."
    )

    def draw(self, data: Comparison) -> Drawing:
        figure, lines = _draw_tallies(data)
        for panel in figure.axes:
            panel.axhline(0, color="0.4", lw=0.8, label="calibrated")
        for panel, model, tally, look in lines:
            levels = np.linspace(0, 1, len(tally.pit) + 1)
            excess = (
                np.concatenate([[0], np.cumsum(tally.pit) / tally.pit.sum()]) - levels
            )
            panel.plot(levels, excess, label=model, markevery=_MARKED_EVERY, **look)
        figure.supxlabel("level of the quantile")
        figure.supylabel("fraction of λ below\nthe quantile − level", fontsize=TITLE)
        legend_outside(figure, columns=5, side="upper center")
        return figure


class _Sparsification(Figure):
    name, title = "sparsification", "Sparsification: uncertainty against error"
    text = (
        "Mean error |λ − E[λ]| of the remaining cells over the fraction of cells "
        "removed: the most uncertain first "
        "(lines), or those of largest error first (dotted). The area between the two "
        "is AUSE."
    )

    def draw(self, data: Comparison) -> Drawing:
        figure, lines = _draw_tallies(data)
        for panel, model, tally, look in lines:
            left_out, by_width, by_error = tally.curves()
            panel.plot(
                left_out, by_width, label=model, markevery=2 * _MARKED_EVERY, **look
            )
            panel.plot(left_out, by_error, color=look["color"], lw=0.8, ls=":")
        panel.set_ylim(bottom=0)  # of all, which share it
        figure.supxlabel(
            "fraction of cells left out, those of the widest intervals first"
        )
        figure.supylabel("mean |E[λ] − λ| of the rest", fontsize=TITLE)
        best = Line2D(
            [],
            [],
            color="0.4",
            lw=0.8,
            ls=":",
            label="largest errors first, the best order",
        )
        legend_outside(figure, [best], 5, side="upper center")
        return figure


class _Severity(Figure):
    name, title = "severity", "Quality over the severity of a shift"
    text = (
        "CRPS and pinball loss of the lower fifth over the severity of each scenario: "
        "0 is the training maps, 1 "
        "the scenario itself. Lines are 95 % intervals over maps."
    )

    def needs(self, data: Comparison) -> bool:
        return bool(find_series(data.splits))

    def draw(self, data: Comparison) -> Drawing:
        series = series_table(data.splits)
        count = series["scenario"].nunique()
        measured = data.summary.rename(columns={"model": "line"})
        curves = Curves(
            table=series.merge(measured, on="split").rename(
                columns={"scenario": "panel", "severity": "x"}
            ),
            measures={
                score.name: score.title
                for score in COMPARED
                if score.name in _AT_SEVERITY
            },
            looks=_looks(data),
            x_label="severity of the shift",
            across=min(count, 3),
            high_in=1.7,
            width_in=page_width(count, 3),
            bars=True,
        )
        figure, panels = curves.draw()
        for panel in panels.values():
            ticks_of(panel, "y", 5)
        legend_outside(figure, columns=5, side="upper center")
        return figure


def comparison_figures(comparison: Comparison) -> list[Figure]:
    """List the figures of a comparison that apply."""
    return applicable(
        (_Measures(), _Calibration(), _Sparsification(), _Severity()), comparison
    )


def _looks(comparison: Comparison) -> Looks:
    return model_looks(list(comparison.models), comparison.privileged)
