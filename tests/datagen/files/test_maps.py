from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from benchnav.core.errors import DatasetError
from benchnav.datagen.files import reader
from benchnav.datagen.files.create import create
from benchnav.datagen.files.maps import TerrainMaps
from benchnav.datagen.files.reader import TerrainDataset
from tests.factories import tiny_dataset, tiny_recipe


@pytest.mark.parametrize("in_memory", [False, True])
def test_maps_are_what_is_stored(dataset_path: Path, in_memory: bool) -> None:
    maps = TerrainMaps(
        dataset_path,
        "train",
        ("slope_deg", "environment", "start_m"),
        in_memory=in_memory,
    )
    stored = TerrainDataset(dataset_path).read("train")
    assert len(maps) == 8
    for index in (0, 5, -1):
        assert list(maps[index]) == ["slope_deg", "environment", "start_m"]
        for name, value in maps[index].items():
            assert torch.equal(value, torch.from_numpy(stored[name])[index])
    with pytest.raises(IndexError, match="0–7"):
        maps[8]


@pytest.mark.parametrize("context", ["fork", "spawn"])
@pytest.mark.parametrize("in_memory", [False, True])
def test_workers_read_what_this_process_reads(
    dataset_path: Path, context: str, in_memory: bool
) -> None:
    maps = TerrainMaps(dataset_path, "train", in_memory=in_memory)
    # and so the file is open already
    here = torch.stack([maps[i]["rgb"] for i in range(len(maps))])
    workers = {"fork": 2, "spawn": 1}[context]
    loader = DataLoader(
        maps, batch_size=2, num_workers=workers, multiprocessing_context=context
    )
    assert torch.equal(torch.cat([batch["rgb"] for batch in loader]), here)
    assert torch.equal(maps[3]["rgb"], here[3])


def test_another_process_opens_the_file_for_itself(
    dataset_path: Path, monkeypatch
) -> None:  # type: ignore[no-untyped-def]
    maps = TerrainMaps(dataset_path, "train")
    here = [maps.dataset._open(dataset_path)[0] for _ in range(2)]
    monkeypatch.setattr("os.getpid", lambda: -1)
    assert here[0] is here[1] is not maps.dataset._open(dataset_path)[0]


def test_only_the_fields_asked_for_are_read(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        del file["train/elevation_m"]
    assert TerrainMaps(path, "train")[0].keys() == {"rgb", "class_id"}


def test_bad_requests_and_damage_are_named(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with pytest.raises(DatasetError, match=r"fields.*'colour'"):
        TerrainMaps(path, "train", ("rgb", "colour"))
    with pytest.raises(DatasetError, match="'nope'"):
        TerrainMaps(path, "nope")
    with h5py.File(path, "r") as file:
        place = file["train/rgb"].id.get_chunk_info(1)
    raw = bytearray(path.read_bytes())
    raw[place.byte_offset + 9] ^= 16
    path.write_bytes(raw)
    maps = TerrainMaps(path, "train")
    assert maps[0]
    with pytest.raises(DatasetError, match=r"'rgb'.*validate"):
        maps[1]


def test_maps_from_memory_are_copies_and_relative_paths_hold(
    dataset_path: Path, monkeypatch
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.chdir(dataset_path.parent)
    maps = [
        TerrainMaps(dataset_path.name, "train", in_memory=there)
        for there in (False, True)
    ]
    monkeypatch.chdir("/")
    before = maps[0][2]["rgb"].clone()
    for source in maps:
        source[2]["rgb"].zero_()
        assert torch.equal(source[2]["rgb"], before)


def test_a_missing_array_is_damage(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        del file["train/rgb"]
    with pytest.raises(DatasetError, match=r"'rgb'.*validate"):
        TerrainMaps(path, "train")[0]


def test_maps_of_a_folder_are_those_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in create(tiny_recipe(), tmp_path / "d", shard_cells=3 * 32 * 32):
        pass
    monkeypatch.setattr(reader, "_MAX_OPEN", 2)
    whole = TerrainMaps(tiny_dataset(tmp_path / "d.h5"), "train")
    parts = TerrainMaps(tmp_path / "d", "train")
    for index in (7, 0, 3, 5, 2, 6, 1, 4):
        for name, values in parts[index].items():
            assert torch.equal(values, whole[index][name])
    assert len(parts.dataset._opened) == 2
    loaded = torch.cat(
        [batch["rgb"] for batch in DataLoader(parts, batch_size=3, num_workers=2)]
    )
    assert torch.equal(loaded, torch.stack([whole[index]["rgb"] for index in range(8)]))


@pytest.fixture
def shards(tmp_path: Path) -> TerrainMaps:
    """Eight maps in shards of three."""
    for _ in create(tiny_recipe(), tmp_path / "d", shard_cells=3 * 32 * 32):
        pass
    return TerrainMaps(tmp_path / "d", "train", ("rgb", "start_m"))


@settings(
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.lists(st.integers(0, 7), max_size=12))
def test_maps_of_shards_are_read_in_any_order_and_more_than_once(
    shards: TerrainMaps, indices: list[int]
) -> None:
    stored = shards.dataset.read("train", fields=("rgb", "start_m"))
    for name, values in shards.read(indices).items():
        np.testing.assert_array_equal(values, stored[name][indices])


def test_maps_that_lie_side_by_side_are_read_together(
    shards: TerrainMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    plainly, runs = reader._values, []
    monkeypatch.setattr(
        reader,
        "_values",
        lambda array, which: (
            runs.append((which.start, which.stop)) or plainly(array, which)
        ),
    )
    shards.read([4, 0, 3, 2, 7])
    assert runs[::2] == [(0, 1), (2, 3), (0, 2), (1, 2)]


def test_a_file_that_is_one_too_many_is_closed(
    shards: TerrainMaps, monkeypatch: pytest.MonkeyPatch
) -> None:
    def count() -> int:
        return h5py.h5f.get_obj_count(
            h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_FILE | h5py.h5f.OBJ_DATASET
        )

    monkeypatch.setattr(reader, "_MAX_OPEN", 2)
    before = count()
    for index in range(8):
        shards[index]
        assert count() - before <= 2 * 3  # files, each with two arrays
    assert count() - before == 2 * 3
