"""Rasters as they come: each is imported right, or stopped in one line whose remedy
works when it is applied.

All are of a plane that rises 20 % eastward and 10 % northward, so the slope of what is
imported says whether units, cells and missing values were read right.
"""

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.reader import TerrainDataset
from tests.commands import call
from tests.datagen.dem.rasters import SOUTH, WEST, plane, write

rasterio = pytest.importorskip("rasterio")
from rasterio.rio.main import main_group  # noqa: E402

SLOPE_DEG = np.degrees(np.arctan(np.hypot(0.2, 0.1)))
FT, US_FT, FLOAT_MAX = 0.3048, 1200 / 3937, 3.4028234663852886e38
FEET = (100, 100)  # rows and columns of the larger rasters
HIGH = {"height": 70, "width": 100}  # 35 m × 50 m, which hold 2 × 3 maps of 16 m


@dataclass
class Case:
    """A raster `dem.tif`, and what comes of it.

    Args:
        values: Of the raster.
        cell: Width of its cells.
        profile: Of the file.
        edit: Changes the open file.
        others: Write further rasters into a folder.
        words: Of the command.
        fixes: Parts of the lines that the import stops with, in order; each is applied
            as a command or an option.
        fill: Values of the words in capitals of a remedy.
        maps: Number that is kept; 0 where the ground cannot be imported.
        out: Text of the last output.
        atol: Of the median slope, degrees.
    """

    values: np.ndarray = field(default_factory=lambda: plane(**HIGH, cell=0.5))
    cell: float = 0.5
    profile: dict[str, Any] = field(default_factory=dict)
    edit: Callable[[Any], None] | None = None
    others: Callable[[Path], object] | None = None
    words: str = ""
    fixes: tuple[str, ...] = ()
    fill: dict[str, str] = field(default_factory=dict)
    maps: int = 6
    out: str = ""
    atol: float = 0.3


def holed(value: float, dtype: str = "float32", scale: float = 1.0) -> np.ndarray:
    """Return the plane with a value in the south-west corner, within one map of six."""
    values = (plane(**HIGH, cell=0.5) / scale).astype(dtype)
    values[-12:, :12] = value
    return values


def feet(crs: str, unit_m: float, west: float, south: float, **settings: Any) -> Case:
    """Return a case of cells of 2 ft and elevations in feet."""
    north = south + 2 * FEET[0]
    profile = {"crs": crs, "transform": rasterio.Affine(2, 0, west, 0, -2, north)}
    return Case(
        plane(*FEET, cell=2), profile=profile, **{"maps": 9, "atol": 0.5} | settings
    )


def geographic(height: int = 150, width: int = 150) -> Case:
    """Return a case in degrees."""
    cell, south = 5e-6, 35.7
    metres = np.array([np.cos(np.radians(south)), 1]) * np.radians(cell) * 6378137
    values = (
        500
        + 0.2 * metres[0] * np.arange(width)
        - 0.1 * metres[1] * np.arange(height)[:, None]
    )
    transform = rasterio.Affine(cell, 0, 139.7, 0, -cell, south)
    return Case(values, profile={"crs": "EPSG:4326", "transform": transform}, maps=20)


def turned(affine: Any, size: int = 160) -> dict[str, Any]:
    """Return values and profile of a square raster that lies as a transform says."""
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    x, y = affine * (column, row)
    return {
        "values": 0.2 * (x - WEST) + 0.1 * (y - SOUTH),
        "profile": {"transform": affine},
    }


def scale(factor: float, offset: float = 0.0) -> Callable[[Any], None]:
    """Return an edit that declares scale and offset."""

    def edit(file: Any) -> None:
        file.scales, file.offsets = (factor,), (offset,)

    return edit


def unit(name: str) -> Callable[[Any], None]:
    """Return an edit that declares a unit."""

    def edit(file: Any) -> None:
        file.units = (name,)

    return edit


def masked(rows: slice, columns: slice) -> Callable[[Any], None]:
    """Return an edit that masks cells."""

    def edit(file: Any) -> None:
        valid = np.ones(file.shape, dtype=bool)
        valid[rows, columns] = False
        file.write_mask(valid)

    return edit


def step(cells: int, height_m: float) -> np.ndarray:
    """Return the plane with a block of one map raised."""
    values = plane(**HIGH, cell=0.5)
    values[-cells:, :cells] += height_m
    return values


def coarse(cell: float, height: int = 150, width: int = 150, **settings: Any) -> Case:
    """Return a case of cells much wider than the maps'."""
    return Case(plane(height, width, cell), cell, **settings)


def photo(folder: Path) -> None:
    """Write colours that begin two cells within the elevation model."""
    write(folder / "photo.tif", np.full((3, 66, 96), 99, np.uint8), offset=(1, 1))


def measured(
    value: float, scale: float = 1.0, unit: str = "", **profile: Any
) -> Callable[[Path], object]:
    """Return a writer of λ of 0.5 with a value in a corner."""

    def make(folder: Path) -> None:
        values = np.full((70, 100), 0.5 * scale, np.float32)
        values[-3:, :3] = value
        with rasterio.open(
            write(folder / "measured.tif", values, **profile), "r+"
        ) as file:
            file.units = (unit,)

    return make


def corner(east: float, north: float) -> str:
    """Return an option of an origin, metres from the south-west corner."""
    return f"--origin [{WEST + east},{SOUTH + north}]"


ARIZONA = ("EPSG:2223", 700_000, 1_000_000)
CALIFORNIA = ("EPSG:2229", 6_500_000, 1_800_000)
ROT = (
    rasterio.Affine.translation(WEST, SOUTH)
    * rasterio.Affine.scale(0.5)
    * rasterio.Affine.rotation(20)
)
LAMBDA = "--traversability measured.tif --random-classes"
DECLARE = "rio edit-info --nodata "

CASES: dict[str, Case] = {
    # right at once
    "metres": Case(out="elevations in metres (the raster declares no unit"),
    "unit declared": Case(
        edit=unit("metre"), out="elevations in metres as the raster declares"
    ),
    "whole centimetres": Case(
        (100 * plane(**HIGH, cell=0.5) - 9e4).astype("int16"),
        edit=scale(0.01, 900.0),
        atol=0.5,
    ),
    "NaN": Case(holed(np.nan), maps=5, out="1 missing elevation"),
    "infinity": Case(holed(np.inf), maps=5, out="1 missing elevation"),
    "declared": Case(holed(-9999), profile={"nodata": -9999}, maps=5),
    "mask": Case(edit=masked(slice(-12, None), slice(12)), maps=5),
    "south up": Case(**turned(rasterio.Affine(0.5, 0, WEST, 0, 0.5, SOUTH)), maps=25),
    "rotated": Case(**turned(ROT), maps=14, out="22 missing elevation"),
    "degrees": geographic(),
    "metres above a metre of sea": Case(profile={"crs": "EPSG:32654+5773"}),
    "feet on the map, metres of height": Case(
        FT * plane(*FEET, cell=2),
        edit=unit("metre"),
        maps=9,
        atol=0.5,
        profile={
            "crs": "EPSG:2229",
            "transform": rasterio.Affine(2, 0, 6_500_000, 0, -2, 1_800_200),
        },
    ),
    "below the sea": Case(plane(**HIGH, cell=0.5) - 1330),
    "a shore": Case(np.maximum(plane(**HIGH, cell=0.5) - 900.5, 0).round(3)),
    "radii in place of heights": Case(plane(**HIGH, cell=0.5) + 1_737_400),
    "a cliff of 3 km": Case(step(12, 3000), maps=5, out="1 too rough"),
    "a hole of no common value": Case(step(12, -4321), maps=5, out="1 too rough"),
    "an origin between cells": Case(words=f"--origin [{WEST + 0.13},{SOUTH + 0.29}]"),
    "colours that begin elsewhere": Case(
        others=photo,
        words=f"--photo photo.tif --random-classes --origin [{WEST + 1},{SOUTH + 1}]",
    ),
    "cells of half the width": Case(plane(140, 200, 0.25), 0.25),
    # units
    "US feet": feet(CALIFORNIA[0], US_FT, *CALIFORNIA[1:], fixes=("--dem-unit us-ft",)),
    "feet": feet(ARIZONA[0], FT, *ARIZONA[1:], fixes=("--dem-unit ft",)),
    "kilometres on the map": Case(
        profile={
            "crs": "+proj=utm +zone=54 +units=km",
            "transform": rasterio.Affine(5e-4, 0, 500, 0, -5e-4, 4000),
        },
        fixes=("--dem-unit m",),
    ),
    "feet declared": Case(
        plane(**HIGH, cell=0.5) / FT, edit=unit("ft"), fixes=("--dem-unit ft",)
    ),
    "centimetres declared": Case(
        100 * plane(**HIGH, cell=0.5), edit=unit("cm"), fixes=("--dem-unit 0.01",)
    ),
    "US feet above the sea": Case(
        plane(**HIGH, cell=0.5) / US_FT,
        profile={"crs": "EPSG:32654+6360"},
        fixes=("--dem-unit us-ft",),
    ),
    "inches declared": Case(
        plane(**HIGH, cell=0.5) / 0.0254,
        edit=unit("Inches"),
        fixes=("--dem-unit 0.0254",),
    ),
    "feet declared of metres": Case(
        edit=unit("US survey foot"), fixes=("--dem-unit m",)
    ),
    # values that stand for missing
    "-9999": Case(holed(-9999), fixes=(f"{DECLARE}-9999",), maps=5),
    "-1 in low ground": Case(
        np.where(holed(np.nan) > 0, holed(0) - 940, -1),
        fixes=(f"{DECLARE}-1",),
        maps=5,
        atol=np.inf,
    ),
    "-999 in low ground": Case(holed(-999), fixes=(f"{DECLARE}-999",), maps=5),
    "-32768": Case(
        holed(-32768, "int16", 0.1),
        edit=scale(0.1),
        fixes=(f"{DECLARE}-32768",),
        maps=5,
        atol=0.5,
    ),
    "65535": Case(
        holed(65535, "uint16", 0.02),
        edit=scale(0.02),
        fixes=(f"{DECLARE}65535",),
        maps=5,
    ),
    "the largest float": Case(
        holed(FLOAT_MAX), fixes=(f"{DECLARE}3.40282347e+38",), maps=5
    ),
    "the smallest float": Case(
        holed(-FLOAT_MAX), fixes=(f"{DECLARE}-3.40282347e+38",), maps=5
    ),
    "a million": Case(holed(1e6), fixes=(f"{DECLARE}1000000",), maps=5),
    "-1 far below": Case(holed(-1), fixes=(f"{DECLARE}-1",), maps=5),
    "zero far below": Case(holed(0), fixes=(f"{DECLARE}0",), maps=5),
    "-9999 of scaled values": Case(
        holed(-9999, "int16", 0.1),
        edit=scale(0.1),
        fixes=(f"{DECLARE}-9999",),
        maps=5,
        atol=0.5,
    ),
    "-9999 of feet": Case(
        (holed(-9999 * FT) / FT).astype("float32"),
        edit=unit("ft"),
        fixes=("--dem-unit ft", f"{DECLARE}-9999"),
        maps=5,
    ),
    "a second value": Case(
        holed(-32768),
        profile={"nodata": -9999},
        fixes=("'(where (== (read 1) -32768) -9999 (read 1))'",),
        maps=5,
    ),
    "a second value near heights": Case(
        holed(-999) - np.float32(840) * (holed(-999) > 0),
        profile={"nodata": -9999},
        fixes=("'(where (== (read 1) -999) -9999 (read 1))'",),
        maps=5,
    ),
    "a second zero": Case(
        holed(0),
        profile={"nodata": -9999},
        fixes=("'(where (== (read 1) 0) -9999 (read 1))'",),
        maps=5,
    ),
    "a value next to a mask": Case(
        holed(-999),
        edit=masked(slice(12), slice(-12, None)),
        fixes=("rio calc --profile nodata=-999 '(read 1)'",),
        maps=4,
    ),
    "a sea below a cliff of 97 m": Case(
        holed(803) - np.float32(803), profile={"nodata": -9999}
    ),
    "a map of -9999": Case(
        np.where(np.arange(100) < 32, -9999, plane(**HIGH, cell=0.5)),
        fixes=(f"{DECLARE}-9999",),
        maps=4,
    ),
    "measured λ in percent": Case(
        others=measured(80, 100), words=LAMBDA, fixes=("rio calc --not-masked",), maps=6
    ),
    "measured λ of -1": Case(
        others=measured(-1), words=LAMBDA, fixes=(f"{DECLARE}-1",)
    ),
    "a layer of -9999": Case(
        others=measured(-9999),
        words="--layer wet=measured.tif",
        fixes=(f"{DECLARE}-9999",),
    ),
    "a layer of a second -9999": Case(
        others=measured(-9999, nodata=-32768),
        words="--layer wet=measured.tif",
        fixes=("'(where (== (read 1) -9999) -32768 (read 1))'",),
    ),
    "a layer of an endless value": Case(
        others=measured(FLOAT_MAX),
        words="--layer wet=measured.tif",
        fixes=(f"{DECLARE}3.40282347e+38",),
    ),
    "a layer in yards": Case(
        others=measured(0, unit="yard"),
        words="--layer vegetation_m=measured.tif",
        fixes=("'(* 0.9144 (read 1))'",),
    ),
    "a layer called kilometres": Case(
        others=measured(0, unit="km"),
        words="--layer vegetation_m=measured.tif",
        fixes=("rio edit-info --bidx 1 --units m measured.tif",),
    ),
    "a layer in ells": Case(
        others=measured(0, unit="ell"),
        words="--layer vegetation_m=measured.tif",
        fixes=("'(* METRES (read 1))'",),
        fill={"METRES": "1.143"},
    ),
    # too many maps, or too smooth ones
    "10 m": coarse(10.0, fixes=("o.h5 resolution_m=10 'start_m=[80,80]'",), maps=16),
    "10 m of feet": coarse(
        10.0,
        edit=unit("ft"),
        words="--dem-unit m class_periods_m=[9,4]",
        fixes=("'class_periods_m=[180,80]'",),
        maps=16,
    ),
    "three splits": coarse(
        30.0,
        words="--splits train:0.6,valid:0.2,test/x:0.2 --stride 4",
        fixes=("test/x:0.2 resolution_m=15",),
        maps=0,
    ),
    "few cells": coarse(30.0, 20, 20, fixes=("o.h5 resolution_m=15",), maps=1),
    "coarse and rotated": Case(
        **turned(ROT * rasterio.Affine.scale(20), 40),
        fixes=("o.h5 resolution_m=5",),
        maps=1,
    ),
    "very few cells": coarse(30.0, 10, 10, fixes=("height=16 width=16",), maps=1),
    "side by side": coarse(
        10.0, words="--stride 16", fixes=("o.h5 resolution_m=10",), maps=16
    ),
    "too few cells": coarse(30.0, 3, 3, fixes=("Expected cells of `dem`",), maps=0),
    "drawn places": coarse(
        2.0,
        words="--recipe stakes-v1 resolution_m=0.4 places.margin_m=1",
        fixes=("places.least_distance_m=100 places.margin_m=5",),
        maps=4,
    ),
    "as coarse as it may be": coarse(2.0, 60, 60, words="--coarse", maps=49),
    "more maps than one wants": Case(
        words="--stride 2 --max-maps 10",
        fixes=("--max-maps 10 --stride 10",),
        maps=8,
        out="one every 10 m",
    ),
    "22 201 maps": Case(
        plane(180, 180, 0.5),
        words="--stride 0.5",
        fixes=("Expected at most 20,000 maps",),
        maps=0,
    ),
    "smooth and wanted": coarse(2.0, 60, 60, fixes=("--coarse",), maps=49),
    # where the ground lies
    "no CRS": Case(
        profile={"crs": None}, fixes=("rio edit-info --crs",), fill={"CODE": "32654"}
    ),
    "no place": Case(
        profile={"transform": rasterio.Affine.identity()},
        fixes=("rio edit-info --transform",),
        fill={"CELL": "0.5", "WEST": f"{WEST}", "NORTH": f"{SOUTH + 35}"},
    ),
    "two bands": Case(np.stack([plane(**HIGH, cell=0.5)] * 2), fixes=("rio stack",)),
    "an origin too far east": Case(
        words=corner(40, 3),
        fixes=(f"--origin '[{WEST + 34:.0f},{SOUTH + 3:.0f}]'",),
        maps=2,
    ),
    "an origin too far north-east": Case(
        words=corner(49, 34), fixes=("--origin '[",), maps=1
    ),
    "an origin too far for three splits": Case(
        plane(140, 200, 0.5),
        words=f"{corner(30, 60)} --stride 8 --splits train:0.6,valid:0.2,test/x:0.2",
        fixes=(f"--origin '[{WEST + 20:.0f},{SOUTH + 54:.0f}]'",),
        maps=0,
    ),
    "an origin elsewhere": Case(
        words="--origin [0,0]", fixes=("Expected `origin` on `dem`",), maps=0
    ),
    "a unit of no length": Case(
        words="--dem-unit parsec", fixes=("Expected `dem_unit`",), maps=0
    ),
    "complex numbers": Case(
        plane(**HIGH, cell=0.5).astype("complex64"), fixes=("rio convert",)
    ),
}


def mended(line: str, fix: str, case: Case, words: list[str]) -> list[str]:
    """Apply the remedy of a line: run its command, or add its option.

    Returns:
        The words of the next import.
    """
    if fix.startswith("--origin"):
        (origin,) = re.findall(r"--origin '(.*?)'", line)
        words = words.copy()
        words[words.index("--origin") + 1] = origin
        return words
    if fix.startswith("--") and "benchnav-datagen import" not in line:
        return [*words, *fix.split()]
    if fix == "--coarse":
        return [*words, fix]
    if corrected := re.search(r"benchnav-datagen (import-dem .*)", line):
        return shlex.split(corrected[1])
    command = line[line.rindex("rio ", 0, line.index(fix) + 4) :]
    command = re.split(r"\. (?:If|Otherwise,) ", command)[0]
    for blank, value in case.fill.items():
        command = command.replace(blank, value)
    _, tool, *arguments = shlex.split(command)
    ran = CliRunner().invoke(main_group, [tool, *arguments])
    assert ran.exit_code == 0, ran.output
    if tool == "edit-info":
        return words
    source, target = arguments[-2:]
    return [word.replace(source, target) for word in words]


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.filterwarnings("ignore::numpy.exceptions.ComplexWarning")
@pytest.mark.parametrize("name", CASES)
def test_a_raster_is_imported_right_or_stopped_with_a_remedy(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    case = CASES[name]
    write(Path("dem.tif"), case.values, case.cell, **case.profile)
    if case.edit:
        with rasterio.open("dem.tif", "r+") as file:
            case.edit(file)
    if case.others:
        case.others(tmp_path)
    recipe = [] if "--recipe" in case.words else ["--recipe", "tiny-v1"]
    words = [
        "import-dem",
        "dem.tif",
        *recipe,
        "--out",
        "o.h5",
        *shlex.split(case.words),
    ]
    for fix in case.fixes:
        assert call("datagen", *words) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert fix in line
        assert not Path("o.h5").exists()
        if fix.startswith("Expected"):
            return
        words = mended(line, fix, case, words)
    assert call("datagen", *words) == 0, capsys.readouterr().err
    said = capsys.readouterr().out
    assert case.out in said
    assert find_faults(Path("o.h5")) == []
    dataset = TerrainDataset("o.h5")
    maps = [dataset.map_count(split) for split in dataset.splits]
    assert sum(maps) == case.maps or (
        case.maps == 0 and min(maps) > 0 and sum(maps) <= 20_000
    )
    chosen = dataset.recipe
    if chosen.places:  # 1 m is 2.5 of the user's cells
        assert chosen.places.margin_m == pytest.approx(2.5 * chosen.resolution_m)
    else:  # on the same part of a map as in the user's recipe
        ends = np.divide([chosen.start_m, chosen.goal_m], chosen.grid.extent_m)
        np.testing.assert_allclose(ends, [[0.25, 0.25], [0.75, 0.75]], rtol=1e-5)
    for split in dataset.splits:
        slopes = dataset.read(split, fields=["slope_deg"])["slope_deg"][:, 2:-2, 2:-2]
        assert np.median(slopes) == pytest.approx(SLOPE_DEG, abs=case.atol)
