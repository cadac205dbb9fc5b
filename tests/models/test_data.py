import numpy as np
import pytest
import torch

from benchnav.datagen.store import TerrainDataset
from benchnav.errors import ConfigError, DatasetError
from benchnav.models.data import MapData, MapSampler, PixelTable, apply_symmetry, read_pixels

from .support import make_dataset


def test_the_eight_symmetries_of_the_square_are_distinct() -> None:
    square = torch.arange(9).view(3, 3)
    turned = {tuple(apply_symmetry(square, which).flatten().tolist()) for which in range(8)}
    assert len(turned) == 8


@pytest.mark.parametrize("which", [0, 1, 4, 5])
def test_symmetries_of_a_rectangle_keep_its_shape(which: int) -> None:
    assert apply_symmetry(torch.zeros(2, 3, 5), which).shape == (2, 3, 5)


def test_image_and_classes_are_turned_together(dataset: TerrainDataset) -> None:
    data = MapData(dataset, 4, seed=0)
    maps = data.train
    key = (torch.arange(8), torch.arange(8))
    batch = maps[key]
    for place in range(8):
        assert torch.equal(batch["rgb"][place], apply_symmetry(maps.rgb[place], place))
        assert torch.equal(batch["class_id"][place], apply_symmetry(maps.class_id[place], place).long())


def test_order_is_keyed_by_seed_and_epoch() -> None:
    def draw(seed: int, epoch: int) -> tuple[list[int], list[int]]:
        sampler = MapSampler(50, 50, seed, tuple(range(8)), shuffle=True)
        sampler.set_epoch(epoch)
        ((index, which),) = sampler
        return index.tolist(), which.tolist()

    assert draw(0, 3) == draw(0, 3)
    for other in (draw(0, 4), draw(1, 3)):
        assert all(a != b for a, b in zip(draw(0, 3), other, strict=True))
    assert set(draw(0, 3)[1]) == set(range(8))


def test_an_epoch_has_every_map_once_in_batches_of_nearly_one_size() -> None:
    batches = [index for index, _ in MapSampler(10, 4, 0, (0,), shuffle=True)]
    assert sorted(torch.cat(batches).tolist()) == list(range(10))
    assert [len(batch) for batch in batches] == [4, 3, 3]


def test_loaders_give_fixed_keys_and_leave_the_global_generator_alone(dataset: TerrainDataset) -> None:
    data = MapData(dataset, 4, seed=0)
    before = torch.random.get_rng_state()
    batch = next(iter(data.train_dataloader()))
    assert torch.equal(before, torch.random.get_rng_state())
    assert set(batch) == {"rgb", "class_id"}
    assert batch["rgb"].dtype == torch.uint8
    assert batch["class_id"].dtype == torch.int64
    valid = torch.cat([batch["class_id"] for batch in data.val_dataloader()])
    assert torch.equal(valid, data.valid.class_id.long())


def test_colour_statistics_are_those_of_the_training_maps(dataset: TerrainDataset) -> None:
    mean, std = MapData(dataset, 4, seed=0).colour_statistics()
    rgb = dataset.read("train", fields=["rgb"])["rgb"].astype(float)
    np.testing.assert_allclose(mean, rgb.mean((0, 2, 3)), rtol=1e-5)
    np.testing.assert_allclose(std, rgb.std((0, 2, 3)), rtol=1e-5)


def test_a_split_that_is_not_there_is_named(tmp_path) -> None:
    small = make_dataset(tmp_path / "d.h5", train=2)
    with pytest.raises(DatasetError, match="'valid'"):
        MapData(small, 4, seed=0)


def test_pixels_keep_their_class_and_their_pairing(dataset: TerrainDataset) -> None:
    table = read_pixels(dataset, "train", max_points=50, seed=1)
    maps = dataset.read("train", fields=["class_id", "slope_deg", "traversability"])
    for class_id in range(10):
        here = maps["class_id"] == class_id
        there = set(zip(maps["slope_deg"][here].tolist(), maps["traversability"][here].tolist(), strict=True))
        count = int(table.count[class_id])
        assert count == min(50, here.sum())
        row = zip(table.slope_deg[class_id].tolist(), table.traversability[class_id].tolist(), strict=True)
        assert set(list(row)[:count]) <= there
    again = read_pixels(dataset, "train", max_points=50, seed=1)
    other = read_pixels(dataset, "train", max_points=50, seed=2)
    assert torch.equal(table.slope_deg, again.slope_deg)
    assert not torch.equal(table.slope_deg, other.slope_deg)


def test_a_subsample_draws_from_all_of_a_class() -> None:
    slope = torch.linspace(0, 90, 4001)
    table = PixelTable.group(torch.zeros(4001, dtype=torch.long), slope, slope / 90, 2, max_points=1000)
    assert table.count.tolist() == [1000, 0]
    assert len(table.slope_deg[0].unique()) == 1000
    assert float(table.slope_deg[0].mean()) == pytest.approx(45, abs=4)


def test_a_table_of_logs_out_of_range_is_refused() -> None:
    ids = torch.tensor([0, 1])
    with pytest.raises(ConfigError, match="traversability"):
        PixelTable.group(ids, torch.tensor([1.0, 2.0]), torch.tensor([0.5, 1.5]), 2)
    with pytest.raises(ConfigError, match="class_id"):
        PixelTable.group(ids, torch.tensor([1.0, 2.0]), torch.tensor([0.5, 0.5]), 1)
    with pytest.raises(ConfigError, match="one length"):
        PixelTable.group(ids, torch.tensor([1.0]), torch.tensor([0.5, 0.5]), 2)
