"""Formats 1.0 and 1.1 stay readable, and their maps stay the same on every machine.

`tests/data/golden-1.0.h5` was made by `benchnav-datagen create tests/data/golden.yaml`,
and `golden-1.1.h5` by `benchnav-datagen create tests/datagen/files/golden-1.1.yaml`.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchnav.datagen import schema
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.synth.generate import generate

DATA = Path(__file__).parent.parent.parent / "data"
GOLDEN = DATA / "golden-1.0.h5"
DIGESTS = {
    "train": "e466dbe980b5796f6cc1b24c9c764c06a0ea38f881db1ceec6e5863bdd54db5b",
    "test/hg": "e488981e71592cc64bab2f150b382f32c1b71be822e98f7cdfc673ead85f71ba",
    "test/dusk": "4ddfa3680ac1bbbdf4b52397d234c37fdedc1336574f9123addc3c28741263b3",
}
SECOND = Path(__file__).parent / "golden-1.1.h5"
SECOND_DIGESTS = {
    "train": "ab407c74c577c024148a7baf8a99ab4ae1d67072133ca6a3190c33057873ca5c",
    "test/hg": "da7da0122f061b7e8f81a28f2baa8a1077e6eb5e3f1ec2710a8f583b6ead4381",
    "test/dusk": "f8b99914ddda6379c6b7756dc706b8c9d0bb03ef60ccb5199b0e1744ce276f23",
}
VERSIONS = [
    pytest.param("1.0", GOLDEN, DATA / "golden.yaml", DIGESTS, id="1.0"),
    pytest.param("1.1", SECOND, SECOND.with_suffix(".yaml"), SECOND_DIGESTS, id="1.1"),
]


def dispatched() -> list[str]:
    from numpy._core import _multiarray_umath as core

    return [name for name in core.__cpu_dispatch__ if core.__cpu_features__.get(name)]


@pytest.mark.parametrize(("version", "path", "source", "digests"), VERSIONS)
def test_the_golden_file_is_sound_and_holds_what_its_recipe_makes(
    version: str, path: Path, source: Path, digests: dict[str, str]
) -> None:
    dataset = TerrainDataset(path)
    assert dataset.manifest["format_version"] == version
    assert find_faults(path) == []
    assert {name: entry["digest"] for name, entry in dataset.splits.items()} == digests
    recipe = load_recipe(source)
    assert dataset.recipe == recipe
    for split, entry in dataset.splits.items():
        made = generate(recipe, split, np.arange(entry["maps"]))
        for name, values in dataset.read(split).items():
            np.testing.assert_array_equal(values, made[name])


def test_version_1_1_has_the_fields_of_1_0(tmp_path: Path) -> None:
    first, second = TerrainDataset(GOLDEN).manifest, TerrainDataset(SECOND).manifest
    assert list(first) == list(second)
    assert first["fields"] == second["fields"]
    new = {"synthesis", "places", "correlation_m"}
    assert set(second["recipes"][0]) - set(first["recipes"][0]) == new
    assert set(first["recipes"][0]) - set(second["recipes"][0]) == {"start_m", "goal_m"}


def test_version_1_0_is_written_as_ever(tmp_path: Path) -> None:
    path = tmp_path / "d.h5"
    for _ in create(load_recipe(DATA / "golden.yaml"), path):
        pass
    with h5py.File(path) as made, h5py.File(GOLDEN) as golden:
        texts = [json.loads(file["manifest"][()]) for file in (made, golden)]
    for text in texts:
        del text["generator"], text["manifest_digest"]
    assert json.dumps(texts[0]) == json.dumps(texts[1])


def test_the_golden_file_is_laid_out_as_documented() -> None:
    with h5py.File(GOLDEN) as file:
        text = file["manifest"][()]
        assert set(file) == {"manifest", "train", "test"}
        for name, field in schema.FIELDS.items():
            array = file["test/hg"][name]
            assert array.dtype.str == field.dtype
            assert array.shape == (3, *field.entry_shape(16, 20))
            assert array.chunks[0] == (1 if "H" in field.shape else 3)
            assert (array.compression, array.shuffle, array.fletcher32) == (
                "gzip",
                True,
                True,
            )
            assert array.attrs["unit"] == field.unit
        assert file["test/hg/entry_digests"].shape == (3, 9, 32)
    manifest = json.loads(text)
    assert set(manifest) == {
        "format", "format_version", "id", "generator", "fields", "splits", "recipes", "manifest_digest",
    }  # fmt: skip
    assert manifest["splits"]["test/dusk"] == {
        "scenario": "dusk",
        "maps": 2,
        "parts": [{"maps": 2, "recipe": 0, "split": "test/dusk", "first": 0}],
        "digest": DIGESTS["test/dusk"],
    }


@pytest.mark.parametrize(
    "settings",
    [
        {
            "NPY_DISABLE_CPU_FEATURES": " ".join(dispatched()),
            "ATEN_CPU_CAPABILITY": "default",
        },
        {
            "OPENBLAS_CORETYPE": "Prescott",
            "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F",
        },
        {"OMP_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "3"},
    ],
    ids=["no vector instructions", "plain BLAS and C library", "threads"],
)
def test_digests_are_the_same_on_other_processors(
    tmp_path: Path, settings: dict[str, str]
) -> None:
    sources = [str(DATA / "golden.yaml"), str(SECOND.with_suffix(".yaml"))]
    code = (
        "from pathlib import Path; from benchnav.datagen.recipe.load import load_recipe; "
        "from benchnav.datagen.files.create import create\n"
        f"for number, source in enumerate({sources!r}):\n"
        "    for _ in create(load_recipe(source), Path(f'{number}.h5')): pass"
    )
    subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | settings,
        check=True,
    )
    for number, digests in enumerate((DIGESTS, SECOND_DIGESTS)):
        made = TerrainDataset(tmp_path / f"{number}.h5")
        assert {name: entry["digest"] for name, entry in made.splits.items()} == digests
