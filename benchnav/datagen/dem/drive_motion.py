"""Comparison of a drive log's positions with its speeds, and detection of faults.

λ is computed from measured speed, which must therefore be the speed over ground. To
confirm this, the distance between positions is compared with the distance at the
measured speed, over spans of two seconds. The distance between positions need not equal
the commanded distance, since their ratio is λ. Rows with an impossible time, position
or speed are left out. A log with many such rows is rejected, since its other rows are
unreliable too.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import (
    MAX_FAULTY,
    MAX_SPEED_M_S,
    OVER_SPEED,
    REASONS,
    TOP_RATIO,
    DriveLog,
)
from benchnav.datagen.dem.drive_pace import check_pace, check_sign, off_pace
from benchnav.datagen.dem.drive_tracks import (
    find_frozen,
    find_jumped,
    find_restarted,
    period_of,
    spans_of,
    track_of,
)
from benchnav.datagen.dem.drive_units import is_coarse, median_ratio
from benchnav.datagen.dem.drive_velocity import speed_of_positions, velocity_of
from benchnav.datagen.dem.drive_wheels import check_wheels

# Thresholds that this package chooses without a source are marked "(choice)".
# Quantile of commanded speeds that counts as the highest command. The maximum is not
# used, since single commands may be wrong (choice).
_TOP_QUANTILE = 0.99
# Maximum climb per horizontal distance. Steeper cells of a surface model are trees and
# walls (choice).
_MAX_CLIMB = 1.0

_REMEDIES = {
    "restarted": "Sort the rows by time, or name each session in a column `drive`.",
    "frozen": "Leave out the rows in which the receiver had no fix.",
    "jumped": "Leave out those rows, or log filtered positions.",
    "implausible": "Leave the speed empty in rows where it was not measured.",
}


def compare_motion(log: DriveLog) -> DriveLog:
    """Return a log without faulty rows, with λ in each row.

    λ is the ratio of measured speed (or of the speed from positions) to the command.

    Args:
        log: log with positions in metres.

    Raises:
        DatasetError: If positions and measured speed disagree, measured speed has no
            sign, or the time, position or speed of more than a tenth of the rows is
            impossible.
    """
    least_speed = log.settings.least_speed
    is_compared = log.settings.speed == ""
    by_positions = log.settings.speed == "positions"
    if by_positions:
        # Measured speed is only compared with positions, where it is plausible.
        measured = log.rows["speed"]
        comparable = measured.where(measured.abs() <= MAX_SPEED_M_S)
        log = replace(log, rows=log.rows.assign(speed=comparable))
    log = log.without("doubled", log.rows.duplicated().to_numpy())
    log = _leave_out(log, {"restarted": find_restarted(log.rows)})
    is_beyond = log.rows[["commanded", "speed"]].abs() > MAX_SPEED_M_S
    log = _leave_out(log, {"implausible": is_beyond.any(axis=1).to_numpy()})
    is_slow = (log.rows["commanded"].abs() < least_speed).to_numpy()
    if is_slow.all():
        return log.without("slow", is_slow)
    track = track_of(log.rows)
    still = find_frozen(track, least_speed, by_positions=by_positions)
    still = still.reindex(log.rows.index)
    _check_rest(log, still["is_unknown"].to_numpy())
    log = _leave_out(log, {"frozen": still["is_frozen"].to_numpy()})

    rows = log.rows
    commanded = rows["commanded"].to_numpy()
    speed = rows["speed"].to_numpy()
    is_slow = np.abs(commanded) < least_speed
    if is_slow.all():
        return log.without("slow", is_slow)
    moving_commands = np.abs(commanded[~is_slow])
    limit = TOP_RATIO * np.quantile(moving_commands, _TOP_QUANTILE, method="lower")
    is_implausible = np.abs(commanded) > limit
    if is_compared:
        is_implausible |= np.abs(speed) > limit
    is_jumped = rows.index.isin(find_jumped(track_of(rows), limit))
    is_jumpy = bool(is_jumped.mean() > MAX_FAULTY)
    # If many rows seem faulty, the cause is probably a unit. The spans of all rows then
    # show which unit, so faulty rows are not removed.
    is_faulty = np.zeros(len(rows), dtype=bool)
    if not is_jumpy:
        is_faulty |= is_jumped
    if is_implausible.mean() <= MAX_FAULTY:
        is_faulty |= is_implausible

    sound_rows = rows[~is_faulty]
    track = track_of(sound_rows)
    spans = spans_of(track, least_speed)
    motion = {**log.motion, **_pace_ratios(spans)}
    motion["period_s"] = period_of(track)
    motion["standing"] = int(still["is_unmeasured"].sum())
    log = replace(log, motion=motion)
    check_pace(log, sound_rows, spans, is_jumpy=is_jumpy)

    remedies = _scale_remedies(log)
    if is_coarse(spans, log.resolution_m):
        remedies["jumped"] = (
            "Log positions with more decimals, since they are multiples of "
            f"{log.resolution_m:.2g} m."
        )
    masks = {"jumped": is_jumped}
    if is_compared:
        is_off_pace, remedies["off_pace"] = off_pace(log, spans)
        check_sign(log, ~(is_slow | is_off_pace))
        masks["off_pace"] = is_off_pace
    masks["slow"] = is_slow
    masks["implausible"] = is_implausible
    if log.settings.speed != "measured":
        is_sound = ~(is_jumped | is_implausible)
        sound_track = track_of(rows[is_sound])
        positions_speed = speed_of_positions(sound_track, least_speed)
        positions_speed = positions_speed.reindex(rows.index).to_numpy()
        reverses = _n_reverses(log, positions_speed, is_sound & ~is_slow)
        log = replace(log, motion={**log.motion, "reverses": reverses})
        if by_positions:
            speed = positions_speed
            masks["missing"] = np.isnan(speed)
    log = replace(log, rows=rows.assign(speed=speed))
    log = _leave_out(log, masks, remedies)
    ratio = log.rows["speed"] / log.rows["commanded"]
    return replace(log, rows=log.rows.assign(traversability=ratio))


def compare_slopes(log: DriveLog, elevation_m: ndarray) -> DriveLog:
    """Reject measured wheel speed; correct speed from positions for the slope.

    Measured speed is the speed of wheels if its ratio to the command does not depend on
    the slope, or if it equals the command while positions move less far.

    Args:
        log: log from `compare_motion`.
        elevation_m: elevation at each row's position in metres, NaN if unknown, shape
            [N].

    Returns:
        The log. If its speed is from positions, speed and λ are along the slope.

    Raises:
        DatasetError: If measured speed is the speed of wheels.
    """
    track = track_of(log.rows.assign(z=elevation_m))
    if log.settings.speed == "":
        check_wheels(log, track)
    if log.settings.speed != "positions":
        return log
    climb = velocity_of(track, ["z"])["z"]
    climb = climb.reindex(log.rows.index).fillna(0.0)
    speed = log.rows["speed"]
    max_climb = _MAX_CLIMB * speed.abs()
    along = np.sign(speed) * np.hypot(speed, np.minimum(climb.abs(), max_climb))
    ratio = along / log.rows["commanded"]
    return replace(log, rows=log.rows.assign(speed=along, traversability=ratio))


def _leave_out(
    log: DriveLog,
    masks: Mapping[str, ndarray],
    remedies: Mapping[str, str] = MappingProxyType({}),
) -> DriveLog:
    """Return a log without faulty rows; reject a log with too many of them.

    A row with several faults is counted under the first reason in `masks`.

    Args:
        log: log of the drives.
        masks: masks of the rows to leave out, by reason (key of `REASONS`), bool, shape
            [N].
        remedies: sentences by reason that replace those of `_REMEDIES`.
    """
    is_remaining = np.ones(len(log.rows), dtype=bool)
    for reason, mask in masks.items():
        count = int(mask[is_remaining].sum())
        remedy = remedies.get(reason) or _REMEDIES.get(reason)
        if remedy and count > MAX_FAULTY * len(mask):
            raise DatasetError(
                f"Expected at most {MAX_FAULTY:.0%} of the rows of {log.settings.file} "
                f"to be faulty, got {count} of {len(mask)} rows that "
                f"{REASONS[reason]}. {remedy}"
            )
        before = log.left_out.get(reason, 0)
        log = log.without(reason, mask[is_remaining])
        left_out = {**log.left_out, reason: before + count}
        log = replace(log, left_out=left_out)
        is_remaining &= ~mask
    return log


def _check_rest(log: DriveLog, is_unknown: ndarray) -> None:
    """Reject a log with many rows at rest in which the receiver may have had no fix."""
    if is_unknown.mean() > MAX_FAULTY:
        raise DatasetError(
            "Expected positions that change until the end of each drive in "
            f"{log.settings.file}, got {is_unknown.sum()} of "
            f"{len(is_unknown)} rows under command whose position stays the same until "
            "the end. Log `measured_m_s` in these rows, 0 where the robot was "
            "immobilised, or leave out the rows in which the receiver had no fix."
        )


def _pace_ratios(spans: pd.DataFrame) -> dict[str, float | None]:
    """Return the ratio of distance by positions to distance by each speed, by name.

    Ratios are rounded to three digits; an unknown ratio is None.
    """
    paces = {}
    for name, speed in (("pace", "measured"), ("commanded_pace", "commanded")):
        ratio = median_ratio(spans, speed)
        paces[name] = float(f"{ratio:.3g}") if np.isfinite(ratio) else None
    return paces


def _scale_remedies(log: DriveLog) -> dict[str, str]:
    """Return remedies by reason if logged commands are too low, otherwise none."""
    ratio = log.motion["commanded_pace"]
    if ratio is None or ratio <= OVER_SPEED:
        return {}
    remedy = (
        f"Positions move {ratio:g} times as far as `commanded_m_s` implies: calibrate "
        "`commanded_m_s` by steady driving on flat, firm terrain."
    )
    return {"jumped": remedy, "implausible": remedy}


def _n_reverses(log: DriveLog, positions_speed: ndarray, is_driven: ndarray) -> int:
    """Return the number of rows whose positions move opposite to the command.

    Measured speed without a sign does not show this motion. The result is 0 if measured
    speed has a sign.
    """
    commanded = log.rows["commanded"].to_numpy()
    speed = log.rows["speed"].to_numpy()
    is_signed = (is_driven & (speed * commanded < 0)).any()
    if is_signed:
        return 0
    is_reversed = is_driven & (positions_speed * commanded < 0)
    is_moving = np.abs(speed) > log.settings.least_speed
    return int((is_reversed & is_moving).sum())
