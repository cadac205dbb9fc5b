"""Figures of the quality of class probabilities: confusion and reliability."""

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.image import AxesImage
from matplotlib.ticker import PercentFormatter

from benchnav.models.quality.figure_data import QualityData
from benchnav.models.quality.scores import CONFIDENCE_BINS
from benchnav.viz.figure import Figure
from benchnav.viz.maps import frame_map
from benchnav.viz.panels import panel_grid
from benchnav.viz.style import BLUE, ORANGE, SKY, legend_outside, page_width

_NUMBER_SIZE = 5.5  # font size in points
_MAX_NUMBERED = 16  # maximum number of classes for which numbers fit the matrix
_MIN_FRACTION = 1e-3  # minimum fraction of the cells for which a bin has a marker


class Confusion(Figure):
    """Confusion matrix of the classes."""

    name = "confusion"
    title = "Confusion of classes"
    text = (
        "Rows are true classes, columns are most likely classes, numbers are percentages "
        "of the row. A perfect model has 100 along the diagonal; no model can "
        "distinguish look-alike classes. Grey rows are classes that do not occur in the "
        "split."
    )

    def is_available(self, data: QualityData) -> bool:
        """Return whether the model predicts classes."""
        return bool(data.by_class)

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel per split."""
        n_panels = len(data.by_class)
        n_columns = 3 if n_panels > 2 else 2
        height = 2.2 if n_columns == 3 else 3.1
        # Panels that have no panel below need space for their column labels.
        is_ragged = n_panels > n_columns and n_panels % n_columns
        margin = 1.25 if is_ragged else 0.7
        titles = [
            f"{split}: accuracy {quality.accuracy:.3f}"
            for split, quality in data.by_class.items()
        ]
        width = page_width(n_panels, n_columns)
        figure, axes = panel_grid(
            titles, n_columns, height, margin, width, sharex=True, sharey=True
        )
        panels = [panel for (panel,) in axes]
        classes = data.dataset.recipe.classes
        labels = [item.name.replace("_", " ") for item in classes]
        for panel, quality in zip(panels, data.by_class.values(), strict=True):
            image = self._draw_matrix(panel, np.array(quality.confusion))
            panel.set_xticks(range(len(labels)), labels, rotation=90, parse_math=False)
            panel.set_yticks(range(len(labels)), labels, parse_math=False)
            frame_map(panel)
        figure.supxlabel("most likely class")
        figure.supylabel("true class")
        # The upper right panel contains a square that does not fill the panel. The
        # colour bar is as high as this square.
        right_panel = panels[min(n_panels, n_columns) - 1]
        colour_bar = right_panel.inset_axes((1.04, 0, 0.05, 1))
        figure.colorbar(image, cax=colour_bar, label="fraction of the true class [%]")
        return figure

    def _draw_matrix(self, panel: Axes, confusion: np.ndarray) -> AxesImage:
        """Draw a confusion matrix in per cent of its rows, with numbers if they fit."""
        counts = confusion.astype(np.float64)
        with np.errstate(invalid="ignore"):
            totals = counts.sum(1, keepdims=True)
            percentages = 100 * counts / totals
        palette = matplotlib.colormaps["Blues"].with_extremes(bad="0.85")
        image = panel.imshow(percentages, cmap=palette, vmin=0, vmax=100)
        if len(counts) > _MAX_NUMBERED:
            return image
        for row, column in np.argwhere(percentages >= 0.5):
            value = percentages[row, column]
            is_dark = value > 55
            panel.text(
                column,
                row,
                f"{value:.0f}",
                size=_NUMBER_SIZE,
                color="white" if is_dark else "black",
                ha="center",
                va="center",
            )
        return image


class Reliability(Figure):
    """Accuracy over the probability of the most likely class."""

    name = "reliability"
    title = "Calibration of the class probabilities"
    text = (
        "Upper panel: accuracy of the most likely class over its probability. A "
        "calibrated model is on the dashed line, an overconfident model below it. ECE is "
        "the mean gap. Lower panel: fraction of cells with that probability."
    )
    is_available = Confusion.is_available

    def draw(self, data: QualityData) -> Drawing:
        """Draw two panels per split."""
        titles = [
            f"{split}: ECE {quality.ece:.3f}"
            for split, quality in data.by_class.items()
        ]
        n_rows = -(-len(titles) // 3)
        width = page_width(len(titles), 3)
        figure, pairs = panel_grid(
            titles, 3, 2.6, 0.35, width, 2, sharex=True, height_ratios=[3, 1] * n_rows
        )
        edges = np.linspace(0, 1, CONFIDENCE_BINS + 1)
        bars: dict[str, Any] = {"align": "edge", "color": SKY, "ec": "white", "lw": 0.4}
        points: dict[str, Any] = {"color": BLUE, "ms": 3, "lw": 1, "clip_on": False}
        for (upper, lower), quality in zip(pairs, data.by_class.values(), strict=True):
            cells, confidence, accuracy = map(np.array, quality.reliability.values())
            fraction = cells / cells.sum()
            is_marked = fraction >= _MIN_FRACTION
            is_filled = cells > 0
            upper.plot([0, 1], [0, 1], color="0.5", lw=0.8, ls="--", label="calibrated")
            upper.plot(
                confidence[is_marked],
                accuracy[is_marked],
                "o-",
                **points,
                label="observed",
            )
            x = confidence[is_filled]
            gap = (x, x, accuracy[is_filled])
            upper.vlines(*gap, color=ORANGE, lw=2, alpha=0.45, zorder=1.5, label="gap")
            upper.set(xlim=(0, 1), ylim=(0, 1), yticks=[0, 0.5, 1])
            lower.bar(edges[:-1], fraction, 1 / CONFIDENCE_BINS, **bars)
            lower.set(ylim=(0, 1), yticks=[0, 1])
            lower.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        for upper, lower in pairs[::3]:
            upper.set_ylabel("accuracy")
            lower.set_ylabel("cells")
        figure.align_ylabels()
        figure.supxlabel("probability of the most likely class")
        legend_outside(figure, side="upper center")
        return figure
