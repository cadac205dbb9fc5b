import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from benchnav.datagen import schema
from benchnav.datagen.generate import generate
from benchnav.datagen.store import TerrainDataset, create, find_dataset
from benchnav.datagen.validate import find_faults
from benchnav.errors import BenchnavError, DatasetError
from tests.factories import tiny_dataset, tiny_recipe


def digests(path: Path) -> dict[str, str]:
    return {name: split["digest"] for name, split in TerrainDataset(path).splits.items()}


def test_digest_does_not_depend_on_workers_or_blocks(tmp_path: Path) -> None:
    recipe = tiny_recipe(train=13)
    found = []
    for name, jobs, block in (("a", 1, 100), ("b", 2, 3), ("c", 1, 5)):
        path = tmp_path / f"{name}.h5"
        for _ in create(recipe, path, jobs=jobs, block_maps=block):
            pass
        found.append(digests(path))
    assert found[0] == found[1] == found[2]
    assert len(set(found[0].values())) == 5


def test_what_is_read_is_what_was_generated(dataset_path: Path) -> None:
    dataset = TerrainDataset(dataset_path)
    recipe, manifest = tiny_recipe(), json.dumps(dataset.manifest)
    assert dataset.recipe == recipe
    assert json.dumps(dataset.manifest) == manifest
    for split in dataset.splits:
        made = generate(recipe, split, np.arange(2))
        read = dataset.read(split, [0, 1])
        for name in schema.FIELDS:
            np.testing.assert_array_equal(made[name], read[name])
    terrain = dataset.terrain("train", [3, 5])
    assert terrain.class_id.dtype == torch.int64
    assert terrain.traversability_std.dtype == torch.float32
    np.testing.assert_array_equal(terrain.rgb, dataset.read("train", [3, 5], ["rgb"])["rgb"])


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    before = path.read_bytes()
    with pytest.raises(DatasetError, match="exists"):
        tiny_dataset(path)
    assert path.read_bytes() == before


def test_a_killed_run_leaves_no_file_and_goes_on_to_the_same_digest(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    code = (
        "from pathlib import Path; from tests.factories import tiny_recipe; from benchnav.datagen.store import create\n"
        f"for _ in create(tiny_recipe(train=4000), Path({str(path)!r}), block_maps=20): pass"
    )
    process = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[2])
    folder = tmp_path / ".d.h5.partial"
    while len(list(folder.glob("*.npz"))) < 4:
        time.sleep(0.02)
        assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not path.exists()
    finished = {block: block.stat().st_mtime_ns for block in folder.glob("*.npz")}
    recipe = tiny_recipe(train=4000)
    steps = create(recipe, path, block_maps=20)
    done, total = next(steps)
    assert done > 20 * (len(finished) - 1)
    assert total == 4009
    # Not carried to the end here; the kept blocks stand untouched.
    steps.close()
    assert all(block.stat().st_mtime_ns == when for block, when in finished.items())


def test_a_resumed_run_has_the_digest_of_an_unbroken_one(tmp_path: Path) -> None:
    recipe = tiny_recipe(train=12)
    broken, whole = tmp_path / "broken.h5", tmp_path / "whole.h5"
    steps = create(recipe, broken, block_maps=4)
    next(steps)
    next(steps)
    steps.close()
    assert not broken.exists()
    for path in (broken, whole):
        for _ in create(recipe, path, block_maps=4):
            pass
    assert digests(broken) == digests(whole)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["broken.h5", "whole.h5"]


def test_two_runs_on_one_file_refuse_each_other(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    first = create(tiny_recipe(), path, block_maps=4)
    next(first)
    with pytest.raises(BenchnavError, match="Another run"):
        next(create(tiny_recipe(), path, block_maps=4))
    first.close()


def test_validate_finds_a_flipped_byte_and_a_changed_value(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    assert find_faults(path) == []
    with h5py.File(path, "r") as file:
        place = file["train"]["slope_deg"].id.get_chunk_info(5)
    raw = bytearray(path.read_bytes())
    raw[place.byte_offset + place.size // 2] ^= 4
    path.write_bytes(raw)
    assert find_faults(path) == ["train: map 5: field 'slope_deg' is damaged"]
    with pytest.raises(DatasetError, match=r"slope_deg.*validate"):
        TerrainDataset(path).read("train")

    path = tiny_dataset(tmp_path / "e.h5")
    with h5py.File(path, "r+") as file:
        file["test/hs"]["traversability"][1, 2, 3] = 1.5
    faults = find_faults(path)
    assert "test/hs: map 1: field 'traversability' is out of range" in faults
    assert any("content digest" in fault for fault in faults)


def test_foreign_newer_and_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="not there"):
        TerrainDataset(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(DatasetError, match="no readable HDF5"):
        TerrainDataset(tmp_path / "text.h5")
    path = tiny_dataset(tmp_path / "d.h5")
    with h5py.File(path, "r+") as file:
        manifest = json.loads(file["manifest"][()]) | {"format_version": "1.1"}
        del file["manifest"]
        file["manifest"] = json.dumps(manifest)
    with pytest.raises(DatasetError, match="newer benchnav"):
        TerrainDataset(path)


def test_bad_requests_are_named(dataset_path: Path) -> None:
    dataset = TerrainDataset(dataset_path)
    with pytest.raises(DatasetError, match="test/std"):
        dataset.read("nope")
    with pytest.raises(DatasetError, match="0–7"):
        dataset.read("train", [8])
    with pytest.raises(DatasetError, match="neither a file"):
        find_dataset("no-such-id")
