import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.core.errors import DatasetError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.training.data import (
    Augmentation,
    Loading,
    MapData,
    apply_jitter,
    apply_symmetry,
)
from benchnav.models.training.map_order import MapKey, MapSampler
from tests.models.support import make_dataset


def test_the_eight_symmetries_of_the_square_are_distinct() -> None:
    square = torch.arange(9).view(3, 3)
    turned = {
        tuple(apply_symmetry(square, which).flatten().tolist()) for which in range(8)
    }
    assert len(turned) == 8


@pytest.mark.parametrize("which", [0, 1, 4, 5])
def test_symmetries_of_a_rectangle_keep_its_shape(which: int) -> None:
    assert apply_symmetry(torch.zeros(2, 3, 5), which).shape == (2, 3, 5)


def test_image_and_classes_are_turned_together(dataset: TerrainDataset) -> None:
    data = MapData(dataset, 4, seed=0)
    maps, stored = data.train, data.train.read(range(8))
    key = MapKey(
        torch.arange(8),
        torch.arange(8),
        torch.ones(8, 3),
        torch.zeros(8, 2, dtype=torch.int64),
        torch.zeros(8, 8),
    )
    batch = maps[key]
    for place in range(8):
        assert torch.equal(
            batch["rgb"][place], apply_symmetry(stored["rgb"][place], place)
        )
        assert torch.equal(
            batch["class_id"][place], apply_symmetry(stored["class_id"][place], place)
        )


def test_order_is_keyed_by_seed_and_epoch() -> None:
    def draw(seed: int, epoch: int) -> tuple[list[float], ...]:
        sampler = MapSampler(
            50, 50, seed, symmetries=tuple(range(8)), jitter=0.3, shuffle=True
        )
        sampler.set_epoch(epoch)
        ((index, which, factors, *_),) = sampler
        return index.tolist(), which.tolist(), factors.tolist()

    assert draw(0, 3) == draw(0, 3)
    for other in (draw(0, 4), draw(1, 3)):
        assert all(a != b for a, b in zip(draw(0, 3), other, strict=True))
    assert set(draw(0, 3)[1]) == set(range(8))


@pytest.mark.parametrize(
    "how", [{"in_memory": True}, {"workers": 2}, {"workers": 1, "in_memory": True}]
)
def test_batches_are_the_same_however_maps_are_read(
    dataset: TerrainDataset, how: dict[str, int]
) -> None:
    plain, other = (
        MapData(dataset, 3, 0, augmentation=Augmentation(jitter=0.2), loading=loading)
        for loading in (Loading(), Loading(**how))
    )
    for load in ("train_dataloader", "val_dataloader"):
        for one, two in zip(
            getattr(plain, load)(), getattr(other, load)(), strict=True
        ):
            assert all(torch.equal(one[name], two[name]) for name in one)
    assert other.train_dataloader().num_workers == how.get("workers", 0)


def test_maps_are_read_when_they_are_asked_for_or_at_once(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, asked = TerrainDataset.read, []
    monkeypatch.setattr(
        TerrainDataset,
        "read",
        lambda self, split, *given: asked.append(split) or read(self, split, *given),
    )
    lazy = MapData(dataset, 3, 0)
    assert asked == []
    next(iter(lazy.train_dataloader()))
    assert asked == ["train"]
    held = MapData(dataset, 3, 0, loading=Loading(in_memory=True))
    assert asked == ["train", "train", "valid"]
    next(iter(held.train_dataloader()))
    assert len(asked) == 3


def test_an_epoch_has_every_map_once_in_batches_of_nearly_one_size() -> None:
    batches = [index for index, *_ in MapSampler(10, 4, shuffle=True)]
    assert sorted(torch.cat(batches).tolist()) == list(range(10))
    assert [len(batch) for batch in batches] == [4, 3, 3]


def test_training_maps_are_turned_and_validation_maps_are_not(
    dataset: TerrainDataset,
) -> None:
    data = MapData(dataset, 4, seed=0, augmentation=Augmentation(jitter=0.1))
    turned, changed = set(), []
    for _, which, factors, *_ in data.train_dataloader().sampler:
        turned |= set(which.tolist())
        changed.append(bool((factors != 1).any()))
    assert len(turned) > 2
    assert all(changed)
    for _, which, factors, *_ in data.val_dataloader().sampler:
        assert not which.any()
        assert bool((factors == 1).all())


def test_loaders_give_fixed_keys_and_leave_the_global_generator_alone(
    dataset: TerrainDataset,
) -> None:
    data = MapData(dataset, 4, seed=0)
    before = torch.random.get_rng_state()
    batch = next(iter(data.train_dataloader()))
    assert torch.equal(before, torch.random.get_rng_state())
    assert set(batch) == {"rgb", "class_id"}
    assert batch["rgb"].dtype == torch.uint8
    assert batch["class_id"].dtype == torch.uint8
    valid = torch.cat([batch["class_id"] for batch in data.val_dataloader()])
    assert torch.equal(valid, data.valid.read(range(len(data.valid)))["class_id"])


def test_the_scale_of_colours_is_that_of_the_training_maps(
    dataset: TerrainDataset,
) -> None:
    mean, std, _ = MapData(dataset, 4, seed=0).scale(("rgb",))["rgb"]
    rgb = dataset.read("train", fields=["rgb"])["rgb"].astype(float)
    np.testing.assert_allclose(mean, rgb.mean((0, 2, 3)), rtol=1e-5)
    np.testing.assert_allclose(std, rgb.std((0, 2, 3)), rtol=1e-5)


def test_a_split_that_is_not_there_is_named(tmp_path) -> None:
    small = make_dataset(tmp_path / "d.h5", train=2)
    with pytest.raises(DatasetError, match="'valid'"):
        MapData(small, 4, seed=0)


def test_jitter_is_torchvisions_a_map_at_a_time() -> None:
    rgb = torch.randint(
        0,
        256,
        (2, 3, 8, 8),
        generator=torch.Generator().manual_seed(0),
        dtype=torch.uint8,
    )
    assert torch.equal(apply_jitter(rgb, torch.ones(2, 3)), rgb)
    changed = apply_jitter(rgb, torch.tensor([[0.5, 1, 1], [1, 1, 0]]))
    torch.testing.assert_close(changed[0].float(), rgb[0].float() / 2, rtol=0, atol=1)
    # without saturation all channels are one grey
    assert torch.equal(changed[1, 0], changed[1, 1])


def test_jitter_is_within_its_range_and_valid_maps_are_never_changed(
    dataset: TerrainDataset,
) -> None:
    (drawn,) = (key.factors for key in MapSampler(100, 100, jitter=0.2))
    assert drawn.min() >= 0.8
    assert drawn.max() <= 1.2
    assert drawn.std() > 0.1
    plain, jittered = (
        MapData(dataset, 4, seed=0, augmentation=Augmentation(jitter=jitter))
        for jitter in (0.0, 0.5)
    )
    assert torch.equal(
        *(next(iter(data.val_dataloader()))["rgb"] for data in (plain, jittered))
    )
    first, second = (next(iter(data.train_dataloader())) for data in (plain, jittered))
    assert torch.equal(first["class_id"], second["class_id"])
    assert not torch.equal(first["rgb"], second["rgb"])


@settings(max_examples=30, deadline=None)
@given(
    maps=st.integers(1, 40), batch_size=st.integers(1, 16), processes=st.integers(1, 4)
)
def test_processes_share_every_batch(
    maps: int, batch_size: int, processes: int
) -> None:
    whole = [index for index, *_ in MapSampler(maps, batch_size, 3, shuffle=True)]
    parts = [
        [
            index
            for index, *_ in MapSampler(
                maps, batch_size, 3, shuffle=True, process=(place, processes)
            )
        ]
        for place in range(processes)
    ]
    for place, batch in enumerate(whole):
        shared = [part[place] for part in parts]
        assert all(len(one) for one in shared)
        assert set(torch.cat(shared).tolist()) == set(batch.tolist())
        if len(batch) >= processes:
            assert len(torch.cat(shared)) == len(batch)


# --- squares and directions ---


def test_squares_are_cut_from_all_fields_alike_and_lie_within_their_maps(
    dataset: TerrainDataset,
) -> None:
    data = MapData(
        dataset, 4, seed=0, augmentation=Augmentation(symmetries=False), crop=20
    )
    stored = dataset.read("train")
    height, width = dataset.grid.shape
    corners = set()
    for key in data.train_dataloader().sampler:
        batch = data.train[key]
        for place, (index, (row, column)) in enumerate(
            zip(key.maps.tolist(), key.origin.tolist(), strict=True)
        ):
            corners.add((row, column))
            assert 0 <= row <= height - 20
            assert 0 <= column <= width - 20
            for name in ("rgb", "class_id"):
                square = stored[name][index, ..., row : row + 20, column : column + 20]
                np.testing.assert_array_equal(batch[name][place], square)
    assert len(corners) > 5


def test_squares_are_drawn_by_seed_and_epoch_and_stay_for_validation() -> None:
    def draw(seed: int, epoch: int, shuffle: bool) -> list[list[int]]:
        sampler = MapSampler(50, 50, seed, shuffle=shuffle, crop=32, shape=(32, 48))
        sampler.set_epoch(epoch)
        return [corner for key in sampler for corner in key.origin.tolist()]

    assert draw(0, 3, True) == draw(0, 3, True)
    assert draw(0, 3, True) not in (draw(0, 4, True), draw(1, 3, True))
    assert draw(0, 3, False) == draw(0, 4, False)
    rows, columns = np.transpose(draw(0, 0, True))
    assert set(rows) == {0}
    assert min(columns) == 0
    assert max(columns) == 16


def test_a_map_gives_as_many_squares_an_epoch_as_it_has_room_for() -> None:
    sampler = MapSampler(5, 4, shuffle=True, crop=16, shape=(32, 50))
    drawn = torch.cat([key.maps for key in sampler])
    assert torch.bincount(drawn).tolist() == [6] * 5
    assert len(sampler) == 8
    # in validation one a map
    assert len(MapSampler(5, 4, crop=16, shape=(32, 50))) == 2


def test_validation_and_calibration_see_the_same_squares(
    dataset: TerrainDataset,
) -> None:
    data = MapData(dataset, 3, seed=7, crop=16)
    loaded = torch.cat([batch["rgb"] for batch in data.val_dataloader()])
    measured = torch.cat([batch["rgb"] for _, batch in data.valid.chunks()])
    assert torch.equal(loaded, measured)
    assert loaded.shape[-2:] == (16, 16)


def test_directions_turn_with_the_map() -> None:
    """The direction in which a surface rises, found again on the turned surface, is the
    turned direction.
    """
    rows, columns = torch.meshgrid(torch.arange(9.0), torch.arange(9.0), indexing="ij")
    surface = 0.3 * columns + 0.1 * columns**2 - 0.2 * rows + 0.05 * rows * columns

    def rises(of: torch.Tensor) -> torch.Tensor:
        down, right = torch.gradient(of)
        return torch.rad2deg(torch.atan2(down, right)) % 360

    for which in range(8):
        found = apply_symmetry(rises(surface), which, "wind_azimuth_deg")
        wanted = rises(apply_symmetry(surface, which))
        off = (found - wanted + 180) % 360 - 180
        assert float(off[1:-1, 1:-1].abs().max()) < 1e-3, which
    assert torch.equal(
        apply_symmetry(surface, 2, "elevation_m"), torch.rot90(surface, 1, (-2, -1))
    )


def test_layers_are_scaled_by_their_known_cells(dataset: TerrainDataset) -> None:
    scale = MapData(dataset, 4, seed=0).scale(
        ("rgb", "slope_deg", "elevation_m", "traversability")
    )
    for name in ("slope_deg", "elevation_m"):
        values = dataset.read("train", fields=[name])[name].astype(float)
        np.testing.assert_allclose(
            scale[name].mean, [values.mean()], rtol=1e-5, atol=1e-6
        )
        np.testing.assert_allclose(scale[name].std, [values.std()], rtol=1e-5)
    slope = dataset.read("train", fields=["slope_deg"])["slope_deg"].astype(float)
    np.testing.assert_allclose(
        scale["slope_deg"].rms, np.sqrt((slope**2).mean()), rtol=1e-6
    )


def test_what_is_not_finite_has_no_part_in_the_scale(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = MapData(dataset, 4, seed=0)
    values = np.array([[1.0, np.inf], [3.0, np.nan]], np.float32)
    monkeypatch.setattr(
        data.train.dataset,
        "chunks",
        lambda *_: iter([(range(1), {"moss": values[None]})]),
        raising=False,
    )
    scale = data.scale(("moss",))["moss"]
    assert (float(scale.mean), float(scale.std)) == (2, 1)
