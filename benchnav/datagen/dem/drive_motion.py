"""The comparison of a drive log's positions with its speeds, and the faults that it shows.

Measured speed makes λ, so it must be the speed over ground. Positions are its witness: over spans of two seconds they
must move as far as the measured speed says. Their distance over that of the command is λ and no fault. Rows whose time
or position cannot be right are left out by kind. A log with many of them is rejected, since the rest is suspect too.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import MOST_SPEED_M_S, OVER_SPEED, REASONS, TOP_RATIO, DriveLog
from benchnav.datagen.dem.drive_tracks import (
    MIN_SPANS,
    find_jumped,
    find_restarted,
    find_standing,
    spans_of,
    speed_of_positions,
    track_of,
    velocity_of,
)

# Thresholds that are someone's choice are marked (choice).
PACE_LIMITS = (0.85, 1.15)  # of the distance of positions to that of the measured speed (choice)
_TOP_QUANTILE = 0.99  # of commands, since single ones may be wrong (choice)
MAX_AGAINST = 0.05  # of the rows, with a measured speed of the other sign (choice)
MAX_FAULTY = 0.1  # of the rows, with faults of one kind (choice)
_UNIT_TOLERANCE = 0.08  # of a ratio to that of a unit (choice)
_PLAUSIBLE = (0.05, 1.3)  # λ of a whole log (choice)
_STEADY = 0.02  # spread of measured over commanded speed that no terrain leaves (choice)
_MIN_WHEEL_SPANS = 10  # 20 s (choice)
_WHEEL_PACE = 0.05  # that positions may differ from wheels that equal the command (choice)
_VARIED_SLOPE_DEG = 10.0  # from the 5 % to the 95 % quantile along a track, so that λ varies too (choice)
_STEEPEST = 1.0  # of a track; steeper cells of a surface model are trees and walls (choice)

# The ratio of positions to measured speed that each unit gives.
_SPEEDS = {"knots": 0.5144, "km/h": 1 / 3.6, "mph": 1 / 2.237, "ft/s": 1 / 3.281, "cm/s": 0.01}
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "minutes": 60.0, "hours": 3600.0}
_LENGTHS = {"feet": 3.281, "centimetres": 100.0, "millimetres": 1000.0}

_REMEDIES = {
    "restarted": "Sort the rows by time, or name each session in a column `drive`.",
    "frozen": "Leave out the rows in which the receiver had no fix.",
    "jumped": "Leave out those rows, or log filtered positions.",
    "implausible": "Leave the value out where the robot measured none.",
}


def compare_motion(log: DriveLog) -> DriveLog:
    """Compare positions with speeds and return the log without faulty rows, with the ratio of each row.

    Args:
        log: with positions in metres.

    Raises:
        DatasetError: If positions and measured speed disagree, measured speed has no sign, or more than a tenth of the
            rows has a time, position or speed that cannot be right.
    """
    settings = log.settings
    is_compared = settings.speed == ""
    by_positions = settings.speed == "positions"
    if by_positions:  # measured speed is compared where there is one
        comparable = log.rows["speed"].where(log.rows["speed"].abs() <= MOST_SPEED_M_S)
        log = replace(log, rows=log.rows.assign(speed=comparable))
    log = log.without("doubled", log.rows.duplicated().to_numpy())
    log = _leave_out(log, {"restarted": find_restarted(log.rows)})
    beyond = (log.rows[["commanded", "speed"]].abs() > MOST_SPEED_M_S).any(axis=1).to_numpy()
    log = _leave_out(log, {"implausible": beyond})
    is_slow = log.rows["commanded"].abs() < settings.least_speed
    if is_slow.all():
        return log.without("slow", is_slow.to_numpy())
    standing = find_standing(track_of(log.rows), settings.least_speed, by_positions=by_positions)
    standing = standing.reindex(log.rows.index)
    _check_rest(log, standing["is_unknown"].to_numpy())
    log = _leave_out(log, {"frozen": standing["is_frozen"].to_numpy()})
    rows = log.rows
    commanded, speed = (rows[name].to_numpy() for name in ("commanded", "speed"))
    slow = np.abs(commanded) < settings.least_speed
    if slow.all():
        return log.without("slow", slow)
    limit = TOP_RATIO * np.quantile(np.abs(commanded[~slow]), _TOP_QUANTILE, method="lower")
    implausible = (np.abs(commanded) > limit) | (is_compared & (np.abs(speed) > limit))
    jumped = rows.index.isin(find_jumped(track_of(rows), limit))
    is_jumpy = jumped.mean() > MAX_FAULTY
    # Where most rows are at fault, it is by a unit, which spans of all of them show.
    is_faulty = (jumped & (not is_jumpy)) | (implausible & (implausible.mean() <= MAX_FAULTY))
    spans = spans_of(track_of(rows[~is_faulty]), settings.least_speed)
    log = replace(log, motion=_sum_up(spans) | {"standing": int(standing["is_unmeasured"].sum())})
    _check_pace(log, spans, is_jumpy=is_jumpy)
    masks, remedies = {"jumped": jumped}, _remedies_of_scale(log)
    if is_compared:
        off_pace, remedies["off_pace"] = _off_pace(log, spans)
        _check_sign(log, ~(slow | off_pace))
        masks["off_pace"] = off_pace
    masks |= {"slow": slow, "implausible": implausible}
    if by_positions:
        positions = speed_of_positions(track_of(rows[~(jumped | implausible)]), settings.least_speed)
        speed = positions.reindex(rows.index).to_numpy()
        masks["missing"] = np.isnan(speed)
    log = _leave_out(replace(log, rows=rows.assign(speed=speed)), masks, remedies)
    return replace(log, rows=log.rows.assign(traversability=log.rows["speed"] / log.rows["commanded"]))


def compare_slopes(log: DriveLog, elevation_m: ndarray) -> DriveLog:
    """Compare the ratio of speeds with slopes along the track, and take speeds of positions along the slope.

    Measured speed that follows the command up and down alike, or that equals it where positions do not, is of wheels.

    Args:
        log: from `compare_motion`.
        elevation_m: at each row, NaN where it is unknown, shape [N].

    Raises:
        DatasetError: If measured speed is that of wheels.
    """
    track = track_of(log.rows.assign(z=elevation_m))
    if log.settings.speed == "":
        _check_wheels(log, spans_of(track, log.settings.least_speed))
    if log.settings.speed != "positions":
        return log
    climb = velocity_of(track, ["z"])["z"].reindex(log.rows.index).fillna(0.0)
    speed = log.rows["speed"]
    along = np.sign(speed) * np.hypot(speed, np.minimum(climb.abs(), _STEEPEST * speed.abs()))
    return replace(log, rows=log.rows.assign(speed=along, traversability=along / log.rows["commanded"]))


def _leave_out(
    log: DriveLog, masks: Mapping[str, ndarray], remedies: Mapping[str, str] = MappingProxyType({})
) -> DriveLog:
    """Leave rows out, each by its first reason, and reject a log with too many of them.

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
                f"Expected up to {MAX_FAULTY:.0%} of the rows of {log.settings.file} to be faulty, got {count} of "
                f"{len(mask)} that {REASONS[reason]}. {remedy}"
            )
        before = log.left_out.get(reason, 0)
        log = log.without(reason, mask[remaining])
        log = replace(log, left_out={**log.left_out, reason: before + count})
        remaining &= ~mask
    return log


def _check_rest(log: DriveLog, unknown: ndarray) -> None:
    """Reject a log with many rows at rest of which nothing shows whether the robot or the receiver stopped."""
    if unknown.mean() > MAX_FAULTY:
        raise DatasetError(
            f"Expected positions that change to the end of the drives of {log.settings.file}, got {unknown.sum()} of "
            f"{len(unknown)} rows under command whose position stays the same to the end. Log `measured_m_s` there, 0 "
            "where the robot was immobilised, or leave the rows out where the receiver had no fix."
        )


def _remedies_of_scale(log: DriveLog) -> dict[str, str]:
    """Return what to do about speeds above the top command where positions exceed the command, by reason."""
    ratio = log.motion["commanded_pace"]
    if ratio is None or ratio <= OVER_SPEED:
        return {}
    remedy = (
        f"Since positions move {ratio:g} times as far as `commanded_m_s` says, scale it by steady driving on flat, "
        "firm terrain."
    )
    return {"jumped": remedy, "implausible": remedy}


def _median_ratio(spans: pd.DataFrame, of: str) -> float:
    """Return the median of the distance of positions over that by a speed, in straight spans where they suffice."""
    spans = spans[spans["is_moving"] & spans[of].notna()]
    straight = spans[spans["is_straight"]]
    chosen = straight if len(straight) >= MIN_SPANS else spans
    return float((chosen["moved"] / chosen[of]).median())


def _sum_up(spans: pd.DataFrame) -> dict[str, float | None]:
    """Return the ratios of positions to both speeds, to three digits; None where they are unknown."""
    ratios = {"pace": _median_ratio(spans, "measured"), "commanded_pace": _median_ratio(spans, "commanded")}
    return {name: float(f"{ratio:.3g}") if np.isfinite(ratio) else None for name, ratio in ratios.items()}


def _check_pace(log: DriveLog, spans: pd.DataFrame, *, is_jumpy: bool) -> None:
    """Reject a log whose positions and measured speed disagree, and name the unit that explains it.

    Args:
        log: the log.
        spans: of it.
        is_jumpy: whether positions jump so often that only the ratio of a unit is sure.
    """
    path, speed = log.settings.file, log.settings.speed
    if spans.empty and speed == "":
        times = log.rows.groupby("drive")["time_s"]
        raise DatasetError(
            f"Expected motion under one command in {path}, to compare positions with `measured_m_s`, got none in "
            f"drives of up to {(times.max() - times.min()).max():.3g} s. Log `time_s` in seconds, or pass --speed "
            "measured."
        )
    ratio = _median_ratio(spans, "measured")
    if speed == "measured" or math.isnan(ratio) or PACE_LIMITS[0] <= ratio <= PACE_LIMITS[1]:
        return
    unit, remedy = _unit_of(spans, log.is_geographic)
    if unit in _TIMES or unit in _LENGTHS:
        remedy = f"{remedy}."
    elif speed == "positions" or (is_jumpy and not unit):
        return
    else:
        if _wheel_ratios(spans)[1]:
            unit, remedy = "wheel odometry, since it equals `commanded_m_s`", "Log the speed over ground"
        remedy += ", or pass --speed positions; pass --speed measured if measured_m_s is right and positions are not."
    raise DatasetError(
        f"Expected positions to move {PACE_LIMITS[0]:g} to {PACE_LIMITS[1]:g} times as far as `measured_m_s` says, got "
        f"{ratio:.3g} times in {path}, which looks like {unit or _no_unit(spans)}. {remedy}"
    )


def _is_winding(spans: pd.DataFrame) -> bool:
    """Return whether positions move less far than measured because the track winds between them."""
    n_straight = int((spans["is_moving"] & spans["is_straight"]).sum())
    return n_straight < min(MIN_SPANS, len(spans)) and _median_ratio(spans, "measured") < 1


def _no_unit(spans: pd.DataFrame) -> str:
    """Return the words of messages where no unit is named."""
    return "no unit that is known" + ", since the track winds between positions" * _is_winding(spans)


def _unit_of(spans: pd.DataFrame, is_geographic: bool) -> tuple[str, str]:
    """Name the unit that the ratio of positions to measured speed looks like, and the remedy.

    Args:
        spans: of a log.
        is_geographic: whether positions are angles, which have no other unit.

    Returns:
        The unit, empty if none fits, and the remedy without a full stop.
    """
    ratio, by_command = (_median_ratio(spans, name) for name in ("measured", "commanded"))
    remedy = "Bring speeds to m/s, times to s and positions to m"
    if _is_winding(spans):
        return "", f"{remedy}, log positions more often"
    others = {name: (value, "`time_s`", value) for name, value in _TIMES.items()}
    if not is_geographic:
        others |= {name: (value, "`x_m` and `y_m`", 1 / value) for name, value in _LENGTHS.items()}
    # Times and positions are off against the command too, a measured speed is not.
    is_plausible = _PLAUSIBLE[0] <= by_command <= _PLAUSIBLE[1]
    for name, (value, column, factor) in others.items():
        if abs(ratio / value - 1) <= _UNIT_TOLERANCE and not is_plausible:
            return name, f"Multiply {column} by {factor:.4g}"
    for name, value in sorted(_SPEEDS.items(), key=lambda item: abs(ratio / item[1] - 1)):
        if abs(ratio / value - 1) <= _UNIT_TOLERANCE:
            also = f" (`commanded_m_s` too, if it is in {name})"
            return name, f"Multiply `measured_m_s` by {value:.4g}{also}"
    return "", remedy


def _check_sign(log: DriveLog, is_driven: ndarray) -> None:
    """Reject measured speed of the other sign than the command.

    Args:
        log: the log.
        is_driven: rows that count, bool, shape [N].
    """
    commanded, measured = (log.rows[name].to_numpy()[is_driven] for name in ("commanded", "speed"))
    ratio = measured / commanded
    for direction, is_commanded in (("forward", commanded > 0), ("backward", commanded < 0)):
        against = int((ratio[is_commanded] < 0).sum())
        if against > MAX_AGAINST * len(ratio) and np.median(ratio[is_commanded]) < 0:
            raise DatasetError(
                f"Expected `measured_m_s` of the sign of `commanded_m_s` in {log.settings.file}, got the other one in "
                f"{against} of {is_commanded.sum()} rows commanded {direction}. Log speed forward over ground, "
                "negative backward, or pass --speed positions, or --speed measured to take the rows as they are."
            )


def _off_pace(log: DriveLog, spans: pd.DataFrame) -> tuple[ndarray, str]:
    """Find rows of drives whose positions and measured speed disagree.

    Returns:
        bool, shape [N], and what to do about these drives, a sentence.
    """
    is_off = np.zeros(len(log.names), dtype=bool)
    for drive, of_drive in spans.groupby("drive"):
        ratio = _median_ratio(of_drive, "measured")
        is_known = of_drive["is_moving"].sum() >= MIN_SPANS and not math.isnan(ratio)
        is_off[int(drive)] = is_known and not PACE_LIMITS[0] <= ratio <= PACE_LIMITS[1]
    off_spans = spans[is_off[spans["drive"].to_numpy(int)]]
    unit, remedy = _unit_of(off_spans, log.is_geographic)
    names = np.array(log.names)[is_off]
    which = ", ".join(names[:5]) + ", …" * (len(names) > 5)
    ratio = _median_ratio(off_spans, "measured")
    remedy = (
        f"Positions move {ratio:.3g} times as far as `measured_m_s` says, which looks like "
        f"{unit or _no_unit(off_spans)} in {which}. {remedy} there, leave those drives out, or pass --speed positions."
    )
    return is_off[log.rows["drive"]], remedy


def _wheel_ratios(spans: pd.DataFrame) -> tuple[bool, bool]:
    """Return whether measured over commanded speed stays the same, and whether it stays 1.

    Returns:
        Both; false where spans are too few.
    """
    spans = spans[spans["is_moving"]]
    steady = spans[spans["is_steady"]]
    chosen = steady if len(steady) >= _MIN_WHEEL_SPANS else spans
    if len(chosen) < _MIN_WHEEL_SPANS:
        return False, False
    low, middle, high = (chosen["measured"] / chosen["commanded"]).quantile([0.16, 0.5, 0.84])
    stays = bool((high - low) / 2 < _STEADY * middle)
    return stays, stays and abs(middle - 1) < _STEADY


def _check_wheels(log: DriveLog, spans: pd.DataFrame) -> None:
    """Reject a measured speed that is that of wheels."""
    stays, equals = _wheel_ratios(spans)
    moving = spans[spans["is_moving"]]
    pace = moving["moved"] / moving["measured"]
    off = float((~pace.between(*PACE_LIMITS)).mean())
    disagree = abs(pace.median() - 1) > _WHEEL_PACE or off > MAX_FAULTY
    gentle, steep = moving["slope_deg"].quantile([0.05, 0.95])
    reasons = []
    if equals and disagree:
        reasons.append(f"equals `commanded_m_s` where positions do not (over 15 % off in {off:.0%} of spans)")
    if stays and steep - gentle >= _VARIED_SLOPE_DEG:
        reasons.append(f"follows `commanded_m_s` to {_STEADY:.0%} on slopes of {gentle:.0f}° to {steep:.0f}°")
    if reasons:
        raise DatasetError(
            f"Expected `measured_m_s` over ground in {log.settings.file}, got one that {' and '.join(reasons)}, "
            "as wheel odometry does. Log the speed over ground, or pass --speed positions; pass --speed measured if it "
            "is right."
        )
