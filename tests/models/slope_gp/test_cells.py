import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from benchnav.core.errors import ConfigError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.slope_gp.cells import Cells, cell_nll, hold_out, observed_cells, read_cells
from benchnav.models.slope_gp.table import SoftModes
from tests.models.support import linear_table, make_cells


def rows_of(cells: Cells, c: int) -> list[tuple[float, float]]:
    here = cells.select(cells.class_id == c)
    return list(zip(here.slope_deg.tolist(), here.traversability.tolist(), strict=True))


@pytest.mark.parametrize("chunk_cells", [1, 3 * 32 * 32, 10**9])
def test_cells_keep_their_class_and_their_pairing_however_many_are_held(
    dataset: TerrainDataset, chunk_cells: int
) -> None:
    parts = list(read_cells(dataset, "train", chunk_cells))
    assert len(parts) == {1: 10, 3 * 32 * 32: 4, 10**9: 1}[chunk_cells]
    maps = dataset.read("train", fields=["class_id", "slope_deg", "traversability"])
    for name, values in maps.items():
        np.testing.assert_array_equal(torch.cat([getattr(part, name) for part in parts]), values.ravel())


def test_cells_that_were_not_observed_are_left_out() -> None:
    ids = torch.tensor([[0, 0], [1, 1]])
    slope = torch.tensor([[1.0, 2.0], [math.nan, 4.0]])
    value = torch.tensor([[0.1, math.nan], [0.3, 0.4]])
    cells = observed_cells(ids, slope, value, 2)
    np.testing.assert_allclose([rows_of(cells, 0)[0], rows_of(cells, 1)[0]], [(1, 0.1), (4, 0.4)])
    assert len(cells) == 2
    assert len(observed_cells(ids, slope, torch.full((2, 2), math.nan), 2)) == 0


def test_columns_out_of_range_are_refused() -> None:
    ids = torch.tensor([0, 1])
    with pytest.raises(ConfigError, match="traversability"):
        observed_cells(ids, torch.tensor([1.0, 2.0]), torch.tensor([0.5, 1.5]), 2)
    with pytest.raises(ConfigError, match="slope_deg"):
        observed_cells(ids, torch.tensor([1.0, -2.0]), torch.tensor([0.5, 0.5]), 2)
    with pytest.raises(ConfigError, match="class_id"):
        observed_cells(ids, torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.5]), 1)
    with pytest.raises(ConfigError, match="one length"):
        observed_cells(ids, torch.tensor([1.0]), torch.tensor([0.5, 0.5]), 2)


def test_holding_out_splits_each_class_by_the_share() -> None:
    full = make_cells(100)
    place = torch.arange(300) % 100
    some = (full.class_id == 0) | ((full.class_id == 1) & (place < 11)) | ((full.class_id == 2) & (place < 1))
    cells = full.select(some)
    kept, held = hold_out(cells, 0.2, seed=3)
    assert held.class_id.bincount(minlength=3).tolist() == [20, 2, 0]
    for c in range(3):
        assert sorted(rows_of(kept, c) + rows_of(held, c)) == sorted(rows_of(cells, c))
    # Those held out follow one another, somewhere among the rest.
    every = rows_of(cells, 0)
    first = every.index(rows_of(held, 0)[0])
    assert rows_of(held, 0) == every[first : first + 20]
    starts = {every.index(rows_of(hold_out(cells, 0.2, seed)[1], 0)[0]) for seed in range(200)}
    assert (min(starts), max(starts)) == (0, 80)
    assert rows_of(hold_out(cells, 0.2, seed=3)[1], 0) == rows_of(held, 0)
    assert rows_of(hold_out(cells, 0.2, seed=4)[1], 0) != rows_of(held, 0)


def test_neighbours_of_a_drive_do_not_tell_of_each_other() -> None:
    """λ wanders along the drive: rows drawn singly would be known by their neighbours, a stretch of it is not."""
    generator = torch.Generator().manual_seed(0)
    drift = 0.02 * torch.randn(400, generator=generator)
    cells = Cells(
        class_id=torch.zeros(400, dtype=torch.int64),
        slope_deg=torch.full((400,), 5.0),
        traversability=(0.5 + drift.cumsum(0)).clamp(0, 1),
    )
    kept, held = hold_out(cells, 0.25, 1)
    gaps = (held.traversability[:, None] - kept.traversability).abs().min(1).values
    single = torch.arange(400) % 4 == 0
    apart = (cells.traversability[single][:, None] - cells.traversability[~single]).abs().min(1).values
    assert len(held) == int(single.sum())
    assert float(gaps.mean()) > float(apart.mean())


def test_holding_out_refuses_a_share_that_leaves_nothing() -> None:
    with pytest.raises(ConfigError, match="`share` in"):
        hold_out(make_cells(10), 1.0)
    with pytest.raises(ConfigError, match="at least 10 cells"):
        hold_out(make_cells(9), 0.1)


# The means are 1 − ψ/90, 0.5 and ψ/90, the standard deviations 0.1, 0.2 and 0.3.
CELLS = Cells(
    class_id=torch.tensor([0, 0, 1, 2]),
    slope_deg=torch.tensor([45.0, 45.0, 20.0, 90.0]),
    traversability=torch.tensor([0.6, 1.0, 0.0, 0.9]),
)
LOGS = (
    norm.logpdf(0.6, 0.5, 0.1), norm.logsf(1, 0.5, 0.1), norm.logcdf(0, 0.5, 0.2), norm.logpdf(0.9, 1.0, 0.3)
)  # fmt: skip


def test_nll_is_that_of_each_cells_own_class() -> None:
    assert cell_nll(CELLS, linear_table()) == pytest.approx(-np.mean(LOGS), rel=1e-5)
    with pytest.raises(ConfigError, match="of 3 classes, got of 4"):
        cell_nll(replace(CELLS, class_id=torch.tensor([0, 0, 1, 3])), linear_table())
    with pytest.raises(ConfigError, match="got none"):
        cell_nll(CELLS.select(torch.zeros(4, dtype=torch.bool)), linear_table())


def test_nll_of_a_class_with_a_second_mode_is_that_of_both() -> None:
    soft = SoftModes(
        weight=torch.tensor([0.3, 0.0, 0.0]), mean=torch.tensor([0.55, 0.0, 0.0]), std=torch.full((3,), 0.2)
    )
    both = [
        np.log(0.7 * np.exp(LOGS[0]) + 0.3 * norm.pdf(0.6, 0.55, 0.2)),
        np.log(0.7 * np.exp(LOGS[1]) + 0.3 * norm.sf(1, 0.55, 0.2)),
        *LOGS[2:],
    ]
    found = cell_nll(CELLS, replace(linear_table(), soft=soft))
    assert found == pytest.approx(-np.mean(both), rel=1e-5)


def test_cells_without_a_class_are_left_out() -> None:
    ids = torch.tensor([0, 255, 1, 255], dtype=torch.uint8)
    numbers = torch.tensor([0.1, 0.2, 0.3, 0.4])
    cells = observed_cells(ids, numbers, numbers, 2)
    assert cells.class_id.tolist() == [0, 1]
    assert cells.traversability.tolist() == pytest.approx([0.1, 0.3])
