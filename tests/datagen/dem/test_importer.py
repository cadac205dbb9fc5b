"""Imports of synthetic GeoTIFFs; the oracles are closed forms, the raster's own numbers, and GDAL."""

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchnav.datagen.dem.importer import import_dem
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.places import PlacesRule
from benchnav.datagen.schema import quantise
from benchnav.datagen.synth.appearance import light_direction, shade
from benchnav.errors import BenchnavError, ConfigError
from tests.datagen.small import small_stakes
from tests.factories import tiny_recipe

rasterio = pytest.importorskip("rasterio")

WEST, SOUTH = 500_000.0, 3_999_900.0
STEP = 2.0**-13  # of stored elevation
# 12 m × 8 m: not square, so that swapped axes show.
RECIPE = replace(tiny_recipe(), height=16, width=24, start_m=(2.2, 2.2), goal_m=(9.2, 5.2))
NAMES = [kind.name for kind in RECIPE.classes]


def write(
    path: Path, values: Any, cell: float = 0.5, offset: tuple[float, float] = (0, 0), **profile: Any
) -> Path:
    """Writes a north-up GeoTIFF whose south-west corner lies `offset` metres off (WEST, SOUTH)."""
    values = np.asarray(values)
    values = values[None] if values.ndim == 2 else values
    bands, height, width = values.shape
    north = SOUTH + offset[1] + height * cell
    settings = {
        "driver": "GTiff", "crs": "EPSG:32654", "dtype": values.dtype, "count": bands, "height": height,
        "width": width, "transform": rasterio.Affine(cell, 0, WEST + offset[0], 0, -cell, north),
    }  # fmt: skip
    with rasterio.open(path, "w", **(settings | profile)) as file:
        file.write(values)
    return path


def centres(height: int, width: int, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """x and y of a raster's cells from its south-west corner, rows southward."""
    return (np.arange(width) + 0.5) * cell, (height - np.arange(height) - 0.5)[:, None] * cell


def plane(height: int, width: int, cell: float, slope_x: float = 0.2, slope_y: float = 0.1) -> np.ndarray:
    x, y = centres(height, width, cell)
    return 900 + slope_x * x + slope_y * y


def rough(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(100, 101, (height, width)).astype(np.float32)


def read(dem: Path, **settings: Any) -> TerrainDataset:
    """Imports into a new file, which must be sound."""
    out = dem.with_name(f"out-{len(list(dem.parent.iterdir()))}.h5")
    steps = list(import_dem(dem, out, settings.pop("recipe", RECIPE), dataset_id="real-v1", **settings))
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)
    assert steps[-1][0] == steps[-1][1]
    assert find_faults(out) == []
    assert {path.suffix for path in dem.parent.iterdir()} <= {".h5", ".tif"}
    return TerrainDataset(out)


def source_of(dataset: TerrainDataset) -> dict[str, Any]:
    (split,) = dataset.splits.values()
    (part,) = split["parts"]
    assert part["maps"] == split["maps"] == len(part["source"]["kept"]) == len(part["source"]["lowest_m"])
    assert "recipe" not in part
    return part["source"]


def maps_of(dataset: TerrainDataset) -> dict[str, np.ndarray]:
    return dataset.read(next(iter(dataset.splits)))


# Elevation


@pytest.mark.parametrize("cell", [0.5, 1.0, 0.8, 2.5, 0.25, 0.3, 0.35])
def test_a_plane_keeps_its_slope_and_rises_the_right_way(tmp_path: Path, cell: float) -> None:
    height, width = (int(np.ceil(metres / cell)) for metres in (16, 24))
    maps = maps_of(read(write(tmp_path / "dem.tif", plane(height, width, cell), cell)))
    x, y = (np.arange(24) + 0.5) * 0.5, (np.arange(16)[:, None] + 0.5) * 0.5
    expected = 0.2 * x + 0.1 * y
    assert len(maps["elevation_m"]) == 4
    for stored in maps["elevation_m"]:
        np.testing.assert_allclose(stored, expected - expected.min(), atol=STEP)
    np.testing.assert_allclose(maps["slope_deg"], np.degrees(np.arctan(np.hypot(0.2, 0.1))), atol=0.05)


def test_an_oblique_hill_is_shaded_as_in_the_raster(tmp_path: Path) -> None:
    x, y = centres(16, 24, 0.5)
    ridge = 3 * np.exp(-(((x - 5) + (y - 4.5)) ** 2) / 6 - ((x - 5) - (y - 4.5)) ** 2 / 20)
    stored = maps_of(read(write(tmp_path / "dem.tif", ridge)))["elevation_m"]
    # Cartographers' hillshade, on the raster's rows: azimuth clockwise from north, light from WNW.
    dz_southward, dz_eastward = np.gradient(ridge, 0.5)
    slope = np.arctan(np.hypot(dz_southward, dz_eastward))
    downhill = np.arctan2(-dz_eastward, dz_southward)
    azimuth, zenith = np.radians(295), np.radians(50)
    hillshade = np.cos(zenith) * np.cos(slope) + np.sin(zenith) * np.sin(slope) * np.cos(azimuth - downhill)
    light = light_direction(np.array([np.pi / 2 - azimuth]), np.array([np.cos(zenith)]))
    ours = shade(stored.astype(np.float64), 0.5, light, 0)[0]
    inside = (slice(1, -1), slice(1, -1))
    assert np.ptp(hillshade) > 0.5
    np.testing.assert_allclose(ours[inside], np.maximum(hillshade[::-1], 0)[inside], atol=0.05)


def test_at_its_own_resolution_a_tile_is_the_raster_at_its_recorded_origin(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(3 * 16 + 5, 2 * 24 + 7), blockysize=8)
    dataset = read(dem)
    source, stored = source_of(dataset), maps_of(dataset)["elevation_m"]
    assert source["kept"] == [0, 1, 2, 3, 4, 5]
    assert (source["tiles"], source["origin_m"]) == ([3, 2], [WEST, SOUTH])
    with rasterio.open(dem) as file:
        for index, number in enumerate(source["kept"]):
            row, column = divmod(number, 2)
            west, south = source["origin_m"][0] + 12 * column, source["origin_m"][1] + 8 * row
            window = rasterio.windows.from_bounds(west, south, west + 12, south + 8, file.transform)
            expected = file.read(1, window=window)[::-1].astype(np.float64)
            assert source["lowest_m"][index] == expected.min()
            np.testing.assert_array_equal(stored[index], quantise(expected - expected.min(), 13))


def test_coarser_cells_are_block_means(tmp_path: Path) -> None:
    fine = rough(16 * 3, 24 * 3)
    dataset = read(write(tmp_path / "dem.tif", fine, 0.5 / 3))
    means = fine.reshape(16, 3, 24, 3).mean(axis=(1, 3), dtype=np.float64)[::-1]
    stored = maps_of(dataset)["elevation_m"][0]
    np.testing.assert_allclose(stored + source_of(dataset)["lowest_m"][0], means, atol=STEP)


@pytest.mark.parametrize(("cell", "shape"), [(1.0, (8, 12)), (0.8, (20, 30)), (0.7, (24, 36))])
def test_finer_cells_are_gdals_cubic_away_from_the_border(
    tmp_path: Path, cell: float, shape: tuple[int, int]
) -> None:
    coarse = rough(*shape)
    dem = write(tmp_path / "dem.tif", coarse, cell)
    dataset = read(dem)
    expected = np.empty((16, 24), np.float64)
    with rasterio.open(dem) as file:
        rasterio.warp.reproject(
            file.read(1).astype(np.float64), expected, src_transform=file.transform, src_crs=file.crs,
            dst_transform=rasterio.Affine(0.5, 0, WEST, 0, -0.5, SOUTH + 8), dst_crs=file.crs,
            resampling=rasterio.enums.Resampling.cubic,
        )  # fmt: skip
    stored = maps_of(dataset)["elevation_m"][0] + source_of(dataset)["lowest_m"][0]
    inside = (slice(4, -4), slice(4, -4))
    np.testing.assert_allclose(stored[inside], expected[::-1][inside], atol=STEP)


def test_cells_need_not_be_square_and_numbers_may_be_scaled(tmp_path: Path) -> None:
    x, y = (np.arange(12) + 0.5) * 1.0, (32 - np.arange(32)[:, None] - 0.5) * 0.25
    stretched = rasterio.Affine(1, 0, WEST, 0, -0.25, SOUTH + 8)
    path = write(tmp_path / "dem.tif", np.rint(100 * (x + 2 * y)).astype(np.int16), transform=stretched)
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.001,), (50.0,)
    dataset = read(path)
    stored = maps_of(dataset)["elevation_m"][0].astype(np.float64)
    np.testing.assert_allclose(np.diff(stored, axis=1), 0.05, atol=0.002)
    np.testing.assert_allclose(np.diff(stored, axis=0), 0.1, atol=0.002)
    assert source_of(dataset)["lowest_m"][0] == pytest.approx(50.075, abs=0.001)


# Missing cells


@pytest.mark.parametrize("kind", ["nodata", "nan", "mask"])
@pytest.mark.parametrize("cell", [1.0, 0.5, 0.25])
def test_only_the_touched_map_is_left_out_and_the_others_stay_as_they_are(
    tmp_path: Path, cell: float, kind: str
) -> None:
    height, width = int(24 / cell), int(24 / cell)  # 3 rows of 2 maps
    values = rough(height, width)
    whole = read(write(tmp_path / "whole.tif", values, cell))
    # In map 3, the second of the second row: 16 m east and 12 m north.
    place = (height - 1 - int(12 / cell), int(16 / cell))
    holed = values.copy()
    holed[place] = {"nodata": -9999, "nan": np.nan, "mask": 100}[kind]
    path = write(tmp_path / "holed.tif", holed, cell, nodata=-9999 if kind == "nodata" else None)
    if kind == "mask":
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(path, "r+") as file:
            mask = np.full(values.shape, 255, np.uint8)
            mask[place] = 0
            file.write_mask(mask)
    dataset = read(path)
    assert source_of(dataset)["kept"] == [0, 1, 2, 4, 5]
    assert source_of(dataset)["left_out"] == {"missing_cells": 1, "not_solvable": 0}
    before = maps_of(whole)
    for name, kept in maps_of(dataset).items():
        np.testing.assert_array_equal(kept, before[name][[0, 1, 2, 4, 5]], err_msg=name)
    # The six differ from one another: λ of flat ground alone would not tell.
    assert len({m.tobytes() for m in before["traversability"]}) == 6


def test_a_missing_cell_that_had_a_share_in_the_next_map_leaves_that_out_too(tmp_path: Path) -> None:
    values = rough(8, 24)
    values[4, 11] = np.nan  # the last column of map 0; cubic convolution reaches it from map 1
    dataset = read(write(tmp_path / "cubic.tif", np.pad(values, ((0, 0), (0, 12)), mode="edge"), 1.0))
    assert source_of(dataset)["kept"] == [2]
    # At the maps' own resolution nothing reaches over.
    values = rough(16, 48)
    values[8, 23] = np.nan
    assert source_of(read(write(tmp_path / "own.tif", values)))["kept"] == [1]


@pytest.mark.parametrize(("column", "kept"), [(239, [0, 2]), (240, [0, 1])])
def test_rounding_of_coordinates_does_not_reach_over_to_the_next_map(
    tmp_path: Path, column: int, kept: list[int]
) -> None:
    dem = write(tmp_path / "dem.tif", rough(80, 360), 0.1)
    kinds = np.zeros((100, 400), np.uint8)
    kinds[50, 13 + column] = 255
    # Tenths of a metre are no binary fractions: the cells' edges miss one another by 10^-10 m.
    classes = write(tmp_path / "classes.tif", kinds, 0.1, offset=(-1.3, -0.7), nodata=255)
    assert source_of(read(dem, classes=classes))["kept"] == kept


# Classes and colours


def test_classes_are_mapped_by_name_and_the_largest_share_wins(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(16, 48))
    rng = np.random.default_rng(1)
    # Cells of 0.125 m, 4×4 a map's cell, over a larger extent: 10 of 16 are of the class of the cell.
    chosen = rng.integers(0, 3, (18, 52))
    fine = np.repeat(np.repeat(chosen, 4, axis=0), 4, axis=1)
    others = rng.random((18, 52, 16)).argsort(axis=2) < 6
    others = others.reshape(18, 52, 4, 4).swapaxes(1, 2).reshape(72, 208)
    fine = np.where(others, (fine + 1 + rng.integers(0, 2, fine.shape)) % 3, fine)
    values = np.array([40, 5, 100], np.uint8)[fine]
    classes = write(tmp_path / "classes.tif", values, 0.125, offset=(-1, -0.5))
    named = {40: "gravel", 5: "basalt", 100: "dune_sand", 7: "scree"}
    dataset = read(dem, classes=classes, class_ids=named)
    expected = np.array([NAMES.index(n) for n in ("gravel", "basalt", "dune_sand")])[chosen[::-1]][1:17, 2:50]
    maps = maps_of(dataset)
    np.testing.assert_array_equal(np.concatenate(list(maps["class_id"]), axis=1), expected)
    assert maps["environment"].tolist() == [0, 0]
    recorded = source_of(dataset)["classes"]
    assert recorded["ids"] == {"5": "basalt", "40": "gravel", "100": "dune_sand"}
    assert recorded["file"] == "classes.tif"
    assert len(recorded["sha256"]) == 64


def test_coarse_classes_are_indices_by_default_and_their_gaps_leave_maps_out(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(16, 48))
    values = np.arange(4 * 12).reshape(4, 12) % 9
    values[1, 8] = 255
    classes = write(tmp_path / "classes.tif", values.astype(np.uint8), 2.0, nodata=255)
    dataset = read(dem, classes=classes)
    assert source_of(dataset)["kept"] == [0]
    expected = np.repeat(np.repeat(values[::-1, :6], 4, axis=0), 4, axis=1)
    np.testing.assert_array_equal(maps_of(dataset)["class_id"][0], expected)


def test_without_a_class_raster_the_recipe_lays_classes_out_by_map_number(tmp_path: Path) -> None:
    maps = maps_of(read(write(tmp_path / "dem.tif", rough(48, 48))))
    assert maps["environment"].tolist() == [number % RECIPE.environments for number in range(6)]
    for environment, class_id in zip(maps["environment"], maps["class_id"], strict=True):
        assert set(np.unique(class_id)) == set(RECIPE.environment_classes(int(environment)))
    assert np.isnan(maps["reference_time_s"]).all()


def test_a_photo_keeps_its_colours(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(16, 48))
    cells = np.random.default_rng(2).integers(0, 256, (3, 16, 48))
    # Each map's cell is seen as 2×2 that average to it.
    spread = np.minimum(np.minimum(cells, 255 - cells), 20)
    fine = np.repeat(np.repeat(cells, 2, axis=1), 2, axis=2)
    fine[:, ::2, ::2] += spread
    fine[:, 1::2, 1::2] -= spread
    photo = write(tmp_path / "photo.tif", fine.astype(np.uint8), 0.25)
    painted, real = read(dem), read(dem, photo=photo)
    maps = maps_of(real)
    np.testing.assert_array_equal(np.concatenate(list(maps["rgb"]), axis=2), cells[:, ::-1])
    np.testing.assert_array_equal(maps["traversability"], maps_of(painted)["traversability"])
    assert source_of(real)["photo"]["file"] == "photo.tif"
    # Transparent cells are missing.
    opaque = np.full((1, *fine.shape[1:]), 255)
    opaque[0, 10, 60] = 0
    clear = write(tmp_path / "clear.tif", np.concatenate([fine, opaque]).astype(np.uint8), 0.25)
    assert source_of(read(dem, photo=clear))["kept"] == [0]


# The dataset


def test_the_manifest_says_where_the_maps_came_from(tmp_path: Path) -> None:
    dataset = read(write(tmp_path / "dem.tif", rough(16, 48)), split="test/hills", scenario="hs")
    assert dataset.id == dataset.recipe.id == "real-v1"
    assert set(dataset.splits) == {"test/hills"}
    assert dataset.splits["test/hills"]["scenario"] == "hs"
    assert dataset.recipe.splits["test/hills"].maps == dataset.splits["test/hills"]["maps"] == 2
    source = source_of(dataset)
    assert (source["kind"], source["file"], source["crs"]) == ("dem", "dem.tif", "EPSG:32654")
    assert source["resolution_m"] == [0.5, 0.5]
    assert source["classes"] is source["photo"] is None
    assert len(dataset.terrain("test/hills")) == 2


def test_with_solvable_maps_behind_a_wall_are_left_out(tmp_path: Path) -> None:
    values = np.zeros((16, 72))
    values[:, 24 + 12 :] = 50  # through map 1, between start and goal
    flat = np.zeros((16, 72), np.uint8)
    dem, classes = write(tmp_path / "dem.tif", values), write(tmp_path / "classes.tif", flat)
    dataset = read(dem, classes=classes, solvable=True)
    assert source_of(dataset)["kept"] == [0, 2]
    assert source_of(dataset)["left_out"] == {"missing_cells": 0, "not_solvable": 1}
    times = maps_of(dataset)["reference_time_s"]
    distance = 0.5 * (14 - 6 + 6 * np.sqrt(2))  # 14 cells east and 6 north, on eight headings
    assert distance < times[0] < 1.1 * distance
    every = maps_of(read(dem, classes=classes))
    np.testing.assert_array_equal(maps_of(dataset)["traversability"], every["traversability"][[0, 2]])


def test_a_map_may_cover_more_of_a_raster_than_is_read_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dem = write(tmp_path / "dem.tif", rough(80, 120), 0.1)
    at_once = maps_of(read(dem))
    monkeypatch.setattr("benchnav.datagen.dem.importer._VALUES_AT_ONCE", 7 * 120)
    for name, values in maps_of(read(dem)).items():
        np.testing.assert_array_equal(values, at_once[name], err_msg=name)


def test_an_import_that_stops_leaves_nothing(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(16 * 8, 24 * 8))
    steps = import_dem(dem, tmp_path / "out.h5", RECIPE, dataset_id="real-v1")
    assert next(steps) == (32, 64)
    steps.close()
    assert [path.name for path in tmp_path.iterdir()] == ["dem.tif"]


# Errors


def refusal(dem: Path, **settings: Any) -> str:
    """The one line that an import ends in, which leaves nothing behind."""
    before = sorted(dem.parent.iterdir())
    with pytest.raises(BenchnavError) as caught:
        list(import_dem(dem, dem.parent / "out.h5", RECIPE, **({"dataset_id": "real-v1"} | settings)))
    assert sorted(dem.parent.iterdir()) == before
    message = str(caught.value)
    assert "\n" not in message
    return message


FLAT = np.zeros((16, 24), np.float32)
ROTATED = rasterio.Affine(0.5, 0.1, WEST, 0.1, -0.5, SOUTH + 8)
DEGREES = {"crs": "EPSG:4326", "transform": rasterio.Affine(5e-6, 0, 139.7, 0, -5e-6, 35.7)}

BAD_GROUND: dict[str, tuple[dict[str, Any], list[str]]] = {
    "no CRS": ({"crs": None}, ["`dem`", "coordinate reference system", "rio edit-info --crs"]),
    "degrees": (DEGREES, ["`dem`", "EPSG:4326", "degree", "--dst-crs EPSG:32654"]),
    "southern degrees": (
        {"crs": "EPSG:4326", "transform": rasterio.Affine(5e-6, 0, -70.4, 0, -5e-6, -23.6)},
        ["--dst-crs EPSG:32719"],
    ),
    "feet": ({"crs": "EPSG:2263"}, ["`dem`", "EPSG:2263", "US survey foot", "--dst-crs EPSG:326"]),
    "web mercator": (
        {"crs": "EPSG:3857", "transform": rasterio.Affine(0.5, 0, 15551332, 0, -0.5, 4257980)},
        ["`dem`", "EPSG:3857", "1000 of them are 8", "--dst-crs EPSG:32654"],
    ),
    "heights in feet": (
        {"crs": "EPSG:26918+6360"},
        ["`dem`", "in metres", "US survey foot", "--units metre"],
    ),
    "rotated": ({"transform": ROTATED}, ["`dem`", "north up", "rotated", "rio warp"]),
    "upside down": ({"transform": rasterio.Affine(0.5, 0, WEST, 0, 0.5, SOUTH)}, ["north up", "mirrored"]),
    "nowhere": ({"transform": rasterio.Affine.identity()}, ["`dem`", "geotransform", "rio edit-info"]),
}


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("case", BAD_GROUND)
def test_ground_in_no_usable_place_is_refused(tmp_path: Path, case: str) -> None:
    profile, said = BAD_GROUND[case]
    message = refusal(write(tmp_path / "dem.tif", FLAT, **profile))
    for words in ["Expected", "dem.tif", *said]:
        assert words in message


def test_files_that_are_no_whole_geotiff_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.tif").write_text("hello")
    (tmp_path / "empty.tif").touch()
    whole = write(tmp_path / "dem.tif", rough(160, 240), compress="deflate").read_bytes()
    (tmp_path / "cut.tif").write_bytes(whole[: len(whole) // 2])
    write(tmp_path / "picture.tif", FLAT.astype(np.uint8), driver="PNG")
    for name in ("text.tif", "empty.tif", "cut.tif", "picture.tif"):
        message = refusal(tmp_path / name)
        assert "Expected `dem` as a GeoTIFF" in message
        assert name in message
    assert "not there" in refusal(tmp_path / "none.tif")
    dem = write(tmp_path / "dem.tif", FLAT)
    assert "`classes` as a GeoTIFF" in refusal(dem, classes=tmp_path / "text.tif")
    assert "`photo` as a GeoTIFF" in refusal(dem, photo=tmp_path / "text.tif")


def test_ground_that_gives_no_maps_is_refused(tmp_path: Path) -> None:
    message = refusal(write(tmp_path / "small.tif", FLAT[:-1]))
    assert "12 m × 8 m" in message
    assert "12 m × 7.5 m" in message
    message = refusal(write(tmp_path / "gaps.tif", np.full((32, 24), -1, np.int16), nodata=-1))
    assert "of 2, 2 have missing cells and 0 a goal" in message
    assert "one band" in refusal(write(tmp_path / "bands.tif", np.stack([FLAT, FLAT])))
    sentinel = FLAT.copy()
    sentinel[3, 3] = -9999
    assert "rio edit-info --nodata -9999" in refusal(write(tmp_path / "undeclared.tif", sentinel))
    # Averaged with 624 others it would look like ground.
    many = np.zeros((400, 600), np.float32)
    many[77, 99] = -32767
    assert "rio edit-info --nodata -32767" in refusal(write(tmp_path / "blended.tif", many, 0.02))


def test_rasters_that_do_not_fit_the_ground_are_refused(tmp_path: Path) -> None:
    dem, kinds = write(tmp_path / "dem.tif", FLAT), np.zeros((16, 24), np.uint8)
    moved = write(tmp_path / "moved.tif", np.stack([kinds] * 3), offset=(0.5, 0))
    afar = write(tmp_path / "afar.tif", np.stack([kinds] * 3), crs="EPSG:32655")
    for argument in ("classes", "photo"):
        message = refusal(dem, **{argument: moved})
        for words in (
            f"`{argument}` to cover `dem`",
            "x 500000 to 500012",
            "x 500000.5 to 500012.5",
            "rio clip",
        ):
            assert words in message
        message = refusal(dem, **{argument: afar})
        for words in (f"`{argument}` in the CRS of `dem`", "EPSG:32654", "EPSG:32655"):
            assert words in message
    assert "`photo`" in refusal(dem, photo=write(tmp_path / "grey.tif", kinds))
    assert "uint16" in refusal(dem, photo=write(tmp_path / "deep.tif", np.zeros((3, 16, 24), np.uint16)))
    assert "one band in `classes`" in refusal(dem, classes=write(tmp_path / "3.tif", np.stack([kinds] * 3)))


def test_a_crs_with_heights_is_the_same_place_as_one_without(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", FLAT, crs="EPSG:32654+5773")
    dataset = read(dem, classes=write(tmp_path / "classes.tif", FLAT.astype(np.uint8)))
    assert source_of(dataset)["crs"] == "EPSG:32654"


def test_unknown_classes_are_listed(tmp_path: Path) -> None:
    dem, kinds = write(tmp_path / "dem.tif", FLAT), np.zeros((16, 24), np.uint8)
    kinds[2, 3], kinds[9, 20] = 77, 12
    classes = write(tmp_path / "classes.tif", kinds)
    message = refusal(dem, classes=classes)
    assert "[12, 77]" in message
    assert str(NAMES) in message
    assert "[77]" in refusal(dem, classes=classes, class_ids={0: "scree", 12: "gravel"})
    message = refusal(dem, classes=classes, class_ids={0: "scree", 12: "lava", 77: "gravel"})
    assert "['lava']" in message
    message = refusal(dem, classes=write(tmp_path / "heights.tif", rough(16, 24)))
    assert "…" in message
    assert len(message) < 1000
    assert "Expected `classes` with `class_ids`" in refusal(dem, class_ids={0: "scree"})


def test_settings_and_targets_are_checked(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    assert "letters" in refusal(dem, split="a b")
    assert "letters" in refusal(dem, dataset_id="a/b")
    assert "'nope'" in refusal(dem, scenario="nope")
    (tmp_path / "out.h5").write_text("mine")
    assert "exists" in refusal(dem)
    assert (tmp_path / "out.h5").read_text() == "mine"
    list(import_dem(dem, tmp_path / "out.h5", RECIPE, dataset_id="real-v1", overwrite=True))
    assert TerrainDataset(tmp_path / "out.h5").splits["test/real"]["maps"] == 1


def test_without_rasterio_the_message_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(ConfigError, match=r"Expected rasterio.*pip install 'benchnav\[geo\]'"):
        next(import_dem(dem, tmp_path / "out.h5", RECIPE, dataset_id="real-v1"))


def level(*shape: int) -> np.ndarray:
    return np.full(shape, 500, np.float32)


# By case: rasters that are refused, and what the user has to fill in.
REMEDIES: dict[str, tuple[dict[str, dict[str, Any]], dict[str, str]]] = {
    "degrees": ({"dem": {"values": level(60, 90), **DEGREES}}, {}),
    "rotated": ({"dem": {"values": level(90, 90), "transform": ROTATED}}, {}),
    "no CRS": ({"dem": {"values": level(16, 24), "crs": None}}, {"CODE": "32654"}),
    "bands": ({"dem": {"values": level(2, 16, 24)}}, {}),
    "feet": ({"dem": {"values": level(16, 24), "crs": "EPSG:26918+6360"}}, {}),
    "undeclared": ({"dem": {"values": np.where(np.arange(48) < 40, level(16, 48), -9999)}}, {}),
    "not covered": (
        {
            "dem": {"values": level(30, 40)},
            "classes": {"values": np.zeros((20, 30), np.uint8), "offset": (1, 1)},
        },
        {},
    ),
}


@pytest.mark.parametrize("case", REMEDIES)
def test_the_remedy_of_the_message_is_one(tmp_path: Path, case: str) -> None:
    from click.testing import CliRunner
    from rasterio.rio.main import main_group

    profiles, filled = REMEDIES[case]
    rasters = {name: write(tmp_path / f"{name}.tif", **profile) for name, profile in profiles.items()}
    command = refusal(rasters.pop("dem"), **rasters).split(": rio ")[1]
    for blank, value in filled.items():
        command = command.replace(blank, value)
    words = shlex.split(command)
    if not words[-1].startswith(str(tmp_path)):
        words[-1] = str(tmp_path / words[-1])
    ran = CliRunner().invoke(main_group, words)
    assert ran.exit_code == 0, ran.output
    source = source_of(read(Path(words[-1]), **rasters))
    np.testing.assert_allclose(source["lowest_m"], 500, atol=0.001)


# Recipes of synthesis 2


def test_places_and_luck_are_drawn_on_real_ground_too(tmp_path: Path) -> None:
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
    rest = read(write(tmp_path / "hole.tif", values, nodata=-1), recipe=recipe, solvable=True)
    assert source_of(rest)["kept"] == [0, 1, 3]
    for name, found in maps_of(rest).items():
        np.testing.assert_array_equal(found, maps[name][[0, 1, 3]])
