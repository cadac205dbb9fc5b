"""Rasters that become layers: their values, their place, and what is refused."""

import hashlib
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchnav.core.errors import ConfigError
from benchnav.datagen.dem.layer import read_layer
from benchnav.datagen.dem.options import Rasters
from benchnav.datagen.files.reader import TerrainDataset
from tests.commands import call
from tests.datagen.dem.rasters import (
    FLAT,
    RECIPE,
    SOUTH,
    WEST,
    centres,
    maps_of,
    read,
    rough,
    run,
    source_of,
    write,
)

rasterio = pytest.importorskip("rasterio")


def layered(dem: Path, *layers: str, **settings: Any) -> TerrainDataset:
    return read(dem, layer=layers, **settings)


def values(height: int, width: int, seed: int = 1, most: float = 9.0) -> np.ndarray:
    return (
        np.random.default_rng(seed).uniform(0, most, (height, width)).astype(np.float32)
    )


def refusal(dem: Path, *layers: str, **settings: Any) -> str:
    with pytest.raises(Exception) as caught:  # noqa: PT011 - which of ours is said by each test
        run(dem, dem.parent / "out.h5", {"layer": layers, **settings})
    assert not (dem.parent / "out.h5").exists()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_layer_is_the_raster_on_the_maps_cells(tmp_path: Path) -> None:
    height_m, other = values(32, 48), values(32, 48, 2, 1e6)
    dem = write(tmp_path / "dem.tif", rough(32, 48))
    canopy, rock = (
        write(tmp_path / "canopy.tif", height_m),
        write(tmp_path / "rock.tif", other),
    )
    dataset = layered(dem, f"vegetation_m={canopy}", f"rock_share={rock}")
    assert dataset.manifest["format_version"] == "1.3"
    assert dataset.layer_names == ("vegetation_m", "rock_share")
    stored = maps_of(dataset)
    for name, own in (("vegetation_m", height_m), ("rock_share", other)):
        northward = own[::-1]
        tiles = [northward[r : r + 16, c : c + 24] for r in (0, 16) for c in (0, 24)]
        np.testing.assert_array_equal(stored[name], np.stack(tiles))
    # All else is as without.
    plain = maps_of(read(dem))
    for name in plain:
        np.testing.assert_array_equal(plain[name], stored[name])


def test_the_manifest_holds_unit_meaning_and_digest_of_each(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(16, 24))
    files = {
        name: write(tmp_path / f"{place}.tif", values(16, 24, place))
        for place, name in enumerate(
            ("vegetation_m", "wind_mps", "dust", "salt", "aspect_deg")
        )
    }
    units = {"salt": ":g/kg", "dust": ":percent"}
    dataset = layered(
        dem,
        *(
            f"{name}={file}{units.get(name, '').replace('/', '_')}"
            for name, file in files.items()
        ),
    )
    fields = dataset.manifest["fields"]
    assert {name: fields[name]["unit"] for name in files} == {
        "vegetation_m": "m", "wind_mps": "m/s", "dust": "percent", "salt": "g_kg", "aspect_deg": "deg",
    }  # fmt: skip
    assert all(fields[name]["meaning"] for name in files)
    layers = source_of(dataset)["layers"]
    assert list(layers) == list(files)
    for name, file in files.items():
        assert layers[name] == {
            "file": file.name,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
    assert "layers" not in source_of(read(dem))


def test_finer_cells_are_averaged_but_directions_are_not(tmp_path: Path) -> None:
    fine = np.where(np.indices((32, 48)).sum(axis=0) % 2, 359.0, 1.0).astype(np.float32)
    dem, raster = (
        write(tmp_path / "dem.tif", FLAT),
        write(tmp_path / "rows.tif", fine, 0.25),
    )
    stored = maps_of(layered(dem, f"rows_azimuth_deg={raster}", f"rows_deg={raster}"))
    # not 180, the opposite
    assert set(np.unique(stored["rows_azimuth_deg"])) <= {
        1.0,
        359.0,
    }
    np.testing.assert_allclose(stored["rows_deg"], 180.0)


def test_another_projection_and_a_larger_raster_are_laid_on_the_same_cells(
    tmp_path: Path,
) -> None:
    x, y = centres(80, 80, 1.0)
    wide = write(
        tmp_path / "wide.tif", (x + 100 * y).astype(np.float32), 1.0, (-30.0, -30.0)
    )
    dem = write(tmp_path / "dem.tif", FLAT)
    stored = maps_of(layered(dem, f"place={wide}", f"again={wide}:cell"))
    cell_x, cell_y = (np.arange(n) * 0.5 + 0.25 for n in (24, 16))
    expected = (np.floor(cell_x + 30) + 0.5) + 100 * (np.floor(cell_y + 30) + 0.5)[
        :, None
    ]
    np.testing.assert_array_equal(stored["place"][0], expected)
    np.testing.assert_array_equal(stored["place"], stored["again"])


def test_cells_without_a_value_are_nan_and_the_map_is_kept(tmp_path: Path) -> None:
    holed = values(16, 48)
    holed[3:5, 7] = -9999
    dem = write(tmp_path / "dem.tif", rough(16, 48))
    dataset = layered(
        dem, f"vegetation_m={write(tmp_path / 'canopy.tif', holed, nodata=-9999)}"
    )
    stored, expected = (
        maps_of(dataset)["vegetation_m"],
        np.where(holed < 0, np.nan, holed)[::-1],
    )
    np.testing.assert_array_equal(
        stored, np.stack([expected[:, :24], expected[:, 24:]])
    )
    assert np.isnan(stored).sum() == 2
    assert dataset.splits["test/real"]["maps"] == 2
    terrain = dataset.terrain("test/real")
    np.testing.assert_array_equal(
        terrain.observe().layers["vegetation_m"].numpy(), stored
    )


def test_layers_go_with_their_maps_where_others_are_left_out_and_maps_overlap(
    tmp_path: Path,
) -> None:
    heights, canopy = rough(16, 96), values(16, 96)
    heights[:, 30] = np.nan
    dem, raster = (
        write(tmp_path / "dem.tif", heights),
        write(tmp_path / "canopy.tif", canopy),
    )
    for suffix in (".h5", ""):
        dataset = layered(dem, f"vegetation_m={raster}", stride_m=6.0, suffix=suffix)
        assert list(dataset.fields)[-2:] == ["group", "vegetation_m"]
        kept = source_of(dataset)["kept"]
        assert 0 < len(kept) < 7
        for number, stored in zip(kept, maps_of(dataset)["vegetation_m"], strict=True):
            np.testing.assert_array_equal(
                stored, canopy[::-1, 12 * number : 12 * number + 24]
            )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("canopy.tif", "`layer` as NAME=RASTER or NAME=RASTER:UNIT, got 'canopy.tif'"),
        ("canopy=", "`layer` as NAME=RASTER"),
        (
            "tree height=a.tif",
            "letters, digits and '_', not beginning with a digit, got 'tree height'",
        ),
        ("2nd=a.tif", "got '2nd'"),
        ("höhe_m=a.tif", "got 'höhe_m'"),
        ("=a.tif", "got ''"),
        (
            "slope_deg=a.tif",
            "other than the reserved names rgb, class_id, elevation_m, slope_deg,",
        ),
        ("group=a.tif", "other than the reserved names rgb"),
        ("entry_digests=a.tif", "other than the reserved names rgb"),
        ("state=a.tif", "other than the reserved names rgb"),
        ("vegetation_m=a.tif:ft", "`layer` vegetation_m in m, got 'ft'"),
    ],
)
def test_a_layer_that_cannot_be_one_is_refused(text: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Rasters(layer=(text,))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_name_stands_once() -> None:
    with pytest.raises(ConfigError, match="each `layer` once, got a more than once"):
        Rasters(layer=("a=x.tif", "b=x.tif", "a=y.tif"))


@pytest.mark.parametrize(
    ("text", "raster", "unit"),
    [
        ("moss=a.tif", "a.tif", "1"),
        ("moss=canopy", "canopy", "1"),
        ("moss_m=a.tif", "a.tif", "m"),
        ("moss_m=a.tif:cm", "a.tif", "cm"),
        ("moss=https://host/a.tif", "https://host/a.tif", "1"),
        ("moss=https://host/a.tif:%", "https://host/a.tif", "%"),
        ("moss=zip://a.zip!b.tif", "zip://a.zip!b.tif", "1"),
        ("moss=a=b.tif", "a=b.tif", "1"),
        ("moss_k=C:\\data\\a.tif", "C:\\data\\a.tif", "K"),
        ("vegetation_m=a.tif:m", "a.tif", "m"),
    ],
)
def test_a_unit_follows_the_last_colon_or_the_name(
    text: str, raster: str, unit: str
) -> None:
    own = read_layer(text)
    assert (own.raster, own.field.unit) == (raster, unit)


def test_a_raster_that_does_not_cover_the_ground_is_refused(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", rough(32, 48))
    half = write(tmp_path / "half.tif", values(32, 24))
    elsewhere = write(tmp_path / "elsewhere.tif", values(32, 48), 0.5, (5000.0, 0.0))
    ours = f"{WEST:.10g} {SOUTH:.10g} {WEST + 24:.10g} {SOUTH + 16:.10g}"
    for raster in (half, elsewhere):
        message = refusal(dem, f"vegetation_m={raster}")
        assert (
            f"Expected `layer vegetation_m` to cover all of the terrain (WEST SOUTH EAST NORTH {ours} in EPSG:32654)"
            in message
        )
        assert raster.name in message
    # A cell is no matter, which reprojection may take off.
    short = write(tmp_path / "short.tif", values(16, 24)[:, :23], 1.0)
    assert layered(dem, f"vegetation_m={short}").layer_names == ("vegetation_m",)


@pytest.mark.parametrize(
    ("content", "profile", "expected"),
    [
        (values(16, 24) - 1, {}, "values of `layer vegetation_m` in [0, 200], got -"),
        (values(16, 24) + 300, {}, "values of `layer vegetation_m` in [0, 200], got 3"),
        (
            np.full((16, 24), -1.0, np.float32),
            {"nodata": -1},
            "value of `layer vegetation_m` in at least one cell of the maps, got only",
        ),
        (
            np.zeros((2, 16, 24), np.float32),
            {},
            "Expected one band in `layer vegetation_m`, got 2",
        ),
    ],
)
def test_rasters_of_no_such_values_are_refused(
    tmp_path: Path, content: np.ndarray, profile: dict[str, Any], expected: str
) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    assert expected in refusal(
        dem, f"vegetation_m={write(tmp_path / 'canopy.tif', content, **profile)}"
    )


def test_a_raster_that_is_not_there_is_refused(tmp_path: Path) -> None:
    dem = write(tmp_path / "dem.tif", FLAT)
    assert (
        "Expected `layer moss` to be a raster that GDAL can read, got nope.tif"
        in refusal(dem, "moss=nope.tif")
    )


@pytest.mark.parametrize(
    "flags",
    [
        ("--layer", "[vegetation_m=a.tif,moss=b.tif:kg]"),
        ("--layer", "vegetation_m=a.tif,moss=b.tif:kg"),
        ("--layer", "vegetation_m=a.tif", "--layer", "moss=b.tif:kg"),
        ("--layer=vegetation_m=a.tif", "--layer=[moss=b.tif:kg]"),
    ],
)
def test_the_command_takes_layers_as_a_list_or_one_by_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flags: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    size = RECIPE.height, RECIPE.width
    for name, seed in (("dem", 0), ("a", 1), ("b", 2)):
        write(tmp_path / f"{name}.tif", values(32, 32, seed) if size else FLAT)
    words = ["import-dem", "dem.tif", "--recipe", "tiny-v1", "--out", "site.h5", *flags]
    assert call("datagen", *words) == 0, capsys.readouterr().err
    dataset = TerrainDataset("site.h5")
    assert dataset.layer_names == ("vegetation_m", "moss")
    assert dataset.fields["moss"].unit == "kg"
    assert call("datagen", "show", "site.h5") == 0
    assert "imported layer" in capsys.readouterr().out


@pytest.mark.parametrize("nodata", [None, -9999])
def test_a_layer_of_metres_that_declares_feet_is_refused_with_a_conversion(
    tmp_path: Path, nodata: float | None
) -> None:
    from click.testing import CliRunner
    from rasterio.rio.main import main_group

    height_ft = values(16, 24)
    if nodata:
        height_ft[2, 3] = nodata
    dem = write(tmp_path / "dem.tif", FLAT)
    canopy = write(tmp_path / "canopy.tif", height_ft, nodata=nodata)
    with rasterio.open(canopy, "r+") as file:
        file.units = ("US survey foot",)
    command = refusal(dem, f"vegetation_m={canopy}").split(": rio ")[-1]
    words = shlex.split(command)
    words[-1] = str(tmp_path / words[-1])
    assert CliRunner().invoke(main_group, words).exit_code == 0
    stored = maps_of(layered(dem, f"vegetation_m={words[-1]}"))["vegetation_m"][0]
    expected = np.where(height_ft < 0, np.nan, height_ft * 1200 / 3937)[::-1]
    np.testing.assert_allclose(stored, expected, rtol=1e-6)
