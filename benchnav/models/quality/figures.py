"""Figures of a model's quality: where it errs, and whether its probabilities can be trusted.

They are as wide as the two columns of a page, or narrower where panels are few. Lines differ in marker or dash
beside their colour. A figure has a panel a split, in the order given. Letters in shapes: C classes, G nodes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from scipy.stats import binom

from benchnav.core.figures import (
    BLUE,
    LINE_COLOURS,
    MARKERS,
    ORANGE,
    SKY,
    TEXT,
    TWO_COLUMNS_IN,
    frame_map,
    legend_outside,
    stack_panels,
    styled,
)
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.recipe.latent import expected_of
from benchnav.datagen.recipe.latent import truth as true_distribution
from benchnav.models.quality.measure import ClassQuality, TraversabilityQuality
from benchnav.models.quality.scores import CONFIDENCE_BINS, LEVEL, PIT_BINS
from benchnav.models.slope_gp.table import SlopeTable, table_slopes

_LEAST_WIDTH = 4.4
_SMALL = 5.5
_MOST_NUMBERED = 16  # classes; among more, numbers would not fit their cells
_BAND = "0.82"
_RARE = 1e-3
_NEAR = 0.01  # to the ideal; finer differences fill no panel

# Title, and the quantity of ClassQuality or TraversabilityQuality.
_SEVERITY = (
    ("Accuracy", "accuracy"),
    ("Calibration error (ECE)", "ece"),
    ("Mean entropy [nats]", "entropy"),
    ("AUROC of uncertainty", "entropy_auroc"),
    ("RMSE of E[λ]", "rmse_expected"),
    ("CRPS of λ", "crps"),
    ("In the 90 % interval", "coverage"),
    ("Under VaR at 0.9", "tail_rate"),
)
_IDEALS = {"coverage": 0.9, "tail_rate": 0.1}  # that are not an end
_OF_CLASSES = 4  # the first so many


@styled()
def confusion_figure(qualities: Mapping[str, ClassQuality], names: Sequence[str]) -> Figure:
    """Draws which classes are taken for which: shares of each true class, in percent.

    Args:
        qualities: by split.
        names: of the C classes.
    """
    most = 3 if len(qualities) > 2 else 2
    shown = [(f"{split}: accuracy {quality.accuracy:.3f}", quality) for split, quality in qualities.items()]
    ragged = len(shown) > most and len(shown) % most  # panels that end above hold the names of columns too
    high = 2.2 if most == 3 else 3.1
    figure, panels = _grid(shown, most, high, 1.25 if ragged else 0.7, share_y=True)
    labels = [name.replace("_", " ") for name in names]
    palette = matplotlib.colormaps["Blues"].with_extremes(bad="0.85")
    for (panel,), quality in panels:
        counts = np.array(quality.confusion, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            shares = 100 * counts / counts.sum(1, keepdims=True)
        image = panel.imshow(shares, cmap=palette, vmin=0, vmax=100)
        for row, column in np.argwhere(shares >= 0.5) if len(names) <= _MOST_NUMBERED else ():
            share = shares[row, column]
            colour = "white" if share > 55 else "black"
            panel.text(column, row, f"{share:.0f}", size=_SMALL, color=colour, ha="center", va="center")
        panel.set_xticks(range(len(names)), labels, rotation=90, parse_math=False)
        panel.set_yticks(range(len(names)), labels, parse_math=False)
        frame_map(panel)
    figure.supxlabel("most likely class")
    figure.supylabel("true class")
    # Beside the upper right panel, and as high as its square, which is less than the room that it is given.
    beside = panels[min(len(panels), most) - 1][0][0].inset_axes((1.04, 0, 0.05, 1))
    figure.colorbar(image, cax=beside, label="share of the true class [%]")
    return figure


@styled()
def reliability_figure(qualities: Mapping[str, ClassQuality]) -> Figure:
    """Draws how often the most likely class is right against its probability, over how many cells say so.

    Args:
        qualities: by split.
    """
    shown = [(f"{split}: ECE {quality.ece:.3f}", quality) for split, quality in qualities.items()]
    figure, pairs = _grid(shown, 3, 2.6, 0.35, heights=(3, 1))
    edges = np.linspace(0, 1, CONFIDENCE_BINS + 1)
    for (upper, lower), quality in pairs:
        cells, confidence, accuracy = map(np.array, quality.reliability.values())
        share, filled = cells / cells.sum(), cells > 0
        often = share >= _RARE
        few = filled & ~often
        upper.plot([0, 1], [0, 1], color="0.5", lw=0.8, ls="--", label="calibrated")
        points: dict[str, Any] = {"color": BLUE, "ms": 3, "lw": 1, "clip_on": False}
        upper.plot(confidence[often], accuracy[often], "o-", **points, label="observed")
        if few.any():  # no point at all would ask for all the room there is
            words = "observed, under 0.1 % of cells"
            upper.plot(confidence[few], accuracy[few], "o", mfc="white", **points, label=words)
        gap = (confidence[filled], confidence[filled], accuracy[filled])
        upper.vlines(*gap, color=ORANGE, lw=2, alpha=0.45, zorder=1.5, label="gap")
        upper.set(xlim=(0, 1), ylim=(0, 1), yticks=[0, 0.5, 1])
        lower.bar(edges[:-1], share, 1 / CONFIDENCE_BINS, align="edge", color=SKY, ec="white", lw=0.4)
        lower.set(ylim=(0, 1), yticks=[0, 1])
        lower.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    for (upper, lower), _ in pairs[::3]:
        upper.set_ylabel("accuracy")
        lower.set_ylabel("cells")
    figure.align_ylabels()
    figure.supxlabel("probability of the most likely class")
    _explain(figure)
    return figure


@styled()
def pit_figure(qualities: Mapping[str, TraversabilityQuality]) -> Figure:
    """Draws the histogram of the PIT of λ as it departs from 1, its height for a calibrated model.

    Each panel has a scale of its own, since one bad split would flatten all others. The band holds 90 % of
    the bins of as many independent, rightly predicted cells.

    Args:
        qualities: by split.
    """
    figure, panels = _grid(list(qualities.items()), 3, 1.75, 0.45 if len(qualities) > 2 else 0.65)
    edges = np.linspace(0, 1, PIT_BINS + 1)
    tail = round((1 - LEVEL) * PIT_BINS)
    for (panel,), quality in panels:
        counts = np.array(quality.pit)
        level = counts.sum() / PIT_BINS
        density = counts / level
        low, high = np.array(binom.interval(0.9, counts.sum(), 1 / PIT_BINS)) / level
        for first, last, colour, label in (
            (0, tail, ORANGE, "observed, under VaR at 0.9"),
            (tail, PIT_BINS, SKY, "observed"),
        ):
            heights, ends = density[first:last], edges[first : last + 1]
            panel.stairs(heights, ends, baseline=1, fill=True, color=colour, alpha=0.75, lw=0, label=label)
            panel.stairs(heights, ends, baseline=None, color=colour, lw=1)
        panel.axhline(1, color="black", lw=0.7, label="calibrated")
        words = "90 % of a calibrated model's bins"
        panel.fill_between([0, 1], low, high, color=_BAND, lw=0, zorder=0.5, label=words)
        for bound in (0.05, 0.95):
            panel.axvline(bound, color="black", lw=0.7, ls=":", label="central 90 %")
        panel.text(
            0.5, 0.97,
            f"in 5–95 %: {quality.coverage:.3f} (ideally 0.9)\nunder VaR: {quality.tail_rate:.3f} (ideally 0.1)",
            size=TEXT, ha="center", va="top", transform=panel.transAxes, linespacing=1.3,
        )  # fmt: skip
        lowest, highest = min(0.95, *density), max(1.05, *density)
        room = highest - lowest
        panel.set(xlim=(0, 1), ylim=(lowest - 0.1 * room, highest + 0.5 * room), xticks=[0, 0.5, 1])
        panel.locator_params(axis="y", nbins=5, steps=[1, 2, 5, 10])
    figure.supxlabel("PIT of observed λ")
    figure.supylabel("density")
    _explain(figure, most=5)
    return figure


@styled()
def severity_figure(
    all_series: Mapping[str, Sequence[tuple[float, str]]], numbers: Mapping[str, Mapping[str, float]]
) -> Figure:
    """Draws quality against the severity of a shift, a line a scenario.

    Args:
        all_series: by scenario, its pairs as (severity, split), ascending.
        numbers: of the quality of all these splits, by name.
    """
    table = pd.DataFrame(
        {"scenario": scenario, "severity": severity, **numbers[split]}
        for scenario, series in all_series.items()
        for severity, split in series
    )
    measured = table.dropna(axis=1)
    quantities = _SEVERITY if "accuracy" in measured else _SEVERITY[_OF_CLASSES:]
    figure, panels = _grid(quantities, 4, 1.65, 0.45)
    for (panel,), name in panels:
        for place, (scenario, own) in enumerate(table.groupby("scenario", sort=False)):
            look: dict[str, Any] = {
                "color": LINE_COLOURS[place % len(LINE_COLOURS)], "marker": MARKERS[place % len(MARKERS)],
                "ms": 3, "lw": 1,
            }  # fmt: skip
            panel.plot(own["severity"], own[name], label=scenario, **look)
            if name == "entropy_auroc" and "mutual_information" in measured:
                words = "of mutual information; solid: of entropy"
                others = own["mutual_information_auroc"]
                panel.plot(own["severity"], others, ls=":", mfc="white", **look, label=words)
        panel.margins(x=0.05, y=0.12)
        if ideal := _IDEALS.get(name):
            panel.axhline(ideal, color="0.4", lw=0.8, ls="--", label="calibrated")
            low, high = panel.get_ylim()
            panel.set_ylim(min(low, ideal - _NEAR), max(high, ideal + _NEAR))
        panel.grid(alpha=0.3)
        panel.locator_params(axis="y", nbins=4, steps=[1, 2, 5, 10])
    figure.supxlabel("severity of the shift")
    _explain(figure)
    return figure


@styled()
def latent_figure(
    table: SlopeTable,
    classes: Sequence[TerrainClass],
    slope_cells: Sequence[Sequence[int]],
    truth: bool = True,
) -> Figure:
    """Draws each class's GP over slope with its uncertainty, beside the true latent function and E[λ].

    Args:
        table: the GPs of the C classes.
        classes: the true functions, where these are known.
        slope_cells: measured cells by true class and whole degree of slope, [C][90].
        truth: whether they are.
    """
    shown = [(item.name.replace("_", " "), item) for item in classes]
    figure, panels = _grid(shown, 5, 1.55, 0.5 if len(shown) > 4 else 1.0, share_y=True)
    x = table_slopes().numpy()
    x = x[x <= max(10.0, 1.15 * max(_steeper_than(cells, 0) for cells in slope_cells))]
    class_id, slopes = np.broadcast_arrays(np.arange(len(classes))[:, None, None], x)
    mixture = table.own(torch.tensor(class_id), torch.tensor(slopes))
    weights, means, stds = (v.numpy() for v in (mixture.weights, mixture.means, mixture.stds))
    true = true_distribution(class_id, slopes, tuple(classes))
    expected, true_expected = expected_of((weights, means, stds)), expected_of(true)
    noise = table.noise_std.double().cpu().numpy()
    for number, ((panel,), item) in enumerate(panels):
        mean, std = means[number, 0, 0], stds[number, 0, 0]
        latent = np.sqrt(np.maximum(std**2 - noise[number] ** 2, 0))
        panel.plot(x, mean, color=BLUE, lw=1.1, label="GP mean")
        panel.plot(x, expected[number, 0], color=ORANGE, lw=1.1, label="predicted E[λ]")
        for spread, colour, alpha, label in (
            (std, SKY, 0.3, "± 2σ with noise"),
            (latent, BLUE, 0.45, "± 2σ of the latent function"),
        ):
            low, high = mean - 2 * spread, mean + 2 * spread
            panel.fill_between(x, low, high, color=colour, alpha=alpha, lw=0, label=label)
        words = f"σ {noise[number]:.3f}"
        if truth:
            panel.plot(x, true[1][number, 0, 0], color="black", lw=0.9, ls="--", label="true latent function")
            panel.plot(x, true_expected[number, 0], color="black", lw=1, ls=":", label="true E[λ]")
            words += f" ({item.noise:.3f})"
        if weights[number, 0, 0, 0] < 1:
            panel.axhline(means[number, 1, 0, 0], color=BLUE, lw=0.9, ls="-.", label="mean of soft spots")
        for share, shade, label in (
            (_RARE, 0.12, "steeper: 1 cell in 1000"),
            (0.0, 0.25, "steeper: no cell of the class"),
        ):
            steeper = _steeper_than(slope_cells[number], share)
            panel.axvspan(steeper, 90, color="0.4", alpha=shade, lw=0, label=label)
        panel.text(0.05, 0.05, words, size=TEXT, transform=panel.transAxes)
        panel.set(xlim=(0, x[-1]), ylim=(-0.45, 1.45), yticks=[0, 0.5, 1])
    figure.supxlabel(f"slope [°]  (σ: noise{', in brackets the true one' if truth else ''})")
    figure.supylabel("traversability")
    _explain(figure)
    return figure


def _steeper_than(cells: Sequence[int], share: float) -> float:
    """The whole degree of slope that at most `share` of the cells are steeper than."""
    steeper = np.cumsum(cells[::-1])[::-1]
    return float(np.sum(steeper > share * steeper[0]))


def _grid(
    shown: Sequence[tuple[str, Any]],
    most: int,
    high: float,
    rest: float,
    heights: Sequence[float] = (1,),
    share_y: bool = False,
) -> tuple[Figure, list[tuple[list[Axes], Any]]]:
    """A figure of places for things by title, at most so many side by side, each so high, and with room for the rest.

    Beside each place stands what it is to show. A place holds panels under each other, whose heights are as given. The
    figure has the width that its places need, and that of its legend.
    """
    columns = min(len(shown), most)
    rows = -(-len(shown) // columns)
    width = max(TWO_COLUMNS_IN * (columns / most), _LEAST_WIDTH)
    figure = Figure(figsize=(width, rows * high + rest), layout="constrained")
    places = stack_panels(
        figure, len(shown), columns, len(heights), sharex=True, sharey=share_y,
        height_ratios=[*heights] * rows,
    )  # fmt: skip
    for (panel, *_), (title, _) in zip(places, shown, strict=True):
        panel.set_title(title, parse_math=False)
    return figure, [(place, item) for place, (_, item) in zip(places, shown, strict=True)]


def _explain(figure: Figure, most: int = 4) -> None:
    """Lays a legend over the panels, in at most so many columns where the figure is of full width."""
    columns = most if figure.get_figwidth() == TWO_COLUMNS_IN else 2
    legend_outside(figure, columns=columns, side="upper center")
