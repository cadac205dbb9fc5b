"""Input of the figures of a model's quality."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import pandas as pd

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.base import TraversabilityModel
from benchnav.models.quality.map_sheet import (
    MapSheet,
    read_sheet,
)
from benchnav.models.quality.measure import ClassQuality, Quality
from benchnav.models.slope_gp.table import SlopeTable


@dataclass(frozen=True, kw_only=True)
class QualityData:
    """Input of the figures of a model's quality.

    Args:
        title: names of model and dataset, for the map sheets.
        model: measured model.
        dataset: dataset of the measured maps.
        qualities: quality of the model by split.
        maps: number of maps of each split that the map sheets show.
    """

    title: str
    model: TraversabilityModel
    dataset: TerrainDataset
    qualities: Mapping[str, Quality]
    maps: int = 0

    @property
    def by_class(self) -> dict[str, ClassQuality]:
        """Quality of the class probabilities, by split."""
        return {
            split: item
            for split, quality in self.qualities.items()
            for item in quality.classes
        }

    @property
    def table(self) -> SlopeTable | None:
        """Table of the model's Gaussian processes over slope; None if it has no table."""
        table = getattr(self.model, "table", None)
        return table if isinstance(table, SlopeTable) else None

    @cached_property
    def sheets(self) -> dict[str, MapSheet]:
        """Maps of each split with their predictions."""
        if not self.maps:
            return {}
        sheets = {}
        for split in self.qualities:
            n_maps = min(self.maps, self.dataset.map_count(split))
            sheets[split] = read_sheet(self.model, self.dataset, split, range(n_maps))
        return sheets

    @property
    def absent(self) -> list[str]:
        """A line for each figure that is not drawn, with the reason."""
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
    """Return the series of shifts: one row per `split`, with `scenario` and `severity`."""
    rows = []
    for scenario, pairs in find_series(splits).items():
        for severity, split in pairs:
            rows.append((scenario, severity, split))
    return pd.DataFrame(rows, columns=["scenario", "severity", "split"])
