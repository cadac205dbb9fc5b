import fcntl
import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from benchnav.core.errors import DatasetError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen import schema
from benchnav.datagen.files import manifest, reader
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.files.stored_terrain import terrain_of
from benchnav.datagen.recipe import classes
from benchnav.datagen.synth.generate import generate
from tests.datagen.small import small_stakes
from tests.factories import tiny_dataset, tiny_recipe


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
    assert terrain.truth.stds.dtype == torch.float32
    np.testing.assert_array_equal(
        terrain.rgb, dataset.read("train", [3, 5], ["rgb"])["rgb"]
    )


def test_the_truth_of_a_dataset_is_known_where_that_of_all_splits_is(
    dataset_path: Path,
) -> None:
    dataset = TerrainDataset(dataset_path)
    assert dataset.truth == "generated"
    dataset.manifest["splits"]["valid"]["parts"][0] = {
        "maps": 3,
        "source": {"file": "dem.tif", "photo": {"file": "p"}},
    }
    assert (dataset.truth, dataset.truth_of("train")) == ("unknown", "generated")
    assert [dataset.has_photo(split) for split in ("train", "valid")] == [False, True]


def test_a_locked_file_is_called_locked(dataset_path: Path, tmp_path: Path) -> None:
    path = tmp_path / "locked.h5"
    shutil.copy(dataset_path, path)
    with open(path) as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(
            DatasetError,
            match=r"not locked, got .*locked\.h5: .*Close the program that writes to it\.$",
        ):
            TerrainDataset(path)
    TerrainDataset(path)


def test_dimensions_have_scales_with_the_centres_of_cells(dataset_path: Path) -> None:
    dataset = TerrainDataset(dataset_path)
    height, width = dataset.grid.shape
    y, x = dataset.grid.centre_of(torch.arange(height), torch.arange(width))
    with h5py.File(dataset_path) as file:
        for split in dataset.splits:
            for name, array in file[split].items():
                if array.is_scale:
                    continue
                labels = [
                    [scale.name for scale in dimension.values()]
                    for dimension in array.dims
                ]
                assert [label[0].rsplit("/")[-1] for label in labels] == {
                    **{name: ["map_index", "y_m", "x_m"] for name in schema.MAP_FIELDS},
                    "rgb": ["map_index", "axis_3", "y_m", "x_m"],
                    **{key: ["map_index", "axis_2"] for key in ("start_m", "goal_m")},
                    **{
                        key: ["map_index"]
                        for key in ("environment", "reference_time_s")
                    },
                    "entry_digests": ["map_index", "axis_9", "axis_32"],
                }[name], name
                for size, dimension in zip(array.shape, array.dims, strict=True):
                    assert [scale.shape for scale in dimension.values()] == [(size,)]
            np.testing.assert_allclose(file[split]["y_m"], y)
            np.testing.assert_allclose(file[split]["x_m"], x)


def test_a_damaged_scale_is_found(dataset_path: Path, tmp_path: Path) -> None:
    path = tmp_path / "damaged.h5"
    raw = bytearray(dataset_path.read_bytes())
    with h5py.File(dataset_path) as file:
        raw[file["valid/y_m"].id.get_chunk_info(0).byte_offset + 3] ^= 1
    path.write_bytes(raw)
    assert [str(fault) for fault in find_faults(path)] == [
        "valid: field 'y_m' is damaged"
    ]


def test_foreign_newer_and_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        TerrainDataset(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(DatasetError, match="a readable HDF5"):
        TerrainDataset(tmp_path / "text.h5")
    path = tiny_dataset(tmp_path / "d.h5")
    rewrite(path, {"format_version": "1.5"})
    with pytest.raises(DatasetError, match="newer benchnav"):
        TerrainDataset(path)
    rewrite(path, {"format": "other"})
    with pytest.raises(DatasetError, match="got 'other'"):
        TerrainDataset(path)


def test_a_changed_manifest_is_found(tmp_path: Path) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    raw = path.read_bytes()
    at = raw.index(b'"scale": 2.0')
    path.write_bytes(raw[:at] + raw[at:].replace(b'"scale": 2.0', b'"scale": 3.0', 1))
    with pytest.raises(DatasetError, match="was changed after benchnav wrote it"):
        TerrainDataset(path)


def rewrite(path: Path, changes: dict[str, str]) -> None:
    with h5py.File(path, "r+") as file:
        manifest = json.loads(file["manifest"][()]) | changes
        del file["manifest"]
        file["manifest"] = json.dumps(manifest)


def test_bad_requests_are_named(dataset_path: Path) -> None:
    dataset = TerrainDataset(dataset_path)
    with pytest.raises(DatasetError, match="test/std"):
        dataset.read("nope")
    with pytest.raises(DatasetError, match="0–7"):
        dataset.read("train", [8])
    for indices in ([-1], [0.5]):
        with pytest.raises(DatasetError, match="0–7"):
            dataset.read("train", indices)  # type: ignore[arg-type]
    with pytest.raises(DatasetError, match=r"fields.*'colour'"):
        dataset.read("train", fields=["colour"])
    assert dataset.read("train", [], ["rgb"])["rgb"].shape == (0, 3, 32, 32)
    assert dataset.read("train", fields=[]) == {}
    with pytest.raises(DatasetError, match="neither a dataset"):
        find_dataset("no-such-id")


def test_components_belong_to_the_class_whose_soft_spots_they_hold() -> None:
    """The truth as one class, and what looks alike by its classes: single-class
    settings choose among these.
    """
    recipe = small_stakes()
    terrain = terrain_of(generate(recipe, "train", np.arange(4)), recipe)
    assert terrain.truth.group == (0, 0)
    assert terrain.look_alikes is not None
    seen = terrain.look_alikes(terrain)
    table = classes.look_alike_classes(recipe.classes)
    shares = torch.zeros(len(table), len(table))
    for number, own in enumerate(table):
        shares[number, list(own)] = 1 / len(own)
    found = seen.class_probabilities(len(table)).movedim(1, -1)
    torch.testing.assert_close(found, shares[terrain.class_id])
    assert {len(own) for own in table} == {1, 2}
    # Under each class with its own λ.
    own = torch.tensor(seen.group)[:, None, None] == terrain.class_id[:, None]
    of_class = TraversabilityMixture(
        torch.where(own, seen.weights, 0.0), seen.means, seen.stds
    )
    torch.testing.assert_close(of_class.mean(), terrain.truth.mean())


class Tight:
    """An array of which one map at a time can be read, as where memory is short."""

    def __init__(self, values: np.ndarray, damaged: int = -1) -> None:
        self.values, self.damaged = values, damaged

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, which: object) -> np.ndarray:
        found = self.values[which]
        if len(found) > 1 or self.damaged in found:
            raise OSError("no room")
        return found


@pytest.mark.parametrize("which", [slice(0, 6), slice(1, 5)])
def test_want_of_memory_is_not_taken_for_damage(which: slice) -> None:
    values = np.arange(6)
    np.testing.assert_array_equal(reader._values(Tight(values), which), values[which])
    with pytest.raises(OSError, match="no room"):
        reader._values(Tight(values, damaged=4), which)
    assert not issubclass(MemoryError, manifest.READ_ERRORS)


def test_recorded_digests_cover_what_maps_mean(tmp_path: Path) -> None:
    dataset = TerrainDataset(tiny_dataset(tmp_path / "d.h5"))
    recipe, split = tiny_recipe(), "train"
    kinds = (replace(recipe.classes[0], noise=0.123), *recipe.classes[1:])
    digests = {dataset.split_digest(split)}
    for changed in (
        recipe,
        replace(recipe, classes=kinds),
        replace(recipe, stuck_threshold=0.17),
        replace(recipe, resolution_m=0.6),
    ):
        other = TerrainDataset(dataset.path)
        other.recipe = changed  # of the same arrays
        digests.add(other.split_digest(split))
    other = TerrainDataset(dataset.path)
    other.manifest["splits"][split]["parts"] = [{"maps": 8, "source": {}}]
    assert (dataset.truth_of(split), other.truth_of(split)) == ("generated", "unknown")
    assert other.truth_of("valid") == "generated"
    mixed = TerrainDataset(dataset.path)
    mixed.manifest["splits"][split]["parts"] = [
        {"maps": 7, "recipe": 0},
        {"maps": 1, "source": {}},
    ]
    assert mixed.truth_of(split) == "unknown"
    digests.add(other.split_digest(split))
    assert len(digests) == 5
    assert dataset.about_digest("train") == dataset.about_digest("valid")
    assert dataset.split_digest("train") != dataset.split_digest("valid")
    assert dataset.digest.startswith(f"train:{dataset.split_digest('train')},")
