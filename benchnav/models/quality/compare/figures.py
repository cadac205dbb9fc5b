"""Figures of a comparison: measures with intervals, calibration, sparsification, and quality over severity.

A model has one colour, marker and dash in every figure; privileged ones are grey. A panel is a measure or a split.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.core.figures import (
    LINE_COLOURS,
    MARKERS,
    TITLE,
    TWO_COLUMNS_IN,
    legend_outside,
    stack_panels,
    styled,
)
from benchnav.models.quality.map_sums import MapTally
from benchnav.models.quality.scores import LEVEL
from benchnav.models.quality.scores_of_maps import COMPARED

_GREYS = ("0.35", "0.6")
_DASHES = ("-", "--", "-.")
_LEAST_WIDTH_IN = 4.4
_LINE_IN, _ROW_IN = 0.075, 0.16  # of a mark, and at least of a model
_AT_SEVERITY = ("crps", "pinball")
_MARKED_EVERY = 4
_ARROWS = {"higher": " ↑", "lower": " ↓", "": ""}

Looks = Mapping[str, Mapping[str, Any]]
Tallies = Mapping[tuple[str, str], MapTally]


def model_looks(models: Sequence[str], privileged: Sequence[str]) -> dict[str, dict[str, Any]]:
    """How the lines of each model are drawn, as keywords of `Axes.plot`."""
    looks: dict[str, dict[str, Any]] = {}
    for place, model in enumerate(model for model in models if model not in privileged):
        turn, colour = divmod(place, len(LINE_COLOURS))
        looks[model] = {
            "color": LINE_COLOURS[colour],
            "marker": MARKERS[place % len(MARKERS)],
            "ls": _DASHES[turn % len(_DASHES)],
        }
    for place, model in enumerate(privileged):
        looks[model] = {
            "color": _GREYS[place % len(_GREYS)],
            "marker": "+x|_"[place % 4],
            "ls": ("--", "-.")[place % 2],
        }
    return {model: {"ms": 3, "lw": 1, **looks[model]} for model in models}


@styled()
def measures_figure(
    summary: pd.DataFrame, headings: Mapping[str, str], looks: Looks, privileged: Sequence[str]
) -> Figure:
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
    down = -(-len(shown) // across)
    high = len(models) * max(_ROW_IN, _LINE_IN * (len(splits) + 1.5)) + 0.45
    figure = Figure(figsize=(TWO_COLUMNS_IN, down * high + 0.35), layout="constrained")
    panels = [panel for (panel,) in stack_panels(figure, len(shown), across, sharey=True)]
    for panel, score in zip(panels, shown, strict=True):
        name = score.name
        panel.set_title(headings[name] + _ARROWS[score.better], parse_math=False)
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
            panel.axvline(LEVEL, color="0.4", lw=0.8, ls="--", zorder=0.5, label="calibrated")
        panel.grid(axis="x", alpha=0.3)
        panel.margins(x=0.08)
        panel.locator_params(axis="x", nbins=4, steps=[1, 2, 5, 10])
    for panel in panels[::across]:
        panel.set_yticks(range(len(models)), models, parse_math=False)
        for label in panel.get_yticklabels():
            label.set_color("0.5" if label.get_text() in privileged else "black")
    panels[0].set_ylim(len(models) - 0.5, -0.5)
    legend_outside(figure, side="upper center", columns=5)
    return figure


@styled()
def calibration_figure(tallies: Tallies, looks: Looks) -> Figure:
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
    figure.supylabel("share of λ below\nthe quantile − level", fontsize=TITLE)
    _explain(figure)
    return figure


@styled()
def sparsification_figure(tallies: Tallies, looks: Looks) -> Figure:
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
    figure.supxlabel("share of cells left out, those of the widest intervals first")
    figure.supylabel("mean |E[λ] − λ| of the rest", fontsize=TITLE)
    best = Line2D([], [], color="0.4", lw=0.8, ls=":", label="largest errors first, the best order")
    _explain(figure, [best])
    return figure


@styled()
def severity_figure(
    all_series: Mapping[str, Sequence[tuple[float, str]]],
    summary: pd.DataFrame,
    headings: Mapping[str, str],
    looks: Looks,
) -> Figure:
    """Draws CRPS and pinball loss over the severity of a shift, a column a scenario and a line a model.

    Args:
        all_series: by scenario, its pairs as (severity, split), ascending.
        summary: of `Comparison`.
        headings: of the measures.
        looks: from `model_looks`.
    """
    width = max(TWO_COLUMNS_IN * min(len(all_series), 3) / 3, _LEAST_WIDTH_IN)
    high = 1.7 * len(_AT_SEVERITY) * math.ceil(len(all_series) / 3)
    figure = Figure(figsize=(width, high + 0.6), layout="constrained")
    places = stack_panels(figure, len(all_series), min(len(all_series), 3), len(_AT_SEVERITY), sharey="row")
    known = summary.set_index(["split", "model"])
    for panels, (scenario, series) in zip(places, all_series.items(), strict=True):
        panels[0].set_title(scenario, parse_math=False)
        for panel, name in zip(panels, _AT_SEVERITY, strict=True):
            for model, look in looks.items():
                there = [(severity, split) for severity, split in series if (split, model) in known.index]
                rows = known.loc[[(split, model) for _, split in there]]
                severities = [severity for severity, _ in there]
                panel.plot(severities, rows[name], label=model, **look)
                panel.vlines(
                    severities, rows[f"{name}_low"], rows[f"{name}_high"], color=look["color"], lw=0.7
                )
            panel.grid(alpha=0.3)
            panel.locator_params(axis="y", nbins=5, steps=[1, 2, 5, 10])
            if panels is places[0]:
                panel.set_ylabel(headings[name])
    figure.supxlabel("severity of the shift")
    _explain(figure)
    return figure


def _panels_of_splits(tallies: Tallies) -> tuple[Figure, dict[str, Axes]]:
    splits = list(dict.fromkeys(split for split, _ in tallies))
    across = min(len(splits), 3)
    width = max(TWO_COLUMNS_IN * across / 3, _LEAST_WIDTH_IN)
    figure = Figure(figsize=(width, 1.8 * math.ceil(len(splits) / across) + 0.6), layout="constrained")
    panels = [panel for (panel,) in stack_panels(figure, len(splits), across, sharex=True, sharey=True)]
    for panel, split in zip(panels, splits, strict=True):
        panel.set_title(split, parse_math=False)
        panel.set_xlim(0, 1)
        panel.set_xticks([0, 0.5, 1], ["0", "0.5", "1"])
        panel.grid(alpha=0.3)
    return figure, dict(zip(splits, panels, strict=True))


def _explain(figure: Figure, handles: Sequence[Artist] = ()) -> None:
    legend_outside(
        figure, handles, columns=5 if figure.get_figwidth() == TWO_COLUMNS_IN else 3, side="upper center"
    )
