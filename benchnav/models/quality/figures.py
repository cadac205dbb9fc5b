"""Figures of a model's quality: where it errs, and whether its probabilities can be
trusted.

They are as wide as the two columns of a page, or narrower where panels are few. Lines
differ in marker or dash beside their colour. A figure has a panel a split, in the order
given. Letters in shapes: C classes, G nodes.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import matplotlib
import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import PercentFormatter
from scipy.stats import binom

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.latent import expected_of
from benchnav.datagen.recipe.latent import truth as true_distribution
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.base import TraversabilityModel
from benchnav.models.quality.map_sheet import (
    MapSheet,
    map_sheet_figure,
    read_sheet,
    shared_scales,
)
from benchnav.models.quality.measure import ClassQuality, Quality
from benchnav.models.quality.report import numbers
from benchnav.models.quality.scores import CONFIDENCE_BINS, LEVEL, PIT_BINS
from benchnav.models.slope_gp.table import SlopeTable, table_slopes
from benchnav.viz.figure import Figure, applicable
from benchnav.viz.maps import frame_map
from benchnav.viz.panels import Curves, draw_baseline, line_looks, panel_grid, ticks_of
from benchnav.viz.style import BLUE, ORANGE, SKY, TEXT, legend_outside, page_width

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


def _steeper_than(cells: Sequence[int], share: float) -> float:
    """The whole degree of slope that at most `share` of the cells are steeper than."""
    steeper = np.cumsum(cells[::-1])[::-1]
    return float(np.sum(steeper > share * steeper[0]))


@dataclass(frozen=True, kw_only=True)
class QualityData:
    """What figures of a model's quality are drawn from.

    Args:
        title: what the map sheets say of model and dataset.
        model: what was measured.
        dataset: on what.
        qualities: by split.
        maps: how many maps of each split the map sheets show.
    """

    title: str
    model: TraversabilityModel
    dataset: TerrainDataset
    qualities: Mapping[str, Quality]
    maps: int = 0

    @property
    def by_class(self) -> dict[str, ClassQuality]:
        """The quality of the classes, of the splits that have it."""
        return {
            split: item
            for split, quality in self.qualities.items()
            for item in quality.classes
        }

    @property
    def table(self) -> SlopeTable | None:
        """The model's Gaussian processes over slope; None where it has none."""
        table = getattr(self.model, "table", None)
        return table if isinstance(table, SlopeTable) else None

    @cached_property
    def sheets(self) -> dict[str, MapSheet]:
        """Maps of each split with what was predicted."""
        if not self.maps:
            return {}
        counts = {
            split: min(self.maps, self.dataset.map_count(split))
            for split in self.qualities
        }
        return {
            split: read_sheet(self.model, self.dataset, split, range(n))
            for split, n in counts.items()
        }

    @property
    def absent(self) -> list[str]:
        """A line for each figure that is not drawn, with why."""
        lines = []
        if len(self.by_class) < len(self.qualities):
            lines.append(
                "no confusion matrix, reliability diagram or entropy: the model "
                "predicts no classes"
            )
        if self.table is None:
            lines.append(
                "no latent functions: the model has no Gaussian processes over slope"
            )
        if not find_series(self.qualities):
            lines.append(
                "no series of shifts: no splits such as test/hg-050 and test/hg-100 "
                "were measured"
            )
        return lines


def series_table(splits: Iterable[str]) -> pd.DataFrame:
    """Tabulate the series of shifts among splits, a row a `split` with its `scenario`
    and `severity`.
    """
    rows = [
        (scenario, *pair)
        for scenario, pairs in find_series(splits).items()
        for pair in pairs
    ]
    return pd.DataFrame(rows, columns=["scenario", "severity", "split"])


class Confusion(Figure):
    """Which classes are taken for which."""

    name, title = "confusion", "Confusion of classes"
    text = (
        "Rows are true classes, columns the most likely ones, numbers fractions of "
        "the row in per cent. A perfect "
        "model has 100 along the diagonal; no model can tell look-alike classes "
        "apart. Grey rows are classes that no "
        "map of the split shows."
    )

    def needs(self, data: QualityData) -> bool:
        """Return whether the model predicts classes."""
        return bool(data.by_class)

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel a split."""
        names = [item.name for item in data.dataset.recipe.classes]
        most = 3 if len(data.by_class) > 2 else 2
        shown = [
            (f"{split}: accuracy {quality.accuracy:.3f}", quality)
            for split, quality in data.by_class.items()
        ]
        # panels that end above hold the names of columns too
        ragged = len(shown) > most and len(shown) % most
        high = 2.2 if most == 3 else 3.1
        titles, rest = [title for title, _ in shown], 1.25 if ragged else 0.7
        figure, panels = panel_grid(
            titles,
            most,
            high,
            rest,
            page_width(len(shown), most),
            sharex=True,
            sharey=True,
        )
        labels = [name.replace("_", " ") for name in names]
        palette = matplotlib.colormaps["Blues"].with_extremes(bad="0.85")
        for (panel,), (_, quality) in zip(panels, shown, strict=True):
            counts = np.array(quality.confusion, dtype=np.float64)
            with np.errstate(invalid="ignore"):
                shares = 100 * counts / counts.sum(1, keepdims=True)
            image = panel.imshow(shares, cmap=palette, vmin=0, vmax=100)
            for row, column in (
                np.argwhere(shares >= 0.5) if len(names) <= _MOST_NUMBERED else ()
            ):
                share = shares[row, column]
                colour = "white" if share > 55 else "black"
                panel.text(
                    column,
                    row,
                    f"{share:.0f}",
                    size=_SMALL,
                    color=colour,
                    ha="center",
                    va="center",
                )
            panel.set_xticks(range(len(names)), labels, rotation=90, parse_math=False)
            panel.set_yticks(range(len(names)), labels, parse_math=False)
            frame_map(panel)
        figure.supxlabel("most likely class")
        figure.supylabel("true class")
        # Beside the upper right panel, and as high as its square, which is less than
        # the room that it is given.
        beside = panels[min(len(panels), most) - 1][0].inset_axes((1.04, 0, 0.05, 1))
        figure.colorbar(image, cax=beside, label="fraction of the true class [%]")
        return figure


class Reliability(Figure):
    """Accuracy over the probability of the most likely class."""

    name, title = "reliability", "Calibration of the class probabilities"
    text = (
        "Above: accuracy of the most likely class over its probability. Calibrated is "
        "on the dashed line; below it the "
        "model is overconfident. ECE is the mean gap. Below: number of cells with "
        "that probability."
    )
    needs = Confusion.needs

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel a split."""
        titles = [
            f"{split}: ECE {quality.ece:.3f}"
            for split, quality in data.by_class.items()
        ]
        heights, width = [3, 1] * -(-len(titles) // 3), page_width(len(titles), 3)
        figure, pairs = panel_grid(
            titles, 3, 2.6, 0.35, width, 2, sharex=True, height_ratios=heights
        )
        edges = np.linspace(0, 1, CONFIDENCE_BINS + 1)
        for (upper, lower), quality in zip(pairs, data.by_class.values(), strict=True):
            cells, confidence, accuracy = map(np.array, quality.reliability.values())
            share, filled = cells / cells.sum(), cells > 0
            often = share >= _RARE
            upper.plot([0, 1], [0, 1], color="0.5", lw=0.8, ls="--", label="calibrated")
            points: dict[str, Any] = {"color": BLUE, "ms": 3, "lw": 1, "clip_on": False}
            upper.plot(
                confidence[often], accuracy[often], "o-", **points, label="observed"
            )
            gap = (confidence[filled], confidence[filled], accuracy[filled])
            upper.vlines(*gap, color=ORANGE, lw=2, alpha=0.45, zorder=1.5, label="gap")
            upper.set(xlim=(0, 1), ylim=(0, 1), yticks=[0, 0.5, 1])
            lower.bar(
                edges[:-1],
                share,
                1 / CONFIDENCE_BINS,
                align="edge",
                color=SKY,
                ec="white",
                lw=0.4,
            )
            lower.set(ylim=(0, 1), yticks=[0, 1])
            lower.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        for upper, lower in pairs[::3]:
            upper.set_ylabel("accuracy")
            lower.set_ylabel("cells")
        figure.align_ylabels()
        figure.supxlabel("probability of the most likely class")
        legend_outside(figure, side="upper center")
        return figure


class PIT(Figure):
    """Histograms of the probability integral transform of λ."""

    name, title = "pit", "Calibration of the predicted distribution of λ"
    text = (
        "The probability integral transform (PIT) is the place of observed λ in its "
        "prediction, from 0 (low end) to 1 "
        "(high end). Calibrated is flat at 1. High at both ends is overconfident, "
        "high in the middle underconfident. "
        "High at the left (orange): low λ is more frequent than predicted. Panels "
        "have scales of their own."
    )

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel a split."""
        qualities = {
            split: quality.traversability for split, quality in data.qualities.items()
        }
        rest, width = (
            0.45 if len(qualities) > 2 else 0.65,
            page_width(len(qualities), 3),
        )
        figure, panels = panel_grid(list(qualities), 3, 1.75, rest, width, sharex=True)
        edges = np.linspace(0, 1, PIT_BINS + 1)
        tail = round((1 - LEVEL) * PIT_BINS)
        for (panel,), quality in zip(panels, qualities.values(), strict=True):
            counts = np.array(quality.pit)
            level = counts.sum() / PIT_BINS
            density = counts / level
            low, high = (
                np.array(binom.interval(0.9, counts.sum(), 1 / PIT_BINS)) / level
            )
            for first, last, colour, label in (
                (0, tail, ORANGE, "observed, under VaR at 0.9"),
                (tail, PIT_BINS, SKY, "observed"),
            ):
                heights, ends = density[first:last], edges[first : last + 1]
                panel.stairs(
                    heights,
                    ends,
                    baseline=1,
                    fill=True,
                    color=colour,
                    alpha=0.75,
                    lw=0,
                    label=label,
                )
                panel.stairs(heights, ends, baseline=None, color=colour, lw=1)
            panel.axhline(1, color="black", lw=0.7, label="calibrated")
            words = "90 % of a calibrated model's bins"
            panel.fill_between(
                [0, 1], low, high, color=_BAND, lw=0, zorder=0.5, label=words
            )
            for bound in (0.05, 0.95):
                panel.axvline(
                    bound, color="black", lw=0.7, ls=":", label="central 90 %"
                )
            panel.text(
                0.5,
                0.97,
                f"in 5–95 %: {quality.coverage:.3f} (ideally 0.9)\nunder VaR: "
                f"{quality.tail_rate:.3f} (ideally 0.1)",
                size=TEXT,
                ha="center",
                va="top",
                transform=panel.transAxes,
                linespacing=1.3,
            )
            lowest, highest = min(0.95, *density), max(1.05, *density)
            room = highest - lowest
            panel.set(
                xlim=(0, 1),
                ylim=(lowest - 0.1 * room, highest + 0.5 * room),
                xticks=[0, 0.5, 1],
            )
            ticks_of(panel, "y", 5)
        figure.supxlabel("PIT of observed λ")
        figure.supylabel("density")
        legend_outside(figure, columns=5, side="upper center")
        return figure


class Severity(Figure):
    """Quality over the severity of a shift."""

    name, title = "severity", "Quality over the severity of a shift"
    text = (
        "Measures of the table over the severity of each scenario: 0 is the "
        "training maps, 1 the scenario itself."
    )

    def needs(self, data: QualityData) -> bool:
        """Return whether a series of shifts was measured."""
        return bool(find_series(data.qualities))

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel a measure."""
        values = pd.DataFrame(
            {"split": split, **numbers(own)} for split, own in data.qualities.items()
        )
        table = series_table(data.qualities).merge(values, on="split")
        measured = table.dropna(axis=1)
        quantities = _SEVERITY if "accuracy" in measured else _SEVERITY[_OF_CLASSES:]
        table = table.assign(panel="").rename(
            columns={"severity": "x", "scenario": "line"}
        )
        looks = line_looks(table["line"].tolist())
        measures = {name: title for title, name in quantities}
        curves = Curves(
            table=table,
            measures=measures,
            looks=looks,
            x_label="severity of the shift",
            width_in=page_width(len(quantities), 4),
        )
        figure, panels = curves.draw()
        for (_, name), panel in panels.items():
            if name == "entropy_auroc" and "mutual_information" in measured:
                for scenario, own in table.groupby("line", sort=False):
                    look = {**looks[str(scenario)], "ls": ":", "mfc": "white"}
                    words = "of mutual information; solid: of entropy"
                    panel.plot(
                        own["x"], own["mutual_information_auroc"], label=words, **look
                    )
            panel.margins(x=0.05, y=0.12)
            if ideal := _IDEALS.get(name):
                draw_baseline(panel, ideal, "calibrated")
                low, high = panel.get_ylim()
                panel.set_ylim(min(low, ideal - _NEAR), max(high, ideal + _NEAR))
            ticks_of(panel, "y")
        legend_outside(figure, side="upper center")
        return figure


class Latent(Figure):
    """The Gaussian process over slope of each class."""

    name, title = "latent", "What the Gaussian processes have learned"
    text = (
        "Predicted traversability over slope for each class, with the truth in black "
        "where it is known. Few or no "
        "measured cells are as steep as the grey part."
    )

    def needs(self, data: QualityData) -> bool:
        """Return whether the model has such processes, and classes were measured."""
        return data.table is not None and bool(data.by_class)

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel a class."""
        assert data.table is not None
        cells = np.sum([quality.slope_cells for quality in data.by_class.values()], 0)
        known = all(
            data.dataset.truth_of(split) == "generated" for split in data.qualities
        )
        classes = data.dataset.recipe.classes
        titles = [item.name.replace("_", " ") for item in classes]
        rest, width = 0.5 if len(titles) > 4 else 1.0, page_width(len(titles), 5)
        figure, panels = panel_grid(
            titles, 5, 1.55, rest, width, sharex=True, sharey=True
        )
        x = table_slopes().numpy()
        x = x[x <= max(10.0, 1.15 * max(_steeper_than(cells, 0) for cells in cells))]
        class_id, slopes = np.broadcast_arrays(
            np.arange(len(classes))[:, None, None], x
        )
        mixture = data.table.own(torch.tensor(class_id), torch.tensor(slopes))
        weights, means, stds = (
            v.numpy() for v in (mixture.weights, mixture.means, mixture.stds)
        )
        true = true_distribution(class_id, slopes, tuple(classes))
        expected, true_expected = expected_of((weights, means, stds)), expected_of(true)
        noise = data.table.noise_std.double().cpu().numpy()
        for number, ((panel,), item) in enumerate(zip(panels, classes, strict=True)):
            mean, std = means[number, 0, 0], stds[number, 0, 0]
            latent = np.sqrt(np.maximum(std**2 - noise[number] ** 2, 0))
            panel.plot(x, mean, color=BLUE, lw=1.1, label="GP mean")
            panel.plot(
                x, expected[number, 0], color=ORANGE, lw=1.1, label="predicted E[λ]"
            )
            for spread, colour, alpha, label in (
                (std, SKY, 0.3, "± 2σ with noise"),
                (latent, BLUE, 0.45, "± 2σ of the latent function"),
            ):
                low, high = mean - 2 * spread, mean + 2 * spread
                panel.fill_between(
                    x, low, high, color=colour, alpha=alpha, lw=0, label=label
                )
            words = f"σ {noise[number]:.3f}"
            if known:
                panel.plot(
                    x,
                    true[1][number, 0, 0],
                    color="black",
                    lw=0.9,
                    ls="--",
                    label="true latent function",
                )
                panel.plot(
                    x,
                    true_expected[number, 0],
                    color="black",
                    lw=1,
                    ls=":",
                    label="true E[λ]",
                )
                words += f" ({item.noise:.3f})"
            if weights[number, 0, 0, 0] < 1:
                panel.axhline(
                    means[number, 1, 0, 0],
                    color=BLUE,
                    lw=0.9,
                    ls="-.",
                    label="mean of soft spots",
                )
            for share, shade, label in (
                (_RARE, 0.12, "steeper: 1 cell in 1000"),
                (0.0, 0.25, "steeper: no cell of the class"),
            ):
                steeper = _steeper_than(cells[number], share)
                panel.axvspan(steeper, 90, color="0.4", alpha=shade, lw=0, label=label)
            panel.text(0.05, 0.05, words, size=TEXT, transform=panel.transAxes)
            panel.set(xlim=(0, x[-1]), ylim=(-0.45, 1.45), yticks=[0, 0.5, 1])
        figure.supxlabel(
            f"slope [°]  (σ: noise{', in brackets the true one' if known else ''})"
        )
        figure.supylabel("traversability")
        legend_outside(figure, side="upper center")
        return figure


class MapSheets(Figure):
    """Maps of a split: observation, truth, prediction, error and uncertainty.

    Attributes:
        split: whose.
    """

    name, split = "maps", ""
    text = (
        "Each row is a map: observation, truth, prediction, error and uncertainty. "
        "Observed λ stands for the truth "
        "where the true distribution is unknown. A quantity has one scale in all "
        "sheets of an evaluation."
    )

    def variants(self, data: QualityData) -> Sequence[Self]:
        """Return a sheet a split."""
        return [
            self.variant(
                split=split,
                name=f"maps-{split.replace('/', '-')}",
                title=f"Maps of {split}",
            )
            for split in data.sheets
        ]

    def draw(self, data: QualityData) -> Drawing:
        """Draw a row a map."""
        classes = data.dataset.recipe.classes
        scales = shared_scales(list(data.sheets.values()), classes)
        return map_sheet_figure(data.sheets[self.split], scales, classes, data.title)


def quality_figures(data: QualityData) -> list[Figure]:
    """List the figures of a model's quality that apply."""
    return applicable(
        (Confusion(), Reliability(), PIT(), Severity(), Latent(), MapSheets()), data
    )
