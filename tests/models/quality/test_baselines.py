import math

import numpy as np
import pytest

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.quality.baselines import climatology_crps


def test_the_crps_of_one_distribution_is_half_the_mean_difference_of_two_cells(
    dataset: TerrainDataset,
) -> None:
    observed = np.sort(
        dataset.read("test/std", fields=("traversability",))["traversability"].ravel()
    ).astype(float)
    cells = len(observed)
    # Σ over pairs of |x − y| by ranks.
    gini = 2 * np.sum((2 * np.arange(1, cells + 1) - cells - 1) * observed) / cells**2
    assert climatology_crps(dataset, "test/std") == pytest.approx(gini / 2, abs=2e-4)


def test_cells_that_were_not_observed_do_not_count(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.array([[[0.25, 0.25, 0.75, 0.75, np.nan]]], dtype=np.float32)
    monkeypatch.setattr(
        dataset, "chunks", lambda *_: [(range(1), {"traversability": values})]
    )
    assert climatology_crps(dataset, "test/std") == pytest.approx(0.125, abs=2e-4)
    monkeypatch.setattr(
        dataset, "chunks", lambda *_: [(range(1), {"traversability": values * np.nan})]
    )
    assert math.isnan(climatology_crps(dataset, "test/std"))
