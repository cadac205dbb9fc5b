"""A user's layer from a file, through the commands: made, drawn, shown, read without
its code, driven on.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from benchnav.core import part_lookup, registry
from benchnav.core.errors import ConfigError
from benchnav.datagen import (
    TerrainDataset,
    create_dataset,
    generate,
    load_recipe,
    recipe_from_dict,
)
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.layers.layer import Layer
from tests.commands import call
from tests.datagen.layers.own import PAGE, Plain, write_page
from tests.datagen.small import small_stakes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the layer and the recipe of the page, and its dataset as the
    command makes it.
    """
    folder = tmp_path_factory.mktemp("own")
    write_page(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert call("datagen", "create", "wet.yaml", "--out", "one.h5") == 0
        assert call("datagen", "create", "wet.yaml", "--out", "two", "--jobs", 2) == 0
    return folder


def test_a_layer_on_the_page_is_at_most_40_lines() -> None:
    assert len(PAGE["wet.py"].splitlines()) <= 40


def test_one_and_two_processes_make_the_same_maps(folder: Path) -> None:
    one, two = (TerrainDataset(folder / name) for name in ("one.h5", "two"))
    assert one.digest == two.digest
    assert one.layer_names == ("wetness",)
    assert one.manifest["format_version"] == "1.4"
    assert find_faults(one.path) == find_faults(two.path) == []


def test_the_manifest_says_whose_code_drew_the_layer(folder: Path) -> None:
    (layer,) = TerrainDataset(folder / "one.h5").manifest["recipes"][0]["layers"]
    assert (layer["part"], layer["source"]) == ("wet.py:Wetness", "file wet.py")
    assert layer["options"] == {"period_m": 6.0, "loss": 0.7}
    assert len(layer["digest"]) == 64
    assert layer["affects"] is True
    assert layer["hides"] is False


def test_the_commands_show_it(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert call("datagen", "show", "one.h5") == 0
    shown = capsys.readouterr().out
    assert "layer wetness (period_m 6.0, loss 0.7)" in shown
    assert "file wet.py, digest " in shown
    assert call("datagen", "show", "one.h5", "--json") == 0
    assert json.loads(capsys.readouterr().out)["drawn_layers"][0]["name"] == "wetness"
    assert call("datagen", "validate", "one.h5") == 0
    assert (
        call(
            "datagen",
            "preview",
            "one.h5",
            "--split",
            "train",
            "--maps",
            "[0]",
            "--out",
            "p.png",
        )
        == 0
    )
    assert (folder / "p.png").stat().st_size > 10_000


def test_a_dataset_is_read_and_driven_on_without_the_code(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)  # where there is no wet.py
    dataset = TerrainDataset(folder / "one.h5")
    terrain = dataset.terrain("train", [2, 0])
    stored = dataset.read("train", [2, 0])
    np.testing.assert_array_equal(terrain.layers["wetness"].numpy(), stored["wetness"])
    np.testing.assert_array_equal(terrain.truth.means.numpy(), stored["truth_mean"])
    assert call("datagen", "show", dataset.path) == 0
    words = (
        "--models",
        "[oracle]",
        "--planners",
        "[straight]",
        "--world",
        "stakes",
        "--seeds",
        "[0]",
        "--maps",
        2,
    )
    assert (
        call("eval", "run", "--data", dataset.path, *words, "--out", "run", "--jobs", 2)
        == 0
    )
    capsys.readouterr()
    with pytest.raises(ConfigError) as caught:
        generate(dataset.recipe, "train", np.arange(1))
    assert str(caught.value).startswith(
        "Expected the code of layer 'wetness' to be available for"
    )
    assert "\n" not in str(caught.value)


def test_other_code_than_was_recorded_is_rejected(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wet.py").write_text(
        PAGE["wet.py"].replace("0.3 * hollows", "0.4 * hollows")
    )
    recipe = TerrainDataset(folder / "one.h5").recipe
    with pytest.raises(
        ConfigError,
        match="Expected the code of layer 'wetness' to have the digest",
    ):
        generate(recipe, "train", np.arange(1))
    # With the code as it was, the maps are made again, bit for bit.
    (tmp_path / "wet.py").write_text(PAGE["wet.py"])
    again = generate(TerrainDataset(folder / "one.h5").recipe, "train", np.arange(2))
    stored = TerrainDataset(folder / "one.h5").read("train", [0, 1])
    for name, values in again.items():
        np.testing.assert_array_equal(values, stored[name])


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            ("return mean *", "return 3 + mean *"),
            "means of `affect` of layer 'wetness' in [0, 1]",
        ),
        (
            ("return rgb *", "return np.nan * rgb *"),
            "colours of `look` of layer 'wetness' in [0, 255], got nan",
        ),
        (
            ("return np.clip", "return noise[0]; np.clip"),
            "values of `draw` of layer 'wetness' of shape",
        ),
        (
            ("np.clip(", "np.slip("),
            "`draw` of layer 'wetness' failed: AttributeError",
        ),
        (
            ("class Wetness(Layer)", "class Wetness"),
            "to be an instance of benchnav.datagen.Layer",
        ),
    ],
)
def test_a_bad_layer_ends_the_command_in_one_line(
    change: tuple[str, str],
    expected: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_page(tmp_path)
    assert PAGE["wet.py"].count(change[0]) == 1
    (tmp_path / "wet.py").write_text(PAGE["wet.py"].replace(*change))
    assert call("datagen", "create", "wet.yaml", "--out", "d.h5") == 2
    error = capsys.readouterr().err
    assert [
        line for line in error.splitlines() if "error:" in line
    ] == error.splitlines()[-1:]
    assert expected in error
    assert not (tmp_path / "d.h5").exists()


def test_a_recipe_with_a_layer_is_changed_by_its_place_in_the_list(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    recipe = load_recipe("wet.yaml", ["id=wetter", "layers.0.options.loss=0.9"])
    assert recipe.layers[0].options["loss"] == 0.9
    about = TerrainDataset(folder / "one.h5").about_digest("train")
    steps = create_dataset(recipe, folder / "wetter.h5")
    assert sum(1 for _ in steps) > 0
    assert TerrainDataset(folder / "wetter.h5").about_digest("train") != about


def test_a_layer_of_this_process_only_is_not_made_in_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})
    registry.register("layer", "mine", Plain)
    recipe = recipe_from_dict(small_stakes().to_dict() | {"layers": ["mine"]}, "test")
    with pytest.raises(
        ConfigError, match=r"a single process, got several\. The class of layer 'plain'"
    ):
        next(create_dataset(recipe, tmp_path / "d.h5", jobs=2))
    assert generate(recipe, "train", np.arange(1))["plain"].shape == (1, 32, 32)


def test_the_base_class_has_no_effect() -> None:
    assert not Layer.affects()
    assert not Layer.hides()
