import math
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from scipy.stats import norm

from benchnav.datagen.store import TerrainDataset
from benchnav.errors import ConfigError, DatasetError
from benchnav.models.pixels import PixelTable, hold_out, pixel_nll, read_pixels

from .support import linear_table, make_dataset, make_table


def rows_of(table: PixelTable, c: int) -> list[tuple[float, float]]:
    count = int(table.count[c])
    return list(
        zip(table.slope_deg[c, :count].tolist(), table.traversability[c, :count].tolist(), strict=True)
    )


def test_pixels_keep_their_class_and_their_pairing(dataset: TerrainDataset) -> None:
    table = read_pixels(dataset, "train", max_points=50, seed=1)
    maps = dataset.read("train", fields=["class_id", "slope_deg", "traversability"])
    for class_id in range(10):
        here = maps["class_id"] == class_id
        there = set(zip(maps["slope_deg"][here].tolist(), maps["traversability"][here].tolist(), strict=True))
        assert int(table.count[class_id]) == min(50, here.sum())
        assert set(rows_of(table, class_id)) <= there
    again = read_pixels(dataset, "train", max_points=50, seed=1)
    other = read_pixels(dataset, "train", max_points=50, seed=2)
    assert torch.equal(table.slope_deg, again.slope_deg)
    assert not torch.equal(table.slope_deg, other.slope_deg)


def test_a_subsample_draws_from_all_of_a_class() -> None:
    slope = torch.linspace(0, 90, 4001)
    table = PixelTable.group(torch.zeros(4001, dtype=torch.long), slope, slope / 90, 2, max_points=1000)
    assert table.count.tolist() == [1000, 0]
    assert len(table.slope_deg[0].unique()) == 1000
    assert float(table.slope_deg[0].mean()) == pytest.approx(45, abs=0.5)


def test_a_subsample_keeps_every_rare_slope_and_shares_the_rest_evenly() -> None:
    generator = torch.Generator().manual_seed(0)
    flat, middle = torch.rand(9000, generator=generator), 5 + torch.rand(900, generator=generator)
    slope = torch.cat([flat, middle, 30 + torch.rand(10, generator=generator)])
    table = PixelTable.group(torch.zeros(len(slope), dtype=torch.long), slope, slope / 90, 1, max_points=200)
    kept = table.slope_deg[0]
    assert [int(((kept >= low) & (kept < low + 1)).sum()) for low in (0, 5, 30)] == [95, 95, 10]
    # Within a band the draw is even.
    assert float(kept[kept < 1].mean()) == pytest.approx(0.5, abs=0.1)


def test_cells_that_were_not_observed_are_left_out() -> None:
    ids = torch.tensor([[0, 0], [1, 1]])
    slope = torch.tensor([[1.0, 2.0], [math.nan, 4.0]])
    value = torch.tensor([[0.1, math.nan], [0.3, 0.4]])
    table = PixelTable.group(ids, slope, value, 2)
    assert table.count.tolist() == [1, 1]
    np.testing.assert_allclose([rows_of(table, 0)[0], rows_of(table, 1)[0]], [(1, 0.1), (4, 0.4)])
    with pytest.raises(ConfigError, match="NaN in all 4"):
        PixelTable.group(ids, slope, torch.full((2, 2), math.nan), 2)


def test_a_dataset_with_unobserved_cells_gives_the_others(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "d.h5", train=2)
    whole = read_pixels(dataset, "train", max_points=10**6)
    with h5py.File(dataset.path, "r+") as file:
        values = file["train/traversability"][...]
        values[:, ::2] = np.nan
        file["train/traversability"][...] = values
    seen = read_pixels(dataset, "train", max_points=10**6)
    assert int(seen.count.sum()) * 2 == int(whole.count.sum())
    assert not bool(seen.traversability.isnan().any())
    with h5py.File(dataset.path, "r+") as file:
        file["train/traversability"][...] = np.nan
    with pytest.raises(DatasetError, match=r"'train'.*NaN in every cell"):
        read_pixels(dataset, "train")


def test_a_table_of_logs_out_of_range_is_refused() -> None:
    ids = torch.tensor([0, 1])
    with pytest.raises(ConfigError, match="traversability"):
        PixelTable.group(ids, torch.tensor([1.0, 2.0]), torch.tensor([0.5, 1.5]), 2)
    with pytest.raises(ConfigError, match="slope_deg"):
        PixelTable.group(ids, torch.tensor([1.0, -2.0]), torch.tensor([0.5, 0.5]), 2)
    with pytest.raises(ConfigError, match="class_id"):
        PixelTable.group(ids, torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.5]), 1)
    with pytest.raises(ConfigError, match="one length"):
        PixelTable.group(ids, torch.tensor([1.0]), torch.tensor([0.5, 0.5]), 2)
    with pytest.raises(ConfigError, match="max_points"):
        PixelTable.group(ids, torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.5]), 2, max_points=0)


def test_holding_out_splits_each_class_by_the_share() -> None:
    full = make_table(100)
    table = PixelTable(
        slope_deg=full.slope_deg, traversability=full.traversability, count=torch.tensor([100, 11, 1])
    )
    kept, held = hold_out(table, 0.2, seed=3)
    assert held.count.tolist() == [20, 2, 0]
    for c in range(3):
        assert sorted(rows_of(kept, c) + rows_of(held, c)) == sorted(rows_of(table, c))
    # At random: neither the first cells nor the last.
    assert not set(rows_of(held, 0)) <= {*rows_of(table, 0)[:20]}
    assert not set(rows_of(held, 0)) <= {*rows_of(table, 0)[-20:]}
    assert rows_of(hold_out(table, 0.2, seed=3)[1], 0) == rows_of(held, 0)
    assert rows_of(hold_out(table, 0.2, seed=4)[1], 0) != rows_of(held, 0)


def test_holding_out_refuses_a_share_that_leaves_nothing() -> None:
    with pytest.raises(ConfigError, match="`share` in"):
        hold_out(make_table(10), 1.0)
    with pytest.raises(ConfigError, match="at least 10 cells"):
        hold_out(make_table(9), 0.1)


def test_nll_is_that_of_each_cells_own_class() -> None:
    # The means are 1 − ψ/90, 0.5 and ψ/90, the standard deviations 0.1, 0.2 and 0.3.
    pixels = PixelTable(
        slope_deg=torch.tensor([[45.0, 45.0], [20.0, 0.0], [90.0, 0.0]]),
        traversability=torch.tensor([[0.6, 1.0], [0.0, 0.0], [0.9, 0.3]]),
        count=torch.tensor([2, 1, 1]),
    )
    logs = (
        norm.logpdf(0.6, 0.5, 0.1),
        norm.logsf(1, 0.5, 0.1),
        norm.logcdf(0, 0.5, 0.2),
        norm.logpdf(0.9, 1.0, 0.3),
    )
    assert pixel_nll(pixels, linear_table()) == pytest.approx(-np.mean(logs), rel=1e-5)
    two = PixelTable(
        slope_deg=pixels.slope_deg[:2], traversability=pixels.traversability[:2], count=torch.tensor([2, 2])
    )
    with pytest.raises(ConfigError, match="of 3 classes, got 4 of 2"):
        pixel_nll(two, linear_table())
