"""Positions of drive logs compared with their speeds."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_cells import elevation_under
from benchnav.datagen.dem.drive_log import OVER_SPEED, DriveLog, Drives
from benchnav.datagen.dem.drive_motion import compare_motion, compare_slopes
from benchnav.datagen.dem.drive_tracks import find_jumped, track_of
from benchnav.datagen.dem.drive_velocity import speed_of_positions, velocity_of

STEP_S = 0.1


def drive(
    commanded: np.ndarray, traversability: np.ndarray, turn: np.ndarray | float = 0.0
) -> pd.DataFrame:
    """A drive whose positions, measured speed and command agree; `turn` is the rate of
    turn in rad/s.
    """
    speed = commanded * traversability
    heading = np.cumsum(np.broadcast_to(turn, len(speed))) * STEP_S + 0.3
    way = np.concatenate([[0], (speed * STEP_S)[1:]])
    return pd.DataFrame(
        {
            "x": np.cumsum(way * np.cos(heading)),
            "y": np.cumsum(way * np.sin(heading)),
            "time_s": np.arange(len(speed)) * STEP_S,
            "commanded": commanded,
            "speed": speed,
            "drive": 0,
        }
    )


def log_of(
    rows: pd.DataFrame, speed: str = "", is_geographic: bool = False
) -> DriveLog:
    names = tuple(f"drive-{index}" for index in range(rows["drive"].max() + 1))
    settings = Drives(file="log.csv", speed=speed)  # type: ignore[arg-type]
    return DriveLog(
        settings=settings,
        sha256="",
        names=names,
        is_geographic=is_geographic,
        rows=rows,
    )


def rough_drive(rows: int = 600, seed: int = 0) -> pd.DataFrame:
    """A minute of 0.5 to 1 m/s over terrain of changing λ, with noise of 3 % in the
    measured speed.
    """
    generator = np.random.default_rng(seed)
    commanded = np.repeat(generator.choice([0.5, 0.8, 1.0], rows // 50), 50)
    traversability = 0.75 + 0.2 * np.sin(np.arange(rows) / 37)
    table = drive(commanded, traversability, turn=0.1)
    return table.assign(
        speed=table["speed"] * (1 + 0.03 * generator.standard_normal(rows))
    )


@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_the_ratio_of_positions_to_speeds_is_that_of_the_drive(turn: float) -> None:
    log = compare_motion(log_of(drive(np.ones(600), np.full(600, 0.8), turn)))
    assert log.motion["pace"] == pytest.approx(1, abs=0.03)
    assert log.motion["commanded_pace"] == pytest.approx(0.8, abs=0.03)
    np.testing.assert_allclose(log.rows["traversability"], 0.8)


@pytest.mark.parametrize(
    ("column", "factor", "unit", "remedy"),
    [
        ("speed", 1 / 0.5144, "knots", "Multiply `measured_m_s` by 0.5144"),
        ("speed", 3.6, "km/h", "Multiply `measured_m_s` by 0.2778"),
        ("speed", 2.237, "mph", "Multiply `measured_m_s` by 0.447"),
        ("speed", 3.281, "ft/s", "Multiply `measured_m_s` by 0.3048"),
        ("time_s", 1e3, "milliseconds", "Multiply `time_s` by 0.001."),
        ("time_s", 1e9, "nanoseconds", "Multiply `time_s` by 1e-09."),
        ("time_s", 1 / 60, "minutes", "Multiply `time_s` by 60."),
        ("time_s", 1 / 3600, "hours", "Multiply `time_s` by 3600."),
        ("x y", 3.281, "feet", "Multiply `x_m` and `y_m` by 0.3048."),
    ],
)
@pytest.mark.parametrize("fix_rows", [1, 5])
def test_another_unit_is_named_with_its_factor(
    column: str, factor: float, unit: str, remedy: str, fix_rows: int
) -> None:
    rows = rough_drive()
    rows[["x", "y"]] = (
        rows[["x", "y"]].iloc[np.arange(600) // fix_rows * fix_rows].to_numpy()
    )
    columns = column.split()
    rows[columns] *= factor
    with pytest.raises(DatasetError, match=f"which looks like {unit}\\. ") as caught:
        compare_motion(log_of(rows))
    assert remedy in str(caught.value)
    mended = rows.copy()
    mended[columns] *= float(str(caught.value).split(" by ")[1].split()[0].rstrip("."))
    log = compare_motion(log_of(mended))
    assert log.motion["pace"] == pytest.approx(1, abs=0.03)
    kept = compare_motion(log_of(rows, "measured")) if "speed" in columns else log
    assert len(kept.rows) == 600
    if (
        "speed" not in columns
    ):  # off against the command as well, so that positions do not help
        with pytest.raises(DatasetError, match=unit):
            compare_motion(log_of(rows, "positions"))


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("turn", [0.03, 0.5])
@pytest.mark.parametrize(
    ("factor", "unit", "remedy"),
    [
        (1e3, "milliseconds", 1e-3),
        (1e6, "microseconds", 1e-6),
        (1e9, "nanoseconds", 1e-9),
        (1 / 60, "minutes", 60),
        (1 / 3600, "hours", 3600),
    ],
)
def test_a_unit_of_time_is_named_in_curves_and_without_measured_speed(
    factor: float, unit: str, remedy: float, turn: float, measured: bool
) -> None:
    rows = drive(np.ones(3000), 0.5 + 0.1 * np.sin(np.arange(3000) / 37), turn)
    rows = rows.assign(
        time_s=rows["time_s"] * factor, speed=rows["speed"] if measured else np.nan
    )
    for speed in ("", "positions") if measured else ("positions",):
        with pytest.raises(
            DatasetError,
            match=rf"{unit}.* ultiply `time_s` by {remedy:.4g}".replace(" u", "[Mm]u"),
        ):
            compare_motion(log_of(rows, speed, is_geographic=True))


def test_positions_that_no_command_explains_are_rejected_and_slow_ones_are_not() -> (
    None
):
    rows = drive(np.ones(900), np.repeat([0.02, 0.06], [800, 100]))
    compare_motion(log_of(rows.assign(speed=np.nan), "positions"))
    compare_motion(
        log_of(
            drive(np.ones(900), np.full(900, 4.5)).assign(speed=np.nan, commanded=1.0),
            "positions",
        )
    )
    compare_motion(log_of(rows.assign(speed=0.0), "positions"))  # it is immobilised
    tenth = drive(np.ones(900), np.full(900, 0.4)).assign(time_s=np.arange(900.0))
    for speed in (0.4, np.nan):
        with pytest.raises(
            DatasetError,
            match=r"0\.04 times as far as `commanded_m_s` .* no known unit.* in seconds",
        ):
            compare_motion(log_of(tenth.assign(speed=speed), "positions"))


def test_positions_of_few_decimals_name_no_unit() -> None:
    rows = drive(np.ones(900), np.full(900, 0.3), turn=0.05)
    log = log_of(rows.assign(x=rows["x"].round(-1), y=rows["y"].round(-1), speed=1.2))
    with pytest.raises(
        DatasetError,
        match=r"no known unit, since positions are multiples of 10 m\. Log .* decimals",
    ):
        compare_motion(replace(log, motion={"resolution_m": 10.0}))


def test_a_slalom_is_not_of_wheels() -> None:
    turn = 1.2 * np.cos(np.arange(2400) * STEP_S * 2 * np.pi / 6)
    log = compare_motion(log_of(drive(np.ones(2400), np.ones(2400), turn)))
    compare_slopes(log, np.zeros(len(log.rows)))


def test_few_straight_spans_name_no_unit_of_speed() -> None:
    turning = drive(
        np.ones(30), np.full(30, 0.5), turn=np.repeat([0, 6.0, 0], 10)
    ).assign(speed=1.0)
    standing = drive(np.repeat([0.0, 1.0], [18, 12]), np.full(30, 0.5144))
    for rows in (turning, standing.assign(speed=standing["commanded"])):
        with pytest.raises(DatasetError, match="no known unit"):
            compare_motion(log_of(rows))


def test_a_measured_speed_of_no_unit_is_rejected_too() -> None:
    rows = rough_drive()
    for factor, ratio in (
        (1 / 1.3, "1.3"),
        (1 / 3.281, "3.2"),
    ):  # positions agree with the command: they are no feet
        with pytest.raises(
            DatasetError,
            match=rf"got {ratio}\d* times, .*like no known unit\. .* m, or pass",
        ):
            compare_motion(log_of(rows.assign(speed=rows["speed"] * factor)))


def test_noise_of_positions_is_no_disagreement() -> None:
    rows = rough_drive(1200)
    rows[["x", "y"]] += 0.1 * np.random.default_rng(0).standard_normal((1200, 2))
    assert compare_motion(log_of(rows)).motion["pace"] == pytest.approx(1, abs=0.02)


def test_curves_and_gaps_are_no_disagreement() -> None:
    turning = np.repeat([0, 1.2, -1.2, 0, 1.2], 120)
    log = compare_motion(log_of(drive(np.ones(600), np.full(600, 0.9), turning)))
    assert log.motion["pace"] == pytest.approx(1, abs=0.02)
    rows = drive(np.ones(600), np.full(600, 0.9))
    # stands for a minute, and logs nothing
    paused = rows.assign(time_s=rows["time_s"] + 60 * (rows.index // 12))
    log = compare_motion(log_of(paused))
    assert (log.motion["pace"], len(log.rows)) == (pytest.approx(1, abs=0.02), 600)


@pytest.mark.parametrize("rows", [8, 15, 25])
def test_short_drives_are_compared_too(rows: int) -> None:
    parts = [
        drive(np.ones(rows), np.full(rows, 0.8)).assign(drive=index)
        for index in range(40)
    ]
    table = pd.concat(parts, ignore_index=True)
    for speed in ("", "measured"):
        assert compare_motion(log_of(table, speed)).motion["pace"] == pytest.approx(
            1, abs=0.02
        )
    with pytest.raises(DatasetError, match="knots"):
        compare_motion(log_of(table.assign(speed=table["speed"] / 0.5144)))


def test_a_log_without_motion_under_one_command_is_not_compared() -> None:
    commanded = np.tile([1.0, -1.0], 300)
    rows = drive(commanded, np.full(600, 0.8))
    with pytest.raises(DatasetError, match=r"got none in drives of up to 59\.9 s"):
        compare_motion(log_of(rows))


@pytest.mark.parametrize("period_s", [1, 2, 5])
@pytest.mark.parametrize("is_thinned", [True, False])
def test_positions_that_come_seldom_name_no_false_unit(
    period_s: int, is_thinned: bool
) -> None:
    rows, step = rough_drive(6000), 10 * period_s
    if is_thinned:
        rows = rows.iloc[::step].reset_index(drop=True)
    else:
        rows[["x", "y"]] = rows[["x", "y"]].iloc[rows.index // step * step].to_numpy()
    log = compare_motion(log_of(rows))
    assert log.motion["pace"] == pytest.approx(1, abs=0.03)
    with pytest.raises(DatasetError, match=r"like (knots|no known unit, since)"):
        compare_motion(log_of(rows.assign(speed=rows["speed"] / 0.5144)))
    winding = (
        drive(np.ones(6000), np.full(6000, 0.9), turn=0.6)
        .iloc[::step]
        .reset_index(drop=True)
    )
    if period_s > 2:  # chords are much shorter than their arcs
        with pytest.raises(DatasetError, match="no known unit, since"):
            compare_motion(log_of(winding))


def test_the_command_may_be_far_from_positions() -> None:
    rows = drive(np.ones(900), np.repeat([0.1, 0.4, 0.9], 300))
    log = compare_motion(log_of(rows))
    assert len(log.rows) == 900
    assert log.motion["commanded_pace"] == pytest.approx(0.4, abs=0.02)


def test_a_drive_that_disagrees_among_many_is_left_out_and_counted() -> None:
    parts = [rough_drive(seed=seed).assign(drive=seed) for seed in range(12)]
    parts[3]["speed"] *= 1.3
    log = compare_motion(log_of(pd.concat(parts, ignore_index=True)))
    assert log.left_out["off_pace"] == 600
    assert 3 not in set(log.rows["drive"])
    parts[4]["speed"] *= 1.3
    with pytest.raises(
        DatasetError, match=r"got 1200 of 7200 .* disagree by more than 15 %"
    ):
        compare_motion(log_of(pd.concat(parts, ignore_index=True)))


@pytest.mark.parametrize(("factor", "unit"), [(1 / 0.5144, "knots"), (3.6, "km/h")])
def test_the_unit_of_drives_that_disagree_is_named(factor: float, unit: str) -> None:
    parts = [rough_drive(seed=seed).assign(drive=seed) for seed in range(6)]
    for index in (1, 4):
        parts[index]["speed"] *= factor
    with pytest.raises(
        DatasetError,
        match=rf"1200 of 3600 .* In drive-1, drive-4, .* looks like {unit}",
    ) as caught:
        compare_motion(log_of(pd.concat(parts, ignore_index=True)))
    for index in (1, 4):
        parts[index]["speed"] *= float(
            str(caught.value).split("Multiply `measured_m_s` by ")[1].split()[0]
        )
    log = compare_motion(log_of(pd.concat(parts, ignore_index=True)))
    assert log.left_out["off_pace"] == 0


def test_sliding_back_and_over_speed_are_kept() -> None:
    traversability = np.full(600, 0.9)
    traversability[100:200], traversability[300:320] = -0.25, 1.3
    for speed in ("", "measured"):
        log = compare_motion(log_of(drive(np.ones(600), traversability), speed))
        np.testing.assert_allclose(log.rows["traversability"], traversability)
    # From positions, away from the changes.
    log = compare_motion(log_of(drive(np.ones(600), traversability), "positions"))
    away = (
        np.abs(log.rows["time_s"].to_numpy()[:, None] - [10, 20, 30, 32]).min(axis=1)
        > 1
    )
    actual = log.rows["traversability"][away]
    np.testing.assert_allclose(
        actual, traversability[(log.rows["time_s"][away] / STEP_S).round().astype(int)]
    )
    assert (actual < 0).sum() > 50


@pytest.mark.parametrize("speed", ["", "positions", "measured"])
def test_no_ratio_to_the_command_stops_an_import(speed: str) -> None:
    for ratio in (0.1, 0.9, 1.3, 1.45):
        log = compare_motion(log_of(drive(np.ones(600), np.full(600, ratio)), speed))
        assert log.motion["commanded_pace"] == pytest.approx(ratio, abs=0.01)
        np.testing.assert_allclose(log.rows["traversability"], ratio)
    double = drive(np.ones(600), np.full(600, 2.0))
    seldom = double.iloc[::10].reset_index(drop=True)  # at 1 Hz no row is in reach
    for rows in (seldom, double) if speed == "" else (seldom,):
        with pytest.raises(
            DatasetError,
            match=r"1\.5 times .* Positions move 2 times as far as `commanded_m_s` .* by steady",
        ):
            compare_motion(log_of(rows, speed))
        log = compare_motion(log_of(rows.assign(commanded=2.0), speed))
        # both ends have too few positions around them
        assert len(log.rows) >= len(rows) - 2


def skid_steer_log() -> pd.DataFrame:
    """Return a log of a skid-steer robot at 1.08 times its command, in knots.

    The command changes often, and speed follows it with a time constant of 0.5 s, so
    that a tenth of the rows exceeds 1.2 times the command. Positions come once a
    second.
    """
    generator = np.random.default_rng(4)
    commanded = generator.choice([0.15, 0.3, 0.45, 0.6], 20).repeat(60)
    followed = commanded.copy()
    for row in range(1, len(followed)):
        followed[row] = (
            followed[row - 1] + (commanded[row] - followed[row - 1]) * STEP_S / 0.5
        )
    rows = drive(commanded, 1.08 * followed / commanded, turn=0.05)
    rows[["x", "y"]] = rows[["x", "y"]].iloc[rows.index // 10 * 10].to_numpy()
    measured = rows["speed"] + 0.01 * generator.standard_normal(len(rows))
    return rows.assign(speed=measured / 0.5144)


def test_a_log_in_knots_imports_by_its_remedy_though_it_exceeds_its_command() -> None:
    rows = skid_steer_log()
    with pytest.raises(
        DatasetError, match=r"like knots\. Multiply `measured_m_s` by 0\.5144 "
    ):
        compare_motion(log_of(rows))
    for mended in (
        log_of(rows.assign(speed=rows["speed"] * 0.5144)),
        log_of(rows, "positions"),
    ):
        log = compare_motion(mended)
        assert len(log.rows) >= 0.98 * len(rows)
        assert log.motion["commanded_pace"] == pytest.approx(1.08, abs=0.03)
        assert (log.rows["traversability"] > OVER_SPEED).mean() > 0.05


def test_a_speed_of_the_other_sign_is_rejected() -> None:
    commanded = np.repeat([1.0, -1.0], 300)
    rows = drive(commanded, np.full(600, 0.9))
    unsigned = rows.assign(speed=rows["speed"].abs())
    with pytest.raises(
        DatasetError,
        match=r"sign of .* got the opposite sign in 300 of the 300 rows with a backward command",
    ):
        compare_motion(log_of(unsigned))
    for speed in ("measured", "positions"):
        assert len(compare_motion(log_of(unsigned, speed)).rows) == 600


# Faulty rows


def test_an_immobilised_robot_is_no_frozen_receiver() -> None:
    traversability = np.full(600, 0.8)
    traversability[200:400] = 0
    stuck = compare_motion(log_of(drive(np.ones(600), traversability)))
    assert stuck.left_out["frozen"] == 0
    np.testing.assert_allclose(stuck.rows["traversability"], traversability)
    rows = drive(np.ones(6000), np.full(6000, 0.8))
    rows.loc[200:500, ["x", "y"]] = rows.loc[200, ["x", "y"]].to_numpy()
    frozen = compare_motion(log_of(rows))
    assert (frozen.left_out["frozen"], frozen.left_out["jumped"]) == (300, 0)
    rows.loc[200:1000, ["x", "y"]] = rows.loc[200, ["x", "y"]].to_numpy()
    with pytest.raises(
        DatasetError, match="800 of 6000 rows that have a position that stays the same"
    ):
        compare_motion(log_of(rows))


def stuck_drive() -> pd.DataFrame:
    """Ten minutes of λ 0.8 with 40 s of immobility, whose positions are exactly the
    same.
    """
    traversability = np.full(6000, 0.8)
    traversability[2000:2400] = 0
    rows = drive(np.ones(6000), traversability)
    return rows.assign(x=rows["x"].round(3), y=rows["y"].round(3))


@pytest.mark.parametrize("measured", ["of the drive", "of wheels", "missing"])
@pytest.mark.parametrize("fix_rows", [1, 5])
def test_positions_separate_immobility_from_a_frozen_receiver(
    measured: str, fix_rows: int
) -> None:
    rows = stuck_drive()
    if measured != "of the drive":
        rows["speed"] = 0.8 * rows["commanded"] if measured == "of wheels" else np.nan
    rows[["x", "y"]] = (
        rows[["x", "y"]].iloc[rows.index // fix_rows * fix_rows].to_numpy()
    )
    log = compare_motion(log_of(rows, "positions"))
    assert log.left_out["frozen"] == 0
    assert len(log.rows) > 5980
    is_stuck = log.rows["time_s"].between(202, 238)
    np.testing.assert_allclose(log.rows["traversability"][is_stuck], 0, atol=1e-9)
    assert is_stuck.sum() == 361
    if measured == "missing":
        assert log.motion["standing"] == pytest.approx(400, abs=10)
    else:
        assert log.motion["standing"] == 0
        left_out = compare_motion(
            log_of(rows)
        ).left_out  # a measured speed that is used has to agree
        assert left_out["frozen"] == pytest.approx(
            400 if measured == "of wheels" else 0, abs=10
        )
    frozen = rows.copy()  # the robot drives on, and the receiver comes back
    frozen.loc[4000:4300, ["x", "y"]] = frozen.loc[4000, ["x", "y"]].to_numpy()
    log = compare_motion(log_of(frozen, "positions"))
    assert log.left_out["frozen"] == pytest.approx(300, abs=10)
    assert (log.rows["traversability"][log.rows["time_s"] > 300] > 0.7).all()


def test_a_robot_that_stands_at_the_end_is_immobilised_unless_its_speed_says_no() -> (
    None
):
    rows = drive(np.ones(6000), np.repeat([0.8, 0], [5700, 300]))
    log = compare_motion(log_of(rows.assign(speed=np.nan), "positions"))
    assert log.left_out["frozen"] == 0
    assert log.motion["standing"] == 300
    assert (
        compare_motion(log_of(rows.assign(speed=0.8), "positions")).left_out["frozen"]
        == 300
    )
    short = rows.iloc[5400:].reset_index(drop=True)
    with pytest.raises(
        DatasetError, match=r"300 of 600 .* stays the same .* Log `measured_m_s`"
    ):
        compare_motion(log_of(short.assign(speed=np.nan), "positions"))
    assert len(compare_motion(log_of(short, "positions")).rows) == 600


@pytest.mark.parametrize("speed", ["", "positions", "measured"])
def test_positions_that_never_change_are_frozen(speed: str) -> None:
    rows = drive(np.ones(600), np.full(600, 0.9)).assign(x=5.0, y=5.0)
    with pytest.raises(
        DatasetError, match="599 of 600 rows that have a position that stays the same"
    ):
        compare_motion(log_of(rows, speed))


def test_positions_that_repeat_until_the_next_fix_are_not_frozen() -> None:
    rows = rough_drive()
    # every 2 s
    rows[["x", "y"]] = rows[["x", "y"]].iloc[np.arange(600) // 20 * 20].to_numpy()
    log = compare_motion(log_of(rows))
    assert not log.left_out["frozen"] + log.left_out["jumped"]
    assert log.motion["pace"] == pytest.approx(1, abs=0.05)
    # much faster than usual at the end
    rows = drive(np.repeat([0.2, 1.0], [500, 200]), np.ones(700))
    rows[["x", "y"]] = rows[["x", "y"]].iloc[np.arange(700) // 20 * 20].to_numpy()
    assert compare_motion(log_of(rows)).left_out["frozen"] == 0


def test_each_jump_is_out_of_reach_from_the_last_right_position() -> None:
    rows = rough_drive()
    rows.loc[[350, 550], "x"] += 10
    assert set(find_jumped(track_of(rows), 1.5)) == {350, 550}


@pytest.mark.parametrize("speed", ["", "positions", "measured"])
def test_a_wrong_command_does_not_hide_jumps(speed: str) -> None:
    rows = drive(np.ones(600), np.full(600, 0.9))
    rows.loc[[300, 450], "x"] += 12
    rows.loc[[5, 100], "commanded"] = 14.0
    left_out = compare_motion(log_of(rows, speed)).left_out
    assert (left_out["jumped"], left_out["implausible"]) == (2, 2)


@given(
    st.sets(st.integers(0, 599), max_size=55), st.floats(3, 1e6), st.integers(0, 2**32)
)
def test_jumps_are_found_and_nothing_else(
    jumps: set[int], size_m: float, seed: int
) -> None:
    rows, away = rough_drive(), sorted(jumps)
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(away))
    rows.loc[away, "x"] += size_m * np.cos(angle)
    rows.loc[away, "y"] += size_m * np.sin(angle)
    found = find_jumped(track_of(rows.sample(frac=1, random_state=seed % 2**31)), 1.5)
    # A jump of 3 m is in reach again after 2 s, so that one after another may count as
    # a track.
    assert set(found) == jumps or size_m < 100


def test_times_that_restart_are_counted_and_rows_out_of_order_are_not() -> None:
    rows = rough_drive()
    mixed = compare_motion(
        log_of(rows.sample(frac=1, random_state=0, ignore_index=True))
    )
    assert mixed.left_out["restarted"] == 0
    assert mixed.motion["pace"] == pytest.approx(1, abs=0.03)
    again = rows.assign(
        time_s=rows["time_s"].where(rows.index < 570, rows["time_s"] - 57)
    )
    assert compare_motion(log_of(again)).left_out["restarted"] == 30
    twice = rows.assign(time_s=rows["time_s"] % 30)
    with pytest.raises(
        DatasetError, match=r"299 of 600 rows that have a time before .* column `drive`"
    ):
        compare_motion(log_of(twice))
    named = twice.assign(drive=rows.index // 300)
    assert len(compare_motion(log_of(named)).rows) == 600


# Wheels


def test_a_speed_that_is_the_command_is_of_wheels() -> None:
    rows = drive(np.ones(1200), np.repeat([1.0, 0.4, 1.0], 400)).assign(speed=1.0)
    log = compare_motion(log_of(rows))  # on most of the way they agree
    with pytest.raises(
        DatasetError,
        match=r"equals `commanded_m_s` while positions move .*--speed positions",
    ):
        compare_slopes(log, np.zeros(1200))
    with pytest.raises(
        DatasetError, match=r"got 0.7 times, .*like wheel odometry, since it equals"
    ):
        compare_motion(log_of(drive(np.ones(600), np.full(600, 0.7)).assign(speed=1.0)))


@pytest.mark.parametrize(
    ("radius_m", "noise_m"),
    [(np.inf, 0.0), (3.0, 0.0), (0.8, 0.0), (np.inf, 0.3), (3.0, 0.1)],
)
def test_a_robot_that_follows_its_command_over_ground_is_not_of_wheels(
    radius_m: float, noise_m: float
) -> None:
    """Curves shorten the chords of spans, and noise lengthens them."""
    rows = drive(np.ones(1200), np.ones(1200), np.repeat([1, 0, -1], 400) / radius_m)
    rows[["x", "y"]] += noise_m * np.random.default_rng(0).standard_normal((1200, 2))
    log = compare_motion(log_of(rows))
    log = compare_slopes(log, np.zeros(len(log.rows)))
    assert log.motion["pace"] == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("part", [0.2, 0.3])
def test_wheels_in_a_part_of_a_drive_are_seen(part: float) -> None:
    rows = drive(np.ones(2400), 0.6 + 0.1 * np.sin(np.arange(2400) / 37), turn=0.1)
    rows["speed"] = rows["speed"].where(rows.index >= part * 2400, rows["commanded"])
    with pytest.raises(
        DatasetError, match=r"over 15% less far in \d\d% of spans. .* wheel odometry"
    ):
        compare_slopes(compare_motion(log_of(rows)), np.zeros(2400))


@pytest.mark.parametrize(
    ("noise", "rise", "is_wheels"),
    [(0.005, 1, True), (0.05, 1, False), (0.005, 0.2, False)],
)
def test_a_speed_that_follows_the_command_up_and_down_is_of_wheels(
    noise: float, rise: float, is_wheels: bool
) -> None:
    rows = drive(np.ones(1200), np.full(1200, 0.95))
    measured = rows["speed"] * (
        1 + noise * np.random.default_rng(0).standard_normal(60).repeat(20)
    )
    elevation = rise * 3 * np.sin(np.hypot(rows["x"], rows["y"]) / 12)  # up to 14°
    log = compare_motion(log_of(rows.assign(speed=measured)))
    if is_wheels:
        with pytest.raises(
            DatasetError,
            match=r"to within 2%, on slopes of -1\d° to 1\d°.*--speed measured",
        ):
            compare_slopes(log, elevation.to_numpy())
    else:
        compare_slopes(log, elevation.to_numpy())
    compare_slopes(
        compare_motion(log_of(rows.assign(speed=measured), "measured")),
        elevation.to_numpy(),
    )


@pytest.mark.parametrize("height", [40, 200])
def test_elevation_is_interpolated_between_cells(height: int) -> None:
    class Plane:
        """A layer whose elevation is 3 · row + 5 · column, framed by one cell."""

        warped = SimpleNamespace(height=height + 2, width=32)

        def read(self, rows: range, columns: range) -> np.ndarray:
            row, column = np.meshgrid(
                np.arange(rows.start - 1, rows.stop + 1),
                np.arange(-1, columns.stop + 1),
                indexing="ij",
            )
            return (3.0 * row + 5.0 * column)[None]

    generator = np.random.default_rng(0)
    row, column = (
        generator.uniform(-0.5, height - 0.5, 500),
        generator.uniform(-0.5, 29.5, 500),
    )
    actual = elevation_under(Plane(), row, column)  # type: ignore[arg-type]
    np.testing.assert_allclose(actual, 3 * row + 5 * column)


# Speed of positions


def test_velocity_is_the_derivative_of_savitzky_and_golay() -> None:
    generator = np.random.default_rng(0)
    x = np.cumsum(generator.normal(0.05, 0.02, 500)) + 4e6
    rows = pd.DataFrame(
        {"x": x, "y": 0.0, "time_s": np.arange(500) * STEP_S, "drive": 0}
    )
    velocity = velocity_of(track_of(rows), ["x"])["x"]
    expected = savgol_filter(x, 21, 2, deriv=1, delta=STEP_S)
    np.testing.assert_allclose(velocity[10:-10], expected[10:-10], atol=1e-6)
    assert velocity.notna().all()


def test_the_error_of_a_velocity_is_that_of_its_noise() -> None:
    generator = np.random.default_rng(0)
    for step_s, spread_s2 in ((1.0, 2.0), (0.1, 7.7)):  # Σ t² of three fixes, and of 21
        time_s = np.arange(2000) * step_s
        x, y = np.stack([0.8 * time_s, 0 * time_s]) + 0.1 * generator.standard_normal(
            (2, 2000)
        )
        rows = pd.DataFrame({"x": x, "y": y, "time_s": time_s, "drive": 0})
        error = velocity_of(track_of(rows), ["x", "y"])["error"][20:-20]
        expected = 0.1 / np.sqrt(spread_s2)
        assert error.min() == pytest.approx(expected, rel=0.05)
        assert expected <= error.median() < 1.1 * expected


@pytest.mark.parametrize("fix_rows", [1, 3, 10])
def test_speed_of_positions_is_that_of_the_drive_forward_and_backward(
    fix_rows: int,
) -> None:
    commanded = np.concatenate([np.full(300, 0.8), np.zeros(50), np.full(300, -0.6)])
    rows = drive(commanded, np.full(650, 0.75), turn=0.2)
    rows[["x", "y"]] = (
        rows[["x", "y"]].iloc[np.arange(650) // fix_rows * fix_rows].to_numpy()
    )
    speed = speed_of_positions(track_of(rows), 0.1)
    steady = (rows.index > 30) & (rows.index < 260) | (rows.index > 400) & (
        rows.index < 620
    )
    np.testing.assert_allclose(speed[steady], 0.75 * commanded[steady], rtol=0.02)


@pytest.mark.parametrize(
    ("rate", "fix_rows", "noise_m"),
    [(0.5, 1, 0.02), (1.0, 1, 0.0), (-1.0, 5, 0.0), (0.6, 10, 0.0)],
)
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_speed_of_positions_is_that_along_an_arc(
    rate: float, fix_rows: int, noise_m: float, direction: float
) -> None:
    """Oracle: the arc of a circle of 0.8 m at 1 rad/s, on which a fitted line is 10 %
    shorter.
    """
    rows = drive(np.full(900, direction), np.full(900, 0.8), turn=rate)
    rows[["x", "y"]] += noise_m * np.random.default_rng(0).standard_normal((900, 2))
    rows[["x", "y"]] = (
        rows[["x", "y"]].iloc[rows.index // fix_rows * fix_rows].to_numpy()
    )
    log = compare_motion(log_of(rows, "positions"))
    assert log.rows["traversability"][30:-30].mean() == pytest.approx(0.8, abs=0.01)
    assert log.motion["pace"] == pytest.approx(1, abs=0.02)
    assert len(compare_motion(log_of(rows)).rows) == 900


@pytest.mark.parametrize("fix_rows", [10, 20])
def test_a_turn_between_fixes_is_no_slide(fix_rows: int) -> None:
    """A skid-steer robot turns by half a circle at 2 rad/s, slowly, which at 1 Hz looks
    like a reversal.
    """
    turns = np.tile(np.repeat([0.0, 2.0], [84, 16]), 12)
    rows = drive(np.where(turns > 0, 0.15, 1.0), np.full(1200, 0.8), turns)
    rows[["x", "y"]] = (
        rows[["x", "y"]].iloc[rows.index // fix_rows * fix_rows].to_numpy()
    )
    assert (compare_motion(log_of(rows, "positions")).rows["traversability"] >= 0).all()


@pytest.mark.parametrize("noise_m", [0.05, 0.1, 0.3])
@pytest.mark.parametrize("fix_rows", [1, 10])
def test_noise_does_not_turn_an_immobilised_robot(
    noise_m: float, fix_rows: int
) -> None:
    for seed in range(8):
        generator = np.random.default_rng(seed)
        # every second one turns round at rest
        turn = np.repeat([0.05, 0.14 * (seed % 2), 0.05], [300, 200, 400])
        rows = drive(np.ones(900), np.repeat([0.8, 0, 0.8], [300, 200, 400]), turn)
        rows[["x", "y"]] += noise_m * generator.standard_normal((900, 2))
        rows[["x", "y"]] = (
            rows[["x", "y"]].iloc[rows.index // fix_rows * fix_rows].to_numpy()
        )
        speed = speed_of_positions(track_of(rows), 0.1)
        moves = ~rows["time_s"].between(28, 52)
        assert (speed[moves].dropna() > 0).all(), seed


@pytest.mark.parametrize(
    ("noise_m", "rest"), [(0.0, 0), (0.05, 0), (0.05, 25), (0.1, 10)]
)
def test_sliding_back_is_seen_through_noise(noise_m: float, rest: int) -> None:
    for seed in range(8):
        generator = np.random.default_rng(seed)
        traversability = np.repeat([0.8, 0, -0.6, 0, 0.8], [300, rest, 100, rest, 200])
        rows = drive(np.ones(len(traversability)), traversability, turn=0.05)
        rows[["x", "y"]] += noise_m * generator.standard_normal((len(rows), 2))
        speed = speed_of_positions(track_of(rows), 0.1)
        start_s, end_s = (300 + rest) * STEP_S, (400 + rest) * STEP_S
        assert (speed[rows["time_s"].between(start_s + 1, end_s - 1)] < 0).all(), seed
        assert (
            speed[
                ~rows["time_s"].between(start_s - rest / 10 - 1, end_s + rest / 10 + 1)
            ]
            > 0
        ).all(), seed


def test_speed_of_positions_goes_along_the_slope() -> None:
    rows = drive(np.ones(600), np.full(600, 0.9))
    log = compare_motion(
        log_of(rows.drop(columns="speed").assign(speed=np.nan), "positions")
    )
    assert (log.motion["pace"], log.motion["commanded_pace"]) == (
        None,
        pytest.approx(0.9),
    )
    height = np.tan(np.radians(20)) * np.hypot(log.rows["x"], log.rows["y"])
    along = compare_slopes(log, height.to_numpy()).rows["traversability"]
    np.testing.assert_allclose(along, 0.9 / np.cos(np.radians(20)), rtol=1e-6)
    cliff = compare_slopes(log, 10 * height.to_numpy()).rows["traversability"]
    np.testing.assert_allclose(cliff, 0.9 * np.sqrt(2), rtol=1e-6)
