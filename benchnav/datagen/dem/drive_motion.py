"""The comparison of a drive log's positions with its speeds, and what is wrong with a log by it.

Measured speed makes λ, so it must be the speed over ground. Positions are its witness: over spans of two seconds they
must move as far as the measured speed says. Their distance over that of the command is λ and no fault. Rows whose time
or position cannot be right are left out by kind. A log with many of them is rejected, since the rest is suspect too.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import MOST_SPEED_M_S, REASONS, TOP_RATIO, DriveLog
from benchnav.datagen.dem.drive_tracks import (
    MIN_SPANS,
    WINDOW_S,
    find_frozen,
    find_jumped,
    find_restarted,
    spans_of,
    speed_of_positions,
    track_of,
    velocity_of,
)

# Thresholds that are someone's choice are marked (choice).
PACE_LIMITS = (0.85, 1.15)  # of the distance of positions to that of the measured speed (choice)
OVER_SPEED = 1.2  # of the command; noise and downhill driving seldom exceed it (choice)
MAX_OVER_SPEED = 0.05  # of the rows; more means that a speed is on another scale (choice)
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
    "off_pace": "Leave those drives out, bring their speeds to m/s, or pass --speed positions.",
}


def compare_motion(log: DriveLog) -> DriveLog:
    """Compare positions with speeds and return the log without faulty rows, with the ratio of each row.

    Args:
        log: with positions in metres.

    Raises:
        DatasetError: If positions and measured speed disagree, a speed is on another scale, or more than a tenth of the
            rows has a time, position or speed that cannot be right.
    """
    settings, is_compared = log.settings, log.settings.speed == ""
    if settings.speed == "positions":  # measured speed is compared where there is one
        known = log.rows["speed"].where(log.rows["speed"].abs() <= MOST_SPEED_M_S)
        log = replace(log, rows=log.rows.assign(speed=known))
    log = log.without("doubled", log.rows.duplicated().to_numpy())
    log = _leave_out(log, {"restarted": find_restarted(log.rows)})
    beyond = (log.rows[["commanded", "speed"]].abs() > MOST_SPEED_M_S).any(axis=1).to_numpy()
    log = _leave_out(log, {"implausible": beyond})
    rows = log.rows
    commanded, speed = (rows[name].to_numpy() for name in ("commanded", "speed"))
    top = np.abs(commanded).max(initial=0.0)
    implausible = is_compared & (np.abs(speed) > TOP_RATIO * top)
    slow = np.abs(commanded) < settings.least_speed
    if slow.all():
        return log.without("slow", slow)
    track = track_of(rows)
    by = "commanded" if settings.speed == "positions" else "speed"
    frozen = rows.index.isin(find_frozen(track, by, settings.least_speed))
    jumped = rows.index.isin(find_jumped(track[~track.index.isin(rows.index[frozen])], TOP_RATIO * top))
    is_jumpy = jumped.mean() > MAX_FAULTY
    # Where most rows are at fault, it is by a unit, which spans of all of them show.
    is_faulty = frozen | (jumped & (not is_jumpy)) | (implausible & (implausible.mean() <= MAX_FAULTY))
    spans = spans_of(track_of(rows[~is_faulty]), settings.least_speed)
    log = replace(log, motion=_sum_up(spans))
    _check_pace(log, spans, is_jumpy=is_jumpy)
    masks = {"frozen": frozen, "jumped": jumped}
    if is_compared:
        off_pace = _off_pace(log, spans)
        is_driven = ~(slow | off_pace)
        _check_scale(log, commanded[is_driven], speed[is_driven])
        masks["off_pace"] = off_pace
    masks |= {"slow": slow, "implausible": implausible}
    if settings.speed == "positions":
        positions = speed_of_positions(track_of(rows[~(frozen | jumped | implausible)]), settings.least_speed)
        speed = positions.reindex(rows.index).to_numpy()
        masks["missing"] = np.isnan(speed)
    log = _leave_out(replace(log, rows=rows.assign(speed=speed)), masks)
    if settings.speed == "positions":
        _check_scale(log, *(log.rows[name].to_numpy() for name in ("commanded", "speed")))
    return replace(log, rows=log.rows.assign(traversability=log.rows["speed"] / log.rows["commanded"]))


def compare_slopes(log: DriveLog, elevation_m: ndarray) -> DriveLog:
    """Compare the ratio of speeds with slopes along the track, and take speeds of positions along the slope.

    Measured speed that follows the command up and down alike, or that equals it where positions do not, is of wheels.

    Args:
        log: as of `compare_motion`.
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


def _leave_out(log: DriveLog, masks: Mapping[str, ndarray]) -> DriveLog:
    """Leave rows out, each by its first reason, and reject a log with too many of them."""
    is_left = np.ones(len(log.rows), dtype=bool)
    for reason, mask in masks.items():
        count = int(mask[is_left].sum())
        if reason in _REMEDIES and count > MAX_FAULTY * len(mask):
            raise DatasetError(
                f"Expected up to {MAX_FAULTY:.0%} of the rows of {log.settings.file} to be faulty, got {count} of "
                f"{len(mask)} that {REASONS[reason]}. {_REMEDIES[reason]}"
            )
        before = log.left_out.get(reason, 0)
        log = log.without(reason, mask[is_left])
        log = replace(log, left_out={**log.left_out, reason: before + count})
        is_left &= ~mask
    return log


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
    times = log.rows.groupby("drive")["time_s"]
    longest_s = float((times.max() - times.min()).max())
    ratio, by_command = (_median_ratio(spans, of) for of in ("measured", "commanded"))
    unit, remedy = _unit_of(ratio, by_command, log.is_geographic)
    if (longest_s <= WINDOW_S or spans.empty) and speed == "" and unit not in _TIMES:
        raise DatasetError(
            f"Expected drives under command for more than {WINDOW_S:g} s in {path}, to compare positions with "
            f"`measured_m_s`, got drives of up to {longest_s:.3g} s. Log `time_s` in seconds, or pass --speed measured."
        )
    if speed == "measured" or math.isnan(ratio) or PACE_LIMITS[0] <= ratio <= PACE_LIMITS[1]:
        return
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
        f"{ratio:.3g} times in {path}, which looks like {unit or 'no unit that is known'}. {remedy}"
    )


def _unit_of(ratio: float, by_command: float, is_geographic: bool) -> tuple[str, str]:
    """Name the unit that a ratio of positions to measured speed looks like, and the remedy.

    Args:
        ratio: of positions to measured speed.
        by_command: of positions to the command.
        is_geographic: whether positions are angles, which have no other unit.

    Returns:
        The unit, empty if none fits, and the remedy without a full stop.
    """
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
    return "", "Bring speeds to m/s, times to s and positions to m"


def _check_scale(log: DriveLog, commanded: ndarray, speed: ndarray) -> None:
    """Reject speeds that exceed the command too often, or that have the other sign.

    Args:
        log: the log.
        commanded: of the rows that are not slow, m/s.
        speed: over ground, m/s.
    """
    path, ratio = log.settings.file, speed / commanded
    or_said = (
        ", or pass --speed positions, or --speed measured to take the rows as they are"
        if log.settings.speed == ""
        else ""
    )
    for way, is_way in (("forward", commanded > 0), ("backward", commanded < 0)):
        against = int((ratio[is_way] < 0).sum())
        if against > MAX_OVER_SPEED * len(ratio) and np.median(ratio[is_way]) < 0:
            raise DatasetError(
                f"Expected `measured_m_s` of the sign of `commanded_m_s` in {path}, got the other one in {against} of "
                f"{is_way.sum()} rows commanded {way}. Log speed forward over ground, negative backward{or_said}."
            )
    over = int((ratio > OVER_SPEED).sum())
    if over > MAX_OVER_SPEED * len(ratio):
        raise DatasetError(
            f"Expected speeds above {OVER_SPEED:g} times `commanded_m_s` in up to {MAX_OVER_SPEED:.0%} of the rows of "
            f"{path}, got {over} of {len(ratio)}, and a median of {np.median(ratio):.3g} times. Scale `commanded_m_s` "
            "by steady driving on flat, firm terrain, leave out the rows after its changes, raise --least-speed"
            f"{or_said}."
        )


def _off_pace(log: DriveLog, spans: pd.DataFrame) -> ndarray:
    """Find rows of drives whose positions and measured speed disagree, bool, shape [N]."""
    is_off = np.zeros(len(log.names), dtype=bool)
    for drive, own in spans.groupby("drive"):
        ratio = _median_ratio(own, "measured")
        is_known = own["is_moving"].sum() >= MIN_SPANS and not math.isnan(ratio)
        is_off[int(drive)] = is_known and not PACE_LIMITS[0] <= ratio <= PACE_LIMITS[1]
    return is_off[log.rows["drive"]]


def _wheel_ratios(spans: pd.DataFrame) -> tuple[bool, bool]:
    """Say whether measured over commanded speed stays the same, and whether it stays 1.

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
