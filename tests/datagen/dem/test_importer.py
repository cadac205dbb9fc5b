"""Imports as a whole: datasets, splits, errors."""

import itertools
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage

from benchnav.core.errors import BenchnavError, ConfigError, DatasetError
from benchnav.datagen.dem import importer
from benchnav.datagen.dem.importer import import_dem
from benchnav.datagen.dem.options import Cut, GroundOptions
from benchnav.datagen.dem.raster import Layer
from benchnav.datagen.dem.recipe_fit import GroundError
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.merge import merge
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.places import PlacesRule
from benchnav.datagen.schema import FIELDS
from tests.datagen.dem.rasters import (
    ANY,
    FLAT,
    RECIPE,
    SOUTH,
    STEP,
    WEST,
    maps_of,
    plane,
    read,
    refusal,
    rough,
    source_of,
    source_tiles,
    write,
)
from tests.datagen.small import small_stakes

rasterio = pytest.importorskip("rasterio")

# The dataset


def test_the_manifest_says_where_the_maps_came_from(tmp_path: Path) -> None:
    dataset = read(
        write(tmp_path / "dem.tif", rough(16, 48)),
        shares={"test/hills": 1.0},
        scenario="hs",
    )
    assert dataset.id == dataset.recipe.id == "real-v1"
    assert set(dataset.splits) == {"test/hills"}
    assert dataset.splits["test/hills"]["scenario"] == "hs"
    assert (
        dataset.recipe.splits["test/hills"].maps
        == dataset.splits["test/hills"]["maps"]
        == 2
    )
    source = source_of(dataset)
    assert (source["kind"], source["file"], source["crs"]) == (
        "dem",
        "dem.tif",
        "EPSG:32654",
    )
    assert source["resolution_m"] == [0.5, 0.5]
    assert source["classes"] is source["photo"] is None
    assert not dataset.has_photo("test/hills")
    assert len(dataset.terrain("test/hills")) == 2


def test_with_solvable_maps_behind_a_wall_are_left_out(tmp_path: Path) -> None:
    values = np.full((16, 72), 10.0)
    values[:, 24 + 12 :] = 60  # through map 1, between start and goal
    flat = np.zeros((16, 72), np.uint8)
    dem, classes = (
        write(tmp_path / "dem.tif", values),
        write(tmp_path / "classes.tif", flat),
    )
    dataset = read(dem, classes=classes, solvable=True)
    assert source_of(dataset)["kept"] == [0, 2]
    assert source_of(dataset)["left_out"] == {
        "missing_elevation": 0,
        "missing_classes": 0,
        "not_solvable": 1,
        "between_splits": 0,
    }
    times = maps_of(dataset)["reference_time_s"]
    # 14 cells east and 6 north, on eight headings
    distance = 0.5 * (14 - 6 + 6 * np.sqrt(2))
    assert distance < times[0] < 1.1 * distance
    every = maps_of(read(dem, classes=classes))
    np.testing.assert_array_equal(
        maps_of(dataset)["traversability"], every["traversability"][[0, 2]]
    )


@pytest.mark.parametrize(
    "profile", [{}, {"transform": rasterio.Affine(0.3, 0.1, WEST, 0.1, -0.3, SOUTH)}]
)
def test_a_map_is_the_same_however_many_are_made_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, profile: dict[str, Any]
) -> None:
    dem = write(tmp_path / "dem.tif", rough(80, 240), 0.3, **profile)
    at_once = read(dem, stride_m=4.0)
    monkeypatch.setattr(importer, "_CELLS_AT_ONCE", 1)
    assert read(dem, stride_m=4.0).digest == at_once.digest


def test_a_raster_is_never_read_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dem = write(tmp_path / "dem.tif", rough(16 * 8, 24 * 8))
    read_window, shapes = Layer.read, []

    def spy(layer: Layer, rows: range, columns: range) -> np.ndarray:
        shapes.append((len(rows), len(columns)))
        return read_window(layer, rows, columns)

    monkeypatch.setattr(Layer, "read", spy)
    monkeypatch.setattr(importer, "_CELLS_AT_ONCE", 16 * 24 * 4)
    read(dem)
    assert shapes == [(16, 24 * 4)] * 16


def test_an_import_that_stops_leaves_nothing_and_one_that_was_killed_is_cleared_away(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", rough(16 * 8, 24 * 8))
    for name in ("out.h5", "out"):
        steps = import_dem(str(dem), tmp_path / name, RECIPE)
        assert next(steps) == (8, 64)
        steps.close()
        assert [path.name for path in tmp_path.iterdir()] == ["dem.tif"]
        left = tmp_path / f".{name}.building.partial"
        left.mkdir()
        (left / "test+real-00000000-00000008.h5").touch()
        list(import_dem(str(dem), tmp_path / name, RECIPE))
        assert find_faults(tmp_path / name) == []
        assert {path.name for path in tmp_path.iterdir()} == {"dem.tif", name}
        (tmp_path / name).rename(tmp_path.parent / f"{tmp_path.name}-{name}")


def test_only_one_import_writes_a_file(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(32, 48))
    first = import_dem(str(dem), tmp_path / "out.h5", RECIPE)
    next(first)
    with pytest.raises(BenchnavError, match="Another run"):
        next(import_dem(str(dem), tmp_path / "out.h5", RECIPE))
    list(first)
    assert find_faults(tmp_path / "out.h5") == []


def test_a_folder_of_shards_holds_what_a_file_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importer, "SHARD_CELLS", 16 * 24 * 3)
    monkeypatch.setattr(importer, "_CELLS_AT_ONCE", 16 * 24 * 2)
    dem = write(tmp_path / "dem.tif", rough(16 * 4, 24 * 8))
    shares = {"train": 0.6, "test/site": 0.4}
    file, folder = read(dem, shares=shares), read(dem, suffix="", shares=shares)
    assert folder.path.is_dir()
    assert file.digest == folder.digest
    assert file.splits == folder.splits
    assert [piece.maps for piece in folder.pieces["train"]] == [4, 4, 4, 4]
    for split in shares:
        source = folder.splits[split]["parts"][0]["source"]
        for piece in folder.pieces[split]:
            shard = TerrainDataset(piece.path)
            assert find_faults(piece.path) == []
            (part,) = shard.splits[split]["parts"]
            which = slice(piece.first, piece.first + piece.maps)
            assert part["maps"] == piece.maps
            assert part["source"]["kept"] == source["kept"][which]
            assert part["source"]["lowest_m"] == source["lowest_m"][which]
            assert part["source"]["unlabelled"] == source["unlabelled"][which]


def test_a_folder_is_replaced_only_where_it_is_a_dataset(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    out = tmp_path / "out"
    one, two = (replace(RECIPE, id=name) for name in ("one", "two"))
    list(import_dem(str(dem), out, one))
    with pytest.raises(BenchnavError, match="--overwrite"):
        next(import_dem(str(dem), out, two))
    list(import_dem(str(dem), out, two, overwrite=True))
    assert TerrainDataset(out).id == "two"
    (out / "mine.txt").touch()
    with pytest.raises(BenchnavError, match=r"mine\.txt"):
        next(import_dem(str(dem), out, one, overwrite=True))
    assert TerrainDataset(out).id == "two"
    assert {path.name for path in tmp_path.iterdir()} == {"dem.tif", "out"}


# Splits and strides


@pytest.mark.parametrize("stride", [None, 4.0])
@pytest.mark.parametrize(("height", "width"), [(16, 24 * 10), (16 * 10, 24)])
def test_maps_of_different_splits_show_ground_that_does_not_touch(
    tmp_path: Path, height: int, width: int, stride: float | None
) -> None:
    # Every cell is of an elevation of its own, by which it is known again.
    values = np.arange(height * width, dtype=np.float64).reshape(height, width) / 64
    shares = {"train": 0.6, "valid": 0.1, "test/site": 0.3}
    dataset = read(write(tmp_path / "dem.tif", values), shares=shares, stride_m=stride)
    shown, counts, between = {}, {}, set()
    for split, entry in dataset.splits.items():
        (part,) = entry["parts"]
        maps, source = dataset.read(split), part["source"]
        counts[split] = entry["maps"]
        between.add(source["left_out"]["between_splits"])
        cells = np.zeros((height, width), dtype=bool)
        for elevation, lowest in zip(
            maps["elevation_m"], source["lowest_m"], strict=True
        ):
            cells |= np.isin(values, elevation.astype(np.float64) + lowest)
        shown[split] = cells
    grown = {
        split: scipy.ndimage.binary_dilation(cells, np.ones((3, 3)))
        for split, cells in shown.items()
    }
    for one, other in itertools.permutations(shares, 2):
        assert not (grown[one] & shown[other]).any()
    assert list(dataset.splits) == list(shares)
    assert dataset.recipe.splits["valid"].maps == counts["valid"]
    total = source_tiles(source)
    assert between == {total - sum(counts.values())}
    assert (counts, total) == {
        (None, 240): ({"train": 5, "valid": 1, "test/site": 2}, 10),
        (None, 24): ({"train": 5, "valid": 1, "test/site": 2}, 10),
        (4.0, 240): ({"train": 11, "valid": 2, "test/site": 5}, 28),
        (4.0, 24): ({"train": 8, "valid": 1, "test/site": 4}, 19),
    }[stride, width]


def test_maps_closer_than_their_width_overlap(tmp_path: Path) -> None:
    values = rough(16, 48)
    dataset = read(write(tmp_path / "dem.tif", values), stride_m=1.5)
    source, stored = source_of(dataset), maps_of(dataset)["elevation_m"]
    assert (source["tiles"], source["stride_m"]) == ([1, 9], [1.5, 1.5])
    for number in range(9):
        own = values[::-1, 3 * number : 3 * number + 24].astype(np.float64)
        np.testing.assert_allclose(
            stored[number] + source["lowest_m"][number], own, atol=STEP
        )


@pytest.mark.parametrize("suffix", [".h5", ""])
def test_maps_that_overlap_are_of_one_group_and_ground_apart_is_of_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    monkeypatch.setattr(importer, "SHARD_CELLS", 4 * 16 * 24)
    # so that a split has several files
    monkeypatch.setattr(importer, "_CELLS_AT_ONCE", 4 * 16 * 24)
    values = rough(16, 160)
    values[:, 70:80] = np.nan  # no map that shows these is kept
    dataset = read(write(tmp_path / "dem.tif", values), stride_m=1.5, suffix=suffix)
    assert dataset.field_names == (*FIELDS, "group")
    assert dataset.manifest["format_version"] == "1.3"
    kept, groups = (
        np.array(source_of(dataset)["kept"]),
        dataset.read("test/real", fields=["group"])["group"],
    )
    assert groups.dtype == np.int64
    assert set(kept) == {*range(16), *range(27, 46)}
    assert len(set(groups[kept < 16])) == len(set(groups[kept > 16])) == 1
    assert groups[0] != groups[-1]
    some = dataset.read("test/real", [20, 3], ["group"])["group"]
    assert some.tolist() == [groups[20], groups[3]]


def test_the_numbers_of_groups_differ_between_grounds_and_maps_side_by_side_have_none(
    tmp_path: Path,
) -> None:
    first, second = (
        write(tmp_path / f"{name}.tif", rough(16, 48, seed))
        for seed, name in enumerate("ab")
    )
    made = [read(dem, stride_m=1.5) for dem in (first, second)]
    groups = [set(maps_of(dataset)["group"].tolist()) for dataset in made]
    assert [len(own) for own in groups] == [1, 1]
    assert not groups[0] & groups[1]
    both = tmp_path / "both.h5"
    for _ in merge([dataset.path for dataset in made], both):
        pass
    assert find_faults(both) == []
    assert set(maps_of(TerrainDataset(both))["group"].tolist()) == groups[0] | groups[1]
    plain = read(first)
    assert plain.field_names == tuple(FIELDS)
    with pytest.raises(
        DatasetError,
        match=r"different fields \(group only in one dataset: .*--stride\)",
    ):
        list(merge([made[1].path, plain.path], tmp_path / "neither.h5"))


def test_the_truth_of_imported_ground_is_unknown(tmp_path: Path) -> None:
    dataset = read(write(tmp_path / "dem.tif", FLAT))
    assert source_of(dataset)["truth"] == "unknown"
    assert dataset.truth_of("test/real") == dataset.truth == "unknown"


@pytest.mark.parametrize("stride", [0.7, 0, -1, np.nan])
def test_a_stride_is_a_number_of_cells(tmp_path: Path, stride: float) -> None:
    message = refusal(write(tmp_path / "dem.tif", FLAT), stride_m=stride)
    assert "`stride` to be a multiple of 0.5 m (the resolution" in message


def test_a_split_without_maps_is_named_with_the_reason(tmp_path: Path) -> None:
    values = rough(16, 24 * 7)
    values[:, 24 * 5 :] = np.nan
    message = refusal(
        write(tmp_path / "dem.tif", values), shares={"train": 0.7, "valid": 0.3}
    )
    assert "split 'valid'" in message
    assert "Of 2 candidate maps, 2 have cells without elevation" in message


# Errors


BAD_GROUND: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no CRS": (
        {"crs": None},
        ["`dem`", "coordinate reference system", "rio edit-info --crs"],
    ),
    "heights in feet": (
        {"crs": "EPSG:26918+6360"},
        ["`dem`", "in metres", "US survey foot", "--dem-unit us-ft"],
    ),
    "nowhere": (
        {"transform": rasterio.Affine.identity()},
        ["`dem`", "geotransform", "rio edit-info"],
    ),
}


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("case", BAD_GROUND)
def test_ground_in_no_usable_place_is_refused(tmp_path: Path, case: str) -> None:
    profile, said = BAD_GROUND[case]
    message = refusal(write(tmp_path / "dem.tif", FLAT, **profile))
    for words in ["Expected", "dem.tif", *said]:
        assert words in message


def test_files_that_are_no_whole_raster_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.tif").write_text("hello")
    (tmp_path / "empty.tif").touch()
    whole = write(
        tmp_path / "dem.tif", rough(160, 240), compress="deflate"
    ).read_bytes()
    (tmp_path / "cut.tif").write_bytes(whole[: len(whole) // 2])
    for name in ("text.tif", "empty.tif", "cut.tif", "none.tif"):
        message = refusal(tmp_path / name)
        assert "Expected `dem` to be a raster that GDAL can read" in message
        assert name in message
    assert "No such file" in message
    dem = write(tmp_path / "dem.tif", FLAT)
    for argument in ("classes", "photo", "traversability"):
        message = refusal(
            dem,
            **{argument: tmp_path / "text.tif"},
            **({} if argument == "classes" else ANY),
        )
        assert f"`{argument}` to be a raster" in message


def test_a_photo_that_is_damaged_is_blamed_rather_than_the_output(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", rough(160, 240))
    colours = np.random.default_rng(5).integers(0, 255, (3, 160, 240)).astype(np.uint8)
    photo = write(tmp_path / "photo.tif", colours, compress="deflate")
    whole = photo.read_bytes()
    photo.write_bytes(whole[: len(whole) // 2])
    message = refusal(dem, photo=photo, **ANY)
    assert "`photo`" in message
    assert "out.h5" not in message


def test_ground_that_gives_no_maps_is_refused(tmp_path: Path) -> None:
    message = refusal(write(tmp_path / "small.tif", FLAT[:-1]))
    assert "12 m × 8 m" in message
    assert "12 m × 7.5 m" in message
    message = refusal(
        write(tmp_path / "gaps.tif", np.full((32, 24), -1, np.int16), nodata=-1)
    )
    assert "Of 2 candidate maps, 2 have cells without elevation." in message
    assert "one band" in refusal(write(tmp_path / "bands.tif", np.stack([FLAT, FLAT])))
    sentinel = FLAT.copy()
    sentinel[3, 3] = -9999
    assert "rio edit-info --nodata -9999" in refusal(
        write(tmp_path / "undeclared.tif", sentinel)
    )
    # Averaged with 624 others it would look like ground.
    many = np.zeros((400, 600), np.float32)
    many[77, 99] = -32767
    assert "rio edit-info --nodata -32767" in refusal(
        write(tmp_path / "blended.tif", many, 0.02)
    )


def test_rasters_that_hold_something_else_are_refused(tmp_path: Path) -> None:
    dem, kinds = write(tmp_path / "dem.tif", FLAT), np.zeros((16, 24), np.uint8)
    assert "`photo`" in refusal(dem, photo=write(tmp_path / "grey.tif", kinds), **ANY)
    deep = write(tmp_path / "deep.tif", np.zeros((3, 16, 24), np.uint16))
    assert "uint16" in refusal(dem, photo=deep, **ANY)
    bands = write(tmp_path / "3.tif", np.stack([kinds] * 3))
    assert "one band in `classes`" in refusal(dem, classes=bands)
    assert "one band in `traversability`" in refusal(dem, traversability=bands, **ANY)
    afar = write(tmp_path / "afar.tif", np.stack([kinds] * 3), offset=(50, 0))
    assert "Of 1 candidate maps, 1 have cells without colour." in refusal(
        dem, photo=afar, **ANY
    )


def test_unknown_classes_are_listed(tmp_path: Path) -> None:
    dem, kinds = write(tmp_path / "dem.tif", FLAT), np.zeros((16, 24), np.uint8)
    kinds[2, 3], kinds[9, 20] = 77, 12
    classes = write(tmp_path / "classes.tif", kinds)
    message = refusal(dem, classes=classes)
    assert "[12, 77]" in message
    assert "[77]" in refusal(dem, classes=classes, class_ids={0: "scree", 12: "gravel"})
    message = refusal(
        dem, classes=classes, class_ids={0: "scree", 12: "lava", 77: "gravel"}
    )
    assert "['lava']" in message
    message = refusal(dem, classes=write(tmp_path / "heights.tif", rough(16, 24)))
    assert "…" in message
    assert len(message) < 1000
    assert "Expected `classes` with `class_ids`" in refusal(dem, class_ids={0: "scree"})


def test_settings_and_targets_are_checked(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    assert "letters" in refusal(dem, shares={"a b": 1.0})
    with pytest.raises(ConfigError, match="letters"):
        replace(RECIPE, id="a/b")
    assert "'nope'" in refusal(dem, scenario="nope")
    (tmp_path / "out.h5").write_text("mine")
    assert "exists" in refusal(dem)
    assert (tmp_path / "out.h5").read_text() == "mine"
    list(import_dem(str(dem), tmp_path / "out.h5", RECIPE, overwrite=True))
    assert TerrainDataset(tmp_path / "out.h5").splits["test/real"]["maps"] == 1


def test_without_rasterio_the_message_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(
        ConfigError, match=r"Expected rasterio.*pip install 'benchnav\[geo\]'"
    ):
        next(import_dem(str(dem), tmp_path / "out.h5", RECIPE))


def level(*shape: int) -> np.ndarray:
    return np.full(shape, 500, np.float32)


# By case: rasters that are refused, and what the user has to fill in.
REMEDIES: dict[str, tuple[dict[str, Any], dict[str, str]]] = {
    "no CRS": ({"values": level(16, 24), "crs": None}, {"CODE": "32654"}),
    "bands": ({"values": level(2, 16, 24)}, {}),
    "undeclared": ({"values": np.where(np.arange(48) < 40, level(16, 48), -9999)}, {}),
}


@pytest.mark.parametrize("case", REMEDIES)
def test_the_remedy_of_the_message_is_one(tmp_path: Path, case: str) -> None:
    from click.testing import CliRunner
    from rasterio.rio.main import main_group

    profile, filled = REMEDIES[case]
    command = refusal(write(tmp_path / "dem.tif", **profile)).split(": rio ")[1]
    for blank, value in filled.items():
        command = command.replace(blank, value)
    words = shlex.split(command)
    if not words[-1].startswith(str(tmp_path)):
        words[-1] = str(tmp_path / words[-1])
    ran = CliRunner().invoke(main_group, words)
    assert ran.exit_code == 0, ran.output
    source = source_of(read(Path(words[-1])))
    np.testing.assert_allclose(source["lowest_m"], 500, atol=0.001)


# What an import says and takes before it begins


def test_the_paragraph_gives_maps_size_unit_and_origin_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Layer, "read", lambda *_: pytest.fail("read"))
    said: list[str] = []
    dem = write(tmp_path / "dem.tif", np.zeros((3200, 4800), np.int8), 1.0)
    steps = import_dem(
        str(dem),
        tmp_path / "o.h5",
        RECIPE,
        cut=Cut(ground=GroundOptions(origin=(WEST + 1, SOUTH + 2), max_maps=10**6)),
        announce=said.append,
    )
    with pytest.raises(pytest.fail.Exception):
        next(steps)
    (paragraph,) = said
    rows, columns = (3200 - 2) // 8, (4800 - 1) // 12
    # Colours of 3 bytes, class of 1, elevation, slope and λ of 4 each; environment,
    # start, goal and time.
    size = rows * columns * (16 * 24 * (3 + 1 + 3 * 4) + 2 + 8 + 8 + 4)
    for words in (
        "3200 × 4800 cells of 1 m × 1 m", "metres", f"{rows * columns:,} maps of 16 × 24 cells of 0.5 m",
        f"{size / 1e9:.2f} GB", f"[{WEST + 1:.10g},{SOUTH + 2:.10g}]", "EPSG:32654", "set by `origin`",
    ):  # fmt: skip
        assert words in paragraph


def test_ground_that_does_not_fit_is_rejected_with_settings_that_do(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", np.zeros((100, 100)), 10.0)
    with pytest.raises(
        GroundError, match=r"--coarse .* resolution_m=10 .*class_periods_m=\["
    ) as caught:
        next(import_dem(str(dem), tmp_path / "o.h5", RECIPE))
    assert caught.value.changes["resolution_m"] == 10
    assert caught.value.stride_m is None
    with pytest.raises(ConfigError, match="`max_maps`"):
        next(
            import_dem(
                str(dem),
                tmp_path / "o.h5",
                RECIPE,
                cut=Cut(ground=GroundOptions(max_maps=0)),
            )
        )


def test_an_origin_is_the_corner_of_the_first_map_around_drives_too(
    tmp_path: Path,
) -> None:
    from tests.commands import call

    dem = write(tmp_path / "dem.tif", rough(200, 200))
    at = np.linspace(0, 1, 400)
    columns = [
        at * 100,
        WEST + 20 + 60 * at,
        SOUTH + 20 + 60 * at,
        1 + 0 * at,
        0.85 + 0.1 * np.sin(40 * at),
    ]
    header = "time_s,x_m,y_m,commanded_m_s,measured_m_s"
    np.savetxt(
        tmp_path / "log.csv",
        np.transpose(columns),
        "%.6f",
        ",",
        header=header,
        comments="",
    )
    photo = write(tmp_path / "photo.tif", np.full((3, 200, 200), 9, np.uint8))
    words = ("--dem", dem, "--photo", photo, "--recipe", "tiny-v1", "--splits", "train")
    log = ("import-drives", tmp_path / "log.csv", *words)
    for origin, expected in (
        (None, [WEST + 18, SOUTH + 18]),
        ((WEST + 9, SOUTH + 8), [WEST + 9, SOUTH + 8]),
    ):
        out = tmp_path / f"{origin is None}.h5"
        option = ("--origin", list(origin)) if origin else ()
        assert call("datagen", *log, "--out", out, *option) == 0
        dataset = TerrainDataset(out)
        assert dataset.has_photo("train")
        source = source_of(dataset)
        np.testing.assert_allclose(source["origin_m"], expected, atol=2)
        assert origin is None or source["origin_m"] == expected
        maps = dataset.read("train", fields=["drive_count"])["drive_count"]
        cells = np.argwhere(maps[0] > 0)[:, ::-1] * 0.5 + 0.25 + source["origin_m"]
        # the drive is a diagonal
        assert (np.abs(cells[:, 0] - WEST - (cells[:, 1] - SOUTH)) < 0.6).all()


@pytest.mark.parametrize(
    ("cell", "off_m"), [(0.5, 0.0), (0.5, 0.13), (0.25, 0.13), (0.7, 0.2)]
)
def test_heights_are_those_of_the_maps_cells_from_the_origin_on(
    tmp_path: Path, cell: float, off_m: float
) -> None:
    size = round(40 / cell)
    origin = WEST + 4 * cell + off_m, SOUTH + 6 * cell + off_m
    dataset = read(
        write(tmp_path / "dem.tif", plane(size, size, cell), cell), origin=origin
    )
    source, maps = source_of(dataset), maps_of(dataset)
    assert source["origin_m"] == pytest.approx(origin)
    x, y = (
        (np.arange(24) + 0.5) * 0.5 + origin[0] - WEST,
        (np.arange(16)[:, None] + 0.5) * 0.5 + origin[1] - SOUTH,
    )
    stored = maps["elevation_m"][0] + source["lowest_m"][0]
    np.testing.assert_allclose(
        stored, 900 + 0.2 * x + 0.1 * y, atol=0.02 if cell == 0.25 else STEP
    )


@pytest.mark.parametrize("value", [-1, 255, 9999])
def test_level_ground_at_a_common_value_is_level_ground(
    tmp_path: Path, value: float
) -> None:
    dataset = read(write(tmp_path / "dem.tif", np.full((16, 24), value, np.int16)))
    assert source_of(dataset)["lowest_m"] == [value]


def test_a_declared_unit_is_kept_in_the_manifest(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", np.full((16, 24), 1000.0))
    assert "metres_per_unit" not in source_of(read(dem))
    source = source_of(read(dem, dem_unit="us-ft"))
    assert source["metres_per_unit"] == pytest.approx(1200 / 3937)
    assert source["lowest_m"] == pytest.approx([1000 * 1200 / 3937], abs=STEP)


# Recipes of synthesis 2


def test_places_and_noise_are_drawn_on_real_ground_too(tmp_path: Path) -> None:
    places = PlacesRule(least_distance_m=6, margin_m=1)
    recipe = small_stakes(height=16, width=24, places=places)
    values = rough(32, 48).astype(np.float64) / 8
    whole = read(write(tmp_path / "dem.tif", values), recipe=recipe, solvable=True)
    assert whole.manifest["format_version"] == "1.1"
    assert whole.recipe.places == places
    maps = maps_of(whole)
    assert len(np.unique(maps["start_m"], axis=0)) == len(maps["start_m"]) == 4
    assert (np.hypot(*(maps["start_m"] - maps["goal_m"]).T) >= 6).all()
    for name in ("start_m", "goal_m"):
        assert (maps[name] >= 1).all()
        assert (maps[name] < (11, 7)).all()
    assert (maps["reference_time_s"] > 6).all()
    assert (maps["traversability"] < 0.15).any()
    # A map's draws go by its number in the raster, whichever others are left out.
    values[0, 0] = -1
    rest = read(
        write(tmp_path / "hole.tif", values, nodata=-1), recipe=recipe, solvable=True
    )
    assert source_of(rest)["kept"] == [0, 1, 3]
    for name, found in maps_of(rest).items():
        np.testing.assert_array_equal(found, maps[name][[0, 1, 3]])
