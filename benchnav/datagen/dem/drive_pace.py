"""Pace of a drive log: ratio of the distance by positions to the distance by speed.

If positions and speeds disagree, the log is rejected. The error names the unit or fault
that explains the disagreement.
"""

import math

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import PACE_LIMITS, DriveLog
from benchnav.datagen.dem.drive_tracks import MIN_SPANS
from benchnav.datagen.dem.drive_units import (
    median_ratio,
    no_unit_text,
    unit_of,
    unit_of_command,
)
from benchnav.datagen.dem.drive_wheels import equals_command

# Maximum fraction of rows whose measured speed is opposite to the command, a choice of
# this package.
_MAX_AGAINST = 0.05
_SHOWN_DRIVES = 5


def check_pace(
    log: DriveLog, rows: pd.DataFrame, spans: pd.DataFrame, *, is_jumpy: bool
) -> None:
    """Reject a log whose positions and measured speed disagree.

    Args:
        log: log of the drives.
        rows: rows of the log, without faulty rows.
        spans: spans of these rows.
        is_jumpy: whether positions jump often; the log is then rejected here only if a
            unit explains the ratio.

    Raises:
        DatasetError: If positions and measured speed disagree, or cannot be compared.
    """
    path = log.settings.file
    speed = log.settings.speed
    if spans.empty and speed == "":
        times = log.rows.groupby("drive")["time_s"]
        longest_s = (times.max() - times.min()).max()
        raise DatasetError(
            f"Expected motion under a command in {path}, got none in drives of up to "
            f"{longest_s:.3g} s. Positions and `measured_m_s` are compared during such "
            "motion. Log `time_s` in seconds, or pass --speed measured."
        )
    if speed == "positions" and spans["measured"].isna().all():
        _check_command(log, rows, spans)
    ratio = median_ratio(spans, "measured")
    if speed == "measured" or math.isnan(ratio) or _is_within_limits(ratio):
        return
    unit, remedy, is_of_positions = _unit_of(log, rows, spans)
    if speed == "positions" and not is_of_positions:
        _check_command(log, rows, spans)
        return
    if is_jumpy and not unit:
        return
    if is_of_positions:
        advice = f"{remedy}."
    else:
        if equals_command(spans):
            unit = "wheel odometry, since it equals `commanded_m_s`"
            remedy = "Log the speed over ground"
        advice = (
            f"{remedy}, or pass --speed positions. If `measured_m_s` is right and "
            "positions are not, pass --speed measured."
        )
    reason = unit or no_unit_text(spans, log.resolution_m)
    low, high = PACE_LIMITS
    raise DatasetError(
        f"Expected positions in {path} to move {low:g} to {high:g} times as far as "
        f"`measured_m_s` implies, got {ratio:.3g} times, which looks like {reason}. "
        f"{advice}"
    )


def _is_within_limits(ratio: float) -> bool:
    low, high = PACE_LIMITS
    return low <= ratio <= high


def _unit_of(
    log: DriveLog, rows: pd.DataFrame, spans: pd.DataFrame
) -> tuple[str, str, bool]:
    """Return `drive_units.unit_of` for some rows of a log."""
    return unit_of(
        rows,
        spans,
        log.settings.least_speed,
        is_geographic=log.is_geographic,
        resolution_m=log.resolution_m,
    )


def _check_command(log: DriveLog, rows: pd.DataFrame, spans: pd.DataFrame) -> None:
    """Reject a log whose positions and commands together imply an implausible λ."""
    least_speed = log.settings.least_speed
    is_geographic = log.is_geographic
    result = unit_of_command(rows, spans, least_speed, is_geographic=is_geographic)
    if result is not None:
        ratio, unit, remedy = result
        raise DatasetError(
            "Expected positions in metres and times in seconds in "
            f"{log.settings.file}, got positions that move "
            f"{ratio:.3g} times as far as `commanded_m_s` implies, which looks like "
            f"{unit}. {remedy}."
        )


def check_sign(log: DriveLog, is_driven: ndarray) -> None:
    """Reject measured speed whose sign is opposite to the command's sign.

    Args:
        log: log of the drives.
        is_driven: mask of the rows to check, bool, shape [N].

    Raises:
        DatasetError: If the signs differ in most rows with a forward command, or in
            most with a backward command, and these are more than 5 % of all checked
            rows.
    """
    commanded = log.rows["commanded"].to_numpy()[is_driven]
    measured = log.rows["speed"].to_numpy()[is_driven]
    ratio = measured / commanded
    directions = {"forward": commanded > 0, "backward": commanded < 0}
    for direction, is_commanded in directions.items():
        ratios = ratio[is_commanded]
        against = int((ratios < 0).sum())
        if against > _MAX_AGAINST * len(ratio) and np.median(ratios) < 0:
            raise DatasetError(
                "Expected `measured_m_s` to have the sign of `commanded_m_s` in "
                f"{log.settings.file}, got the opposite sign in "
                f"{against} of the {len(ratios)} rows with a {direction} command. Log "
                "the forward speed over ground, negative when the robot moves "
                "backward, or pass --speed positions, or --speed measured to use the "
                "rows unchanged."
            )


def off_pace(log: DriveLog, spans: pd.DataFrame) -> tuple[ndarray, str]:
    """Return a mask of rows of drives whose positions and measured speed disagree.

    Args:
        log: log of the drives.
        spans: spans of the log's rows.

    Returns:
        The mask, bool, shape [N]; and a remedy, as one or more sentences.
    """
    is_off = np.zeros(len(log.names), dtype=bool)
    for drive, drive_spans in spans.groupby("drive"):
        ratio = median_ratio(drive_spans, "measured")
        n_moving = drive_spans["is_moving"].sum()
        if n_moving >= MIN_SPANS and not math.isnan(ratio):
            is_off[int(drive)] = not _is_within_limits(ratio)
    is_off_row = is_off[log.rows["drive"]]
    off_rows = log.rows[is_off_row]
    off_spans = spans[is_off[spans["drive"].to_numpy(int)]]
    unit = ""
    remedy = ""
    if len(off_rows):
        unit, remedy, _ = _unit_of(log, off_rows, off_spans)
    names = np.array(log.names)[is_off].tolist()
    if len(names) > _SHOWN_DRIVES:
        names = [*names[:_SHOWN_DRIVES], "…"]
    ratio = median_ratio(off_spans, "measured")
    reason = unit or no_unit_text(off_spans, log.resolution_m)
    advice = (
        f"In {', '.join(names)}, positions move {ratio:.3g} times as far as "
        f"`measured_m_s` implies, which looks like {reason}. {remedy} there, leave "
        "those drives out, or pass --speed positions."
    )
    return is_off_row, advice
