import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.datagen import cli
from benchnav.datagen.files import create
from benchnav.datagen.files.hdf5 import ShardFile
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.classes import SoftSpots
from benchnav.datagen.recipe.load import load_recipe, shipped_recipes
from benchnav.datagen.recipe.recipe import Recipe
from tests.commands import call
from tests.factories import tiny_dataset

Call = Callable[..., int]

SMALL = ["id=small", "splits.train.maps=3", "splits.valid.maps=1"]
RECIPE = (Path(cli.__file__).parent / "recipe" / "tiny-v1.yaml").read_text()


@pytest.fixture
def datagen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Call:
    """Runs the command in an empty folder and gives its exit status."""
    monkeypatch.chdir(tmp_path)

    return partial(call, "datagen")


def test_a_dataset_from_making_to_mending(
    datagen: Call, tmp_path: Path, capsys
) -> None:  # type: ignore[no-untyped-def]
    assert (
        datagen("create", "tiny-v1", "--out", "d.h5", "--splits", "[test/std,test/hg]")
        == 0
    )
    assert datagen("create", "tiny-v1", "--out", "d.h5") == 2
    capsys.readouterr()
    assert datagen("show", "d.h5") == 0
    shown = capsys.readouterr().out
    assert "scree" in shown
    assert TerrainDataset("d.h5").splits["test/hg"]["digest"] in shown
    assert datagen("show", "d.h5", "--json") == 0
    described = json.loads(capsys.readouterr().out)
    assert described["splits"]["test/hg"]["maps"] == 4
    assert described["classes"][5]["name"] == "scree"
    assert 0 < described["splits"]["test/hg"]["stored_bytes"] < described["bytes"]
    assert datagen("validate", "d.h5") == 0
    assert (
        datagen(
            "preview", "d.h5", "--split", "test/hg", "--maps", "[1]", "--out", "p.png"
        )
        == 0
    )
    assert datagen("preview", "d.h5", "--split", "test/hg", "--contact-sheet") == 0
    for picture in ("p.png", "contact-test-hg.png"):
        assert (tmp_path / picture).stat().st_size > 5_000
    assert datagen("list", "--folder", ".") == 0
    assert "tiny-v1" in capsys.readouterr().out
    with h5py.File("d.h5") as file:
        chunk = file["test/hg"]["elevation_m"].id.get_chunk_info(0)
    whole = Path("d.h5").read_bytes()
    raw = bytearray(whole)
    raw[chunk.byte_offset + 9] ^= 255
    Path("d.h5").write_bytes(raw)
    capsys.readouterr()
    assert datagen("validate", "d.h5") == 1
    told = capsys.readouterr().out
    assert "test/hg: map 0: field 'elevation_m' is damaged" in told
    assert "create the file again with --overwrite" in told


def test_damage_is_one_line_for_every_command(datagen: Call, capsys) -> None:  # type: ignore[no-untyped-def]
    assert (
        datagen("create", "tiny-v1", *SMALL, "--splits", "[train]", "--out", "d.h5")
        == 0
    )
    with h5py.File("d.h5", "r+") as file:
        del file["train/slope_deg"], file["train/entry_digests"]
    for arguments in (["show", "d.h5"], ["merge", "d.h5", "d.h5", "--out", "m.h5"]):
        capsys.readouterr()
        assert datagen(*arguments) == 2
        assert "validate" in capsys.readouterr().err
    whole = Path("d.h5").read_bytes()
    Path("d.h5").write_bytes(whole[: len(whole) // 2])
    capsys.readouterr()
    assert datagen("validate", "d.h5") == 1
    assert "1 fault" in capsys.readouterr().out


def test_parts_made_apart_are_merged(datagen: Call) -> None:
    assert (
        datagen("create", "tiny-v1", *SMALL, "--splits", "[train]", "--out", "a.h5")
        == 0
    )
    assert (
        datagen(
            "create",
            "tiny-v1",
            *SMALL,
            "--splits",
            "[valid]",
            "--out",
            "b.h5",
            "--jobs",
            "2",
        )
        == 0
    )
    assert datagen("merge", "a.h5", "b.h5", "--out", "c.h5") == 0
    assert TerrainDataset("c.h5").id == "c"
    assert set(TerrainDataset("c.h5").splits) == {"train", "valid"}
    assert datagen("merge", "a.h5", "c.h5", "--out", "e.h5") == 2


def test_shards_made_apart_are_one_dataset(datagen: Call, capsys) -> None:  # type: ignore[no-untyped-def]
    assert datagen("create", "tiny-v1", *SMALL, "--out", "whole.h5") == 0
    for index, folder in ((1, "part1"), (2, "part2")):
        assert (
            datagen(
                "create", "tiny-v1", *SMALL, "--shard", f"{index}/2", "--out", folder
            )
            == 0
        )
        assert f"{folder}: shard {index}/2 is complete" in capsys.readouterr().out
    assert datagen("show", "part1") == 2
    assert "merge" in capsys.readouterr().err
    assert datagen("merge", "part1", "part2", "--out", "big") == 0
    assert " files)" in capsys.readouterr().out
    assert datagen("merge", "part1", "part2", "--out", "one.h5") == 0
    assert (
        TerrainDataset("big").digest
        == TerrainDataset("one.h5").digest
        == TerrainDataset("whole.h5").digest
    )
    assert (TerrainDataset("big").id, TerrainDataset("one.h5").id) == ("small", "small")
    for command in (["show"], ["validate"], ["preview", "--out", "p.png"]):
        assert datagen(command[0], "big", *command[1:]) == 0
    capsys.readouterr()
    assert datagen("list", "--folder", ".") == 0
    listed = capsys.readouterr().out
    assert "  big " in listed
    assert "part1" not in listed
    assert datagen("merge", "part1", "--out", "some") == 2
    assert "of valid" in capsys.readouterr().err
    assert datagen("create", "tiny-v1", *SMALL, "--out", "big") == 2
    assert "exists" in capsys.readouterr().err
    (shard,) = Path("big").glob("train*")
    shard.unlink()
    assert datagen("validate", "big") == 1
    assert (
        f"remove {shard.name} in big and run the command that created it again"
        in capsys.readouterr().out
    )
    assert datagen("create", "tiny-v1", *SMALL, "--out", "big") == 0
    assert datagen("validate", "big") == 0


def test_options_of_create_reach_it(
    datagen: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def watched(recipe: Recipe, path: Path, *how: object) -> Iterator[tuple[int, int]]:
        seen.append(how)
        raise ConfigError("seen")

    monkeypatch.setattr("benchnav.datagen.create_dataset", watched)
    plain = ("create", "tiny-v1", "--out", "d")
    for options in (
        (), ("--jobs", "3"), ("--backend", "dask", "--scheduler", "tcp://a:1"), ("--shard", "2/3"), ("--overwrite",),
    ):  # fmt: skip
        assert datagen(*plain, *options) == 2
    none = (1, "", None, False)
    assert seen == [
        none, (3, "", None, False), (1, "tcp://a:1", None, False), (1, "", Shard(index=2, of=3), False),
        (1, "", None, True),
    ]  # fmt: skip


def test_a_large_dataset_is_a_folder(
    datagen: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "_MAX_CELLS_PER_FILE", 32 * 32 * 4)
    Path("datasets").mkdir()
    assert (
        datagen("create", "tiny-v1", "--first", "2", "--splits", "[train,valid]") == 0
    )
    assert (
        datagen(
            "create",
            "tiny-v1",
            "--first",
            "3",
            "--splits",
            "[train,valid]",
            "--seed",
            "1",
        )
        == 0
    )
    assert TerrainDataset("datasets/tiny-v1.h5").map_count("train") == 2
    assert TerrainDataset("datasets/tiny-v1-seed1").map_count("train") == 3


def write_ground(name: str, values: np.ndarray) -> None:
    rasterio = pytest.importorskip("rasterio")
    bands, height, width = values.shape
    north_up = rasterio.transform.from_origin(400_000, 4_000_000, 0.5, 0.5)
    with rasterio.open(
        name, "w", driver="GTiff", height=height, width=width, count=bands, dtype=values.dtype, crs="EPSG:32654",
        transform=north_up, nodata=-9999 if values.dtype == np.float32 else None,
    ) as raster:  # fmt: skip
        raster.write(values)


def test_real_ground_is_imported(datagen: Call, capsys) -> None:  # type: ignore[no-untyped-def]
    ground = np.linspace(0, 2, 70 * 40, dtype=np.float32).reshape(1, 40, 70)
    ground[0, 20, 60] = -9999
    write_ground("site.tif", ground)
    assert (
        datagen("import-dem", "site.tif", "--out", "site.h5", "--recipe", "tiny-v1")
        == 0
    )
    assert "left out of test/real: 1 missing elevation" in capsys.readouterr().out
    made = TerrainDataset("site.h5")
    assert made.splits["test/real"]["maps"] == 1
    assert made.id == "site"
    assert datagen("show", "site.h5") == 0
    assert "1 of site.tif" in capsys.readouterr().out
    assert datagen("validate", "site.h5") == 0
    assert datagen("import-dem", "nope.tif", "--out", "x.h5") == 2
    assert (
        "`dem` to be a raster that GDAL can read, got nope.tif"
        in capsys.readouterr().err
    )


def test_an_import_passes_every_setting_on(datagen: Call, capsys) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(0)
    write_ground("site.tif", rng.random((1, 20, 240), np.float32))
    write_ground("cover.tif", np.full((1, 20, 240), 40, np.uint8))
    write_ground("photo.tif", np.full((3, 20, 240), 77, np.uint8))
    write_ground("lambda.tif", np.full((1, 20, 240), 0.25, np.float32))
    changes = (
        "height=16",
        "width=16",
        "start_m=[1,1]",
        "goal_m=[6,6]",
        "class_periods_m=[4,2]",
        "scenarios.hg.crater_count=[0,0]",
    )
    common = (
        "import-dem",
        "site.tif",
        *changes,
        "--recipe",
        "tiny-v1",
        "--scenario",
        "hs",
    )
    splits = ("--splits", "train:0.7,valid:0.1,test/site:0.2", "--stride", "4")
    real = ("--photo", "photo.tif", "--traversability", "lambda.tif")
    assert datagen(*common, *splits, *real, "--out", "out") == 2
    assert "--random-classes" in capsys.readouterr().err
    named = ("--classes", "cover.tif", "--class-ids", "{40: gravel, 9: null}")
    assert datagen(*common, *splits, *real, *named, "--out", "out", "--solvable") == 0
    assert "left out between splits: 6" in capsys.readouterr().out
    made = TerrainDataset("out")
    assert made.path.is_dir()
    assert made.id == "out"
    sources = {name: entry["parts"][0]["source"] for name, entry in made.splits.items()}
    tried = {
        name: len(s["kept"]) + s["left_out"]["not_solvable"]
        for name, s in sources.items()
    }
    assert tried == {"train": 16, "valid": 2, "test/site": 5}
    assert sources["train"]["left_out"]["not_solvable"] > 0
    assert {entry["scenario"] for entry in made.splits.values()} == {"hs"}
    assert sources["train"]["stride_m"] == [4.0, 4.0]
    assert sources["train"]["classes"]["ids"] == {"9": None, "40": "gravel"}
    maps = made.read("train")
    assert maps["rgb"].shape[1:] == (3, 16, 16)
    assert (maps["rgb"] == 77).all()
    assert (maps["traversability"] == 0.25).all()
    assert np.isfinite(maps["reference_time_s"]).all()
    assert datagen(*common, *splits, "--out", "out") == 2
    assert (
        datagen(
            *common,
            *real,
            "--random-classes",
            "--out",
            "out",
            "--overwrite",
            "--id",
            "mine",
        )
        == 0
    )
    made = TerrainDataset("out")
    assert (made.id, list(made.splits)) == ("mine", ["test/real"])
    assert datagen(*common, "id=named", "--out", "d.h5") == 0
    assert TerrainDataset("d.h5").id == "named"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--splits", "train:0.7"), "sum to 1"),
        (("--stride", "0.3"), "`stride` to be a multiple"),
        (("nonsense",), "Expected an override such as"),
        (("--photo", "photo.tif"), "--random-classes"),
        (("--class-ids", "{1: gravel}"), "Expected `classes` with `class_ids`"),
    ],
)
def test_an_import_that_cannot_be_ends_in_one_line(
    datagen: Call,
    words: tuple[str, ...],
    said: str,
    capsys,  # type: ignore[no-untyped-def]
) -> None:
    write_ground("site.tif", np.zeros((1, 40, 40), np.float32))
    assert (
        datagen(
            "import-dem", "site.tif", *words, "--out", "x.h5", "--recipe", "tiny-v1"
        )
        == 2
    )
    message = capsys.readouterr().err
    assert said in message
    assert message.count("\n") == 1
    assert not Path("x.h5").exists()


def test_overrides_and_seeds_name_what_they_make(datagen: Call) -> None:
    splits = ("--splits", "[train]")
    assert (
        datagen(
            "create",
            "tiny-v1",
            *SMALL,
            "scenarios.std={preset: hs, severity: 0.5}",
            *splits,
        )
        == 0
    )
    made = TerrainDataset("datasets/small.h5")
    assert made.splits["train"]["maps"] == 3
    assert made.recipe.scenarios["std"].light_height == pytest.approx((0.55, 0.9))
    assert datagen("create", "tiny-v1", *SMALL, "--seed", "4", *splits) == 0
    sibling = TerrainDataset("datasets/small-seed4.h5")
    assert sibling.recipe.seed == 4
    assert sibling.recipe.classes == made.recipe.classes
    assert sibling.digest != made.digest


def test_overrides_of_a_recipe_of_ones_own_need_an_id_too(
    datagen: Call, capsys
) -> None:  # type: ignore[no-untyped-def]
    Path("r.yaml").write_text(RECIPE.replace("id: tiny-v1", "id: mine"))
    assert datagen("create", "r.yaml", "splits.train.maps=3", "--out", "d.h5") == 2
    assert "id=NAME" in capsys.readouterr().err
    assert (
        datagen("create", "r.yaml", "splits.train.maps=3", "id=m", "--splits", "train")
        == 0
    )


def test_faults_of_consecutive_maps_are_one_line(datagen: Call, capsys) -> None:  # type: ignore[no-untyped-def]
    assert (
        datagen("create", "tiny-v1", *SMALL, "--splits", "train", "--out", "d.h5") == 0
    )
    with h5py.File("d.h5", "r+") as file:
        file["train/start_m"][...] = 0
    capsys.readouterr()
    assert datagen("validate", "d.h5") == 1
    assert capsys.readouterr().out.splitlines() == [
        "train: maps 0–2: field 'start_m' does not match its digest",
        "d.h5: 3 fault(s)",
        "To repair the dataset, create the file again with --overwrite. The same recipe "
        "and version yield the same digests.",
    ]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("seed: 0", "seed: 0\ncraters: 3", "craters"),
        ("height: 32", "heigth: 32", "got 'heigth'. Did you mean 'height'?"),
        (
            "maps: 40",
            "mapps: 40",
            "`splits.train` among scenario, maps, solvable, got 'mapps'. Did you mean 'maps'?",
        ),
        (
            "{preset: hs, relief_m",
            "{preset: hs, reliefs_m",
            "got 'reliefs_m'. Did you mean 'relief_m'?",
        ),
        (
            "occupancy: [0.3, 0.3, 0.2, 0.2]",
            "occupancy: [0.3, 0.3, 0.2, 0.1]",
            "that sum to 1",
        ),
        ("crater_count: [1, 2]", "crater_count: [30, 40]", "cover at most 40%"),
        (
            "crater_radius_m: [1.5, 3.0]",
            "crater_radius_m: [1.5, 30.0]",
            "crater_radius_m",
        ),
        ("maps: 40", "maps: 0", "`maps` ≥ 1"),
        ("resolution_m: 0.5", "resolution_m: .nan", "resolution_m"),
        ("relief_m: [1.0, 1.2]", "relief_m: [1.0, .nan]", "relief_m"),
        ("occupancy: [0.3", "occupancy: [.nan", "occupancy"),
        ("start_m: [4, 4]", "start_m: [.nan, 4]", "start_m"),
        ("stuck_threshold: 0.3", "stuck_threshold: .nan", "Expected `stuck_threshold`"),
        ("stuck_threshold: 0.3", "stuck_threshold: 5", "Expected `stuck_threshold`"),
        ("relief_m: [1.0, 1.2]", "relief_m: [20000, 20000]", "relief_m"),
        ("environments: 5", "environments: 40000", "environments"),
        (
            "class_periods_m: [6, 3]",
            "class_periods_m: [0.000000001]",
            "class_periods_m",
        ),
        ("  train:", "  1:", "Put numbers in quotes"),
        ("  train:", "  test:", "not nested"),
        ("classes: default", "classes: []", "`classes`"),
        ("goal_m: [12, 12]", "goal_m: [4.1, 4.1]", "different cells"),
        ("stuck_threshold: 0.3", "stuck_threshold: 0.999", "goal that can be reached"),
        ("class_periods_m: [6, 3]", "class_periods_m: [.nan, 3]", "class_periods_m"),
        ("{preset: hs, relief", "{preset: hs, severity: .nan, relief", "severity"),
        ("height: 32", "height: many", "height"),
        ("id: mine", "id: my maps", "my maps"),
        ("environments: 5", "environments: 4", "an `id` in"),
        ("scenario: std", "scenario: dusk", "dusk"),
        ("splits:", "splits: []\nmore:", "splits"),
        (RECIPE, "[1, 2]", "mapping"),
        (RECIPE, "a: [", "YAML"),
    ],
)
def test_a_bad_recipe_is_one_clear_line_and_status_2(
    datagen: Call, capsys, old: str, new: str, said: str
) -> None:  # type: ignore[no-untyped-def]
    own = RECIPE if "an `id` in" in said else RECIPE.replace("id: tiny-v1", "id: mine")
    text = new if old == RECIPE else own.replace(old, new, 1)
    assert text != RECIPE
    Path("r.yaml").write_text(text)
    assert datagen("create", "r.yaml", "--out", "d.h5") == 2
    lines = [
        line
        for line in capsys.readouterr().err.strip().splitlines()
        if not line.startswith("maps: ")
    ]
    assert len(lines) == 1
    assert said in lines[0]
    assert not Path("d.h5").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["create"],
        ["create", "nope"],
        ["create", "tiny-v1", "splits.train.maps=3"],
        ["create", "tiny-v1", "id=x", "splits.train"],
        ["create", "tiny-v1", "id=x", "nothing.at.all=3"],
        ["create", "tiny-v1", "id=x", "seed=[1"],
        ["create", "tiny-v1", "id=paper-v1"],
        ["list", "--folder", "nope"],
        ["create", "tiny-v1", "--jobs", "0"],
        ["create", "tiny-v1", "--splits", "[nope]"],
        ["create", "tiny-v1", "--seed", "many"],
        ["show", "nope"],
        ["validate", "r.yaml"],
        ["create", "tiny-v1", "--shard", "3/2"],
        ["create", "tiny-v1", "--shard", "1/2", "--out", "d.h5"],
        ["create", "tiny-v1", "--backend", "dask"],
        ["create", "tiny-v1", "--scheduler", "tcp://127.0.0.1:1"],
        ["merge", "nope", "--out", "d.h5"],
        ["merge", "--out", "d.h5"],
        ["preview", "nope"],
    ],
    ids=" ".join,
)
def test_bad_arguments_are_one_line_and_status_2(
    datagen: Call, capsys, arguments: list[str]
) -> None:  # type: ignore[no-untyped-def]
    assert datagen(*arguments) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not Path("d.h5").exists()


def test_shipped_recipes_load_and_full_has_the_papers_maps() -> None:
    recipes = {name: load_recipe(name) for name in shipped_recipes()}
    assert {"paper-v1", "full-v1", "tiny-v1", "shift-v1"} <= set(recipes)
    assert all(recipe.id == name for name, recipe in recipes.items())
    paper, full = recipes["paper-v1"], recipes["full-v1"]
    assert full.to_dict() | {"id": 0, "splits": 0} == paper.to_dict() | {
        "id": 0,
        "splits": 0,
    }
    assert {name: split.maps for name, split in full.splits.items()} == {
        "train": 1000, "valid": 250, "test/std": 200, "test/hg": 200, "test/hs": 200,
    }  # fmt: skip
    with pytest.raises(ConfigError, match="shipped recipe"):
        load_recipe("full")


def test_a_dataset_with_stakes_from_making_to_mending(
    datagen: Call, tmp_path: Path, capsys
) -> None:  # type: ignore[no-untyped-def]
    changes = [
        "id=mine", "height=32", "width=32", "places={least_distance_m: 8, margin_m: 1}",
        "splits={train: {scenario: std, maps: 3}, test/hg: {scenario: hg, maps: 2, solvable: true}}",
    ]  # fmt: skip
    assert datagen("create", "stakes-v1", *changes, "--out", "d.h5") == 0
    made = capsys.readouterr().out
    assert "λ_stuck 0.1" in made
    last = made.rstrip().splitlines()[-3:]
    assert last[0].split()[0] == "test/hg"
    assert [line.partition(":")[0] for line in last[1:]] == ["stuck", "time s"]
    assert datagen("show", "d.h5") == 0
    shown = capsys.readouterr().out
    for words in (
        "format 1.1", "synthesis 2", "at least 8 m apart and 1 m from the edges", "λ correlated over 1.5 m",
        "soft spots", "10% N(0.05, 0.05)",
    ):  # fmt: skip
        assert words in shown
    assert sum("10% N" in line for line in shown.splitlines()) == 4
    assert datagen("show", "d.h5", "--json") == 0
    described = json.loads(capsys.readouterr().out)
    assert described["places"] == {"least_distance_m": 8, "margin_m": 1}
    assert described["classes"][1]["soft"]["weight"] == 0.1
    with h5py.File("d.h5", "r+") as file:
        file["train/start_m"][1] = 0
        file["test/hg/traversability"][0] = 0
    assert datagen("validate", "d.h5") == 1
    assert datagen("preview", "d.h5", "--split", "train", "--out", "p.png") == 0
    assert datagen("preview", "d.h5", "--split", "train", "--contact-sheet") == 0


def test_show_of_a_dataset_of_synthesis_1_tells_of_no_soft_spots(
    datagen: Call, capsys
) -> None:  # type: ignore[no-untyped-def]
    assert (
        datagen("create", "tiny-v1", *SMALL, "--splits", "[train]", "--out", "d.h5")
        == 0
    )
    capsys.readouterr()
    assert datagen("show", "d.h5") == 0
    shown = capsys.readouterr().out
    assert "synthesis 1\n" in shown
    assert "soft spots" not in shown


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("classes.1.soft", "override"),
        ("synthesis=1", "`synthesis: 2` with `soft`"),
        ("synthesis=3", "`synthesis` 1 or 2"),
        ("places={least_distance_m: 99, margin_m: 3}", "`least_distance_m`"),
        ("places={margin_m: 3}", "least_distance_m"),
        ("start_m=[3, 3]", "either `start_m` and `goal_m`, or `places`"),
        ("correlation_m=9", "`correlation_m`"),
        ("correlation_m=far", "correlation_m"),
        ("occupancy=[1.0]", "`occupancy`"),
        (
            "classes.dune_sand.soft.wieght=0.3",
            "`classes.dune_sand.soft` among weight, mean, std, got 'wieght'. Did you mean 'weight'?",
        ),
    ],
)
def test_bad_stakes_are_one_line(
    datagen: Call, capsys, change: str, expected: str
) -> None:  # type: ignore[no-untyped-def]
    assert datagen("create", "stakes-v1", "id=mine", change) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert expected in told[-1]
    assert len(told) == 1
    assert not list(Path().iterdir())


def test_the_first_maps_of_each_split_are_those_of_the_whole(
    datagen: Call, capsys
) -> None:  # type: ignore[no-untyped-def]
    assert (
        datagen(
            "create", "tiny-v1", "--splits", "[test/std,valid]", "--out", "whole.h5"
        )
        == 0
    )
    assert (
        datagen(
            "create",
            "tiny-v1",
            "--splits",
            "[test/std,valid]",
            "--first",
            "3",
            "--out",
            "few.h5",
        )
        == 0
    )
    whole, few = TerrainDataset("whole.h5"), TerrainDataset("few.h5")
    assert {name: split["maps"] for name, split in few.splits.items()} == {
        "test/std": 3,
        "valid": 3,
    }
    for split in few.splits:
        for name, values in few.read(split).items():
            np.testing.assert_array_equal(values, whole.read(split, range(3))[name])
    assert few.id == "tiny-v1"
    assert datagen("create", "tiny-v1", "--first", "-1", "--out", "x.h5") == 2
    assert "`first` ≥ 0" in capsys.readouterr().err
    assert (
        datagen(
            "create",
            "tiny-v1",
            "--splits",
            "[test/hs]",
            "--first",
            "9",
            "--out",
            "all.h5",
        )
        == 0
    )
    assert TerrainDataset("all.h5").map_count("test/hs") == 4


def test_an_interrupted_create_goes_on_and_says_what_was_there(
    datagen: Call, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ("create", "tiny-v1", "--splits", "[test/std,valid]", "--out", "d.h5")
    make = create.make_shard

    def interrupted(
        recipe: Recipe, shard: ShardFile, version: str
    ) -> tuple[ShardFile, bytes]:
        if shard.split.startswith("test"):
            raise KeyboardInterrupt
        return make(recipe, shard, version)

    with monkeypatch.context() as patched:
        patched.setattr(create, "make_shard", interrupted)
        assert datagen(*asked) == 130
    assert (
        capsys.readouterr().err.splitlines()[-1]
        == "benchnav-datagen: finished maps are kept; to resume, run the same command again"
    )
    assert datagen(*asked) == 0
    assert capsys.readouterr().err.splitlines()[0] == "10 of 14 maps already exist"
    assert datagen(*asked, "--overwrite") == 0
    assert "already" not in capsys.readouterr().err


def test_a_folder_without_datasets_is_told(
    datagen: Call, capsys: pytest.CaptureFixture[str]
) -> None:
    assert datagen("list", "--folder", ".") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no files in ."
    assert datagen("create", "tiny-v1", "--splits", "train", "--out", "d.h5") == 0
    assert " kB)" in capsys.readouterr().out
    assert datagen("list", "--folder", ".") == 0
    assert capsys.readouterr().out.splitlines()[-2] == "files in .:"


def test_an_override_names_an_item_of_a_list_by_its_name() -> None:
    recipe = load_recipe(
        "stakes-v1",
        ["id=deep", "classes.dune_sand.soft.weight=0.2", "classes.gravel.noise=0.3"],
    )
    by_name = {item.name: item for item in recipe.classes}
    whole = {item.name: item for item in load_recipe("stakes-v1").classes}
    assert by_name["dune_sand"].soft == SoftSpots(weight=0.2, mean=0.05, std=0.05)
    assert by_name["gravel"].noise == 0.3
    assert by_name["wet_clay"] == whole["wet_clay"]
    shipped = load_recipe("paper-v1", ["id=rough", "classes.gravel.noise=0.3"])
    assert {item.name: item for item in shipped.classes}["gravel"].noise == 0.3
    for wrong in ("classes.dune.noise=1", "classes.3.noise=1", "occupancy.first=1"):
        with pytest.raises(ConfigError, match="Expected a name among"):
            load_recipe("stakes-v1", ["id=deep", wrong])


def test_datasets_are_made_listed_and_shown_without_pytorch(tmp_path: Path) -> None:
    code = (
        "import sys; from benchnav.datagen.cli import main\n"
        "try: main()\nexcept SystemExit as ended: assert not ended.code, ended.code\n"
        "print(any(name in sys.modules for name in ('torch', 'lightning', 'matplotlib')))"
    )
    for words in (
        ["create", "tiny-v1", *SMALL, "--splits", "[train]", "--out", "d.h5"],
        ["list"],
        ["show", "d.h5"],
        ["validate", "d.h5"],
    ):
        ran = subprocess.run(
            [sys.executable, "-c", code, *words],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            check=True,
        )
        assert ran.stdout.splitlines()[-1] == "False", words


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ("create", "tiny-v1", "--seed", "-1"),
            "Expected `seed` in 0–2^63 − 1, got -1.",
        ),
        (("create", "tiny-v1", "--seed", "99999999999999999999999"), "at most 64 bits"),
        (
            ("create", "tiny-v1", "--splits", "{a: 1}"),
            "Expected --splits as a list, each text or null, got '{a: 1}'",
        ),
    ],
)
def test_what_was_taken_or_told_in_jargon_is_one_line(
    datagen: Call,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    said: str,
) -> None:
    assert datagen(*arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert list(Path.cwd().iterdir()) == []


def test_show_tells_the_kind_of_truth_and_what_models_record(
    datagen: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny_dataset(tmp_path / "d.h5")
    assert datagen("show", str(path)) == 0
    told, digest = capsys.readouterr().out, TerrainDataset(path).split_digest("test/hg")
    assert "generated" in told
    assert digest in told
    assert datagen("show", str(path), "--json") == 0
    split = json.loads(capsys.readouterr().out)["splits"]["test/hg"]
    assert (split["truth"], split["recorded_digest"]) == ("generated", digest)
