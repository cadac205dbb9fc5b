"""Comparison of a drive log's positions with its speeds, and detection of faults.

λ follows from measured speed, so this must be the speed over ground. Positions confirm
it: over spans of two seconds, they must move as far as the measured speed implies. The
ratio of their distance to that of the command is λ, and not a fault. Rows with an
impossible time or position are left out by kind. A log with many of them is rejected,
since its other rows are unreliable too.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import (
    MOST_SPEED_M_S,
    OVER_SPEED,
    REASONS,
    TOP_RATIO,
    DriveLog,
)
from benchnav.datagen.dem.drive_tracks import (
    MIN_SPANS,
    WINDOW_S,
    find_jumped,
    find_restarted,
    find_standing,
    period_of,
    spans_of,
    speed_of_positions,
    track_of,
    velocity_of,
)
from benchnav.datagen.dem.drive_units import (
    is_coarse,
    median_ratio,
    no_unit,
    unit_of,
    unit_of_command,
)

# Thresholds that are someone's choice are marked (choice).
# of the distance of positions to that of the measured speed (choice)
PACE_LIMITS = (
    0.85,
    1.15,
)
_TOP_QUANTILE = 0.99  # of commands, since single ones may be wrong (choice)
MAX_AGAINST = 0.05  # of the rows, with a measured speed of the other sign (choice)
MAX_FAULTY = 0.1  # of the rows, with faults of one kind (choice)
_STEADY = (
    0.02  # spread of measured over commanded speed that no terrain leaves (choice)
)
_MIN_WHEEL_SPANS = 10  # 20 s (choice)
_WHEEL_PACE = (
    0.05  # that positions may differ from wheels that equal the command (choice)
)
# from the 5 % to the 95 % quantile along a track, so that λ varies too (choice)
_VARIED_SLOPE_DEG = 10.0
_STEEPEST = (
    1.0  # of a track; steeper cells of a surface model are trees and walls (choice)
)

_REMEDIES = {
    "restarted": "Sort the rows by time, or name each session in a column `drive`.",
    "frozen": "Leave out the rows in which the receiver had no fix.",
    "jumped": "Leave out those rows, or log filtered positions.",
    "implausible": "Leave the value out where the robot measured none.",
}


def compare_motion(log: DriveLog) -> DriveLog:
    """Return a log without faulty rows, and with the ratio of speeds of each row.

    Args:
        log: log with positions in metres.

    Raises:
        DatasetError: If positions and measured speed disagree, measured speed has no
            sign, or more than a tenth of the rows has a time, position or speed that
            cannot be right.
    """
    settings = log.settings
    is_compared = settings.speed == ""
    by_positions = settings.speed == "positions"
    if by_positions:  # measured speed is compared where there is one
        comparable = log.rows["speed"].where(log.rows["speed"].abs() <= MOST_SPEED_M_S)
        log = replace(log, rows=log.rows.assign(speed=comparable))
    log = log.without("doubled", log.rows.duplicated().to_numpy())
    log = _leave_out(log, {"restarted": find_restarted(log.rows)})
    beyond = (
        (log.rows[["commanded", "speed"]].abs() > MOST_SPEED_M_S).any(axis=1).to_numpy()
    )
    log = _leave_out(log, {"implausible": beyond})
    is_slow = log.rows["commanded"].abs() < settings.least_speed
    if is_slow.all():
        return log.without("slow", is_slow.to_numpy())
    standing = find_standing(
        track_of(log.rows), settings.least_speed, by_positions=by_positions
    )
    standing = standing.reindex(log.rows.index)
    _check_rest(log, standing["is_unknown"].to_numpy())
    log = _leave_out(log, {"frozen": standing["is_frozen"].to_numpy()})
    rows = log.rows
    commanded, speed = (rows[name].to_numpy() for name in ("commanded", "speed"))
    slow = np.abs(commanded) < settings.least_speed
    if slow.all():
        return log.without("slow", slow)
    limit = TOP_RATIO * np.quantile(
        np.abs(commanded[~slow]), _TOP_QUANTILE, method="lower"
    )
    implausible = (np.abs(commanded) > limit) | (is_compared & (np.abs(speed) > limit))
    jumped = rows.index.isin(find_jumped(track_of(rows), limit))
    is_jumpy = jumped.mean() > MAX_FAULTY
    # Where most rows are at fault, it is by a unit, which spans of all of them show.
    is_faulty = (jumped & (not is_jumpy)) | (
        implausible & (implausible.mean() <= MAX_FAULTY)
    )
    track = track_of(rows[~is_faulty])
    spans = spans_of(track, settings.least_speed)
    motion = _sum_up(spans) | {
        "period_s": period_of(track),
        "standing": int(standing["is_unmeasured"].sum()),
    }
    log = replace(log, motion={**log.motion, **motion})
    _check_pace(log, rows[~is_faulty], spans, is_jumpy=is_jumpy)
    masks, remedies = {"jumped": jumped}, _remedies_of_scale(log)
    if is_coarse(spans, _resolution_m(log)):
        remedies["jumped"] = (
            "Log positions with more decimals: they are multiples of "
            f"{_resolution_m(log):.2g} m."
        )
    if is_compared:
        off_pace, remedies["off_pace"] = _off_pace(log, spans)
        _check_sign(log, ~(slow | off_pace))
        masks["off_pace"] = off_pace
    masks |= {"slow": slow, "implausible": implausible}
    if settings.speed != "measured":
        positions = speed_of_positions(
            track_of(rows[~(jumped | implausible)]), settings.least_speed
        )
        positions = positions.reindex(rows.index).to_numpy()
        is_driven = ~(slow | jumped | implausible)
        is_signed = bool((is_driven & (speed * commanded < 0)).any())
        reverses = (
            is_driven
            & (positions * commanded < 0)
            & (np.abs(speed) > settings.least_speed)
        )
        log = replace(
            log,
            motion={**log.motion, "reverses": 0 if is_signed else int(reverses.sum())},
        )
    if by_positions:
        speed = positions
        masks["missing"] = np.isnan(speed)
    log = _leave_out(replace(log, rows=rows.assign(speed=speed)), masks, remedies)
    return replace(
        log,
        rows=log.rows.assign(traversability=log.rows["speed"] / log.rows["commanded"]),
    )


def compare_slopes(log: DriveLog, elevation_m: ndarray) -> DriveLog:
    """Return a log with speeds of positions along the slope, after a check for wheels.

    Measured speed is that of wheels if its ratio to the command does not depend on the
    slope, or if it equals the command where positions do not.

    Args:
        log: log from `compare_motion`.
        elevation_m: elevation at each row, NaN if unknown, shape [N].

    Raises:
        DatasetError: If measured speed is that of wheels.
    """
    track = track_of(log.rows.assign(z=elevation_m))
    if log.settings.speed == "":
        _check_wheels(log, track)
    if log.settings.speed != "positions":
        return log
    climb = velocity_of(track, ["z"])["z"].reindex(log.rows.index).fillna(0.0)
    speed = log.rows["speed"]
    along = np.sign(speed) * np.hypot(
        speed, np.minimum(climb.abs(), _STEEPEST * speed.abs())
    )
    return replace(
        log,
        rows=log.rows.assign(speed=along, traversability=along / log.rows["commanded"]),
    )


def _leave_out(
    log: DriveLog,
    masks: Mapping[str, ndarray],
    remedies: Mapping[str, str] = MappingProxyType({}),
) -> DriveLog:
    """Return a log without faulty rows; reject a log with too many of them.

    A row counts for its first reason.

    Args:
        log: the log.
        masks: of rows to leave out, by reason.
        remedies: that replace those of `_REMEDIES`.
    """
    remaining = np.ones(len(log.rows), dtype=bool)
    for reason, mask in masks.items():
        count = int(mask[remaining].sum())
        remedy = remedies.get(reason) or _REMEDIES.get(reason)
        if remedy and count > MAX_FAULTY * len(mask):
            raise DatasetError(
                f"Expected up to {MAX_FAULTY:.0%} of the rows of {log.settings.file} "
                f"to be faulty, got {count} of "
                f"{len(mask)} that {REASONS[reason]}. {remedy}"
            )
        before = log.left_out.get(reason, 0)
        log = log.without(reason, mask[remaining])
        log = replace(log, left_out={**log.left_out, reason: before + count})
        remaining &= ~mask
    return log


def _check_rest(log: DriveLog, unknown: ndarray) -> None:
    """Reject a log with many rows at rest, in which the receiver may have stopped."""
    if unknown.mean() > MAX_FAULTY:
        raise DatasetError(
            "Expected positions that change to the end of the drives of "
            f"{log.settings.file}, got {unknown.sum()} of "
            f"{len(unknown)} rows under command whose position stays the same to the "
            "end. Log `measured_m_s` there, 0 "
            "where the robot was immobilised, or leave the rows out where the "
            "receiver had no fix."
        )


def _remedies_of_scale(log: DriveLog) -> dict[str, str]:
    """Return remedies by reason if positions exceed the command."""
    ratio = log.motion["commanded_pace"]
    if ratio is None or ratio <= OVER_SPEED:
        return {}
    remedy = (
        f"Since positions move {ratio:g} times as far as `commanded_m_s` says, scale "
        "it by steady driving on flat, "
        "firm terrain."
    )
    return {"jumped": remedy, "implausible": remedy}


def _sum_up(spans: pd.DataFrame) -> dict[str, float | None]:
    """Return ratios of positions to both speeds, to three digits; None if unknown."""
    ratios = {
        "pace": median_ratio(spans, "measured"),
        "commanded_pace": median_ratio(spans, "commanded"),
    }
    return {
        name: float(f"{ratio:.3g}") if np.isfinite(ratio) else None
        for name, ratio in ratios.items()
    }


def _resolution_m(log: DriveLog) -> float:
    return float(log.motion.get("resolution_m", 0.0))


def _check_pace(
    log: DriveLog, rows: pd.DataFrame, spans: pd.DataFrame, *, is_jumpy: bool
) -> None:
    """Reject a log whose positions and measured speed disagree.

    Args:
        log: the log.
        rows: its rows, without faulty ones.
        spans: spans of these rows.
        is_jumpy: whether positions jump so often that only the ratio of a unit is
            certain.
    """
    path, speed = log.settings.file, log.settings.speed
    if spans.empty and speed == "":
        times = log.rows.groupby("drive")["time_s"]
        raise DatasetError(
            f"Expected motion under one command in {path}, to compare positions with "
            "`measured_m_s`, got none in "
            f"drives of up to {(times.max() - times.min()).max():.3g} s. Log `time_s` "
            "in seconds, or pass --speed "
            "measured."
        )
    if speed == "positions" and spans["measured"].isna().all():
        _check_command(log, rows, spans)
    ratio = median_ratio(spans, "measured")
    if (
        speed == "measured"
        or math.isnan(ratio)
        or PACE_LIMITS[0] <= ratio <= PACE_LIMITS[1]
    ):
        return
    unit, remedy, is_of_positions = _unit_of(log, rows, spans)
    if speed == "positions" and not is_of_positions:
        _check_command(log, rows, spans)
        return
    if is_of_positions:
        remedy = f"{remedy}."
    elif is_jumpy and not unit:
        return
    else:
        if _wheel_ratios(spans)[1]:
            unit, remedy = (
                "wheel odometry, since it equals `commanded_m_s`",
                "Log the speed over ground",
            )
        remedy += (
            ", or pass --speed positions; pass --speed measured if "
            "measured_m_s "
            "is right and positions are not."
        )
    raise DatasetError(
        f"Expected positions to move {PACE_LIMITS[0]:g} to {PACE_LIMITS[1]:g} times "
        "as far as `measured_m_s` says, got "
        f"{ratio:.3g} times in {path}, which looks like "
        f"{unit or no_unit(spans, _resolution_m(log))}. {remedy}"
    )


def _unit_of(
    log: DriveLog, rows: pd.DataFrame, spans: pd.DataFrame
) -> tuple[str, str, bool]:
    """Return the unit of rows of a log, see `unit_of`."""
    least_speed = log.settings.least_speed
    return unit_of(
        rows,
        spans,
        least_speed,
        is_geographic=log.is_geographic,
        resolution_m=_resolution_m(log),
    )


def _check_command(log: DriveLog, rows: pd.DataFrame, spans: pd.DataFrame) -> None:
    """Reject positions whose ratio to the command is an implausible λ."""
    of_command = unit_of_command(
        rows, spans, log.settings.least_speed, is_geographic=log.is_geographic
    )
    if of_command is not None:
        ratio, unit, remedy = of_command
        raise DatasetError(
            "Expected positions in metres and times in seconds in "
            f"{log.settings.file}, got positions that move "
            f"{ratio:.3g} times as far as `commanded_m_s` says, which looks like "
            f"{unit}. {remedy}."
        )


def _check_sign(log: DriveLog, is_driven: ndarray) -> None:
    """Reject measured speed of the other sign than the command.

    Args:
        log: the log.
        is_driven: rows that count, bool, shape [N].
    """
    commanded, measured = (
        log.rows[name].to_numpy()[is_driven] for name in ("commanded", "speed")
    )
    ratio = measured / commanded
    for direction, is_commanded in (
        ("forward", commanded > 0),
        ("backward", commanded < 0),
    ):
        against = int((ratio[is_commanded] < 0).sum())
        if against > MAX_AGAINST * len(ratio) and np.median(ratio[is_commanded]) < 0:
            raise DatasetError(
                "Expected `measured_m_s` of the sign of `commanded_m_s` in "
                f"{log.settings.file}, got the other one in "
                f"{against} of {is_commanded.sum()} rows commanded {direction}. Log "
                "speed forward over ground, "
                "negative backward, or pass --speed positions, or --speed measured to "
                "take the rows as they are."
            )


def _off_pace(log: DriveLog, spans: pd.DataFrame) -> tuple[ndarray, str]:
    """Return a mask of rows of drives whose positions and measured speed disagree.

    Returns:
        bool, shape [N], and a remedy, a sentence.
    """
    is_off = np.zeros(len(log.names), dtype=bool)
    for drive, of_drive in spans.groupby("drive"):
        ratio = median_ratio(of_drive, "measured")
        is_known = of_drive["is_moving"].sum() >= MIN_SPANS and not math.isnan(ratio)
        is_off[int(drive)] = is_known and not PACE_LIMITS[0] <= ratio <= PACE_LIMITS[1]
    off_spans = spans[is_off[spans["drive"].to_numpy(int)]]
    off_rows = log.rows[is_off[log.rows["drive"]]]
    unit, remedy, _ = (
        _unit_of(log, off_rows, off_spans) if len(off_rows) else ("", "", False)
    )
    names = np.array(log.names)[is_off]
    which = ", ".join(names[:5]) + ", …" * (len(names) > 5)
    ratio = median_ratio(off_spans, "measured")
    remedy = (
        f"Positions move {ratio:.3g} times as far as `measured_m_s` says, which looks "
        "like "
        f"{unit or no_unit(off_spans, _resolution_m(log))} in {which}. {remedy} "
        "there, leave those drives out, or pass "
        "--speed positions."
    )
    return is_off[log.rows["drive"]], remedy


def _wheel_ratios(spans: pd.DataFrame) -> tuple[bool, bool]:
    """Return whether measured over commanded speed is constant, and whether it is 1.

    Both are false if there are too few spans.
    """
    spans = spans[spans["is_moving"]]
    steady = spans[spans["is_steady"]]
    chosen = steady if len(steady) >= _MIN_WHEEL_SPANS else spans
    if len(chosen) < _MIN_WHEEL_SPANS:
        return False, False
    low, middle, high = (chosen["measured"] / chosen["commanded"]).quantile(
        [0.16, 0.5, 0.84]
    )
    stays = bool((high - low) / 2 < _STEADY * middle)
    return stays, stays and abs(middle - 1) < _STEADY


def _check_wheels(log: DriveLog, track: pd.DataFrame) -> None:
    """Reject a measured speed of wheels, in the whole log or in stretches of it.

    Shorter spans follow curves that alternate, and noise only adds to the distance of
    positions.
    """
    spans, short = (
        spans_of(track, log.settings.least_speed, span_s)
        for span_s in (WINDOW_S, WINDOW_S / 2)
    )
    stays, equals = _wheel_ratios(spans)
    moving = spans[spans["is_moving"]]
    pace = max(median_ratio(spans, "measured"), median_ratio(short, "measured"))
    off = min(_off_stretches(moving), _off_stretches(short[short["is_moving"]]))
    gentle, steep = moving["slope_deg"].quantile([0.05, 0.95])
    reasons = []
    if equals and pace < 1 - _WHEEL_PACE:
        reasons.append(
            f"equals `commanded_m_s` where positions do not, which move {pace:.3g} "
            "times as far"
        )
    elif off > MAX_FAULTY:
        reasons.append(
            "equals `commanded_m_s` where positions do not (over "
            f"{1 - PACE_LIMITS[0]:.0%} less far in {off:.0%} "
            "of spans)"
        )
    if stays and steep - gentle >= _VARIED_SLOPE_DEG:
        reasons.append(
            f"follows `commanded_m_s` to {_STEADY:.0%} on slopes of {gentle:.0f}° to "
            f"{steep:.0f}°"
        )
    if reasons:
        raise DatasetError(
            f"Expected `measured_m_s` over ground in {log.settings.file}, got one "
            f"that {' and '.join(reasons)}, "
            "as wheel odometry does. Log the speed over ground, or pass --speed "
            "positions; pass --speed measured if it "
            "is right."
        )


def _off_stretches(moving: pd.DataFrame) -> float:
    """Return the fraction of spans in stretches with the speed of slipping wheels."""
    number = moving.groupby("drive").cumcount() // _MIN_WHEEL_SPANS
    off = 0
    for _, stretch in moving.groupby([moving["drive"], number]):
        if (
            _wheel_ratios(stretch)[1]
            and median_ratio(stretch, "measured") < PACE_LIMITS[0]
        ):
            off += len(stretch)
    return off / max(len(moving), 1)
