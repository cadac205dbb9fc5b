"""Drive logs as robots, receivers and spreadsheets spoil them: each imports right, or
stops with a working remedy.
"""

import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchnav.datagen.dem.crs import transformed
from benchnav.datagen.files.reader import TerrainDataset
from tests.commands import call
from tests.datagen.dem.rasters import SOUTH, WEST, write

rasterio = pytest.importorskip("rasterio")

CELL, HEIGHT, WIDTH = 0.5, 64, 192
ROWS, RATE = 300, 5  # of each drive; rows a second
Edit = Callable[[pd.DataFrame], pd.DataFrame]


def traversability(x_m: np.ndarray) -> np.ndarray:
    return np.where(x_m < 40, 0.9, 0.65)


def clean_log() -> pd.DataFrame:
    """Three drives eastward, which wind over hills at 0.8 and 1 m/s, with noise of 3 %
    in the measured speed.
    """
    generator, parts = np.random.default_rng(0), []
    for drive in range(3):
        commanded = np.where(np.arange(ROWS) // 50 % 2, 0.8, 1.0)
        x, y, rows = 10.0, 6.0 + 8 * drive, []
        for step in range(ROWS):
            speed = commanded[step] * float(traversability(np.array(x)))
            heading = 0.4 * np.sin(step / 40)
            x, y = (
                x + speed / RATE * np.cos(heading),
                y + speed / RATE * np.sin(heading),
            )
            rows.append((step / RATE, WEST + x, SOUTH + y, commanded[step], speed))
        table = pd.DataFrame(
            rows, columns=["time_s", "x_m", "y_m", "commanded_m_s", "measured_m_s"]
        )
        table["measured_m_s"] *= 1 + 0.03 * generator.standard_normal(ROWS)
        parts.append(table.assign(drive=f"drive-{drive}"))
    return pd.concat(parts, ignore_index=True)


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ground")
    x, y = np.meshgrid(np.arange(WIDTH) * CELL, np.arange(HEIGHT) * CELL)
    write(
        folder / "dem.tif",
        (100 + 2 * np.sin(x / 8) * np.cos(y / 8)).astype(np.float32),
        CELL,
    )
    write(folder / "photo.tif", np.full((3, HEIGHT, WIDTH), 99, np.uint8), CELL)
    return folder


LINE = (
    "import-drives log.csv --dem dem.tif --photo photo.tif --recipe tiny-v1 --splits train:1 --out out.h5 --overwrite "
    "height=16 width=24 start_m=[2.2,2.2] goal_m=[9.2,5.2]"
)


def scaled(factor: float, *columns: str) -> Edit:
    return lambda log: log.assign(**{name: log[name] * factor for name in columns})


def named_factor(message: str) -> float:
    """The factor that a message says to multiply by."""
    (factor,) = re.findall(r" by ([\d.e+-]+\d)[. (,]", message)
    return float(factor)


def some(fraction: float, seed: int = 1) -> np.ndarray:
    return np.flatnonzero(np.random.default_rng(seed).random(3 * ROWS) < fraction)


def jumping(fraction: float) -> Edit:
    return lambda log: log.assign(
        x_m=log["x_m"] + 20.0 * np.isin(log.index, some(fraction))
    )


def without(fraction: float) -> Edit:
    return lambda log: log.drop(index=some(fraction))


def frozen(start: int, stop: int) -> Edit:
    def edit(log: pd.DataFrame) -> pd.DataFrame:
        log.loc[start:stop, ["x_m", "y_m"]] = log.loc[start, ["x_m", "y_m"]].to_numpy()
        return log

    return edit


def seldom(log: pd.DataFrame) -> pd.DataFrame:
    log[["x_m", "y_m"]] = log[["x_m", "y_m"]].iloc[log.index // RATE * RATE].to_numpy()
    return log


def with_value(fraction: float, value: float, *columns: str) -> Edit:
    def edit(log: pd.DataFrame) -> pd.DataFrame:
        log.loc[some(fraction), list(columns)] = value
        return log

    return edit


def sessions(log: pd.DataFrame) -> pd.DataFrame:
    return log.assign(drive="monday")


def set_back(log: pd.DataFrame) -> pd.DataFrame:
    log.loc[200:215, "time_s"] -= 30
    return log


def angles(log: pd.DataFrame) -> pd.DataFrame:
    places = transformed(
        rasterio.crs.CRS.from_epsg(32654), "EPSG:4326", log["x_m"], log["y_m"]
    )
    return log.assign(longitude_deg=places[0], latitude_deg=places[1]).drop(
        columns=["x_m", "y_m"]
    )


def swapped(*names: str) -> Edit:
    return lambda log: log.rename(
        columns=dict(zip(names, reversed(names), strict=True))
    )


def backward(log: pd.DataFrame) -> pd.DataFrame:
    return log.assign(
        commanded_m_s=log["commanded_m_s"] * np.where(log["drive"] == "drive-1", -1, 1),
        measured_m_s=log["measured_m_s"] * np.where(log["drive"] == "drive-1", -1, 1),
    )


def unsigned(log: pd.DataFrame) -> pd.DataFrame:
    return backward(log).assign(measured_m_s=log["measured_m_s"])


def third_in_knots(log: pd.DataFrame) -> pd.DataFrame:
    log.loc[log["drive"] == "drive-2", "measured_m_s"] /= 0.5144
    return log


def noisy(size_m: float) -> Edit:
    def edit(log: pd.DataFrame) -> pd.DataFrame:
        return log.assign(
            y_m=log["y_m"]
            + size_m * np.random.default_rng(2).standard_normal(len(log)),
        )

    return edit


def zero_at_start(log: pd.DataFrame) -> pd.DataFrame:
    log.loc[:20, ["x_m", "y_m"]] = 0.0
    return log


def stuck(log: pd.DataFrame) -> pd.DataFrame:
    """Ends the first drive by 10 s of wheels that turn in place."""
    end = log[log["drive"] == "drive-0"].tail(1)
    more = pd.concat([end] * 50, ignore_index=True).assign(measured_m_s=0.0)
    more["time_s"] += np.arange(1, 51) / RATE
    return pd.concat([log, more], ignore_index=True)


def wheels(log: pd.DataFrame) -> pd.DataFrame:
    return log.assign(measured_m_s=log["commanded_m_s"])


def few_decimals(log: pd.DataFrame) -> pd.DataFrame:
    return log.assign(x_m=log["x_m"].round(), y_m=log["y_m"].round())


def identical(log: pd.DataFrame) -> pd.DataFrame:
    return log


# What is spoilt, how, what is said, and the remedy (empty: the log imports right):
# options to pass, or what to do with the log by the one line.
Case = tuple[str, Edit, str, str | Callable[[pd.DataFrame, str], pd.DataFrame]]
CASES: list[Case] = [
    ("clean", identical, "", ""),
    ("shuffled", lambda log: log.sample(frac=1, random_state=0), "", ""),
    ("interleaved", lambda log: log.sort_values("time_s", kind="stable"), "", ""),
    ("doubled", lambda log: pd.concat([log, log]), "900 rows are left out: they repeat", ""),
    ("epoch", lambda log: log.assign(time_s=log["time_s"] + 1.7e9), "", ""),
    ("angles", angles, "", ""),
    ("seldom", seldom, "", ""),
    ("gaps", lambda log: log[log.index % 100 < 70], "", ""),
    ("values missing", with_value(0.2, np.nan, "measured_m_s"), "they lack a value", ""),
    ("some jumps", jumping(0.05), f"{len(some(0.05))} rows are left out: they have a position out of", ""),
    ("short freeze", frozen(100, 120), "20 rows are left out: they have a position that stays", ""),
    ("clock set back", set_back, "16 rows are left out: they have a time before", ""),
    ("no fix at first", zero_at_start, "21 rows are left out: they lie off", ""),
    ("few sentinels", with_value(0.03, -1000.0, "measured_m_s"), "they have a speed above 15", ""),
    ("backward", backward, "", ""),
    ("immobilised", stuck, "950 of 950 rows", ""),
    ("noise", noisy(0.1), "", ""),
    ("many jumps", jumping(0.3), "out of reach at 1.5 times", lambda log, _: without(0.3)(log)),
    ("long freeze", frozen(100, 250), "stays the same while", lambda log, _: log.drop(index=range(101, 251))),
    ("sessions of one name", sessions, "name each session in a column `drive`",
     lambda log, _: log.assign(drive=np.arange(len(log)) // ROWS)),
    ("milliseconds", scaled(1000, "time_s"), "looks like milliseconds",
     lambda log, line: scaled(named_factor(line), "time_s")(log)),
    ("hours", scaled(1 / 3600, "time_s"), "looks like hours",
     lambda log, line: scaled(named_factor(line), "time_s")(log)),
    ("one time", lambda log: log.assign(time_s=5.0), "got none in drives of up to 0 s", "--speed measured"),
    ("knots", scaled(1 / 0.5144, "measured_m_s"), "looks like knots", "--speed positions"),
    ("knots, mended", scaled(1 / 0.5144, "measured_m_s"), "looks like knots",
     lambda log, line: scaled(named_factor(line), "measured_m_s")(log)),
    ("km/h", scaled(3.6, "measured_m_s", "commanded_m_s"), r"looks like km/h.*`commanded_m_s` too",
     lambda log, line: scaled(named_factor(line), "measured_m_s", "commanded_m_s")(log)),
    ("mph", scaled(2.237, "measured_m_s"), "looks like mph", "--speed positions"),
    ("one drive in knots", third_in_knots, "disagree by more than 15 %.*--speed positions", "--speed positions"),
    ("one drive in knots, mended", third_in_knots, "In drive-2, .* like knots. Multiply .* by 0.5144 .* there,",
     lambda log, _: log.assign(measured_m_s=log["measured_m_s"] * np.where(log["drive"] == "drive-2", 0.5144, 1))),
    ("wheel odometry", wheels, "suggests wheel odometry", "--speed positions"),
    ("measured nothing", scaled(0, "measured_m_s"), "got inf times", "--speed positions"),
    ("no measured speed", lambda log: log.drop(columns="measured_m_s"), "no measured_m_s.*--speed positions",
     "--speed positions"),
    ("many sentinels", with_value(0.3, -1000.0, "measured_m_s"), "a speed above 15 m/s",
     lambda log, _: log.assign(measured_m_s=log["measured_m_s"].where(log["measured_m_s"] > -999))),
    ("half the command", scaled(0.5, "commanded_m_s"), "times as far as `commanded_m_s` implies: calibrate",
     lambda log, _: scaled(2, "commanded_m_s")(log)),
    ("unsigned", unsigned, "Log the forward speed over ground, negative when",
     lambda log, _: log.assign(measured_m_s=log["measured_m_s"] * np.sign(log["commanded_m_s"]))),
    ("feet", scaled(3.281, "x_m", "y_m"), "Log x_m and y_m in that CRS",
     lambda log, _: scaled(1 / 3.281, "x_m", "y_m")(log)),
    ("axes swapped", swapped("x_m", "y_m"), "Swap `x_m` and `y_m`",
     lambda log, _: swapped("x_m", "y_m")(log)),
    ("angles swapped", lambda log: swapped("longitude_deg", "latitude_deg")(angles(log)),
     r"`latitude_deg` within \[-90, 90\].* Swap `longitude_deg` and `latitude_deg`, or convert to degrees",
     lambda log, _: swapped("longitude_deg", "latitude_deg")(log)),
    ("angles in 1e-7 degrees", lambda log: scaled(1e7, "longitude_deg", "latitude_deg")(angles(log)),
     "Swap `longitude_deg` and `latitude_deg`, or convert to degrees",
     lambda log, _: scaled(1e-7, "longitude_deg", "latitude_deg")(log)),
    ("radians", lambda log: scaled(np.pi / 180, "longitude_deg", "latitude_deg")(angles(log)),
     "Convert `longitude_deg` and `latitude_deg` to degrees in WGS 84",
     lambda log, _: scaled(180 / np.pi, "longitude_deg", "latitude_deg")(log)),
    ("other names", swapped("x_m", "east"), "got no x_m", lambda log, _: swapped("east", "x_m")(log)),
    ("clock times", lambda log: log.assign(time_s=pd.to_datetime(log["time_s"], unit="s").astype(str)),
     "`time_s` to be numbers.*Convert clock times to seconds",
     lambda log, _: log.assign(time_s=(pd.to_datetime(log["time_s"]) - pd.Timestamp(0)).dt.total_seconds())),
]  # fmt: skip


def run(options: str, capfd: pytest.CaptureFixture[str]) -> tuple[int, str]:
    status = call("datagen", *shlex.split(f"{LINE} {options}"))
    said = capfd.readouterr()
    return status, said.err if status else said.out


def cells(dataset: TerrainDataset) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Actual λ of each map, NaN where it was not driven, and expected λ."""
    source = dataset.splits["train"]["parts"][0]["source"]
    for number, actual in zip(
        source["kept"], dataset.read("train")["traversability"], strict=True
    ):
        west = (
            source["origin_m"][0]
            - WEST
            + number % source["tiles"][1] * source["stride_m"][0]
        )
        x = west + (np.arange(24) + 0.5) * CELL
        # Where λ changes, speeds of two seconds of positions are of both.
        expected = np.where(np.abs(x - 40) < 2, np.nan, traversability(x))
        yield actual, np.broadcast_to(expected, actual.shape)


def check_right() -> None:
    actual, expected = (
        np.concatenate(values)
        for values in zip(*cells(TerrainDataset("out.h5")), strict=True)
    )
    error = np.abs(actual - expected)
    error = error[~np.isnan(error)]
    assert len(error) > 100
    assert np.median(error) < 0.025
    assert (error > 0.15).mean() < 0.02


@pytest.mark.parametrize(
    ("spoil", "line", "remedy"),
    [case[1:] for case in CASES],
    ids=[case[0] for case in CASES],
)
def test_a_spoilt_log_imports_right_or_stops_with_a_remedy_that_works(
    spoil: Edit,
    line: str,
    remedy: str | Callable[[pd.DataFrame, str], pd.DataFrame],
    ground: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(ground)
    log = spoil(clean_log())
    log.to_csv("log.csv", index=False)
    status, said = run("", capfd)
    if not remedy:
        assert re.search(line, said)
    else:
        assert status == 2
        (error,) = [text for text in said.splitlines() if "error:" in text]
        assert said.strip().endswith(error)
        assert re.search(line, error)
        if isinstance(remedy, str):
            assert remedy in error
        else:
            remedy(log, error).to_csv("log.csv", index=False)
        status, said = run(remedy if isinstance(remedy, str) else "", capfd)
    assert status == 0, said
    assert "positions move" in said
    check_right()


def reverses() -> pd.DataFrame:
    """A drive at 1 m/s that slides back for half of the time."""
    speed = np.tile(np.repeat([0.8, -0.6], 50), 4)
    x = WEST + 20 + np.cumsum(speed) / RATE
    time_s = np.arange(len(x)) / RATE
    return pd.DataFrame(
        {
            "time_s": time_s,
            "x_m": x,
            "y_m": SOUTH + 10.0,
            "commanded_m_s": 1.0,
            "measured_m_s": np.abs(speed),
        }
    )


@pytest.mark.parametrize(
    ("log", "options", "line"),
    [
        (
            reverses(),
            "",
            r"positions reverse in 1\d\d rows, but measured_m_s never does: where .* must be negative",
        ),
        (
            reverses(),
            "--speed positions",
            "in more than 10% of rows, the robot slides back",
        ),
        (
            clean_log()[::RATE],
            "--speed positions",
            "positions are logged every 1 s, too rarely to distinguish",
        ),
        (
            few_decimals(clean_log()),
            "--speed measured",
            "positions are multiples of 1 m: log more decimals",
        ),
        (clean_log(), "", ""),
        (
            reverses().assign(measured_m_s=np.tile(np.repeat([0.8, -0.6], 50), 4)),
            "",
            "",
        ),
        (clean_log(), "--speed positions", ""),
    ],
)
def test_what_looks_wrong_of_positions_is_printed(
    log: pd.DataFrame,
    options: str,
    line: str,
    ground: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(ground)
    log.to_csv("log.csv", index=False)
    status, said = run(options, capfd)
    assert status == 0, said
    assert re.search(line, said)
    doubts = ("reverse in", "is unlikely", "too rarely", "multiples")
    assert sum(doubt in said for doubt in doubts) == bool(line)
