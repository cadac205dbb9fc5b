"""Format 1.0 stays readable, and its maps stay the same on every machine.

`tests/data/golden-1.0.h5` was made by `benchnav-datagen create tests/data/golden.yaml`.
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
from benchnav.datagen.generate import generate
from benchnav.datagen.scenario import load_recipe
from benchnav.datagen.store import TerrainDataset
from benchnav.datagen.validate import find_faults

DATA = Path(__file__).parent.parent / "data"
GOLDEN = DATA / "golden-1.0.h5"
DIGESTS = {
    "train": "e466dbe980b5796f6cc1b24c9c764c06a0ea38f881db1ceec6e5863bdd54db5b",
    "test/hg": "e488981e71592cc64bab2f150b382f32c1b71be822e98f7cdfc673ead85f71ba",
    "test/dusk": "4ddfa3680ac1bbbdf4b52397d234c37fdedc1336574f9123addc3c28741263b3",
}


def dispatched() -> list[str]:
    from numpy._core import _multiarray_umath as core

    return [name for name in core.__cpu_dispatch__ if core.__cpu_features__.get(name)]


def test_the_golden_file_is_sound_and_holds_what_its_recipe_makes() -> None:
    dataset = TerrainDataset(GOLDEN)
    assert find_faults(GOLDEN) == []
    assert {name: entry["digest"] for name, entry in dataset.splits.items()} == DIGESTS
    recipe = load_recipe(DATA / "golden.yaml")
    assert dataset.recipe == recipe
    for split, entry in dataset.splits.items():
        made = generate(recipe, split, np.arange(entry["maps"]))
        for name, values in dataset.read(split).items():
            np.testing.assert_array_equal(values, made[name])


def test_the_golden_file_is_laid_out_as_documented() -> None:
    with h5py.File(GOLDEN) as file:
        text = file["manifest"][()]
        assert set(file) == {"manifest", "train", "test"}
        for name, field in schema.FIELDS.items():
            array = file["test/hg"][name]
            assert array.dtype.str == field.dtype
            assert array.shape == (3, *field.entry_shape(16, 20))
            assert array.chunks[0] == (1 if "H" in field.shape else 3)
            assert (array.compression, array.shuffle, array.fletcher32) == ("gzip", True, True)
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
        {"NPY_DISABLE_CPU_FEATURES": " ".join(dispatched()), "ATEN_CPU_CAPABILITY": "default"},
        {"OPENBLAS_CORETYPE": "Prescott", "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F"},
        {"OMP_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "3"},
    ],
    ids=["no vector instructions", "plain BLAS and C library", "threads"],
)
def test_digests_are_the_same_on_other_processors(tmp_path: Path, settings: dict[str, str]) -> None:
    code = (
        "from pathlib import Path; from benchnav.datagen.scenario import load_recipe; "
        "from benchnav.datagen.create import create\n"
        f"for _ in create(load_recipe({str(DATA / 'golden.yaml')!r}), Path('d.h5')): pass"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=os.environ | settings, check=True)
    made = TerrainDataset(tmp_path / "d.h5")
    assert {name: entry["digest"] for name, entry in made.splits.items()} == DIGESTS
