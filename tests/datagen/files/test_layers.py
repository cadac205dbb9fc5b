"""Layers of a dataset: which fields are layers, and that every reader carries them."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from benchnav.core.errors import DatasetError
from benchnav.datagen import schema
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.create import create
from benchnav.datagen.files.hdf5 import ShardFile, pack, recipe_entry
from benchnav.datagen.files.maps import TerrainMaps
from benchnav.datagen.files.merge import merge
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.layers.vegetation import Growth
from benchnav.datagen.recipe.recipe import Recipe, Split
from benchnav.datagen.synth.generate import generate
from tests.commands import call
from tests.datagen.small import grown, small_stakes
from tests.factories import tiny_dataset, tiny_recipe

GRASS = Growth(height_m=(0.1, 0.8), cover=0.5, colour=(60, 110, 30))


def overgrown(**changes: object) -> Recipe:
    return grown(small_stakes(**changes), wet_clay=GRASS, gravel=GRASS, scree=GRASS)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_dataset(tmp_path_factory.mktemp("layers") / "small.h5", overgrown())


def foreign(
    folder: Path, unit: str = "1", **fields: tuple[str, tuple[str, ...]]
) -> TerrainDataset:
    """A dataset with fields of its own, by dtype and shape, all zero but a NaN in
    floats.
    """
    recipe = replace(tiny_recipe(), splits={"train": Split(scenario="std", maps=2)})
    own = {
        name: schema.Field(kind, shape, unit, -np.inf, np.inf, "mine")
        for name, (kind, shape) in fields.items()
    }
    maps = generate(recipe, "train", np.arange(2))
    for name, field in own.items():
        maps[name] = np.zeros((2, *field.entry_shape(32, 32)), field.dtype)
        if "f" in field.dtype:
            maps[name].flat[0] = np.nan
    entry = recipe_entry(recipe, ShardFile("train", 0, 2))
    content = pack(recipe, "train", entry, maps, schema.KNOWN | own)
    (folder / "foreign.h5").write_bytes(content)
    assert find_faults(folder / "foreign.h5") == []
    return TerrainDataset(folder / "foreign.h5")


def test_a_dataset_with_vegetation_is_of_1_3_and_lists_it(path: Path) -> None:
    dataset = TerrainDataset(path)
    assert dataset.manifest["format_version"] == "1.3"
    assert dataset.layer_names == ("vegetation_m",)
    assert dataset.field_names == (*schema.FIELDS, "vegetation_m")
    about = dataset.manifest["fields"]["vegetation_m"]
    assert (about["dtype"], about["shape"], about["unit"]) == ("<f4", [32, 32], "m")
    assert find_faults(path) == []
    made = generate(overgrown(), "train", np.arange(8))
    np.testing.assert_array_equal(
        dataset.read("train", fields=["vegetation_m"])["vegetation_m"],
        made["vegetation_m"],
    )
    assert made["vegetation_m"].any()


def test_one_without_stays_as_it_was(tmp_path: Path) -> None:
    dataset = TerrainDataset(tiny_dataset(tmp_path / "d.h5", small_stakes()))
    assert (dataset.manifest["format_version"], dataset.layer_names) == ("1.1", ())
    terrain = dataset.terrain("train")
    assert terrain.layers == terrain.observe().layers == {}


def test_terrain_and_what_is_seen_of_it_have_the_layers(path: Path) -> None:
    dataset = TerrainDataset(path)
    terrain, stored = dataset.terrain("train", [5, 2]), dataset.read("train", [5, 2])
    for layers in (terrain.layers, terrain.observe().layers):
        assert list(layers) == ["vegetation_m"]
        assert layers["vegetation_m"].dtype == torch.float32
        np.testing.assert_array_equal(
            layers["vegetation_m"].numpy(), stored["vegetation_m"]
        )


def test_maps_for_training_have_a_layer_by_name(path: Path) -> None:
    for in_memory in (False, True):
        maps = TerrainMaps(path, "train", ("vegetation_m", "rgb"), in_memory)
        np.testing.assert_array_equal(
            maps[3]["vegetation_m"].numpy(),
            TerrainDataset(path).read("train", [3])["vegetation_m"][0],
        )


def test_float_maps_that_are_not_known_are_layers_and_nothing_else_is(
    tmp_path: Path,
) -> None:
    dataset = foreign(
        tmp_path,
        thermal_inertia=("<f4", ("H", "W")),
        drive=("<i8", ()),
        mask=("|u1", ("H", "W")),
        doubles=("<f8", ("H", "W")),
        height=("<f4", ()),
        bands=("<f4", ("H", "W", "H", "W")),
        group=("<i8", ()),
    )
    assert dataset.layer_names == ("thermal_inertia",)
    (layer,) = dataset.terrain("train").layers.values()
    assert layer.isnan().sum() == 1


def test_optional_fields_that_are_known_are_no_layers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What else a dataset may say of λ, say, is not for a model to see."""
    spread = {"spread": schema.Field("<f4", ("H", "W"), "1", 0, 1, "of measured λ")}
    assert schema.layer_names(schema.FIELDS | spread) == ("spread",)
    monkeypatch.setattr(schema, "KNOWN", schema.KNOWN | spread)
    assert schema.layer_names(schema.FIELDS | spread) == ()


def test_a_folder_of_shards_has_the_same_layers(path: Path, tmp_path: Path) -> None:
    for _ in create(overgrown(), tmp_path / "folder", shard_cells=3 * 32 * 32):
        pass
    folder = TerrainDataset(tmp_path / "folder")
    assert folder.digest == TerrainDataset(path).digest
    assert folder.layer_names == ("vegetation_m",)
    (tmp_path / "folder" / "manifest.json").unlink()
    for _ in merge([tmp_path / "folder"], tmp_path / "again.h5"):
        pass
    assert TerrainDataset(tmp_path / "again.h5").digest == folder.digest


def test_datasets_with_one_set_of_layers_merge_and_others_are_refused_in_one_line(
    path: Path, tmp_path: Path
) -> None:
    sibling = tiny_dataset(tmp_path / "b.h5", overgrown(seed=4))
    for _ in merge([path, sibling], tmp_path / "both.h5"):
        pass
    both = TerrainDataset(tmp_path / "both.h5")
    assert both.layer_names == ("vegetation_m",)
    parts = [
        TerrainDataset(each).read("train")["vegetation_m"] for each in (path, sibling)
    ]
    np.testing.assert_array_equal(
        both.read("train")["vegetation_m"], np.concatenate(parts)
    )
    bare = tiny_dataset(tmp_path / "c.h5", small_stakes(seed=5))
    with pytest.raises(DatasetError) as caught:
        next(merge([path, bare], tmp_path / "no.h5"))
    assert "different fields (vegetation_m only in one dataset)" in str(caught.value)
    assert "\n" not in str(caught.value)
    other = tiny_dataset(
        tmp_path / "d.h5", grown(small_stakes(seed=6), 5.0, wet_clay=GRASS)
    )
    with pytest.raises(DatasetError, match="have different layers"):
        next(merge([path, other], tmp_path / "no.h5"))


def test_layers_of_one_name_and_another_unit_or_order_are_not_merged(
    tmp_path: Path,
) -> None:
    plane = ("<f4", ("H", "W"))
    datasets = []
    for name, unit, fields in (("x", "1", "ab"), ("y", "1", "ba"), ("z", "m", "ab")):
        (tmp_path / name).mkdir()
        datasets.append(
            foreign(tmp_path / name, unit, **dict.fromkeys(fields, plane)).path
        )
    first, swapped, measured = datasets
    with pytest.raises(
        DatasetError, match=r"different order of fields \(.*a, b / .*b, a\)"
    ):
        next(merge([first, swapped], tmp_path / "no.h5"))
    with pytest.raises(
        DatasetError, match=r"fields of different dtype, unit or meaning \(a, b\)"
    ):
        next(merge([first, measured], tmp_path / "no.h5"))


def test_damaged_and_impossible_values_are_found(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.h5"
    copy.write_bytes(path.read_bytes())
    with h5py.File(copy, "r+") as file:
        file["train/vegetation_m"][2, 0, 0] = -1
        file["train/vegetation_m"][3, 0, 0] = 201
        file["train/vegetation_m"][4, 0, 0] = np.nan
    found = {(fault.map, fault.field, fault.problem) for fault in find_faults(copy)}
    assert found == {
        *(
            (number, "vegetation_m", "does not match its digest")
            for number in (2, 3, 4)
        ),
        *((number, "vegetation_m", "is out of range") for number in (2, 3)),
    }


def test_what_models_record_covers_what_grows(path: Path, tmp_path: Path) -> None:
    dataset = TerrainDataset(path)
    taller = grown(
        overgrown(),
        wet_clay=replace(GRASS, height_m=(0.1, 0.9)),
        gravel=GRASS,
        scree=GRASS,
    )
    other = TerrainDataset(tiny_dataset(tmp_path / "t.h5", taller))
    assert dataset.about_digest("train") != other.about_digest("train")


def test_the_command_refuses_unlike_layers_in_one_line(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tiny_dataset(tmp_path / "bare.h5", small_stakes(seed=5))
    assert call("datagen", "merge", path, bare, "--out", tmp_path / "no.h5") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        f"{path} and {bare} have different fields (vegetation_m only in one dataset)"
        in line
    )
    assert not (tmp_path / "no.h5").exists()


def test_the_commands_name_layers(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*words: str) -> str:
        assert call("datagen", *words) == 0
        return capsys.readouterr().out

    assert "; layers vegetation_m" in said("list", "--folder", str(path.parent))
    shown = said("show", str(path))
    assert "height of the vegetation; 0 on bare ground" in shown
    assert "50% #3c6e1e 0.1–0.8 m" in shown
    assert "vegetation in patches with a period of 4 m" in shown
    assert '"vegetation_period_m": 4.0' in said("show", str(path), "--json")
    assert "sound" in said("validate", str(path))
