from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchnav.datagen import schema
from benchnav.datagen.files.check import Fault, find_faults
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.files.repair import maps_to_make, repair
from benchnav.errors import DatasetError
from tests.factories import tiny_dataset, tiny_recipe


def content(path: Path) -> tuple[str, dict[str, np.ndarray]]:
    dataset = TerrainDataset(path)
    arrays = {f"{s}/{n}": a for s in dataset.splits for n, a in dataset.read(s).items()}
    with dataset.open() as file:
        arrays |= {s: file[s][schema.ENTRY_DIGESTS][()] for s in dataset.splits}
    return str(dataset.manifest), arrays


def same(one: tuple[str, dict[str, np.ndarray]], other: tuple[str, dict[str, np.ndarray]]) -> bool:
    return one[0] == other[0] and all(
        np.array_equal(one[1][name], other[1][name], equal_nan=one[1][name].dtype.kind == "f")
        for name in one[1]
    )


def mend(path: Path) -> dict[str, list[int]]:
    dataset = TerrainDataset(path)
    chosen = maps_to_make(dataset, find_faults(path))
    for _ in repair(dataset, chosen):
        pass
    return {split: indices.tolist() for split, indices in chosen.items() if len(indices)}


def flip(path: Path, split: str, field: str, index: int) -> None:
    with h5py.File(path, "r") as file:
        place = file[split][field].id.get_chunk_info(index)
    raw = bytearray(path.read_bytes())
    raw[place.byte_offset + place.size // 2] ^= 4
    path.write_bytes(raw)


def test_a_flipped_byte_is_named_and_exactly_its_map_made_anew(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    assert find_faults(path) == []
    before = content(path)
    flip(path, "train", "slope_deg", 5)
    flip(path, "test/hg", "rgb", 1)
    assert sorted(find_faults(path)) == [
        Fault("test/hg", 1, "rgb", "is damaged"),
        Fault("train", 5, "slope_deg", "is damaged"),
    ]
    with pytest.raises(DatasetError, match=r"slope_deg.*validate.*repair"):
        TerrainDataset(path).read("train")
    assert mend(path) == {"train": [5], "test/hg": [1]}
    assert find_faults(path) == []
    assert same(content(path), before)


def test_changed_values_with_sound_checksums_are_named_by_map_and_field(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = content(path)
    with h5py.File(path, "r+") as file:
        file["test/hs/traversability"][1, 2, 3] = 1.5
        file["train/elevation_m"][2, 0, 0] += 2.0**-13
        file["train/goal_m"][4] = [1, 1]
        file["valid/traversability"][0, 5, 5] = np.nan  # as of a cell not observed: in range
    found = {str(fault) for fault in find_faults(path)}
    assert found == {
        "test/hs: map 1: field 'traversability' is out of range",
        "test/hs: map 1: field 'traversability' does not match its digest",
        "train: map 2: field 'elevation_m' does not match its digest",
        "train: map 4: field 'goal_m' does not match its digest",
        "valid: map 0: field 'traversability' does not match its digest",
    }
    assert mend(path) == {"train": [2, 4], "valid": [0], "test/hs": [1]}
    assert same(content(path), before)


def test_a_missing_and_a_foreign_array_are_named_and_made_anew(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = content(path)
    with h5py.File(path, "r+") as file:
        del file["valid/class_id"], file["train/environment"]
        file["train/environment"] = np.zeros(3)
    problems = {(f.split, f.map, f.field) for f in find_faults(path)}
    assert problems == {("valid", -1, "class_id"), ("train", -1, "environment")}
    assert mend(path) == {"train": list(range(8)), "valid": [0, 1, 2]}
    assert same(content(path), before)


def test_damaged_digests_beside_sound_maps_make_no_map_anew(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = content(path)
    with h5py.File(path, "r+") as file:
        file["train"][schema.ENTRY_DIGESTS][3, 2, 0] ^= 1
    assert [str(f) for f in find_faults(path)] == [
        "train: map 3: field 'entry_digests' does not match the map"
    ]
    assert mend(path) == {}
    assert same(content(path), before)


def test_maps_and_digests_changed_together_are_found(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = content(path)
    with h5py.File(path, "r+") as file:
        file["train/class_id"][3] = 0
        changed = {name: file["train"][name][()] for name in schema.FIELDS}
        file["train"][schema.ENTRY_DIGESTS][...] = schema.entry_digests(changed)
    assert [f.map for f in find_faults(path)] == [-1]
    assert mend(path) == {"train": list(range(8))}
    assert same(content(path), before)


def test_repair_refuses_what_it_cannot_make(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    flip(path, "train", "rgb", 2)
    raw, dataset = path.read_bytes(), TerrainDataset(path)
    recipe = dataset.manifest["recipes"][0]
    recipe["classes"][0]["scale"] += 1
    with pytest.raises(DatasetError, match="cannot be repaired"):
        for _ in repair(
            dataset,
            {split: np.array([2]) for split in dataset.splits if split == "train"}
            | {split: np.array([], int) for split in dataset.splits if split != "train"},
        ):
            pass
    del dataset.splits["train"]["parts"][0]["recipe"]
    with pytest.raises(DatasetError, match=r"maps 2 of train .*import them again"):
        next(repair(dataset, {"train": np.array([2])}))
    assert path.read_bytes() == raw


@pytest.mark.parametrize("seed", range(3))
def test_every_random_flip_in_data_is_found_and_mended(tmp_path: Path, seed: int) -> None:
    recipe = replace(tiny_recipe(train=3, valid=1, test_std=1, test_hg=1, test_hs=1))
    path = tiny_dataset(tmp_path / "d.h5", recipe)
    sound, whole = content(path), path.read_bytes()
    generator = np.random.default_rng(seed)
    found = 0
    for at in generator.integers(len(whole), size=16):
        raw = bytearray(whole)
        raw[at] ^= 1 << int(generator.integers(8))
        path.write_bytes(raw)
        try:
            faults = find_faults(path)
            if faults:
                mend(path)
                assert same(content(path), sound)
        except DatasetError as error:
            # The manifest, or the structure around it: nothing to mend by.
            faults = [error]
        found += bool(faults)
        # Unused room between arrays is no data: a flip there changes nothing.
        assert faults or same(content(path), sound)
    assert found > 12


def test_damage_of_two_kinds_in_neighbouring_maps_is_named_and_mended(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = content(path)
    with h5py.File(path, "r+") as file:
        file["train/class_id"][5] = 1
    flip(path, "train", "rgb", 3)
    assert sorted(find_faults(path)) == [
        Fault("train", 3, "rgb", "is damaged"),
        Fault("train", 5, "class_id", "does not match its digest"),
    ]
    assert mend(path) == {"train": [3, 5]}
    assert same(content(path), before)


def test_a_file_is_mended_through_a_link_and_keeps_its_mode(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    path.chmod(0o600)
    (tmp_path / "link.h5").symlink_to(path)
    flip(path, "train", "rgb", 3)
    mend(tmp_path / "link.h5")
    assert (tmp_path / "link.h5").is_symlink()
    assert find_faults(path) == []
    assert path.stat().st_mode & 0o777 == 0o600
