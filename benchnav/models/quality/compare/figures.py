"""Figures of a comparison: measures with intervals, calibration, sparsification, and quality over severity.

A model has one colour, marker and dash in every figure; privileged ones are grey. A panel is a measure or a split.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D

from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.compare.report import Comparison
from benchnav.models.quality.map_sums import MapTally
from benchnav.models.quality.scores import LEVEL
from benchnav.models.quality.scores_of_maps import COMPARED
from benchnav.viz.figure import Figure
from benchnav.viz.panels import Curves, Looks, draw_baseline, line_looks, panel_grid, ticks_of
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

Tallies = Mapping[tuple[str, str], MapTally]


def model_looks(models: Sequence[str], privileged: Sequence[str]) -> Looks:
    """Return how the lines of each model are drawn, as keywords of `Axes.plot`; privileged ones are grey."""
    looks = line_looks([model for model in models if model not in privileged])
    for place, model in enumerate(privileged):
        grey, marker, dash = _GREYS[place % len(_GREYS)], "+x|_"[place % 4], ("--", "-.")[place % 2]
        looks[model] = {"color": grey, "marker": marker, "ls": dash}
    return {model: {**looks[model], "ms": 3, "lw": 1} for model in models}


def measures_figure(
    summary: pd.DataFrame, headings: Mapping[str, str], looks: Looks, privileged: Sequence[str]
) -> Drawing:
    """Draws each measure of each model with its interval, a panel a measure and a mark a split.

    Args:
        summary: of `Comparison`.
        headings: of the measures.
        looks: from `model_looks`, in the order of the models.
        privileged: those of the models.
    """
    shown = [score for score in COMPARED if score.name in summary and summary[score.name].notna().any()]
    models, splits = list(looks), list(dict.fromkeys(summary["split"]))
    across = 4 if len(shown) > 6 else 3
    high = len(models) * max(_ROW_IN, _LINE_IN * (len(splits) + 1.5)) + 0.45
    titles = [headings[score.name] + _ARROWS[score.better] for score in shown]
    figure, places = panel_grid(titles, across, high, 0.35, TWO_COLUMNS_IN, sharey=True)
    panels = [panel for (panel,) in places]
    for panel, score in zip(panels, shown, strict=True):
        name = score.name
        for place, split in enumerate(splits):
            rows = summary[summary["split"] == split].set_index("model").reindex(models)
            y = np.arange(len(models)) + 0.7 * ((place + 0.5) / len(splits) - 0.5)
            value, low, high_end = (
                rows[own].to_numpy(float) for own in (name, f"{name}_low", f"{name}_high")
            )
            colour = LINE_COLOURS[place % len(LINE_COLOURS)]
            panel.hlines(y, low, high_end, color=colour, lw=1)
            panel.plot(value, y, MARKERS[place % len(MARKERS)], color=colour, ms=2.8, label=split)
        if name == "coverage":
            draw_baseline(panel, LEVEL, "calibrated", horizontal=False)
        panel.grid(axis="x", alpha=0.3)
        panel.margins(x=0.08)
        ticks_of(panel, "x")
    for panel in panels[::across]:
        panel.set_yticks(range(len(models)), models, parse_math=False)
        for label in panel.get_yticklabels():
            label.set_color("0.5" if label.get_text() in privileged else "black")
    panels[0].set_ylim(len(models) - 0.5, -0.5)
    legend_outside(figure, side="upper center", columns=5)
    return figure


def calibration_figure(tallies: Tallies, looks: Looks) -> Drawing:
    """Draws by how much more often than it should λ was under each quantile of its prediction, a panel a split.

    Args:
        tallies: by split and model.
        looks: from `model_looks`.
    """
    figure, panels = _panels_of_splits(tallies)
    for split, panel in panels.items():
        panel.axhline(0, color="0.4", lw=0.8, label="calibrated")
        for model, look in looks.items():
            if (split, model) in tallies:
                counts = tallies[split, model].pit
                levels = np.linspace(0, 1, len(counts) + 1)
                excess = np.concatenate([[0], np.cumsum(counts) / counts.sum()]) - levels
                panel.plot(levels, excess, label=model, markevery=_MARKED_EVERY, **look)
    figure.supxlabel("level of the quantile")
    figure.supylabel("fraction of λ below\nthe quantile − level", fontsize=TITLE)
    legend_outside(figure, columns=5, side="upper center")
    return figure


def sparsification_figure(tallies: Tallies, looks: Looks) -> Drawing:
    """Draws the mean error of the cells that are left over the share that was left out, a panel a split.

    Args:
        tallies: by split and model.
        looks: from `model_looks`.
    """
    figure, panels = _panels_of_splits(tallies)
    for split, panel in panels.items():
        for model, look in looks.items():
            if (split, model) in tallies:
                left_out, by_width, by_error = tallies[split, model].curves()
                panel.plot(left_out, by_width, label=model, markevery=2 * _MARKED_EVERY, **look)
                panel.plot(left_out, by_error, color=look["color"], lw=0.8, ls=":")
    panel.set_ylim(bottom=0)  # of all, which share it
    figure.supxlabel("fraction of cells left out, those of the widest intervals first")
    figure.supylabel("mean |E[λ] − λ| of the rest", fontsize=TITLE)
    best = Line2D([], [], color="0.4", lw=0.8, ls=":", label="largest errors first, the best order")
    legend_outside(figure, [best], 5, side="upper center")
    return figure


def severity_figure(
    all_series: Mapping[str, Sequence[tuple[float, str]]],
    summary: pd.DataFrame,
    headings: Mapping[str, str],
    looks: Looks,
) -> Drawing:
    """Draws CRPS and pinball loss over the severity of a shift, a column a scenario and a line a model.

    Args:
        all_series: by scenario, its pairs as (severity, split), ascending.
        summary: of `Comparison`.
        headings: of the measures.
        looks: from `model_looks`.
    """
    known = summary.set_index(["split", "model"], drop=False)
    points = [
        known.loc[[(split, model)]].assign(panel=scenario, line=model, x=severity)
        for scenario, series in all_series.items()
        for model in looks
        for severity, split in series
        if (split, model) in known.index
    ]
    curves = Curves(
        table=pd.concat(points, ignore_index=True),
        measures={name: headings[name] for name in _AT_SEVERITY},
        looks=looks,
        x_label="severity of the shift",
        across=min(len(all_series), 3),
        high_in=1.7,
        width_in=page_width(len(all_series), 3),
        bars=True,
    )
    figure, panels = curves.draw()
    for panel in panels.values():
        ticks_of(panel, "y", 5)
    legend_outside(figure, columns=5, side="upper center")
    return figure


def _panels_of_splits(tallies: Tallies) -> tuple[Drawing, dict[str, Axes]]:
    splits = list(dict.fromkeys(split for split, _ in tallies))
    width = page_width(len(splits), 3)
    figure, places = panel_grid(splits, 3, 1.8, 0.6, width, sharex=True, sharey=True)
    panels = {split: panel for split, (panel,) in zip(splits, places, strict=True)}
    for panel in panels.values():
        panel.set_xlim(0, 1)
        panel.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        panel.grid(alpha=0.3)
    return figure, panels


class _Measures(Figure):
    name, title = "measures", "Measures with their intervals"
    text = (
        "Each row is a model, each mark a split; lines are 95 % intervals over maps. ↑: higher is better, ↓: lower "
        "is better. Grey: privileged models, which are given part of the truth."
    )

    def draw(self, data: Comparison) -> Drawing:
        return measures_figure(data.summary, _headings(), _looks(data), data.privileged)


class _Calibration(Figure):
    name, title = "calibration", "Calibration of the predicted distributions of λ"
    text = (
        "Fraction of observed λ below a predicted quantile, less the level of the quantile, over that level. 0 is "
        "calibrated. Above 0 at the left: low λ is more frequent than predicted."
    )

    def draw(self, data: Comparison) -> Drawing:
        return calibration_figure(data.tallies, _looks(data))


class _Sparsification(Figure):
    name, title = "sparsification", "Sparsification: uncertainty against error"
    text = (
        "Mean error |λ − E[λ]| of the remaining cells over the fraction of cells removed: the most uncertain first "
        "(lines), or those of largest error first (dotted). The area between the two is AUSE."
    )

    def draw(self, data: Comparison) -> Drawing:
        return sparsification_figure(data.tallies, _looks(data))


class _Severity(Figure):
    name, title = "severity", "Quality over the severity of a shift"
    text = (
        "CRPS and pinball loss of the lower fifth over the severity of each scenario: 0 is the training maps, 1 "
        "the scenario itself. Lines are 95 % intervals over maps."
    )

    def needs(self, data: Comparison) -> bool:
        return bool(find_series(data.splits))

    def draw(self, data: Comparison) -> Drawing:
        return severity_figure(find_series(data.splits), data.summary, _headings(), _looks(data))


def comparison_figures(comparison: Comparison) -> list[Figure]:
    """List the figures of a comparison that apply."""
    figures: tuple[Figure, ...] = (_Measures(), _Calibration(), _Sparsification(), _Severity())
    return [variant for figure in figures for variant in figure.variants(comparison)]


def _looks(comparison: Comparison) -> Looks:
    return model_looks(list(comparison.models), comparison.privileged)


def _headings() -> dict[str, str]:
    return {score.name: score.title for score in COMPARED}
