"""Figures of predicted traversability: PIT histograms and latent functions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from scipy.stats import binom

from benchnav.datagen.recipe.latent import expected_of
from benchnav.datagen.recipe.latent import truth as true_distribution
from benchnav.models.quality.figure_data import QualityData
from benchnav.models.quality.measure import TraversabilityQuality
from benchnav.models.quality.scores import LEVEL, PIT_BINS
from benchnav.models.slope_gp.table import table_slopes
from benchnav.viz.figure import Figure
from benchnav.viz.panels import panel_grid, ticks_of
from benchnav.viz.style import BLUE, ORANGE, SKY, TEXT, legend_outside, page_width

_BAND_COLOUR = "0.82"
_RARE_FRACTION = 1e-3  # of the cells of a class


def _slope_quantile(cells: Sequence[int], fraction: float) -> float:
    """Return the smallest slope such that at most a fraction of the cells is steeper.

    The slope is in whole degrees.

    Args:
        cells: number of cells by slope, in bins of 1° from 0°.
        fraction: maximum fraction of steeper cells, in [0, 1).
    """
    n_steeper = np.cumsum(cells[::-1])[::-1]
    threshold = fraction * n_steeper[0]
    return float(np.sum(n_steeper > threshold))


class PIT(Figure):
    """Histograms of the probability integral transform of λ."""

    name = "pit"
    title = "Calibration of the predicted distribution of λ"
    text = (
        "The probability integral transform (PIT) is the predicted CDF at observed λ, "
        "from 0 (lower end) to 1 (upper end). The histogram of a calibrated model is "
        "flat at 1. If it is high at both ends, the model is overconfident; if high in "
        "the middle, underconfident. If it is high at the left (orange), low λ is more "
        "frequent than predicted. Each panel has its own scale."
    )

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel per split."""
        n_panels = len(data.qualities)
        margin = 0.45 if n_panels > 2 else 0.65
        width = page_width(n_panels, 3)
        figure, panels = panel_grid(
            list(data.qualities), 3, 1.75, margin, width, sharex=True
        )
        for (panel,), quality in zip(panels, data.qualities.values(), strict=True):
            self._draw_histogram(panel, quality.traversability)
        figure.supxlabel("PIT of observed λ")
        figure.supylabel("density")
        legend_outside(figure, columns=5, side="upper center")
        return figure

    def _draw_histogram(self, panel: Axes, quality: TraversabilityQuality) -> None:
        counts = np.array(quality.pit)
        mean_count = counts.sum() / PIT_BINS
        density = counts / mean_count
        tail = round((1 - LEVEL) * PIT_BINS)
        self._draw_bins(
            panel, density, 0, tail, ORANGE, "observed λ below the VaR (0.9)"
        )
        self._draw_bins(panel, density, tail, PIT_BINS, SKY, "observed")
        panel.axhline(1, color="black", lw=0.7, label="calibrated")
        interval = np.array(binom.interval(0.9, counts.sum(), 1 / PIT_BINS))
        low, high = interval / mean_count
        label = "90 % range of a calibrated model's bins"
        panel.fill_between(
            [0, 1], low, high, color=_BAND_COLOUR, lw=0, zorder=0.5, label=label
        )
        for bound in (0.05, 0.95):
            panel.axvline(bound, color="black", lw=0.7, ls=":", label="central 90 %")
        note = (
            f"in 5–95 %: {quality.coverage:.3f} (ideally 0.9)\nbelow VaR: "
            f"{quality.tail_rate:.3f} (ideally 0.1)"
        )
        aligned: dict[str, Any] = {"ha": "center", "va": "top", "linespacing": 1.3}
        panel.text(0.5, 0.97, note, size=TEXT, transform=panel.transAxes, **aligned)
        bottom = min(0.95, *density)
        top = max(1.05, *density)
        span = top - bottom
        ylim = (bottom - 0.1 * span, top + 0.5 * span)
        panel.set(xlim=(0, 1), ylim=ylim, xticks=[0, 0.5, 1])
        ticks_of(panel, "y", 5)

    def _draw_bins(
        self,
        panel: Axes,
        density: np.ndarray,
        start: int,
        stop: int,
        colour: str,
        label: str,
    ) -> None:
        edges = np.linspace(0, 1, PIT_BINS + 1)[start : stop + 1]
        heights = density[start:stop]
        filled: dict[str, Any] = {"fill": True, "alpha": 0.75, "lw": 0, "label": label}
        panel.stairs(heights, edges, baseline=1, color=colour, **filled)
        panel.stairs(heights, edges, baseline=None, color=colour, lw=1)


class Latent(Figure):
    """The Gaussian process over slope of each class."""

    name = "latent"
    title = "Latent functions of the Gaussian processes"
    text = (
        "Predicted traversability over slope for each class, with the truth in black "
        "if it is available. Few measured cells reach slopes in the light grey area; "
        "none reaches slopes in the dark grey area."
    )

    def is_available(self, data: QualityData) -> bool:
        """Return whether the model has GPs and there are results by class."""
        return data.table is not None and bool(data.by_class)

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel per class."""
        assert data.table is not None
        slope_cells = [quality.slope_cells for quality in data.by_class.values()]
        cells = np.sum(slope_cells, 0)
        truths = {data.dataset.truth_of(split) for split in data.qualities}
        has_truth = truths <= {"generated"}
        classes = data.dataset.recipe.classes
        titles = [item.name.replace("_", " ") for item in classes]
        margin = 0.5 if len(titles) > 4 else 1.0
        width = page_width(len(titles), 5)
        figure, panels = panel_grid(
            titles, 5, 1.55, margin, width, sharex=True, sharey=True
        )
        steepest = max(_slope_quantile(class_cells, 0) for class_cells in cells)
        x = table_slopes().numpy()
        x_max = max(10.0, 1.15 * steepest)
        x = x[x <= x_max]
        class_ids = np.arange(len(classes))[:, None, None]
        class_id, slopes = np.broadcast_arrays(class_ids, x)
        mixture = data.table.predict_by_class(
            torch.tensor(class_id), torch.tensor(slopes)
        )
        predicted = (
            mixture.weights.numpy(),
            mixture.means.numpy(),
            mixture.stds.numpy(),
        )
        true = true_distribution(class_id, slopes, tuple(classes))
        _, true_means, _ = true
        expected = expected_of(predicted)
        true_expected = expected_of(true)
        noise = data.table.noise_std.double().cpu().numpy()
        for index, (panel,) in enumerate(panels):
            weight, mean, std = (values[index, :, 0] for values in predicted)
            latent_variance = std[0] ** 2 - noise[index] ** 2
            latent_std = np.sqrt(np.maximum(latent_variance, 0))
            self._draw_prediction(panel, x, mean[0], expected[index, 0])
            self._draw_band(panel, x, mean[0], std[0], "± 2σ with noise")
            self._draw_band(
                panel, x, mean[0], latent_std, "± 2σ of the latent function", BLUE, 0.45
            )
            note = f"σ {noise[index]:.3f}"
            if has_truth:
                true_mean = true_means[index, 0, 0]
                self._draw_truth(panel, x, true_mean, true_expected[index, 0])
                note += f" ({classes[index].noise:.3f})"
            if weight[0, 0] < 1:
                label = "mean of soft spots"
                panel.axhline(mean[1, 0], color=BLUE, lw=0.9, ls="-.", label=label)
            self._shade_steep(panel, cells[index])
            panel.text(0.05, 0.05, note, size=TEXT, transform=panel.transAxes)
            panel.set(xlim=(0, x[-1]), ylim=(-0.45, 1.45), yticks=[0, 0.5, 1])
        true_noise = ", in brackets the true noise" if has_truth else ""
        figure.supxlabel(f"slope [°]  (σ: noise{true_noise})")
        figure.supylabel("traversability")
        legend_outside(figure, side="upper center")
        return figure

    def _draw_prediction(
        self, panel: Axes, x: np.ndarray, mean: np.ndarray, expected: np.ndarray
    ) -> None:
        panel.plot(x, mean, color=BLUE, lw=1.1, label="GP mean")
        panel.plot(x, expected, color=ORANGE, lw=1.1, label="predicted E[λ]")

    def _draw_band(
        self,
        panel: Axes,
        x: np.ndarray,
        mean: np.ndarray,
        std: np.ndarray,
        label: str,
        colour: str = SKY,
        alpha: float = 0.3,
    ) -> None:
        low = mean - 2 * std
        high = mean + 2 * std
        panel.fill_between(x, low, high, color=colour, alpha=alpha, lw=0, label=label)

    def _draw_truth(
        self, panel: Axes, x: np.ndarray, mean: np.ndarray, expected: np.ndarray
    ) -> None:
        panel.plot(x, mean, "k--", lw=0.9, label="true latent function")
        panel.plot(x, expected, "k:", lw=1, label="true E[λ]")

    def _shade_steep(self, panel: Axes, cells: Sequence[int]) -> None:
        """Shade slopes that few cells exceed; shade slopes that none exceeds darker."""
        shades = (
            (_RARE_FRACTION, 0.12, "only 1 cell in 1000 is steeper"),
            (0.0, 0.25, "no cell of the class is steeper"),
        )
        for fraction, alpha, label in shades:
            start = _slope_quantile(cells, fraction)
            panel.axvspan(start, 90, color="0.4", alpha=alpha, lw=0, label=label)
