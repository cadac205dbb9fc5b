"""Figures of a model's quality: where it errs, and whether its probabilities can be trusted.

Sizes are in inches and points as printed over the two columns of a page. Colours are those of Okabe
and Ito (2008) and of maps even in lightness, distinct to every kind of colour vision; lines differ in
marker or dash too. A figure has a panel a split, in the order given. Letters in shapes: C classes, G
nodes.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, PercentFormatter
from scipy.stats import binom

from benchnav.core.drawing import PAGE_WIDTH_IN, TEXT, TITLE, save, thin_ticks
from benchnav.core.store import replacing
from benchnav.datagen.recipe.classes import TerrainClass
from benchnav.datagen.recipe.latent import expected_traversability, latent_mean
from benchnav.models.quality.measure import ClassQuality, Quality, TraversabilityQuality
from benchnav.models.quality.scores import CONFIDENCE_BINS, LEVEL, PIT_BINS
from benchnav.models.slope_gp.table import SlopeTable, table_slopes

DPI = 300

_LEAST_WIDTH = 4.4
_SMALL = 5.5
_BLUE, _ORANGE, _GREEN, _PINK, _SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9"
_COLOURS = (_BLUE, _ORANGE, _GREEN, _PINK, _SKY, "#E69F00", "black")
_MARKERS = "os^Dv<P"
_MOST_NUMBERED = 16  # classes; among more, numbers would not fit their cells
_BAND = "0.82"
_RARE = 1e-3
_NO_SOFT = (0.0, 0.0, 1.0)  # weight, mean and standard deviation of no second mode
_NEAR = 0.01  # to the ideal; finer differences fill no panel

# Title, the quantity of ClassQuality or TraversabilityQuality, and its ideal where that is not an end.
_CLASS_SEVERITY: tuple[tuple[str, str, float | None], ...] = (
    ("Accuracy", "accuracy", None),
    ("Calibration error (ECE)", "ece", None),
    ("Mean entropy [nats]", "entropy", None),
    ("AUROC of uncertainty", "entropy_auroc", None),
)
_LATENT_SEVERITY: tuple[tuple[str, str, float | None], ...] = (
    ("RMSE of E[λ]", "rmse_expected", None),
    ("CRPS of λ", "crps", None),
    ("In the 90 % interval", "coverage", 0.9),
    ("Under VaR at 0.9", "tail_rate", 0.1),
)


def confusion_figure(qualities: Mapping[str, ClassQuality], names: Sequence[str]) -> Figure:
    """Draws which classes are taken for which: shares of each true class, in percent.

    Args:
        qualities: by split.
        names: of the C classes.
    """
    most = 3 if len(qualities) > 2 else 2
    columns, rows = _grid(len(qualities), most)
    names_within = 0.55 if len(qualities) % columns else 0.0  # those of columns, under panels that end above
    figure = _figure(columns / most, rows, 2.2 if most == 3 else 3.1, 0.7 + names_within)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    labels = [name.replace("_", " ") for name in names]
    palette, image = matplotlib.colormaps["Blues"].with_extremes(bad="0.85"), None
    for panel, (split, quality) in zip(panels.flat, qualities.items(), strict=False):
        counts = np.array(quality.confusion, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            shares = 100 * counts / counts.sum(1, keepdims=True)
        image = panel.imshow(shares, cmap=palette, vmin=0, vmax=100)
        if len(names) <= _MOST_NUMBERED:
            for row, column in zip(*np.nonzero(shares >= 0.5), strict=True):
                share = shares[row, column]
                colour = "white" if share > 55 else "black"
                panel.text(column, row, f"{share:.0f}", size=_SMALL, color=colour, ha="center", va="center")
        panel.set_xticks(range(len(names)), labels, rotation=90, parse_math=False)
        panel.set_yticks(range(len(names)), labels, parse_math=False)
        panel.set_title(f"{split}: accuracy {quality.accuracy:.3f}", size=TITLE)
        panel.tick_params(labelsize=TEXT - 0.5, length=2, width=0.5, pad=1.5)
    _drop_rest(panels, len(qualities))
    for panel in panels[:, 0]:
        panel.set_ylabel("true class", size=TEXT)
    figure.supxlabel("most likely class", size=TEXT)
    if image is not None:
        # Beside the upper right panel, and as high as its square, which is less than the room that it is given.
        beside = panels[0, -1].inset_axes((1.04, 0, 0.05, 1))
        bar = figure.colorbar(image, cax=beside)
        bar.set_label("share of the true class [%]", size=TEXT)
        bar.ax.tick_params(labelsize=TEXT, length=2, width=0.5)
    return figure


def reliability_figure(qualities: Mapping[str, ClassQuality]) -> Figure:
    """Draws how often the most likely class is right against its probability, over how many cells say so.

    Args:
        qualities: by split.
    """
    columns, rows = _grid(len(qualities), 3)
    figure = _figure(columns / 3, rows, 2.6, 0.35)
    heights = [3, 1] * rows
    panels = figure.subplots(2 * rows, columns, squeeze=False, sharex=True, height_ratios=heights)
    edges = np.linspace(0, 1, CONFIDENCE_BINS + 1)
    for place, (split, quality) in enumerate(qualities.items()):
        row, column = divmod(place, columns)
        upper, lower = panels[2 * row, column], panels[2 * row + 1, column]
        cells, confidence, accuracy = (
            np.array(values) for values in (
                quality.reliability.cells, quality.reliability.confidence, quality.reliability.accuracy
            )
        )  # fmt: skip
        share, told = cells / cells.sum(), cells > 0
        upper.plot([0, 1], [0, 1], color="0.5", lw=0.8, ls="--")
        upper.vlines(confidence[told], confidence[told], accuracy[told], color=_ORANGE, lw=2, alpha=0.45)
        often = share >= _RARE
        upper.plot(confidence[often], accuracy[often], color=_BLUE, lw=1)
        for many, fill in ((often, _BLUE), (told & ~often, "white")):
            # Unclipped points ask for room; none at all would ask for all of it.
            if many.any():
                points = confidence[many], accuracy[many]
                upper.plot(*points, "o", ms=3, mfc=fill, mec=_BLUE, mew=0.7, clip_on=False)
        upper.set(xlim=(0, 1), ylim=(0, 1), yticks=[0, 0.5, 1])
        upper.set_title(f"{split}: ECE {quality.ece:.3f}", size=TITLE)
        lower.bar(edges[:-1], share, 1 / CONFIDENCE_BINS, align="edge", color=_SKY, ec="white", lw=0.4)
        lower.set(ylim=(0, 1), yticks=[0, 1])
        lower.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        if column == 0:
            upper.set_ylabel("how often right", size=TEXT)
            lower.set_ylabel("cells", size=TEXT)
        for panel in (upper, lower):
            thin_ticks(panel)
    for place in range(len(qualities), rows * columns):
        row, column = divmod(place, columns)
        panels[2 * row, column].remove()
        panels[2 * row + 1, column].remove()
        panels[2 * row - 1, column].tick_params(labelbottom=True)
    figure.align_ylabels(panels[:, 0])
    figure.supxlabel("probability of the most likely class", size=TEXT)
    _legend(
        figure,
        [
            Line2D([], [], color="0.5", lw=0.8, ls="--", label="calibrated"),
            Line2D([], [], color=_BLUE, lw=1, marker="o", ms=3, label="observed"),
            Line2D(
                [],
                [],
                ls="",
                color=_BLUE,
                marker="o",
                ms=3,
                mfc="white",
                label="observed, under 0.1 % of cells",
            ),
            Line2D([], [], color=_ORANGE, lw=2, alpha=0.45, label="gap"),
        ],
    )
    return figure


def pit_figure(qualities: Mapping[str, TraversabilityQuality]) -> Figure:
    """Draws the histogram of the PIT of λ as it departs from 1, its height for a calibrated model.

    Each panel has a scale of its own, since one bad split would flatten all others. The band holds 90 % of
    the bins of as many independent, rightly predicted cells.

    Args:
        qualities: by split.
    """
    columns, rows = _grid(len(qualities), 3)
    figure = _figure(columns / 3, rows, 1.75, 0.45 if columns == 3 else 0.65)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True)
    edges = np.linspace(0, 1, PIT_BINS + 1)
    for panel, (split, quality) in zip(panels.flat, qualities.items(), strict=False):
        counts = np.array(quality.pit)
        level = counts.sum() / PIT_BINS
        low, high = (bound / level for bound in binom.interval(0.9, counts.sum(), 1 / PIT_BINS))
        panel.fill_between([0, 1], low, high, color=_BAND, lw=0)
        tail = round((1 - LEVEL) * PIT_BINS)
        for bins, colour in ((slice(0, tail), _ORANGE), (slice(tail, None), _SKY)):
            ends = np.append(edges[:-1][bins], edges[1:][bins][-1])
            panel.stairs(counts[bins] / level, ends, baseline=1, fill=True, color=colour, alpha=0.75, lw=0)
            panel.stairs(counts[bins] / level, ends, baseline=None, color=colour, lw=1)
        panel.axhline(1, color="black", lw=0.7)
        for bound in (0.05, 0.95):
            panel.axvline(bound, color="black", lw=0.7, ls=":")
        panel.text(
            0.5, 0.97,
            f"in 5–95 %: {quality.coverage:.3f} (ideally 0.9)\nunder VaR: {quality.tail_rate:.3f} (ideally 0.1)",
            size=TEXT, ha="center", va="top", transform=panel.transAxes, linespacing=1.3,
        )  # fmt: skip
        panel.set_title(split, size=TITLE)
        lowest, highest = min(0.95, *(counts / level)), max(1.05, *(counts / level))
        room = highest - lowest
        panel.set(xlim=(0, 1), ylim=(lowest - 0.1 * room, highest + 0.5 * room), xticks=[0, 0.5, 1])
        panel.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        thin_ticks(panel)
    _drop_rest(panels, len(qualities))
    figure.supxlabel("PIT of the realised λ", size=TEXT)
    figure.supylabel("density", size=TEXT)
    _legend(
        figure,
        [
            Patch(facecolor=_SKY, label="observed"),
            Patch(facecolor=_ORANGE, label="observed, under VaR at 0.9"),
            Line2D([], [], color="black", lw=0.7, label="calibrated"),
            Patch(facecolor=_BAND, label="90 % of a calibrated model's bins"),
            Line2D([], [], color="black", lw=0.7, ls=":", label="central 90 %"),
        ],
        most=5,
    )
    return figure


def severity_figure(
    all_series: Mapping[str, Sequence[tuple[float, str]]], qualities: Mapping[str, Quality]
) -> Figure:
    """Draws quality against the severity of a shift, a line a scenario.

    Args:
        all_series: by scenario, its pairs as (severity, split), ascending.
        qualities: of all these splits.
    """
    pairs = [split for series in all_series.values() for _, split in series]
    kinds = [_CLASS_SEVERITY] * all(bool(qualities[split].classes) for split in pairs) + [_LATENT_SEVERITY]
    ensemble = not any(np.isnan(_quantity(qualities[split], "mutual_information")) for split in pairs)

    def values(series: Sequence[tuple[float, str]], name: str) -> list[float]:
        return [_quantity(qualities[split], name) for _, split in series]

    figure = _figure(1, len(kinds), 1.65, 0.45)
    panels = figure.subplots(len(kinds), 4, squeeze=False, sharex=True)
    for panel, (title, name, ideal) in zip(panels.flat, [one for kind in kinds for one in kind], strict=True):
        for place, series in enumerate(all_series.values()):
            severities = [severity for severity, _ in series]
            style = {"color": _COLOURS[place % len(_COLOURS)], "marker": _MARKERS[place % len(_MARKERS)]}
            panel.plot(severities, values(series, name), ms=3, lw=1, **style)
            if name == "entropy_auroc" and ensemble:
                others = values(series, "mutual_information_auroc")
                panel.plot(severities, others, ms=3, lw=1, ls=":", mfc="white", **style)
        panel.set_title(title, size=TITLE)
        panel.margins(x=0.05, y=0.12)
        if ideal is not None:
            panel.axhline(ideal, color="0.4", lw=0.8, ls="--")
            low, high = panel.get_ylim()
            panel.set_ylim(min(low, ideal - _NEAR), max(high, ideal + _NEAR))
        panel.grid(alpha=0.3, lw=0.5)
        panel.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
        thin_ticks(panel)
    figure.supxlabel("severity of the shift", size=TEXT)
    lines = [
        Line2D(
            [],
            [],
            color=_COLOURS[i % len(_COLOURS)],
            marker=_MARKERS[i % len(_MARKERS)],
            ms=3,
            lw=1,
            label=name,
        )
        for i, name in enumerate(all_series)
    ]
    lines.append(Line2D([], [], color="0.4", lw=0.8, ls="--", label="calibrated"))
    if ensemble:
        lines.append(
            Line2D([], [], color="0.4", lw=1, ls=":", label="of mutual information; solid: of entropy")
        )
    _legend(figure, lines)
    return figure


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
    columns, rows = _grid(len(classes), 5)
    figure = _figure(columns / 5, rows, 1.55, 0.5 if columns == 5 else 1.0)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    slopes = table_slopes().numpy()
    shown = slopes <= max(10.0, 1.15 * max(_steeper_than(cells, 0) for cells in slope_cells))
    soft = _soft_modes(table)
    means, stds = (values.double().cpu().numpy() for values in (table.mean, table.std))
    noise = table.noise_std.double().cpu().numpy()
    x = slopes[shown]
    for number, (panel, one) in enumerate(zip(panels.flat, classes, strict=False)):
        mean, std = means[number, shown], stds[number, shown]
        latent = np.sqrt(np.maximum(std**2 - noise[number] ** 2, 0))
        panel.fill_between(x, mean - 2 * std, mean + 2 * std, color=_SKY, alpha=0.3, lw=0)
        panel.fill_between(x, mean - 2 * latent, mean + 2 * latent, color=_BLUE, alpha=0.45, lw=0)
        panel.plot(x, mean, color=_BLUE, lw=1.1)
        panel.plot(x, _with_soft(expected_traversability(mean, std), *soft[number]), color=_ORANGE, lw=1.1)
        if truth:
            true = latent_mean(np.full(len(x), number), x, tuple(classes))
            panel.plot(x, true, color="black", lw=0.9, ls="--")
            firm = expected_traversability(true, np.full_like(x, one.noise))
            true_soft = (one.soft.weight, one.soft.mean, one.soft.std) if one.soft else _NO_SOFT
            panel.plot(x, _with_soft(firm, *true_soft), color="black", lw=1, ls=":")
        if soft[number][0]:
            panel.axhline(soft[number][1], color=_BLUE, lw=0.9, ls="-.")
        for share, shade in ((_RARE, 0.12), (0.0, 0.25)):
            panel.axvspan(_steeper_than(slope_cells[number], share), 90, color="0.4", alpha=shade, lw=0)
        panel.set_title(one.name.replace("_", " "), size=TITLE, parse_math=False)
        true_noise = f" ({one.noise:.3f})" if truth else ""
        panel.text(0.05, 0.05, f"σ {noise[number]:.3f}{true_noise}", size=TEXT, transform=panel.transAxes)
        thin_ticks(panel)
    panels[0, 0].set(xlim=(0, x[-1]), ylim=(-0.45, 1.45), yticks=[0, 0.5, 1])
    _drop_rest(panels, len(classes))
    figure.supxlabel(f"slope [°]  (σ: noise{', in brackets the true one' if truth else ''})", size=TEXT)
    figure.supylabel("traversability", size=TEXT)
    handles: list[Line2D] = []
    if truth:
        handles.append(Line2D([], [], color="black", lw=0.9, ls="--", label="true latent function"))
        handles.append(Line2D([], [], color="black", lw=1, ls=":", label="true E[λ]"))
    if table.soft:
        handles.append(Line2D([], [], color=_BLUE, lw=0.9, ls="-.", label="mean of soft spots"))
    _legend(
        figure,
        [
            Line2D([], [], color=_BLUE, lw=1.1, label="GP mean"),
            Patch(facecolor=_BLUE, alpha=0.45, label="± 2σ of the latent function"),
            Patch(facecolor=_SKY, alpha=0.3, label="± 2σ with noise"),
            Line2D([], [], color=_ORANGE, lw=1.1, label="predicted E[λ]"),
            *handles,
            Patch(facecolor="0.4", alpha=0.12, label="steeper: 1 cell in 1000"),
            Patch(facecolor="0.4", alpha=0.35, label="steeper: no cell of the class"),
        ],
    )
    return figure


def _soft_modes(table: SlopeTable) -> list[tuple[float, float, float]]:
    """Weight, mean and standard deviation of each class's second mode as it was found."""
    if table.soft is None:
        return [_NO_SOFT] * len(table.mean)
    found = (values.double().tolist() for values in (table.soft.weight, table.soft.mean, table.soft.std))
    return list(zip(*found, strict=True))


def _with_soft(expected: np.ndarray, weight: float, mean: float, std: float) -> np.ndarray:
    """E[λ] of ground with soft spots, from that of its firm part."""
    soft = expected_traversability(np.array([mean]), np.array([std]))
    return (1 - weight) * expected + weight * soft


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure as PNG, whole or not at all; its folder is made."""
    with replacing(path, durable=False) as partial:
        save(figure, partial, "png", DPI)


def _steeper_than(cells: Sequence[int], share: float) -> float:
    """The whole degree of slope that at most `share` of the cells are steeper than."""
    steeper = np.cumsum(cells[::-1])[::-1]
    return float(np.sum(steeper > share * steeper[0]))


def _quantity(quality: Quality, name: str) -> float:
    sources = [*quality.classes, quality.traversability]
    return next((float(getattr(source, name)) for source in sources if hasattr(source, name)), float("nan"))


def _grid(count: int, most: int) -> tuple[int, int]:
    """Columns and rows of `count` panels."""
    columns = min(count, most)
    return columns, -(-count // columns)


def _figure(share: float, rows: int, high: float, rest: float) -> Figure:
    """A figure of this share of the full width, but wide enough for its legend."""
    return Figure(
        figsize=(max(PAGE_WIDTH_IN * share, _LEAST_WIDTH), rows * high + rest), layout="constrained"
    )


def _drop_rest(panels: np.ndarray, count: int) -> None:
    """Takes away panels that nothing stands in; those above them get their tick labels."""
    columns = panels.shape[1]
    for place in range(count, panels.size):
        panels.flat[place].remove()
        panels.flat[place - columns].tick_params(labelbottom=True)


def _legend(figure: Figure, handles: Sequence[Any], most: int = 4) -> None:
    """Lays a legend over the panels, in at most so many columns where the figure is of full width."""
    columns = min(len(handles), most if figure.get_figwidth() == PAGE_WIDTH_IN else 2)
    figure.legend(
        handles=handles, loc="outside upper center", ncols=columns, fontsize=TEXT, frameon=False,
        handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip
