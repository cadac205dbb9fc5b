"""From logs of drives to maps of measured λ."""

import gzip
import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchnav.core.errors import BenchnavError, ConfigError, DatasetError
from benchnav.datagen.dem.crs import transformed
from benchnav.datagen.dem.drive_cells import aggregate_drives, describe_drives
from benchnav.datagen.dem.drive_log import REASONS, DriveLog, Drives, read_drives
from benchnav.datagen.dem.drive_motion import compare_motion
from benchnav.datagen.dem.importer import import_dem
from benchnav.datagen.dem.options import Rasters
from benchnav.datagen.dem.tiling import cut
from benchnav.datagen.files.check import find_faults
from benchnav.datagen.files.merge import merge
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from tests.commands import call
from tests.datagen.dem.rasters import (
    COUNTER,
    RECIPE,
    SOUTH,
    WEST,
    cut_of,
    rough,
    source_of,
    write,
)

rasterio = pytest.importorskip("rasterio")

CELL, HEIGHT, WIDTH = 0.5, 16 * 4, 24 * 8  # of the ground, in cells; maps are 16 × 24
THREE = {"train": 0.5, "valid": 0.25, "test/site": 0.25}


def field(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """λ of the ground at places, one value a cell, in the steps that are stored."""
    return (np.floor(x_m / CELL) * 7 + np.floor(y_m / CELL) * 13) % 64 / 64


def drives_over(
    count: int = 12,
    rows: int = 200,
    noise: float = 0.0,
    seed: int = 0,
    reach_m: float = 20.0,
) -> pd.DataFrame:
    """Straight drives all over the ground, by metres from its south-west corner."""
    generator = np.random.default_rng(seed)
    parts = []
    for drive in range(count):
        start = np.array(
            [(drive + 0.51) / count * WIDTH * CELL, generator.uniform(0, HEIGHT * CELL)]
        )
        end = start + generator.uniform(-reach_m, reach_m, 2)
        x, y = (start + np.linspace(0, 1, rows)[:, None] * (end - start)).T
        inside = (x > 0) & (x < WIDTH * CELL) & (y > 0) & (y < HEIGHT * CELL)
        x, y = x[inside], y[inside]
        commanded = (1 if drive % 3 else -1) * generator.choice([0.5, 1.0], len(x))
        about = {
            "x": x,
            "y": y,
            "commanded_m_s": commanded,
            "drive": f"drive-{drive:02d}",
        }
        parts.append(
            timed(pd.DataFrame(about), noise * generator.standard_normal(len(x)))
        )
    return pd.concat(parts, ignore_index=True)


def timed(rows: pd.DataFrame, noise: np.ndarray | float = 0.0) -> pd.DataFrame:
    """Adds the speed that the ground allows at each row of a drive, and the time that
    the way there takes by it.
    """
    speed = rows["commanded_m_s"] * (field(rows["x"], rows["y"]) + noise)
    way = np.hypot(rows["x"].diff(), rows["y"].diff()).fillna(0)
    return rows.assign(
        measured_m_s=speed, time_s=(way / speed.abs().clip(lower=0.02)).cumsum()
    )


def log_of(rows: pd.DataFrame, path: Path) -> Path:
    rows = rows.assign(x_m=WEST + rows["x"], y_m=SOUTH + rows["y"]).drop(
        columns=["x", "y"]
    )
    rows.to_parquet(path) if path.suffix == ".parquet" else rows.to_csv(
        path, index=False
    )
    return path


@pytest.fixture
def dem(tmp_path: Path) -> Path:
    write(tmp_path / "photo.tif", np.full((3, HEIGHT, WIDTH), 99, np.uint8), CELL)
    return write(tmp_path / "dem.tif", rough(HEIGHT, WIDTH), CELL)


def imported(
    dem: Path, log: Path, least_speed: float = 0.1, speed: Any = "", **settings: Any
) -> TerrainDataset:
    out = dem.parent / f"out-{next(COUNTER)}.h5"
    drives = Drives(file=str(log), least_speed=least_speed, speed=speed)
    settings = {
        "recipe": RECIPE,
        "shares": THREE,
        "rasters": Rasters(photo=str(dem.parent / "photo.tif"), unlabelled=True),
    } | settings
    cut = cut_of(settings)
    list(import_dem(str(dem), out, drives=drives, cut=cut, **settings))
    assert find_faults(out) == []
    return TerrainDataset(out)


def on_ground(
    dataset: TerrainDataset, split: str, name: str, empty: float = np.nan
) -> np.ndarray:
    """A field of all maps of a split, put back where they were cut from."""
    source = dataset.splits[split]["parts"][0]["source"]
    whole = np.full((HEIGHT, WIDTH), empty)
    west, south = (np.array(source["origin_m"]) - [WEST, SOUTH]) / CELL
    for values, number in zip(dataset.read(split)[name], source["kept"], strict=True):
        row, column = divmod(number, source["tiles"][1])
        at_y = round(south + row * source["stride_m"][1] / CELL)
        at_x = round(west + column * source["stride_m"][0] / CELL)
        whole[at_y : at_y + 16, at_x : at_x + 24] = values
    return whole


def expected(rows: pd.DataFrame, how: str, empty: float = np.nan) -> np.ndarray:
    """What pandas makes of rows, cell by cell."""
    value = (rows["measured_m_s"] / rows["commanded_m_s"]).clip(0, 1)
    by_cell = value.groupby(
        [np.floor(rows["y"] / CELL), np.floor(rows["x"] / CELL)]
    ).agg(how)
    whole = np.full((HEIGHT, WIDTH), empty)
    whole[tuple(by_cell.index.to_frame().to_numpy(int).T)] = by_cell
    return whole


def used_of(dataset: TerrainDataset, split: str, rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of the drives of a split that lie on its maps."""
    own = rows[rows["drive"].isin(source(dataset, split)["drives"]["drives"][split])]
    shown = on_ground(dataset, split, "elevation_m")
    return own[
        ~np.isnan(shown[(own["y"] // CELL).astype(int), (own["x"] // CELL).astype(int)])
    ]


def source(dataset: TerrainDataset, split: str) -> dict[str, Any]:
    return dataset.splits[split]["parts"][0]["source"]


def test_a_known_field_is_recovered_exactly(dem: Path) -> None:
    rows = drives_over()
    dataset = imported(dem, log_of(rows, dem.parent / "log.csv"))
    y, x = (np.indices((HEIGHT, WIDTH)) + 0.5) * CELL
    seen = 0
    for split in THREE:
        found = on_ground(dataset, split, "traversability")
        driven = ~np.isnan(found)
        np.testing.assert_array_equal(found[driven], field(x, y)[driven])
        np.testing.assert_array_equal(
            driven, expected(used_of(dataset, split, rows), "count", 0) > 0
        )
        seen += driven.sum()
    assert seen > 300


@pytest.mark.parametrize("name", ["log.csv", "log.parquet", "log.csv.gz"])
@pytest.mark.parametrize("stride_m", [None, 4.0])
def test_mean_count_and_spread_of_a_cell_are_those_of_its_rows(
    dem: Path, name: str, stride_m: float | None
) -> None:
    rows = drives_over(noise=0.05)
    rows = rows[(rows["measured_m_s"] / rows["commanded_m_s"]).between(-0.2, 1.2)]
    dataset = imported(dem, log_of(rows, dem.parent / name), stride_m=stride_m)
    assert dataset.manifest["format_version"] == "1.3"
    for split in THREE:
        own, step = used_of(dataset, split, rows), 2.0**-17
        mean, std = (
            on_ground(dataset, split, name) for name in ("traversability", "drive_std")
        )
        np.testing.assert_allclose(mean, expected(own, "mean"), rtol=0, atol=step)
        np.testing.assert_allclose(std, expected(own, "std"), rtol=0, atol=step)
        np.testing.assert_array_equal(
            on_ground(dataset, split, "drive_count", 0), expected(own, "count", 0)
        )
        assert len(own) == source(dataset, split)["drives"]["used"][split] > 50
        counts = dataset.read(split)["drive_count"]
        assert (counts.sum(axis=(1, 2)) > 0).all()
        assert np.isnan(dataset.read(split)["drive_std"][counts < 2]).all()


def test_what_is_known_of_the_measured_is_shown_to_no_model(dem: Path) -> None:
    dataset = imported(dem, log_of(drives_over(), dem.parent / "log.csv"))
    assert {"drive_count", "drive_std"} <= set(dataset.fields)
    assert not set(getattr(dataset, "layer_names", ())) & set(dataset.fields)
    assert not getattr(dataset.terrain("train").observe(), "layers", {})


def test_rows_are_left_out_by_reason_and_kept_beyond_0_and_1(tmp_path: Path) -> None:
    head = "time_s,x_m,y_m,commanded_m_s,measured_m_s,drive\n"
    good = [
        "0,1,2,1,0.5,a",
        "1,1,3,-0.5,-0.4,a",
        "2,1,4,1,1.19,b",
        "3,1,5,1,-0.25,b",
        "4,1,6,0.1,0.05,c",
    ]
    missing = [
        ",1,2,1,1,a",
        "0,,2,1,1,a",
        "0,1,NaN,1,1,a",
        "0,1,2,,1,a",
        "0,1,2,1,null,a",
    ]
    slow = [
        "6,1,7,0.09,0.09,a",
        "7,1,8,-0.09,0,a",
        "8,1,9,0,0,a",
        "9,1,9,0,1.4,a",
        "9,1,9,0,1.4,a",
    ]
    path = tmp_path / "log.csv"
    path.write_text(
        head + "\n".join([*missing, *good, *slow, "10,1,9,1,-1000,a"]) + "\n"
    )
    log = read_drives(Drives(file=str(path), speed="measured"))
    assert log.left_out == {"missing": 5}
    log = compare_motion(log)
    counted = {"missing": 5, "doubled": 1, "slow": 4, "implausible": 1}
    assert {name: count for name, count in log.left_out.items() if count} == counted
    np.testing.assert_allclose(log.rows["traversability"], [0.5, 0.8, 1.19, -0.25, 0.5])
    assert [log.names[one] for one in log.rows["drive"]] == ["a", "a", "b", "b", "c"]
    used, driven = aggregate_drives(
        log,
        cut((8, 8), (8, 8), (8, 8), {"train": 1.0}),
        np.zeros(5, int),
        np.arange(5) // 4,
    )
    np.testing.assert_allclose(driven.values[0], [(0.5 + 0.8 + 1 + 0) / 4, 0.5])
    assert describe_drives(used, ["train"])["beyond"] == {
        "below_0": 1,
        "above_1": 1,
        "above_1.2": 0,
    }
    for least, rest in ((0.6, 3), (0.05, 7)):
        log = compare_motion(
            read_drives(Drives(file=str(path), speed="measured", least_speed=least))
        )
        assert len(log.rows) == rest


def test_a_log_without_drives_is_one(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "time_s,x_m,y_m,commanded_m_s,measured_m_s\n0,1,2,1,0.5\n1,1,2,1,0.5\n"
    )
    log = read_drives(Drives(file=str(path)))
    assert log.names == ("log.csv",)
    assert log.rows["drive"].tolist() == [0, 0]


# Splits


@st.composite
def walks(draw: st.DrawFn) -> tuple[DriveLog, np.ndarray, np.ndarray]:
    """Drives that wander over cells, some of them beyond the ground."""
    rows, columns, drives = [], [], []
    for drive in range(draw(st.integers(3, 8))):
        generator = np.random.default_rng(draw(st.integers(0, 2**32)))
        steps = generator.integers(-2, 3, (draw(st.integers(1, 60)), 2))
        row, column = (generator.integers([0, 0], [40, 200]) + steps.cumsum(axis=0)).T
        rows, columns, drives = (
            [*rows, row],
            [*columns, column],
            [*drives, np.full(len(row), drive)],
        )
    drive = np.concatenate(drives)
    table = pd.DataFrame(
        {"traversability": np.arange(len(drive)) % 5 / 4, "drive": drive}
    )
    table = table.assign(x=0.0, y=0.0, time_s=0.0, speed=1.0)
    names = tuple(f"d{one}" for one in range(drive.max() + 1))
    log = DriveLog(
        settings=Drives(file="x.csv"),
        sha256="",
        names=names,
        is_geographic=False,
        rows=table,
    )
    return log, np.concatenate(rows), np.concatenate(columns)


@given(
    walks(),
    st.sampled_from([(8, 8), (4, 4), (10, 12), (3, 8)]),
    st.booleans(),
    st.integers(1, 3),
)
def test_splits_share_no_drive_and_no_cell(
    walked: tuple[DriveLog, np.ndarray, np.ndarray],
    stride: tuple[int, int],
    turned: bool,
    count: int,
) -> None:
    log, row, column = walked
    shares = dict(list({"a": 0.5, "b": 0.3, "c": 0.2}.items())[:count])
    row, column, cells = (
        (column, row, (200, 40)) if turned else (row, column, (40, 200))
    )
    tiling = cut(cells, (8, 8), stride, shares)
    # Which maps show a cell, by looking at each.
    shown = np.full(cells, "", dtype="<U1")
    for run in tiling.runs(1000):
        for place in run.columns:
            south, west = run.row * stride[0], place * stride[1]
            assert (
                np.isin(shown[south : south + 8, west : west + 8], ["", run.split])
            ).all()
            shown[south : south + 8, west : west + 8] = run.split
    on = (row >= 0) & (row < cells[0]) & (column >= 0) & (column < cells[1])
    own = np.where(on, shown[np.where(on, row, 0), np.where(on, column, 0)], "")
    try:
        used, driven = aggregate_drives(log, tiling, row, column)
    except DatasetError as error:
        counts = pd.crosstab(log.rows["drive"], own).drop(columns="", errors="ignore")
        alone = "got none" in str(error)
        assert alone
        # Some split has none, or several have but one drive between them.
        assert (
            counts.empty
            or (counts > 0).any(axis=1).sum() < count
            or (counts > 0).any().sum() < count
            or (max_matching(counts.to_numpy() > 0) < count)
        )
        return
    about = describe_drives(used, list(shares))
    names = [name for some in about["drives"].values() for name in some]
    assert len(names) == len(set(names))
    assert all(about["drives"][split] for split in shares)
    splits = list(shares)
    for split in splits:
        mine = used.rows[used.rows["split"] == splits.index(split)]
        assert (shown[mine["row"], mine["column"]] == split).all()
        assert len(mine) == about["used"][split]
        assert (
            sorted({log.names[one] for one in mine["drive"]}) == about["drives"][split]
        )
    assert (
        sum(about["used"].values()) + sum(about["left_out"].values())
        == len(log.rows)
        == about["rows"]
    )
    assert about["left_out"]["between_maps"] == (own == "").sum()
    # No other dealing in which each split has a drive uses more rows.
    table = (
        pd.crosstab(log.rows["drive"], own)
        .reindex(columns=splits, fill_value=0)
        .to_numpy()
    )
    assert len(used.rows) == best_dealing(table)
    read = driven.read(range(0, tiling.cells[0]), range(0, tiling.cells[1]))
    assert read[1].sum() == len(used.rows)
    window = driven.read(range(3, 9), range(2, 7))
    np.testing.assert_array_equal(window, read[:, 3:9, 2:7])


def test_a_split_that_would_be_without_a_drive_takes_the_one_that_loses_least() -> None:
    tiling = cut((8, 80), (8, 8), (8, 8), {"a": 0.5, "b": 0.5})
    columns = {
        "far": [(0, 10), (70, 3)],
        "near": [(0, 9), (70, 4)],
        "both": [(0, 20), (70, 1)],
    }
    parts = [
        pd.DataFrame(
            {"column": column, "drive": place, "traversability": 0.5},
            index=range(count),
        )
        for place, runs in enumerate(columns.values())
        for column, count in runs
    ]
    rows = pd.concat(parts, ignore_index=True).assign(
        x=0.0, y=0.0, time_s=0.0, speed=1.0
    )
    log = DriveLog(
        settings=Drives(file="x.csv"),
        sha256="",
        names=tuple(columns),
        is_geographic=False,
        rows=rows,
    )
    used, _ = aggregate_drives(
        log, tiling, np.zeros(len(rows), int), rows["column"].to_numpy()
    )
    about = describe_drives(used, ["a", "b"])
    assert about["drives"] == {"a": ["far", "both"], "b": ["near"]}
    assert about["used"] == {"a": 30, "b": 4}
    assert about["left_out"] == {"between_maps": 0, "other_split": 13}


def test_a_drive_belongs_where_most_of_its_rows_lie_not_where_it_comes_first() -> None:
    tiling = cut((8, 160), (8, 8), (8, 8), {"a": 0.34, "b": 0.33, "c": 0.33})
    start = {name: strip.start * 8 for name, strip in tiling.strips.items()}
    rows_of = {
        "one": {"a": 5},
        "two": {"b": 5},
        "three": {"c": 5},
        "late": {"a": 1, "b": 3, "c": 9},
    }
    rows_of["middle"] = {"a": 2, "b": 7, "c": 3}
    parts = [
        pd.DataFrame(
            {"column": start[split], "drive": drive, "traversability": 0.5},
            index=range(count),
        )
        for drive, counts in enumerate(rows_of.values())
        for split, count in counts.items()
    ]
    rows = pd.concat(parts, ignore_index=True).assign(
        x=0.0, y=0.0, time_s=0.0, speed=1.0
    )
    log = DriveLog(
        settings=Drives(file="x.csv"),
        sha256="",
        names=tuple(rows_of),
        is_geographic=False,
        rows=rows,
    )
    used, _ = aggregate_drives(
        log, tiling, np.zeros(len(rows), int), rows["column"].to_numpy()
    )
    about = describe_drives(used, ["a", "b", "c"])
    assert about["drives"] == {
        "a": ["one"],
        "b": ["two", "middle"],
        "c": ["three", "late"],
    }
    assert about["left_out"]["other_split"] == 1 + 3 + 2 + 3


def best_dealing(counts: np.ndarray) -> int:
    """Most rows that a dealing of drives [D] to splits [S] uses, no split without a
    drive; by trying all.
    """
    best = {(False,) * counts.shape[1]: 0}
    for own in counts:
        after: dict[tuple[bool, ...], int] = {}
        for filled, total in best.items():
            for split, rows in enumerate(own):
                now = tuple(
                    full or (place == split and rows > 0)
                    for place, full in enumerate(filled)
                )
                after[now] = max(after.get(now, 0), total + int(rows))
        best = after
    return best[(True,) * counts.shape[1]]


def max_matching(possible: np.ndarray) -> int:
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    return int((maximum_bipartite_matching(csr_array(possible)) >= 0).sum())


def test_maps_of_two_splits_and_what_drove_there_do_not_touch(dem: Path) -> None:
    rows = drives_over(count=20, reach_m=60)
    dataset = imported(dem, log_of(rows, dem.parent / "log.csv"))
    about = source(dataset, "train")["drives"]
    assert about["left_out"]["other_split"] > 0
    assert about["left_out"]["between_maps"] > 0
    assert sum(about["used"].values()) + sum(about["left_out"].values()) == len(rows)
    shown = {
        split: ~np.isnan(on_ground(dataset, split, "elevation_m")) for split in THREE
    }
    columns = {split: np.flatnonzero(mask.any(axis=0)) for split, mask in shown.items()}
    for one, other in (("train", "valid"), ("valid", "test/site")):
        assert columns[other].min() - columns[one].max() > 24  # a map's width
    driven = [on_ground(dataset, split, "drive_count", 0) > 0 for split in THREE]
    assert np.sum(driven, axis=0).max() == 1


# The ground


def test_the_ground_is_cut_around_the_drives(dem: Path) -> None:
    rows = drives_over(count=20, reach_m=5)
    rows = rows.assign(x=rows["x"] * 0.2 + 30.3, y=rows["y"] * 0.2 + 8.1)
    rows = pd.concat(timed(own) for _, own in rows.groupby("drive"))
    dataset = imported(dem, log_of(rows, dem.parent / "log.csv"), shares={"train": 1.0})
    about = source_of(dataset)
    west, south = np.array(about["origin_m"]) - [WEST, SOUTH]
    high, wide = about["tiles"]
    assert (west % CELL, south % CELL) == (0, 0)
    for low, size, extent in (
        (west, wide * 12, rows["x"]),
        (south, high * 8, rows["y"]),
    ):
        assert low <= extent.min() < extent.max() < low + size
        assert (
            size - (extent.max() - extent.min())
            < (12 if extent is rows["x"] else 8) + 2
        )
    assert about["drives"]["used"] == {"train": len(rows)}
    with rasterio.open(dem) as file:
        ground = file.read(1)[::-1]
    for number, lowest, heights in zip(
        about["kept"],
        about["lowest_m"],
        dataset.read("train")["elevation_m"],
        strict=True,
    ):
        row, column = divmod(number, wide)
        at_y, at_x = round((south + row * 8) / CELL), round((west + column * 12) / CELL)
        np.testing.assert_allclose(
            heights + lowest, ground[at_y : at_y + 16, at_x : at_x + 24], atol=2e-4
        )
    found = on_ground(dataset, "train", "traversability")
    y, x = (np.indices((HEIGHT, WIDTH)) + 0.5) * CELL
    driven = ~np.isnan(found)
    np.testing.assert_array_equal(found[driven], field(x, y)[driven])
    assert driven.sum() > 20


def test_drives_to_the_edge_of_the_ground_are_used_whole(dem: Path) -> None:
    corners = np.array([[0.01, 0.01], [WIDTH * CELL - 0.01, HEIGHT * CELL - 0.01]])
    x, y = np.linspace(*corners, 500).T
    rows = timed(pd.DataFrame({"x": x, "y": y, "commanded_m_s": 1.0}))
    beyond = [rows.assign(y=y).head(100) for y in (-0.01, HEIGHT * CELL + 0.01)]
    beyond += [rows.assign(x=x).head(150) for x in (-0.01, WIDTH * CELL + 0.01)]
    rows = pd.concat([rows, *beyond])
    dataset = imported(dem, log_of(rows, dem.parent / "log.csv"), shares={"train": 1.0})
    about = source_of(dataset)
    assert list(about["drives"]["left_out"]) == list(REASONS)
    assert {
        name: count for name, count in about["drives"]["left_out"].items() if count
    } == {"off_dem": 500}
    assert (
        about["left_out"]["not_driven"]
        == about["tiles"][0] * about["tiles"][1] - len(about["kept"])
        > 0
    )


def test_longitude_and_latitude_are_positions_too(dem: Path) -> None:
    rows = drives_over()
    by_metres = imported(dem, log_of(rows, dem.parent / "log.csv"))
    crs = rasterio.crs.CRS.from_epsg(32654)
    there = transformed(crs, "EPSG:4326", WEST + rows["x"], SOUTH + rows["y"])
    placed = rows.assign(longitude_deg=there[0], latitude_deg=there[1]).drop(
        columns=["x", "y"]
    )
    placed.to_csv(dem.parent / "gps.csv", index=False)
    by_angles = imported(dem, dem.parent / "gps.csv")
    assert by_angles.splits.keys() == by_metres.splits.keys()
    for split in THREE:
        np.testing.assert_array_equal(
            by_angles.read(split)["drive_count"], by_metres.read(split)["drive_count"]
        )
    # Metres of a projection that stretches lengths are not those of the maps, but
    # places of it are.
    mercator = transformed(crs, "EPSG:3857", WEST + rows["x"], SOUTH + rows["y"])
    with rasterio.open(dem) as file:
        ground = rasterio.warp.reproject(
            file.read(1),
            src_transform=file.transform,
            src_crs=crs,
            dst_crs="EPSG:3857",
            dst_resolution=0.3,
        )
    path = dem.parent / "mercator.tif"
    about = {
        "driver": "GTiff",
        "count": 1,
        "dtype": "float32",
        "crs": "EPSG:3857",
        "transform": ground[1],
    }
    with rasterio.open(
        path, "w", height=ground[0].shape[-2], width=ground[0].shape[-1], **about
    ) as file:
        file.write(np.maximum(ground[0].reshape(1, *ground[0].shape[-2:]), 100))
    stretched = rows.assign(x=mercator[0] - WEST, y=mercator[1] - SOUTH)
    shares = {"train": 1.0}
    by_mercator = imported(path, log_of(stretched, dem.parent / "m.csv"), shares=shares)
    by_gps = imported(path, dem.parent / "gps.csv", shares=shares)
    assert by_mercator.read("train")["drive_count"].sum() > 0.8 * len(rows)
    np.testing.assert_array_equal(
        by_mercator.read("train")["drive_count"], by_gps.read("train")["drive_count"]
    )


# Classes


def test_without_classes_no_cell_has_one_and_with_them_each_keeps_its_own(
    dem: Path,
) -> None:
    log = log_of(drives_over(), dem.parent / "log.csv")
    without = imported(dem, log)
    assert (without.read("train")["class_id"] == UNLABELLED).all()
    assert (without.read("train")["environment"] == 0).all()
    classes = write(
        dem.parent / "classes.tif", np.full((HEIGHT, WIDTH), 3, np.uint8), CELL
    )
    with_them = imported(dem, log, rasters=Rasters(classes=str(classes)))
    assert (with_them.read("train")["class_id"] == 3).all()
    for name in ("traversability", "drive_count", "drive_std"):
        np.testing.assert_array_equal(
            without.read("train")[name], with_them.read("train")[name]
        )
    for one in (without, with_them):
        assert source(one, "train")["truth"] == "unknown"
        assert source(one, "train")["traversability"] == {
            name: source(one, "train")["drives"][name] for name in ("file", "sha256")
        }


def test_measured_traversability_by_raster_needs_no_classes_either(dem: Path) -> None:
    value = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    value[:, : WIDTH // 2] = np.nan
    path = write(dem.parent / "value.tif", value, CELL)
    out = dem.parent / "out.h5"
    given = {
        "photo": str(dem.parent / "photo.tif"),
        "traversability": str(path),
        "unlabelled": True,
    }
    list(import_dem(str(dem), out, RECIPE, Rasters(**given)))
    dataset = TerrainDataset(out)
    assert source_of(dataset)["left_out"]["missing_classes"] == 16
    maps = dataset.read("test/real")
    assert (maps["class_id"] == UNLABELLED).all()
    assert (maps["traversability"] == 0.25).all()
    with pytest.raises(ConfigError, match="`unlabelled` with `photo`"):
        Rasters(unlabelled=True)
    with pytest.raises(ConfigError, match="without `classes`"):
        Rasters(unlabelled=True, photo="a.tif", random_classes=True)


def test_datasets_of_other_drives_are_merged(dem: Path) -> None:
    rows = drives_over()
    near, far = rows[rows["x"] < 44], rows[rows["x"] > 60]
    parts = [
        imported(
            dem, log_of(own, dem.parent / f"{name}.csv"), shares={"train": 1.0}
        ).path
        for name, own in (("near", near), ("far", far))
    ]
    list(merge(parts, dem.parent / "both.h5", "both"))
    both = TerrainDataset(dem.parent / "both.h5")
    assert both.read("train")["drive_count"].sum() == len(near) + len(far)


# Bad input

HEAD = "time_s,x_m,y_m,commanded_m_s,measured_m_s,drive\n"
MOVE = "".join(
    f"{step / 5},{500010 + 0.16 * step},3999910,1,0.8,a\n" for step in range(31)
)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (
            "time_s,x_m,y_m,commanded,measured_m_s\n0,1,1,1,1\n",
            "no commanded_m_s.*Did you mean 'commanded'",
        ),
        (
            "t,x_m,y_m,commanded_m_s,measured_m_s\n0,1,1,1,1\n",
            "got no time_s. The file has t, x_m",
        ),
        (
            "time_s,longitude_deg,commanded_m_s,measured_m_s\n0,1,1,1\n",
            "got no x_m and no y_m",
        ),
        (
            (HEAD + MOVE).replace(",", ";"),
            "got no time_s .* Separate columns by commas",
        ),
        (
            (HEAD + MOVE).replace(",", ";").replace(".", ","),
            "cannot be read: .* write decimals with a point",
        ),
        (HEAD, "got none below the header"),
        ("", "No columns to parse from file. Write a line of column names"),
        (MOVE, "Begin the file with a line of column names"),
        ("# robot 7\n" + HEAD + MOVE, "Remove lines above the column names"),
        (HEAD.replace("drive", "x_m") + MOVE, "Expected one column `x_m`"),
        (HEAD + MOVE.replace("1,0.8", "0,0"), "of 31 rows, 31 have a commanded speed"),
        (
            HEAD + "0,1,1,fast,1,a\n",
            "`commanded_m_s` to be numbers in .*, got fast in row 1",
        ),
        (HEAD + "0,inf,1,1,1,a\n", "`x_m` to be numbers in .*, got inf in row 1"),
        (HEAD + "0,1,1,1,1,\n", "`drive` in each row.*row 1"),
        (
            HEAD + "0,1,1,30,30,a\n0,1,1,100,1,a\n",
            "`commanded_m_s` in m/s.*median of 65.*Divide km/h by 3.6",
        ),
        (HEAD + "0,1,1,1,30,a\n", "`measured_m_s` in m/s.*median of 30"),
        (
            HEAD + "0,1,1,1,1,a\n",
            "got x_m 1 to 1 and y_m 1 to 1 in .* covers x 500000 to 500096 and y",
        ),
        (
            HEAD + "0,500010,3999910,1,1,a\n",
            "got none in drives of up to 0 s",
        ),
        (HEAD + MOVE, "a drive for each of the 3 splits .* got 1 in .*--splits"),
        (
            HEAD + "".join(MOVE.replace("a\n", f"{name}\n") for name in "abc"),
            "terrain for 3 splits|a drive of its own on the terrain of each split, got none for valid, test/site",
        ),
    ],
)
def test_a_bad_log_is_refused_in_one_line(dem: Path, text: str, why: str) -> None:
    path = dem.parent / "log.csv"
    path.write_text(text)
    before = sorted(dem.parent.iterdir())
    with pytest.raises(DatasetError, match=why) as caught:
        imported(dem, path)
    assert "\n" not in str(caught.value)
    assert sorted(dem.parent.iterdir()) == before


def test_a_drive_on_the_ground_of_each_split_is_needed(dem: Path) -> None:
    rows = drives_over()
    rows = rows[(rows["x"] < 30) | (rows["drive"] == "drive-11")]
    path = log_of(rows, dem.parent / "log.csv")
    with pytest.raises(
        DatasetError, match="on the terrain of each split, got none for valid in"
    ):
        imported(dem, path)


def test_other_bad_settings_are_refused(dem: Path) -> None:
    with pytest.raises(ConfigError, match="end in one of"):
        Drives(file="log.txt")
    for speed in (0, -1, np.inf, np.nan):
        with pytest.raises(ConfigError, match="`least_speed` above 0"):
            Drives(file="log.csv", least_speed=speed)
    rasters = Rasters(photo="p.tif", traversability="t.tif", unlabelled=True)
    with pytest.raises(
        ConfigError,
        match="either `drives` or `traversability` as the source of λ, got both",
    ):
        imported(dem, Path("log.csv"), rasters=rasters)
    with pytest.raises(ConfigError, match="`classes` with `solvable`"):
        imported(dem, Path("log.csv"), solvable=True)
    with pytest.raises(DatasetError, match="No such file"):
        imported(dem, dem.parent / "none.csv")
    degrees = write(
        dem.parent / "degrees.tif",
        rough(90, 90),
        crs="EPSG:4326",
        transform=rasterio.Affine(1e-5, 0, 11, 0, -1e-5, 47),
    )
    with pytest.raises(
        DatasetError, match=r"`longitude_deg` and `latitude_deg` .* in metres"
    ):
        imported(degrees, log_of(drives_over(), dem.parent / "log.csv"))


# The command


def test_the_command_says_what_was_used_and_what_was_not(
    dem: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(dem.parent)
    rows = drives_over(reach_m=50)
    rows.loc[:9, "commanded_m_s"] = -0.15
    rows.loc[:9, "measured_m_s"] = -0.1
    log_of(rows, dem.parent / "log.csv")
    (dem.parent / "log.csv.gz").write_bytes(
        gzip.compress((dem.parent / "log.csv").read_bytes())
    )
    grid = "height=16 width=24 start_m=[2.2,2.2] goal_m=[9.2,5.2]"
    common = (
        f"import-drives log.csv.gz {grid} --dem dem.tif --recipe tiny-v1 --out site.h5"
    )
    assert call("datagen", *shlex.split(common)) == 2
    assert "`photo` or `classes`" in capfd.readouterr().err
    flags = "--photo photo.tif --splits train:0.5,valid:0.25,test/site:0.25 --least-speed 0.2 --stride 4"
    assert call("datagen", *shlex.split(f"{common} {flags}")) == 0
    said = capfd.readouterr().out
    dataset = TerrainDataset("site.h5")
    assert dataset.id == "site"
    about = source(dataset, "train")["drives"]
    assert about["left_out"]["slow"] == 10
    assert (about["least_speed_m_s"], about["file"]) == (0.2, "log.csv.gz")
    used = sum(about["used"].values())
    assert f"{used} of {len(rows)} rows of log.csv.gz were used" in said
    for reason, why in (
        ("slow", "have a commanded speed below `least_speed`"),
        ("between_maps", "lie between the maps"),
        (
            "other_split",
            "lie on the terrain of a split that their drive does not belong to",
        ),
    ):
        assert f"{about['left_out'][reason]} rows are left out: they {why}" in said
    assert "missing" not in said
    names = about["drives"]["valid"]
    assert (
        f"valid: {about['used']['valid']} rows of {len(names)} drive{'s' * (len(names) > 1)} ({names[0]}"
        in said
    )
    assert re.search(r"left out of train: \d+ maps have ", said)
    assert "have no cell that a drive of their split crossed" in said
    assert "group(s), the statistical unit" in said
    assert 0.95 < about["pace"] < 1.05
    assert (
        f"positions move {about['pace']:g} times as far as measured_m_s implies" in said
    )
    assert (
        f"and {about['commanded_pace']:g} times as far as commanded_m_s implies" in said
    )
    for line in (
        "validate site.h5",
        "show site.h5",
        "preview site.h5 --split train --out sheet.png",
    ):
        assert call("datagen", *shlex.split(line)) == 0
    assert "drive_count, drive_std" in capfd.readouterr().out
    assert call("datagen", *shlex.split("show site.h5 --json")) == 0
    assert (
        json.loads(capfd.readouterr().out)["splits"]["train"]["parts"][0]["source"][
            "drives"
        ]
        == about
    )


def test_the_default_splits_are_for_training(
    dem: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(dem.parent)
    log_of(drives_over(), dem.parent / "log.csv")
    write(dem.parent / "classes.tif", np.full((HEIGHT, WIDTH), 7, np.uint8), CELL)
    write(dem, np.full((HEIGHT, WIDTH), 5, np.float32), CELL)
    # Maps on which the craters of another scenario would have no room.
    grid = (
        "height=16 width=24 resolution_m=0.5 start_m=[2.2,2.2] goal_m=[9.2,5.2] id=mine"
    )
    common = (
        f"import-drives log.csv {grid} --dem dem.tif --out site --classes classes.tif"
    )
    assert (
        call("datagen", *shlex.split(common + " --class-ids '{7: gravel}' --solvable"))
        == 0
    )
    dataset = TerrainDataset("site")
    assert dataset.id == "mine"
    assert list(dataset.splits) == ["train", "valid", "test/site"]
    gravel = [item.name for item in dataset.recipe.classes].index("gravel")
    assert (dataset.read("train")["class_id"] == gravel).all()
    assert np.isfinite(dataset.read("train")["reference_time_s"]).all()
    assert call("datagen", *shlex.split(common)) == 2
    assert "--overwrite" in capfd.readouterr().err
    assert (
        call(
            "datagen",
            *shlex.split(common + " --class-ids '{7: null, 3: gravel}' --overwrite"),
        )
        == 2
    )
    assert (
        "no cell with a class or measured λ, or have cells with neither class nor photo"
        in capfd.readouterr().err
    )
    assert (
        call("datagen", *shlex.split(common + " --class-ids '{7: scree}' --overwrite"))
        == 0
    )
    assert not (TerrainDataset("site").read("train")["class_id"] == gravel).any()


def test_an_import_of_drives_that_fails_leaves_nothing(dem: Path) -> None:
    path = log_of(drives_over(), dem.parent / "log.csv")
    before = sorted(dem.parent.iterdir())
    small = Rasters(
        photo=str(write(dem.parent / "p.tif", np.full((3, 4, 4), 9, np.uint8))),
        unlabelled=True,
    )
    with pytest.raises(BenchnavError, match="have cells without colour"):
        imported(dem, path, rasters=small)
    assert sorted(dem.parent.iterdir()) == sorted([*before, dem.parent / "p.tif"])
