"""Small GeoTIFFs, and imports of them."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchnav.core.errors import BenchnavError
from benchnav.datagen.dem.importer import import_dem
from benchnav.datagen.dem.options import Cut, GroundOptions, Rasters
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.reader import TerrainDataset
from tests.factories import tiny_recipe

rasterio = pytest.importorskip("rasterio")

WEST, SOUTH = 500_000.0, 3_999_900.0
STEP = 2.0**-13  # of stored elevation
# 12 m × 8 m: not square, so that swapped axes show.
RECIPE = replace(
    tiny_recipe(),
    id="real-v1",
    height=16,
    width=24,
    start_m=(2.2, 2.2),
    goal_m=(9.2, 5.2),
)
COUNTER = itertools.count()
NAMES = [kind.name for kind in RECIPE.classes]


def write(
    path: Path,
    values: Any,
    cell: float = 0.5,
    offset: tuple[float, float] = (0, 0),
    **profile: Any,
) -> Path:
    """Writes a north-up GeoTIFF whose south-west corner lies `offset` metres off (WEST,
    SOUTH).
    """
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
    return (np.arange(width) + 0.5) * cell, (height - np.arange(height) - 0.5)[
        :, None
    ] * cell


def plane(
    height: int, width: int, cell: float, slope_x: float = 0.2, slope_y: float = 0.1
) -> np.ndarray:
    x, y = centres(height, width, cell)
    return 900 + slope_x * x + slope_y * y


def rough(height: int, width: int, seed: int = 0) -> np.ndarray:
    return (
        np.random.default_rng(seed)
        .uniform(100, 101, (height, width))
        .astype(np.float32)
    )


def run(dem: Path | str, out: Path, settings: dict[str, Any]) -> list[tuple[int, int]]:
    """Imports rasters by the settings of `Rasters` and of `import_dem`."""
    settings = {"recipe": RECIPE} | settings
    files = {
        name: str(settings.pop(name, ""))
        for name in ("classes", "photo", "traversability")
    }
    plain = {
        name: settings.pop(name)
        for name in ("class_ids", "random_classes", "layer")
        if name in settings
    }
    ground = {
        name: settings.pop(name)
        for name in ("dem_unit", "origin", "max_maps")
        if name in settings
    }
    cut = cut_of(settings, ground=GroundOptions(**ground))
    return list(
        import_dem(
            str(dem), out, rasters=Rasters(**files, **plain), cut=cut, **settings
        )
    )


def cut_of(settings: dict[str, Any], **more: Any) -> Cut:
    """Take the settings of `Cut` out of others."""
    names = ("shares", "scenario", "stride_m", "solvable")
    return Cut(
        **{name: settings.pop(name) for name in names if name in settings}, **more
    )


def read(
    dem: Path | str, folder: Path | None = None, suffix: str = ".h5", **settings: Any
) -> TerrainDataset:
    """Imports into a new file, which must be sound."""
    folder = folder or Path(dem).parent
    before = set(folder.iterdir())
    out = folder / f"out-{next(COUNTER)}{suffix}"
    steps = run(dem, out, settings)
    assert [done for done, _ in steps] == sorted(done for done, _ in steps)
    assert steps[-1][0] == steps[-1][1]
    assert find_faults(out) == []
    assert set(folder.iterdir()) - before == {out}
    return TerrainDataset(out)


def source_of(dataset: TerrainDataset) -> dict[str, Any]:
    (split,) = dataset.splits.values()
    (part,) = split["parts"]
    assert (
        part["maps"]
        == split["maps"]
        == len(part["source"]["kept"])
        == len(part["source"]["lowest_m"])
    )
    assert "recipe" not in part
    return part["source"]


def tile_place(source: dict[str, Any], number: int) -> tuple[float, float]:
    """Metres from the ground's south-west corner to that of a map, northward and
    eastward.
    """
    row, column = divmod(number, source["tiles"][1])
    return row * source["stride_m"][1], column * source["stride_m"][0]


def source_tiles(source: dict[str, Any]) -> int:
    return source["tiles"][0] * source["tiles"][1]


def maps_of(dataset: TerrainDataset) -> dict[str, np.ndarray]:
    return dataset.read(next(iter(dataset.splits)))


def refusal(dem: Path, **settings: Any) -> str:
    """The one line that an import ends in, which leaves nothing behind."""
    before = sorted(dem.parent.iterdir())
    with pytest.raises(BenchnavError) as caught:
        run(dem, dem.parent / "out.h5", settings)
    assert sorted(dem.parent.iterdir()) == before
    message = str(caught.value)
    assert "\n" not in message
    return message


FLAT = np.zeros((16, 24), np.float32)
ANY = {"random_classes": True}
