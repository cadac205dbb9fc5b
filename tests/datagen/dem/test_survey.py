"""What rasters say of the ground; the oracles are closed forms, the raster's own
numbers, and GDAL.
"""

import hashlib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchnav.datagen.dem.survey import provenance
from benchnav.datagen.schema import UNLABELLED, quantise
from benchnav.datagen.synth.appearance import light_direction, shade
from benchnav.datagen.synth.elevation import horn_gradient, inclination_deg, pad_missing
from tests.datagen.dem.rasters import (
    FLAT,
    NAMES,
    RECIPE,
    SOUTH,
    STEP,
    WEST,
    centres,
    maps_of,
    plane,
    read,
    refusal,
    rough,
    source_of,
    source_tiles,
    tile_place,
    write,
)

rasterio = pytest.importorskip("rasterio")
pytest.importorskip("rasterio.shutil")

# Elevation


@pytest.mark.parametrize(
    ("cell", "off_by_deg"),
    [
        (0.5, 0),
        (0.25, 0),
        (0.1, 0),
        (1.0, 0),
        (0.8, 0),
        (0.7, 0),
        (0.3, 0.2),
        (0.4, 0.2),
    ],
)
def test_a_plane_keeps_its_slope_and_rises_the_right_way(
    tmp_path: Path, cell: float, off_by_deg: float
) -> None:
    room = 7 if cell > 0.5 else 0  # beyond the maps, for interpolation
    height, width = (int(np.ceil((metres + room) / cell)) for metres in (16, 24))
    maps = maps_of(read(write(tmp_path / "dem.tif", plane(height, width, cell), cell)))
    x, y = (np.arange(24) + 0.5) * 0.5, (np.arange(16)[:, None] + 0.5) * 0.5
    expected = 0.2 * x + 0.1 * y
    assert len(maps["elevation_m"]) == 4
    for stored in maps["elevation_m"]:
        np.testing.assert_allclose(
            stored, expected - expected.min(), atol=STEP if off_by_deg == 0 else 0.01
        )
    slope = np.degrees(np.arctan(np.hypot(0.2, 0.1)))
    np.testing.assert_allclose(maps["slope_deg"], slope, atol=0.05 + off_by_deg)


def reprojected(
    raster: Path,
    source: dict[str, Any],
    resampling: str,
    cells: tuple[int, int],
    frame: int = 0,
) -> np.ndarray:
    """GDAL's own answer for cells from the maps' south-west corner on, rows northward,
    pad_missing by some more.
    """
    west, south = (metres - 0.5 * frame for metres in source["origin_m"])
    expected = np.full([count + 2 * frame for count in cells], np.nan)
    with rasterio.open(raster) as file:
        rasterio.warp.reproject(
            file.read(1).astype(np.float64), expected, src_transform=file.transform, src_crs=file.crs,
            src_nodata=file.nodata, dst_crs=source["crs"], dst_nodata=np.nan,
            dst_transform=rasterio.Affine(0.5, 0, west, 0, -0.5, south + 0.5 * len(expected)),
            resampling=rasterio.enums.Resampling[resampling], tolerance=0.01,
        )  # fmt: skip
    return expected[::-1]


@pytest.mark.parametrize("stride", [None, 4.0])
@pytest.mark.parametrize(
    ("cell", "resampling"), [(1.0, "cubic"), (0.5, "nearest"), (0.25, "average")]
)
def test_slopes_are_those_of_the_whole_ground_at_seams_too(
    tmp_path: Path, cell: float, resampling: str, stride: float | None
) -> None:
    # Ground of 3 × 2 maps side by side, and more to the north and east.
    dem = write(tmp_path / "dem.tif", 3 * rough(int(30 / cell), int(30 / cell)), cell)
    dataset = read(dem, stride_m=stride)
    source, maps = source_of(dataset), maps_of(dataset)
    assert source["tiles"] == ([3, 2] if stride is None else [6, 5])
    # else the raster ends where the maps begin
    frame = 1 if resampling == "cubic" else 0
    cells = (56, 56) if frame else (60, 60)
    ground = quantise(reprojected(dem, source, resampling, cells, frame), 13)
    slopes = inclination_deg(*horn_gradient(pad_missing(ground[None]), 0.5))[0]
    for index, number in enumerate(source["kept"]):
        row, column = (int(2 * metres) + frame for metres in tile_place(source, number))
        own = (slice(row, row + 16), slice(column, column + 24))
        stored = maps["elevation_m"][index] + source["lowest_m"][index]
        np.testing.assert_allclose(stored, ground[own], atol=STEP)
        np.testing.assert_allclose(maps["slope_deg"][index], slopes[own], atol=0.02)


def test_an_oblique_hill_is_shaded_as_in_the_raster(tmp_path: Path) -> None:
    x, y = centres(16, 24, 0.5)
    ridge = 3 * np.exp(
        -(((x - 5) + (y - 4.5)) ** 2) / 6 - ((x - 5) - (y - 4.5)) ** 2 / 20
    )
    stored = maps_of(read(write(tmp_path / "dem.tif", ridge)))["elevation_m"]
    # Cartographers' hillshade, on the raster's rows: azimuth clockwise from north,
    # light from WNW.
    dz_southward, dz_eastward = np.gradient(ridge, 0.5)
    slope = np.arctan(np.hypot(dz_southward, dz_eastward))
    downhill = np.arctan2(-dz_eastward, dz_southward)
    azimuth, zenith = np.radians(295), np.radians(50)
    hillshade = np.cos(zenith) * np.cos(slope) + np.sin(zenith) * np.sin(
        slope
    ) * np.cos(azimuth - downhill)
    light = light_direction(np.array([np.pi / 2 - azimuth]), np.array([np.cos(zenith)]))
    ours = shade(*horn_gradient(pad_missing(stored.astype(np.float64)), 0.5), light, 0)[
        0
    ]
    inside = (slice(1, -1), slice(1, -1))
    assert np.ptp(hillshade) > 0.5
    np.testing.assert_allclose(
        ours[inside], np.maximum(hillshade[::-1], 0)[inside], atol=0.05
    )


def test_at_its_own_resolution_a_tile_is_the_raster_at_its_recorded_origin(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", rough(3 * 16 + 5, 2 * 24 + 7), blockysize=8)
    dataset = read(dem)
    source, stored = source_of(dataset), maps_of(dataset)["elevation_m"]
    assert source["kept"] == [0, 1, 2, 3, 4, 5]
    assert (source["tiles"], source["origin_m"]) == ([3, 2], [WEST, SOUTH])
    with rasterio.open(dem) as file:
        for index, number in enumerate(source["kept"]):
            row, column = divmod(number, 2)
            west, south = (
                source["origin_m"][0] + 12 * column,
                source["origin_m"][1] + 8 * row,
            )
            window = rasterio.windows.from_bounds(
                west, south, west + 12, south + 8, file.transform
            )
            expected = file.read(1, window=window)[::-1].astype(np.float64)
            expected = quantise(expected, 13)
            assert source["lowest_m"][index] == expected.min()
            np.testing.assert_array_equal(stored[index], expected - expected.min())


def test_coarser_cells_are_block_means(tmp_path: Path) -> None:
    fine = rough(16 * 3, 24 * 3)
    dataset = read(write(tmp_path / "dem.tif", fine, 0.5 / 3))
    means = fine.reshape(16, 3, 24, 3).mean(axis=(1, 3), dtype=np.float64)[::-1]
    stored = maps_of(dataset)["elevation_m"][0]
    np.testing.assert_allclose(
        stored + source_of(dataset)["lowest_m"][0], means, atol=STEP
    )


def test_means_of_whole_numbers_are_not_rounded(tmp_path: Path) -> None:
    whole = np.random.default_rng(6).integers(100, 109, (32, 48)).astype(np.int16)
    dataset = read(write(tmp_path / "dem.tif", whole, 0.25, nodata=-9999))
    means = whole.reshape(16, 2, 24, 2).mean(axis=(1, 3))[::-1]
    stored = maps_of(dataset)["elevation_m"][0] + source_of(dataset)["lowest_m"][0]
    np.testing.assert_allclose(stored, means, atol=STEP)


def test_cells_need_not_be_square_and_numbers_may_be_whole_and_scaled(
    tmp_path: Path,
) -> None:
    x, y = (np.arange(17) + 0.5) * 1.0, (52 - np.arange(52)[:, None] - 0.5) * 0.25
    stretched = rasterio.Affine(1, 0, WEST, 0, -0.25, SOUTH + 13)
    path = write(
        tmp_path / "dem.tif",
        np.rint(100 * (x + 2 * y)).astype(np.int16),
        transform=stretched,
    )
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.001,), (50.0,)
    dataset = read(path)
    stored = maps_of(dataset)["elevation_m"][0].astype(np.float64)
    np.testing.assert_allclose(np.diff(stored, axis=1), 0.05, atol=0.002)
    np.testing.assert_allclose(np.diff(stored, axis=0), 0.1, atol=0.002)
    source = source_of(dataset)
    west, south = source["origin_m"]
    corner = 0.1 * (west + 0.25 - WEST) + 0.2 * (south + 0.25 - SOUTH)
    assert source["lowest_m"][0] == pytest.approx(50 + corner, abs=0.001)
    assert source["resolution_m"] == [1.0, 0.25]


# Coordinate reference systems and addresses


def test_ground_in_degrees_is_laid_in_its_utm_zone(tmp_path: Path) -> None:
    step = 1e-5
    path = tmp_path / "degrees.tif"
    transform = rasterio.Affine(step, 0, 139.7, 0, -step, 35.7)
    longitude = 139.7 + (np.arange(60) + 0.5) * step
    latitude = 35.7 - (np.arange(60)[:, None] + 0.5) * step
    x, y = rasterio.warp.transform(
        "EPSG:4326",
        "EPSG:32654",
        *(v.ravel() for v in np.broadcast_arrays(longitude, latitude)),
    )
    x0, y0 = min(x), min(y)
    values = (0.2 * (np.array(x) - x0) + 0.1 * (np.array(y) - y0)).reshape(60, 60)
    dataset = read(write(path, values, crs="EPSG:4326", transform=transform))
    source, maps = source_of(dataset), maps_of(dataset)
    assert source["crs"] == "EPSG:32654"
    assert len(source["kept"]) >= 4
    west, south = source["origin_m"]
    for index, number in enumerate(source["kept"]):
        north, east = tile_place(source, number)
        cells_x, cells_y = (
            west + east + (np.arange(24) + 0.5) * 0.5,
            south + north + (np.arange(16) + 0.5) * 0.5,
        )
        expected = 0.2 * (cells_x - x0) + 0.1 * (cells_y[:, None] - y0)
        stored = maps["elevation_m"][index] + source["lowest_m"][index]
        np.testing.assert_allclose(stored[3:-3, 3:-3], expected[3:-3, 3:-3], atol=0.005)


@pytest.mark.parametrize(
    ("profile", "crs"),
    [
        (
            {
                "crs": "EPSG:4326",
                "transform": rasterio.Affine(5e-6, 0, -70.4, 0, -5e-6, -23.6),
            },
            "EPSG:32719",
        ),
        (
            {"crs": "EPSG:2263", "transform": rasterio.Affine(1, 0, 1e6, 0, -1, 2e5)},
            "EPSG:32618",
        ),
        (
            {
                "crs": "EPSG:3857",
                "transform": rasterio.Affine(0.5, 0, 15551332, 0, -0.5, 4257980),
            },
            "EPSG:32654",
        ),
        ({"crs": "EPSG:32654+5773"}, "EPSG:32654"),
    ],
)
def test_ground_is_laid_where_metres_are_metres(
    tmp_path: Path, profile: dict[str, Any], crs: str
) -> None:
    dem = write(tmp_path / "dem.tif", np.zeros((120, 120)), **profile)
    assert source_of(read(dem, dem_unit="m"))["crs"] == crs


# Radii in metres, the northing of a latitude, and how long a metre of ground is in the
# projection, eastward and northward: closed forms of Snyder (1987), with the
# ellipsoid's radii of curvature N and M.
def cylindrical(radius: float, _: float, latitude: float) -> tuple[float, float, float]:
    return radius * latitude, 1 / np.cos(latitude), 1.0


def mercator(
    semi_major: float, eccentricity: float, latitude: float
) -> tuple[float, float, float]:
    sine = eccentricity * np.sin(latitude)
    isometric = np.arctanh(np.sin(latitude)) - eccentricity * np.arctanh(sine)
    scale = np.sqrt(1 - sine**2) / np.cos(latitude)
    return semi_major * isometric, scale, scale


def web_mercator(
    semi_major: float, eccentricity: float, latitude: float
) -> tuple[float, float, float]:
    sine, cosine = eccentricity * np.sin(latitude), np.cos(latitude)
    across, along = (
        1 / np.sqrt(1 - sine**2),
        (1 - eccentricity**2) / (1 - sine**2) ** 1.5,
    )
    return (
        semi_major * np.arctanh(np.sin(latitude)),
        1 / (across * cosine),
        1 / (along * cosine),
    )


BODIES = {
    "moon": (cylindrical, "+proj=eqc +R=1737400 +units=m +no_defs", 1737400.0, 0.0),
    "mars": (cylindrical, "IAU_2015:49910", 3396190.0, 0.0),
    "mars ellipsoid": (
        mercator,
        "+proj=merc +a=3396190 +b=3376200 +units=m +no_defs",
        3396190.0,
        0.108337,
    ),
    "earth": (web_mercator, "EPSG:3857", 6378137.0, 0.0818191908),
}


@pytest.mark.parametrize("latitude", [0, 60, 85])
@pytest.mark.parametrize("body", BODIES)
def test_slopes_are_those_of_the_ground_wherever_the_scale_of_the_map_is_another(
    tmp_path: Path, body: str, latitude: int
) -> None:
    formula, crs, radius, eccentricity = BODIES[body]
    north, across, along = formula(radius, eccentricity, np.radians(latitude))
    east, cells = radius * np.radians(10), np.arange(80) - 39.5
    # rising 20 % eastward, 10 % northward
    values = 50 + 0.2 * 0.5 * cells - 0.1 * 0.5 * cells[:, None]
    transform = rasterio.Affine(
        across * 0.5,
        0,
        east - 40 * across * 0.5,
        0,
        -along * 0.5,
        north + 40 * along * 0.5,
    )
    dataset = read(write(tmp_path / "dem.tif", values, crs=crs, transform=transform))
    source, maps = source_of(dataset), maps_of(dataset)
    # 40 m × 40 m of ground hold four rows of maps, and a column between the edges that
    # interpolation lacks.
    assert len(source["kept"]) >= 4
    np.testing.assert_allclose(source["resolution_m"], 0.5, rtol=0.02)
    inner = maps["slope_deg"][:, 2:-2, 2:-2]  # the raster's edge may lie oblique
    np.testing.assert_allclose(
        inner, np.degrees(np.arctan(np.hypot(0.2, 0.1))), atol=0.1
    )
    rises = (
        np.gradient(maps["elevation_m"][0], 0.5, axis=axis).mean() for axis in (1, 0)
    )
    # Northward is that of the projection: on the Earth UTM's grid is turned by its
    # convergence.
    turn = np.radians(7) if body == "earth" and latitude == 85 else 0.03
    np.testing.assert_allclose(list(rises), [0.2, 0.1], atol=0.01 + 0.25 * turn)


def test_ground_off_the_earth_may_be_in_degrees_and_its_own_metres_are_kept_where_they_are_true(
    tmp_path: Path,
) -> None:
    moon = "+proj=longlat +R=1737400 +no_defs"
    # 0.5 m northward, and half of that eastward at 60°
    cell = np.degrees(0.5 / 1737400)
    profile = {"crs": moon, "transform": rasterio.Affine(2 * cell, 0, 20, 0, -cell, 60)}
    maps = maps_of(read(write(tmp_path / "degrees.tif", plane(80, 80, 0.5), **profile)))
    np.testing.assert_allclose(
        maps["slope_deg"], np.degrees(np.arctan(np.hypot(0.2, 0.1))), atol=0.02
    )
    plain = "+proj=stere +lat_0=-90 +R=1737400 +units=m +no_defs"
    near = write(
        tmp_path / "pole.tif",
        FLAT,
        crs=plain,
        transform=rasterio.Affine(0.5, 0, 100, 0, -0.5, 100),
    )
    assert source_of(read(near))["origin_m"] == [100, 92]


def test_ground_that_no_map_shows_true_to_scale_is_refused(tmp_path: Path) -> None:
    globe = {"crs": "+proj=eqc +R=1737400 +units=m +no_defs"}
    globe |= {"transform": rasterio.Affine(136e3, 0, -5.44e6, 0, -136e3, 2.72e6)}
    message = refusal(write(tmp_path / "globe.tif", np.zeros((40, 80)), **globe))
    assert "small enough" in message
    assert "rio clip" in message


@pytest.mark.parametrize("turn", ["mirrored", "rotated"])
def test_a_raster_need_not_be_north_up(tmp_path: Path, turn: str) -> None:
    affine = rasterio.Affine.translation(WEST, SOUTH) * rasterio.Affine.scale(0.25)
    affine *= rasterio.Affine.rotation(20 if turn == "rotated" else 0)
    column, row = np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5)
    x, y = affine * (column, row)
    dataset = read(
        write(
            tmp_path / "dem.tif", 0.2 * (x - WEST) + 0.1 * (y - SOUTH), transform=affine
        )
    )
    source, maps = source_of(dataset), maps_of(dataset)
    west, south = source["origin_m"]
    for index, number in enumerate(source["kept"]):
        north, east = tile_place(source, number)
        expected = 0.2 * (west + east + 0.25 - WEST) + 0.1 * (
            south + north + 0.25 - SOUTH
        )
        assert source["lowest_m"][index] == pytest.approx(expected, abs=0.05)
        inner = maps["slope_deg"][index][1:-1, 1:-1]
        np.testing.assert_allclose(
            np.median(inner), np.degrees(np.arctan(np.hypot(0.2, 0.1))), atol=0.2
        )
    assert source["left_out"]["missing_elevation"] == (
        0 if turn == "mirrored" else source_tiles(source) - index - 1
    )


def test_other_rasters_may_be_in_another_crs_and_their_gaps_leave_maps_out(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", rough(48, 72))
    kinds = (
        np.random.default_rng(3)
        .integers(0, 3, (40, 40))
        .repeat(8, 0)
        .repeat(8, 1)
        .astype(np.uint8)
    )
    transform, width, height = rasterio.warp.calculate_default_transform(
        "EPSG:32654",
        "EPSG:4326",
        24,
        24,
        left=WEST - 1,
        bottom=SOUTH - 1,
        right=WEST + 25,
        top=SOUTH + 25,
    )
    scale = rasterio.Affine.scale(width / 320, height / 320)
    classes = write(
        tmp_path / "classes.tif", kinds, crs="EPSG:4326", transform=transform * scale
    )
    colours = np.stack([kinds * 50, kinds * 20 + 9, kinds + 100]).astype(np.uint8)
    photo = write(
        tmp_path / "photo.tif", colours, crs="EPSG:4326", transform=transform * scale
    )
    measured = write(
        tmp_path / "lambda.tif", kinds / 2, crs="EPSG:4326", transform=transform * scale
    )
    dataset = read(dem, classes=classes, photo=photo, traversability=measured)
    source, maps = source_of(dataset), maps_of(dataset)
    # They end a metre beyond 24 m × 24 m, of which the ground has 36 m × 24 m.
    assert source["kept"] == [0, 1, 3, 4, 6, 7]
    # Of cells without a class a map may have some, of cells without colour none.
    assert source["left_out"]["missing_classes"] == 0
    assert source["left_out"]["missing_colours"] == 3
    expected = reprojected(classes, source, "mode", (48, 48))
    average = reprojected(measured, source, "average", (48, 48))
    for index, number in enumerate(source["kept"]):
        row, column = (int(2 * metres) for metres in tile_place(source, number))
        own = (slice(row, row + 16), slice(column, column + 24))
        np.testing.assert_array_equal(maps["class_id"][index], expected[own])
        np.testing.assert_allclose(
            maps["traversability"][index], average[own], atol=1e-4
        )
        np.testing.assert_allclose(maps["rgb"][index, 0], 100 * average[own], atol=0.51)


def test_rasters_are_found_by_any_address(tmp_path: Path) -> None:
    rasters, zipped = tmp_path / "rasters", tmp_path / "all.zip"
    rasters.mkdir()
    values = rough(16, 48)
    west = write(rasters / "west.tif", values[:, :24])
    whole = write(rasters / "whole.tif", values)
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.write(whole, "whole.tif")
    rasterio.shutil.copy(whole, rasters / "whole.vrt", driver="VRT")
    rasterio.shutil.copy(whole, rasters / "whole.img", driver="HFA")
    expected = read(whole, tmp_path)
    assert (
        source_of(expected)["sha256"] == hashlib.sha256(whole.read_bytes()).hexdigest()
    )
    addresses = [
        f"/vsizip/{zipped}/whole.tif",
        f"zip://{zipped}!whole.tif",
        *map(str, rasters.glob("*.vrt")),
    ]
    for address in [*addresses, str(rasters / "whole.img")]:
        dataset = read(address, tmp_path)
        assert dataset.digest == expected.digest
        is_file = Path(address).is_file()
        assert source_of(dataset)["file"] == (
            Path(address).name if is_file else address
        )
        assert (source_of(dataset)["sha256"] is None) == (not is_file)
    assert source_of(read(west, tmp_path))["tiles"] == [1, 1]


def test_secrets_of_an_address_are_not_kept() -> None:
    kept = provenance("https://me:word@example.org/a/dem.tif?sig=secret")
    assert kept == {"file": "https://example.org/a/dem.tif", "sha256": None}
    assert provenance("/vsicurl/https://me:word@example.org/dem.tif?sig=secret") == {
        "file": "/vsicurl/https://example.org/dem.tif",
        "sha256": None,
    }


# Missing cells


@pytest.mark.parametrize("kind", ["nodata", "nan", "mask"])
@pytest.mark.parametrize("cell", [1.0, 0.5, 0.25])
def test_only_the_touched_map_is_left_out_and_the_others_stay_as_they_are(
    tmp_path: Path, cell: float, kind: str
) -> None:
    height, width = int(28 / cell), int(30 / cell)  # 3 rows of 2 maps, and room
    values = rough(height, width)
    whole = read(write(tmp_path / "whole.tif", values, cell))
    # In map 3, the second of the second row: 18 m east and 14 m north.
    row, column = height - 1 - int(14 / cell), int(18 / cell)
    hole = (
        slice(row - int(1 / cell), row + int(1 / cell)),
        slice(column, column + int(2 / cell)),
    )
    holed = values.copy()
    holed[hole] = {"nodata": -9999, "nan": np.nan, "mask": 100}[kind]
    path = write(
        tmp_path / "holed.tif", holed, cell, nodata=-9999 if kind == "nodata" else None
    )
    if kind == "mask":
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(path, "r+") as file,
        ):
            mask = np.full(values.shape, 255, np.uint8)
            mask[hole] = 0
            file.write_mask(mask)
    dataset = read(path)
    assert source_of(dataset)["kept"] == [0, 1, 2, 4, 5]
    assert source_of(dataset)["left_out"] == {
        "missing_elevation": 1,
        "not_solvable": 0,
        "between_splits": 0,
    }
    before = maps_of(whole)
    for name, kept in maps_of(dataset).items():
        np.testing.assert_array_equal(kept, before[name][[0, 1, 2, 4, 5]], err_msg=name)
    # The six differ from one another: λ of flat ground alone would not tell.
    assert len({m.tobytes() for m in before["traversability"]}) == 6


def test_what_is_missing_beyond_a_map_is_continued_linearly(tmp_path: Path) -> None:
    values = plane(16, 48, 0.5)
    values[:, 24:] = np.nan
    dataset = read(write(tmp_path / "dem.tif", values))
    assert source_of(dataset)["kept"] == [0]
    np.testing.assert_allclose(
        maps_of(dataset)["slope_deg"],
        np.degrees(np.arctan(np.hypot(0.2, 0.1))),
        atol=0.05,
    )


def test_a_cell_takes_what_of_it_is_there(tmp_path: Path) -> None:
    values = rough(32, 48)
    values[::2, ::2] = np.nan
    dataset = read(write(tmp_path / "dem.tif", values, 0.25))
    expected = np.nanmean(values.reshape(16, 2, 24, 2).astype(np.float64), axis=(1, 3))[
        ::-1
    ]
    stored = maps_of(dataset)["elevation_m"][0] + source_of(dataset)["lowest_m"][0]
    np.testing.assert_allclose(stored, expected, atol=STEP)


# Classes and colours


def test_classes_are_mapped_by_name_and_the_largest_share_wins(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(16, 48))
    rng = np.random.default_rng(1)
    # Cells of 0.125 m, 4×4 a map's cell, over a larger extent: 10 of 16 are of the
    # class of the cell.
    chosen = rng.integers(0, 3, (18, 52))
    fine = np.repeat(np.repeat(chosen, 4, axis=0), 4, axis=1)
    others = rng.random((18, 52, 16)).argsort(axis=2) < 6
    others = others.reshape(18, 52, 4, 4).swapaxes(1, 2).reshape(72, 208)
    fine = np.where(others, (fine + 1 + rng.integers(0, 2, fine.shape)) % 3, fine)
    values = np.array([40, 5, 100], np.uint8)[fine]
    classes = write(tmp_path / "classes.tif", values, 0.125, offset=(-1, -0.5))
    named = {40: "gravel", 5: "basalt", 100: "dune_sand", 7: "scree"}
    dataset = read(dem, classes=classes, class_ids=named)
    expected = np.array([NAMES.index(n) for n in ("gravel", "basalt", "dune_sand")])[
        chosen[::-1]
    ][1:17, 2:50]
    maps = maps_of(dataset)
    np.testing.assert_array_equal(
        np.concatenate(list(maps["class_id"]), axis=1), expected
    )
    assert maps["environment"].tolist() == [0, 0]
    recorded = source_of(dataset)["classes"]
    assert recorded["ids"] == {
        "5": "basalt",
        "7": "scree",
        "40": "gravel",
        "100": "dune_sand",
    }
    assert recorded["file"] == "classes.tif"
    assert len(recorded["sha256"]) == 64


def test_coarse_classes_are_indices_by_default_and_their_gaps_leave_painted_maps_out(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", rough(16, 48))
    values = np.arange(4 * 12).reshape(4, 12) % 9
    values[1, 8] = 255
    classes = write(tmp_path / "classes.tif", values.astype(np.uint8), 2.0, nodata=255)
    dataset = read(dem, classes=classes)
    assert source_of(dataset)["kept"] == [0]
    assert source_of(dataset)["left_out"]["missing_classes"] == 1
    expected = np.repeat(np.repeat(values[::-1, :6], 4, axis=0), 4, axis=1)
    np.testing.assert_array_equal(maps_of(dataset)["class_id"][0], expected)


def test_a_class_of_no_name_leaves_its_painted_map_out(tmp_path: Path) -> None:
    dem, values = (
        write(tmp_path / "dem.tif", rough(16, 48)),
        np.full((16, 48), 7, np.uint8),
    )
    values[3, 3] = 9
    classes = write(tmp_path / "classes.tif", values)
    dataset = read(dem, classes=classes, class_ids={7: "scree", 9: None})
    assert source_of(dataset)["kept"] == [1]
    assert source_of(dataset)["left_out"]["missing_classes"] == 1
    assert source_of(dataset)["classes"]["ids"] == {"7": "scree", "9": None}
    assert (maps_of(dataset)["class_id"] == NAMES.index("scree")).all()


def test_with_a_photo_cells_without_a_class_are_kept_as_such(tmp_path: Path) -> None:
    dem, values = (
        write(tmp_path / "dem.tif", rough(16, 72)),
        np.full((16, 72), 7, np.uint8),
    )
    values[0, :5] = 9  # the northern row of map 0
    values[:, 24:48] = 9  # all of map 1
    classes = write(tmp_path / "classes.tif", values)
    photo = write(tmp_path / "photo.tif", np.full((3, 16, 72), 90, np.uint8))
    table = {7: "scree", 9: None}
    dataset = read(dem, classes=classes, class_ids=table, photo=photo)
    source, maps = source_of(dataset), maps_of(dataset)
    assert source["kept"] == [0, 2]
    assert source["unlabelled"] == [5, 0]
    assert source["left_out"]["missing_classes"] == 1
    wanted = np.full((2, 16, 24), NAMES.index("scree"))
    wanted[0, 15, :5] = UNLABELLED
    np.testing.assert_array_equal(maps["class_id"], wanted)
    np.testing.assert_array_equal(
        np.isnan(maps["traversability"]), wanted == UNLABELLED
    )
    truth = dataset.terrain("test/real").truth
    np.testing.assert_array_equal(truth.means[:, 0].isnan(), wanted == UNLABELLED)
    assert dataset.manifest["format_version"] == "1.2"  # which readers of 1.1 refuse
    # What was measured there is kept.
    measured = write(tmp_path / "lambda.tif", np.full((16, 72), 0.25))
    known = read(
        dem, classes=classes, class_ids=table, photo=photo, traversability=measured
    )
    assert (maps_of(known)["traversability"] == 0.25).all()
    # Other cells are as they would be without.
    values[0, :5] = 7
    whole = read(
        dem, classes=write(tmp_path / "whole.tif", values), class_ids=table, photo=photo
    )
    labelled, before = wanted != UNLABELLED, maps_of(whole)
    for name in ("traversability", "slope_deg", "rgb"):
        assert_same_cells(maps[name], before[name], labelled)
    assert whole.manifest["format_version"] == "1.0"


def assert_same_cells(found: np.ndarray, wanted: np.ndarray, where: np.ndarray) -> None:
    layers = [array if array.ndim == 3 else array[:, 0] for array in (found, wanted)]
    np.testing.assert_array_equal(layers[0][where], layers[1][where])


def test_ground_without_a_class_is_no_way_to_the_goal(tmp_path: Path) -> None:
    dem, values = (
        write(tmp_path / "dem.tif", np.zeros((16, 48))),
        np.zeros((16, 48), np.uint8),
    )
    values[:, 12:14] = UNLABELLED  # across map 0, between start and goal
    classes = write(tmp_path / "classes.tif", values, nodata=UNLABELLED)
    photo = write(tmp_path / "photo.tif", np.full((3, 16, 48), 90, np.uint8))
    source = source_of(read(dem, classes=classes, photo=photo, solvable=True))
    assert source["kept"] == [1]
    assert source["left_out"]["not_solvable"] == 1


def test_without_a_class_raster_the_recipe_lays_classes_out_by_map_number(
    tmp_path: Path,
) -> None:
    maps = maps_of(read(write(tmp_path / "dem.tif", rough(48, 48))))
    assert maps["environment"].tolist() == [
        number % RECIPE.environments for number in range(6)
    ]
    for environment, class_id in zip(
        maps["environment"], maps["class_id"], strict=True
    ):
        assert set(np.unique(class_id)) == set(
            RECIPE.environment_classes[int(environment)]
        )
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
    painted, real = read(dem), read(dem, photo=photo, random_classes=True)
    maps = maps_of(real)
    np.testing.assert_array_equal(
        np.concatenate(list(maps["rgb"]), axis=2), cells[:, ::-1]
    )
    np.testing.assert_array_equal(
        maps["traversability"], maps_of(painted)["traversability"]
    )
    assert source_of(real)["photo"]["file"] == "photo.tif"
    # Transparent cells are missing.
    opaque = np.full((1, *fine.shape[1:]), 255)
    opaque[0, 10:12, 60:62] = 0
    clear = write(
        tmp_path / "clear.tif", np.concatenate([fine, opaque]).astype(np.uint8), 0.25
    )
    source = source_of(read(dem, photo=clear, random_classes=True))
    assert source["kept"] == [0]
    assert source["left_out"]["missing_colours"] == 1


def test_real_colours_and_measured_traversability_need_real_classes_or_a_word(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    photo = write(tmp_path / "photo.tif", np.zeros((3, 16, 24), np.uint8))
    measured = write(tmp_path / "lambda.tif", FLAT)
    for given in ({"photo": photo}, {"traversability": measured}):
        message = refusal(dem, **given)
        assert f"`classes` with `{next(iter(given))}`" in message
        assert "--random-classes" in message
        read(dem, **given, random_classes=True)
        read(
            dem, **given, classes=write(tmp_path / "classes.tif", FLAT.astype(np.uint8))
        )
        (tmp_path / "classes.tif").unlink()
    classes = write(tmp_path / "classes.tif", FLAT.astype(np.uint8))
    assert "either `classes` or `random_classes`" in refusal(
        dem, classes=classes, random_classes=True
    )


# Measured traversability


def test_measured_traversability_is_averaged_and_what_was_not_observed_stays_so(
    tmp_path: Path,
) -> None:
    dem, classes = (
        write(tmp_path / "dem.tif", rough(16, 48)),
        write(tmp_path / "classes.tif", np.zeros((16, 48))),
    )
    values = np.random.default_rng(4).random((32, 60))  # 15 m of 24 m
    values[:8] = -1
    measured = write(tmp_path / "lambda.tif", values, 0.25, nodata=-1)
    dataset = read(dem, classes=classes, traversability=measured, solvable=True)
    drawn = read(dem, classes=classes, solvable=True)
    maps, before = maps_of(dataset), maps_of(drawn)
    found = np.concatenate(list(maps["traversability"]), axis=1)
    expected = values[8:].reshape(12, 2, 30, 2).mean(axis=(1, 3))[::-1]
    np.testing.assert_allclose(found[:12, :30], expected, atol=2.0**-16)
    assert np.isnan(found[12:]).all()
    assert np.isnan(found[:, 30:]).all()
    for name in set(maps) - {"traversability"}:
        np.testing.assert_array_equal(maps[name], before[name])
    # The truth is the class table's, whatever was measured.
    truth, expected_truth = (one.terrain("test/real").truth for one in (dataset, drawn))
    assert truth.means.equal(expected_truth.means)
    assert source_of(dataset)["traversability"]["file"] == "lambda.tif"
    assert source_of(drawn)["traversability"] is None
    assert dataset.terrain("test/real").traversability.isnan().any()


def test_measured_traversability_may_be_whole_numbers_with_a_scale(
    tmp_path: Path,
) -> None:
    dem, values = (
        write(tmp_path / "dem.tif", rough(16, 24)),
        np.arange(384).reshape(16, 24) % 256,
    )
    path = write(tmp_path / "lambda.tif", values.astype(np.uint8))
    with rasterio.open(path, "r+") as file:
        file.scales = (1 / 255,)
    found = maps_of(read(dem, traversability=path, random_classes=True))[
        "traversability"
    ][0]
    np.testing.assert_allclose(found, values[::-1] / 255, atol=2.0**-16)


@pytest.mark.parametrize("value", [-9999, 255, 1.5])
@pytest.mark.parametrize("cell", [0.5, 0.05])
def test_traversability_out_of_range_is_refused_however_small_its_share(
    tmp_path: Path, value: float, cell: float
) -> None:
    dem, values = (
        write(tmp_path / "dem.tif", FLAT),
        np.full((int(8 / cell), int(12 / cell)), 0.5),
    )
    values[3, 3] = value
    measured = write(tmp_path / "lambda.tif", values, cell)
    message = refusal(dem, traversability=measured, random_classes=True)
    assert "`traversability` in [0, 1]" in message
    assert (f"--nodata {value}" in message) == (value != 1.5)


@pytest.mark.parametrize("cell", [0.5, 0.25, 0.8])
def test_zeros_for_missing_heights_are_refused_unless_something_is_declared(
    tmp_path: Path, cell: float
) -> None:
    values = 900 + rough(64, 96)
    values[:20, :30] = 0
    message = refusal(write(tmp_path / "dem.tif", values, cell))
    assert "If 0 marks missing cells, declare it: rio edit-info --nodata 0" in message
    declared = read(write(tmp_path / "zero.tif", values, cell, nodata=0))
    assert source_of(declared)["left_out"]["missing_elevation"] > 0
    assert "replace it by the declared value" in refusal(
        write(tmp_path / "other.tif", values, cell, nodata=-9999)
    )
    cliff = np.where(values > 0, values - 940, 0)  # 60 m above the sea, by their word
    kept = read(write(tmp_path / "cliff.tif", cliff, cell, nodata=-9999))
    assert maps_of(kept)["slope_deg"].max() > 85
    # Down to the sea by steps of less than a metre.
    sea = write(
        tmp_path / "sea.tif",
        np.linspace(0, 30, 64)[:, None].repeat(96, 1).round(),
        cell,
    )
    assert len(maps_of(read(sea))["rgb"]) >= 1


def test_a_map_of_no_class_is_kept_where_its_traversability_was_measured(
    tmp_path: Path,
) -> None:
    dem = write(tmp_path / "dem.tif", rough(16, 72))
    kinds = np.full((16, 72), 255, np.uint8)
    kinds[:, :24] = 1
    photo = np.full((3, 16, 72), 90, np.uint8)
    measured = np.full((16, 72), np.nan, np.float32)
    measured[4, 30] = 0.25  # of the second map alone
    rasters = {
        "classes": write(tmp_path / "classes.tif", kinds, nodata=255),
        "photo": write(tmp_path / "photo.tif", photo),
        "traversability": write(tmp_path / "measured.tif", measured),
    }
    dataset = read(dem, **rasters)
    assert source_of(dataset)["kept"] == [0, 1]
    assert source_of(dataset)["left_out"]["missing_classes"] == 1
    maps = maps_of(dataset)
    assert (maps["class_id"][1] == 255).all()
    assert maps["traversability"][1, 11, 6] == 0.25
    assert np.isnan(maps["traversability"][1]).sum() == 16 * 24 - 1
