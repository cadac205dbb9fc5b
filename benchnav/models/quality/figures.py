"""Figures of a model's quality: errors, and calibration of probabilities.

A figure is as wide as two columns of a page, or less if it has few panels. Lines differ
in marker or dash as well as in colour. A figure has a panel per split, in the order of
the evaluation.
"""

from collections.abc import Sequence
from typing import Self

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.figure_data import QualityData, series_table
from benchnav.models.quality.figures_of_classes import Confusion, Reliability
from benchnav.models.quality.figures_of_traversability import PIT, Latent
from benchnav.models.quality.map_sheet import (
    map_sheet_figure,
    shared_scales,
)
from benchnav.models.quality.report import numbers
from benchnav.viz.figure import Figure, applicable
from benchnav.viz.panels import Curves, Looks, draw_baseline, line_looks, ticks_of
from benchnav.viz.style import legend_outside, page_width

# Minimum range of an axis on each side of the ideal value, so that small differences
# look small.
_MARGIN = 0.01

# Title and field of each measure of ClassQuality or TraversabilityQuality.
_SEVERITY: tuple[tuple[str, str], ...] = (
    ("Accuracy", "accuracy"),
    ("Calibration error (ECE)", "ece"),
    ("Mean entropy [nats]", "entropy"),
    ("AUROC of uncertainty", "entropy_auroc"),
    ("RMSE of E[λ]", "rmse_expected"),
    ("CRPS of λ", "crps"),
    ("In the 90 % interval", "coverage"),
    ("Under VaR at 0.9", "tail_rate"),
)
_IDEALS = {"coverage": 0.9, "tail_rate": 0.1}  # ideal values within a range
_N_CLASS_MEASURES = 4  # number of measures of ClassQuality, which come first


class Severity(Figure):
    """Quality over the severity of a shift."""

    name = "severity"
    title = "Quality over the severity of a shift"
    text = (
        "Measures of the table over the severity of each scenario: 0 is the training "
        "maps, 1 the scenario itself."
    )

    def is_available(self, data: QualityData) -> bool:
        """Return whether a series of shifts was measured."""
        return bool(find_series(data.qualities))

    def draw(self, data: QualityData) -> Drawing:
        """Draw a panel per measure."""
        rows = [
            {"split": split, **numbers(quality)}
            for split, quality in data.qualities.items()
        ]
        table = series_table(data.qualities).merge(pd.DataFrame(rows), on="split")
        measured = table.dropna(axis=1)
        quantities = _SEVERITY
        if "accuracy" not in measured:
            quantities = _SEVERITY[_N_CLASS_MEASURES:]
        table = table.assign(panel="")
        table = table.rename(columns={"severity": "x", "scenario": "line"})
        looks = line_looks(table["line"].tolist())
        curves = Curves(
            table=table,
            measures={name: title for title, name in quantities},
            looks=looks,
            x_label="severity of the shift",
            width_in=page_width(len(quantities), 4),
        )
        figure, panels = curves.draw()
        for (_, name), panel in panels.items():
            if name == "entropy_auroc" and "mutual_information" in measured:
                self._draw_information(panel, table, looks)
            panel.margins(x=0.05, y=0.12)
            if name in _IDEALS:
                ideal = _IDEALS[name]
                draw_baseline(panel, ideal, "calibrated")
                low, high = panel.get_ylim()
                low = min(low, ideal - _MARGIN)
                high = max(high, ideal + _MARGIN)
                panel.set_ylim(low, high)
            ticks_of(panel, "y")
        legend_outside(figure, side="upper center")
        return figure

    def _draw_information(self, panel: Axes, table: pd.DataFrame, looks: Looks) -> None:
        """Add the AUROC of mutual information as dotted lines."""
        label = "dotted: mutual information; solid: entropy"
        for scenario, rows in table.groupby("line", sort=False):
            look = {**looks[str(scenario)], "ls": ":", "mfc": "white"}
            auroc = rows["mutual_information_auroc"]
            panel.plot(rows["x"], auroc, label=label, **look)


class MapSheets(Figure):
    """Maps of a split: observation, truth, prediction, error and uncertainty.

    Attributes:
        split: name of the split.
    """

    name = "maps"
    split = ""
    text = (
        "Each row is a map: observation, truth, prediction, error and uncertainty. "
        "Observed λ is shown instead of the truth if the true distribution is unknown. "
        "A quantity has the same scale in all sheets of an evaluation."
    )

    def variants(self, data: QualityData) -> Sequence[Self]:
        """Return a sheet per split."""
        sheets = []
        for split in data.sheets:
            name = f"maps-{split.replace('/', '-')}"
            title = f"Maps of {split}"
            sheets.append(self.variant(split=split, name=name, title=title))
        return sheets

    def draw(self, data: QualityData) -> Drawing:
        """Draw a row per map."""
        classes = data.dataset.recipe.classes
        sheets = list(data.sheets.values())
        scales = shared_scales(sheets, classes)
        sheet = data.sheets[self.split]
        return map_sheet_figure(sheet, scales, classes, data.title)


def quality_figures(data: QualityData) -> list[Figure]:
    """Return the figures that apply to the quality of a model."""
    figures = (Confusion(), Reliability(), PIT(), Severity(), Latent(), MapSheets())
    return applicable(figures, data)
