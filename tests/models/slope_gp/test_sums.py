from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from benchnav.core.errors import DatasetError
from benchnav.models.slope_gp.cells import Cells
from benchnav.models.slope_gp.sums import SlopeSums, levels, sum_cells, sum_split
from tests.models.support import make_cells, make_dataset


def test_every_cell_of_a_split_is_counted(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "d.h5", train=6)
    maps = dataset.read("train", fields=["class_id", "slope_deg", "traversability"])
    sums = sum_split(dataset, "train")
    assert sums.count.tolist() == np.bincount(maps["class_id"].ravel(), minlength=10).tolist()
    bins = sums.bins(censored=True)
    value = maps["traversability"].astype(np.float64)
    inside = (value > 0) & (value < 1)
    assert float(bins["total"].sum()) == pytest.approx(value[inside].sum())
    assert float(bins["squares"].sum()) == pytest.approx((value[inside] ** 2).sum())
    assert int(bins["ones"].sum()) == (value == 1).sum()
    assert int(bins["zeros"].sum()) == (value == 0).sum()
    for c in range(10):
        here = maps["slope_deg"][maps["class_id"] == c]
        assert float(sums.steepest_deg[c]) == (here.max() if len(here) else 0)


def test_parts_add_up_to_the_whole() -> None:
    cells = make_cells(500)
    whole, part = SlopeSums.of(cells, 4), torch.arange(len(cells)) % 7 < 3
    again = sum_cells([cells.select(part), cells.select(~part), cells.select(part & ~part)], 4)
    assert torch.equal(whole.cells, again.cells)
    assert torch.equal(whole.steepest_deg, again.steepest_deg)
    for name in ("slope", "total", "squares"):
        torch.testing.assert_close(getattr(whole, name), getattr(again, name), rtol=1e-12, atol=1e-12)
    assert whole.count.tolist() == [500, 500, 500, 0]


def test_cells_are_counted_by_slope_and_by_traversability() -> None:
    cells = Cells(
        class_id=torch.tensor([1, 1, 1, 0, 1]),
        slope_deg=torch.tensor([0.3, 0.3, 89.99, 90.0, 0.2]),
        traversability=torch.tensor([0.0, 0.5, 1.0, 0.999, 0.001]),
    )
    counted = SlopeSums.of(cells, 2).cells.nonzero().tolist()
    assert counted == [[0, 360, 256], [1, 0, 1], [1, 1, 0], [1, 1, 129], [1, 359, 257]]
    assert levels()[[0, 1, 129, 257]].tolist() == [0, 0.5 / 256, 128.5 / 256, 1]


def test_sums_are_not_changed_through_their_bins() -> None:
    sums = SlopeSums.of(make_cells(50), 3)
    before = sums.total.clone()
    sums.bins(censored=True)["total"].zero_()
    assert torch.equal(sums.total, before)


def test_unobserved_cells_are_left_out_and_a_split_without_any_other_is_refused(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "d.h5", train=2)
    whole = sum_split(dataset, "train")
    with h5py.File(dataset.path, "r+") as file:
        values = file["train/traversability"][...]
        values[:, ::2] = np.nan
        file["train/traversability"][...] = values
    assert int(sum_split(dataset, "train").count.sum()) * 2 == int(whole.count.sum())
    with h5py.File(dataset.path, "r+") as file:
        file["train/traversability"][...] = np.nan
    with pytest.raises(DatasetError, match=r"'train'.*NaN in every cell"):
        sum_split(dataset, "train")
