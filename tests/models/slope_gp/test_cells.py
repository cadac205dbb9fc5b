import math
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from scipy.stats import norm

from benchnav.core.errors import DatasetError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.slope_gp.cells import (
    Cells,
    SlopeSums,
    cell_nll,
    hold_out,
    levels,
    measure_latent,
    observed_cells,
    read_cells,
    sum_cells,
    sum_split,
)
from benchnav.models.slope_gp.table import SoftModes
from tests.factories import normal
from tests.models.support import linear_table, make_cells, make_dataset, make_terrain


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
        np.testing.assert_array_equal(
            torch.cat([getattr(part, name) for part in parts]), values.ravel()
        )


def test_cells_that_were_not_observed_are_left_out() -> None:
    ids = torch.tensor([[0, 0], [1, 1]])
    slope = torch.tensor([[1.0, 2.0], [math.nan, 4.0]])
    value = torch.tensor([[0.1, math.nan], [0.3, 0.4]])
    cells = observed_cells(ids, slope, value)
    np.testing.assert_allclose(
        [rows_of(cells, 0)[0], rows_of(cells, 1)[0]], [(1, 0.1), (4, 0.4)]
    )
    assert len(cells) == 2
    assert len(observed_cells(ids, slope, torch.full((2, 2), math.nan))) == 0


def test_holding_out_splits_each_class_by_the_share() -> None:
    full = make_cells(100)
    place = torch.arange(300) % 100
    some = (
        (full.class_id == 0)
        | ((full.class_id == 1) & (place < 11))
        | ((full.class_id == 2) & (place < 1))
    )
    cells = full.select(some)
    kept, held = hold_out(cells, 0.2, seed=3)
    assert held.class_id.bincount(minlength=3).tolist() == [20, 2, 0]
    for c in range(3):
        assert sorted(rows_of(kept, c) + rows_of(held, c)) == sorted(rows_of(cells, c))
    # Those held out follow one another, somewhere among the rest.
    every = rows_of(cells, 0)
    first = every.index(rows_of(held, 0)[0])
    assert rows_of(held, 0) == every[first : first + 20]
    starts = {
        every.index(rows_of(hold_out(cells, 0.2, seed)[1], 0)[0]) for seed in range(200)
    }
    assert (min(starts), max(starts)) == (0, 80)
    assert rows_of(hold_out(cells, 0.2, seed=3)[1], 0) == rows_of(held, 0)
    assert rows_of(hold_out(cells, 0.2, seed=4)[1], 0) != rows_of(held, 0)


def test_neighbours_of_a_drive_do_not_tell_of_each_other() -> None:
    """λ wanders along the drive: rows drawn singly would be known by their neighbours,
    a stretch of it is not.
    """
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
    apart = (
        (cells.traversability[single][:, None] - cells.traversability[~single])
        .abs()
        .min(1)
        .values
    )
    assert len(held) == int(single.sum())
    assert float(gaps.mean()) > float(apart.mean())


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


def test_nll_of_a_class_with_a_second_mode_is_that_of_both() -> None:
    soft = SoftModes(
        weight=torch.tensor([0.3, 0.0, 0.0]),
        mean=torch.tensor([0.55, 0.0, 0.0]),
        std=torch.full((3,), 0.2),
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
    cells = observed_cells(ids, numbers, numbers)
    assert cells.class_id.tolist() == [0, 1]
    assert cells.traversability.tolist() == pytest.approx([0.1, 0.3])


def test_every_cell_of_a_split_is_counted(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "d.h5", train=6)
    maps = dataset.read("train", fields=["class_id", "slope_deg", "traversability"])
    sums = sum_split(dataset, "train")
    assert (
        sums.count.tolist()
        == np.bincount(maps["class_id"].ravel(), minlength=10).tolist()
    )
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
    again = sum_cells(
        [cells.select(part), cells.select(~part), cells.select(part & ~part)], 4
    )
    assert torch.equal(whole.cells, again.cells)
    assert torch.equal(whole.steepest_deg, again.steepest_deg)
    for name in ("slope", "total", "squares"):
        torch.testing.assert_close(
            getattr(whole, name), getattr(again, name), rtol=1e-12, atol=1e-12
        )
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


def test_unobserved_cells_are_left_out_and_a_split_without_any_other_is_refused(
    tmp_path: Path,
) -> None:
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


def test_latent_metrics_read_each_cell_with_its_own_class() -> None:
    terrain, table = make_terrain(batch=4), linear_table()
    mean, std = table.lookup(terrain.slope_deg)
    own = terrain.class_id[:, None]
    mean, std = mean.gather(1, own)[:, 0], std.gather(1, own)[:, 0]
    perfect = replace(terrain, truth=normal(mean, std))
    exact = measure_latent(table, [perfect])
    assert exact["latent_rmse"] == pytest.approx(0, abs=1e-6)
    assert exact["noise_error"] == pytest.approx(0, abs=1e-6)
    shifted = replace(terrain, truth=normal(mean + 0.1, std))
    assert measure_latent(table, [shifted])["latent_rmse"] == pytest.approx(
        0.1, rel=1e-4
    )
    # In pieces as in one.
    pieces = [shifted.select(torch.tensor(which)) for which in ([0], [1, 2, 3])]
    assert measure_latent(table, pieces) == pytest.approx(
        measure_latent(table, [shifted])
    )
    louder = replace(terrain, truth=normal(mean, std / 1.25))
    pieces = [perfect.select(torch.tensor([0])), louder.select(torch.tensor([1]))]
    assert measure_latent(table, pieces)["noise_error"] == pytest.approx(0.25, rel=1e-5)
    one_cell = std.clone()
    one_cell[2, 3, 4] /= 1.25
    found = measure_latent(table, [replace(terrain, truth=normal(mean, one_cell))])
    # the largest, not the mean
    assert found["noise_error"] == pytest.approx(0.25, rel=1e-5)


def test_a_second_mode_counts_in_the_nll_of_the_processes_and_not_in_their_error() -> (
    None
):
    terrain, table = make_terrain(batch=2), linear_table()
    soft = SoftModes(
        weight=torch.full((3,), 0.4),
        mean=torch.full((3,), 0.1),
        std=torch.full((3,), 0.3),
    )
    plain, both = (
        measure_latent(one, [terrain]) for one in (table, replace(table, soft=soft))
    )
    assert both["latent_rmse"] == plain["latent_rmse"]
    own = replace(table, soft=soft).predict_by_class(
        terrain.class_id, terrain.slope_deg
    )
    wanted = -float(own.log_prob(terrain.traversability).mean())
    assert both["nll"] == pytest.approx(wanted, rel=1e-5)
    assert both["nll"] != pytest.approx(plain["nll"], rel=1e-2)


def test_cells_without_a_class_are_no_part_of_it() -> None:
    terrain, table = make_terrain(batch=2), linear_table()
    class_id, means, seen = (
        terrain.class_id.clone(),
        terrain.truth.means.clone(),
        terrain.traversability.clone(),
    )
    class_id[1], means[1] = UNLABELLED, torch.nan
    holed = replace(
        terrain,
        class_id=class_id,
        truth=replace(terrain.truth, means=means),
        traversability=seen,
    )
    wanted = measure_latent(table, [terrain.select(torch.tensor([0]))])
    assert measure_latent(table, [holed]) == pytest.approx(wanted)
    assert measure_latent(
        table, [holed.select(torch.tensor([1])), holed]
    ) == pytest.approx(wanted)
