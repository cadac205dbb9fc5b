"""Tracks of a drive log: positions over time, faulty positions, and spans of motion.

A *track* is the rows of a log, ordered by drive and time. A *segment* is a part of a
track without a gap in time. A *fix* is a group of consecutive rows with the same
position, since logs repeat a position until the receiver determines the next. A *knot*
is a row with a measured position. A *span* is the motion during about two seconds.
Distances are horizontal, in metres. `drive_velocity` computes velocities from tracks.

Letters in shapes: N rows.
"""

import math

import numpy as np
import pandas as pd
from numpy import ndarray

# Thresholds that this package chooses without a source are marked "(choice)".
# Duration of a span, in which the distance is large compared with position noise.
WINDOW_S = 2.0
MIN_SPANS = 5  # minimum number of spans for a median (choice)
# Maximum time between rows in a segment. In a longer gap, motion is unknown.
GAP_S = 1.0
# Maximum time for which a position may stay the same, in fix periods (choice).
_FREEZE_FIXES = 3
# Neighbouring spans count as straight if the cosine of the angle between them exceeds
# this value. A chord is then at most 1 % shorter than its arc.
_STRAIGHT_COS = 0.9
# A larger angle between neighbouring spans is a reversal (choice).
_MAX_BEND = math.radians(150)


def find_restarted(rows: pd.DataFrame) -> ndarray:
    """Return a mask of rows with a smaller time than a preceding row of the same drive.

    If sorting a drive's rows by time shortens the track, the rows are only out of
    order. The clock of this drive did not restart, and the mask is False.

    Returns:
        bool, shape [N].
    """
    drive = rows["drive"]
    time_s = rows["time_s"]
    latest_s = time_s.groupby(drive).cummax()
    is_before = (time_s < latest_s).to_numpy()
    if is_before.any():
        ordered = rows.sort_values(["drive", "time_s"], kind="stable")
        is_restarted = _length_m(ordered) > _length_m(rows)
        is_before = is_before & is_restarted[drive].to_numpy()
    return is_before


def _length_m(rows: pd.DataFrame) -> pd.Series:
    """Return the length in metres of each drive's track, with rows in given order."""
    by_drive = rows.groupby("drive")
    step_m = np.hypot(by_drive["x"].diff(), by_drive["y"].diff())
    return step_m.groupby(rows["drive"]).sum()


def track_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Order rows by drive and time.

    Args:
        rows: rows of a log.

    Returns:
        The ordered rows with their index, and with three more columns: `step_s` (time
        since the previous row in seconds, 0 after a gap), and the numbers of their
        `segment` and `fix`.
    """
    track = rows.sort_values(["drive", "time_s"], kind="stable")
    drive = track["drive"]
    step_s = track.groupby("drive")["time_s"].diff()
    median_s = step_s.groupby(drive).transform("median")
    max_step_s = np.maximum(GAP_S, 3 * median_s)
    # The first row of a drive, whose step is NaN, also starts a segment.
    starts = ~(step_s <= max_step_s)
    changes = (track[["drive", "x", "y"]].diff() != 0).any(axis=1)
    step_s = step_s.where(~starts, 0.0)
    return track.assign(step_s=step_s, segment=starts.cumsum(), fix=changes.cumsum())


def _fixes(track: pd.DataFrame) -> pd.DataFrame:
    """Return a table by `fix`: its first row, and `rows`, the number of its rows."""
    grouped = track.groupby("fix")
    return grouped.first().assign(rows=grouped.size())


def _period_s(fixes: pd.DataFrame) -> pd.Series:
    """Return the median fix period of each fix's drive; 0 if it has only one fix."""
    step_s = fixes.groupby("drive")["time_s"].diff()
    by_drive = step_s.groupby(fixes["drive"])
    return by_drive.transform("median").fillna(0)


def period_of(track: pd.DataFrame) -> float:
    """Return the median fix period in seconds; 0 if no drive has two fixes."""
    period_s = _period_s(_fixes(track)).median()
    return float(f"{period_s:.3g}")


def knots_of(track: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with a measured position, the knots.

    These are the first rows of fixes. In addition, if a position stays the same for
    more than three fix periods, the robot is at rest, and one row per period is a knot.

    Args:
        track: track from `track_of`.
    """
    fixes = _fixes(track)
    fix = track["fix"]
    period_s = _period_s(fixes)[fix].to_numpy()
    start_s = fixes["time_s"][fix].to_numpy()
    since_s = track["time_s"] - start_s
    duration_s = since_s.groupby(fix).transform("max")
    is_long = duration_s > np.maximum(_FREEZE_FIXES * period_s, GAP_S)
    periods = since_s / np.where(period_s > 0, period_s, 1e-9)
    repeat = np.floor(periods + 1e-6).where(is_long, 0)
    measurements = track[["segment", "fix"]].assign(repeat=repeat)
    return track[~measurements.duplicated()]


def find_frozen(
    track: pd.DataFrame, least_speed: float, *, by_positions: bool
) -> pd.DataFrame:
    """Return masks of rows whose position stays the same for over three fix periods.

    Only rows under a command are used. If the measured speed or a distant next position
    shows that the robot moves meanwhile, the receiver is frozen. A robot that stands
    still under its command is immobilised, which is not a fault.

    Args:
        track: track from `track_of`; `speed` is NaN where it was not measured.
        least_speed: speed from which a command is used, and from which a robot counts
            as moving [m/s].
        by_positions: whether a receiver counts as frozen only if the next position, if
            there is one, is also distant.

    Returns:
        A table by the track's index, False in the first row of each fix:
            is_frozen: whether the receiver is frozen.
            is_unmeasured: whether the robot is immobilised and measured speed is
                missing.
            is_unknown: whether measured speed and a next position are missing.
    """
    fix = track["fix"]
    fixes = _fixes(track)
    period_s = _period_s(fixes)
    by_drive = fixes.groupby("drive")
    step_m = np.hypot(by_drive["x"].diff(), by_drive["y"].diff())
    steps_by_drive = step_m.groupby(fixes["drive"])
    median_m = steps_by_drive.transform("median").fillna(0)
    next_m = steps_by_drive.shift(-1)
    is_repeat = fix.diff() == 0
    is_commanded = track["commanded"].abs() >= least_speed
    is_used = is_repeat & is_commanded
    still_s = track["step_s"].where(is_used, 0).groupby(fix).sum()
    distance_m = (track["speed"] * track["step_s"]).where(is_used)
    measured_m = distance_m.groupby(fix).sum(min_count=1).abs()
    moving_m = np.maximum(_FREEZE_FIXES * median_m, least_speed * still_s)
    is_still = still_s > np.maximum(_FREEZE_FIXES * period_s, GAP_S)
    is_unmeasured = is_still & measured_m.isna()
    is_unknown = is_unmeasured & next_m.isna()
    is_frozen = is_still & ~is_unknown & ~(measured_m < moving_m)
    if by_positions:
        is_frozen &= ~(next_m < moving_m)
    masks = pd.DataFrame(
        {
            "is_frozen": is_frozen,
            "is_unmeasured": is_unmeasured & ~is_frozen,
            "is_unknown": is_unknown,
        }
    )
    by_row = masks.loc[fix].set_axis(track.index)
    return by_row.where(is_repeat, False)


def find_jumped(track: pd.DataFrame, limit_m_s: float) -> pd.Index:
    """Return the labels of rows whose position cannot be reached from correct ones.

    The longest stretch of a drive without a jump is correct. From there, forward and
    backward, a position is correct if the robot can reach it from the last correct
    position. Over short times, noise may exceed the distance that a robot can move, so
    times below 1 s are taken as 1 s.

    Args:
        track: track from `track_of`.
        limit_m_s: maximum speed of the robot in m/s.
    """
    fixes = _fixes(track)
    jumped = [fixes.index[:0]]  # for a track without drives
    for _, drive in fixes.groupby("drive"):
        is_reached = _is_reached(drive, limit_m_s)
        jumped.append(drive.index[~is_reached])
    is_jumped = track["fix"].isin(np.concatenate(jumped))
    return track.index[is_jumped]


def _is_reached(fixes: pd.DataFrame, limit_m_s: float) -> ndarray:
    """Return a mask of the fixes with a correct position, as in `find_jumped`."""
    time_s = fixes["time_s"].to_numpy()
    x_m = fixes["x"].to_numpy()
    y_m = fixes["y"].to_numpy()
    reach_m = limit_m_s * np.maximum(np.diff(time_s), GAP_S)
    is_break = np.hypot(np.diff(x_m), np.diff(y_m)) > reach_m
    if not is_break.any():
        return np.ones(len(fixes), dtype=bool)
    stretch = np.concatenate([[0], np.cumsum(is_break)])
    longest = np.bincount(stretch, fixes["rows"]).argmax()
    is_reached = stretch == longest
    first, last = np.flatnonzero(is_reached)[[0, -1]]
    forward = range(last + 1, len(fixes))
    backward = range(first - 1, -1, -1)
    for start, others in ((last, forward), (first, backward)):
        anchor = start
        for fix in others:
            distance_m = math.hypot(x_m[fix] - x_m[anchor], y_m[fix] - y_m[anchor])
            elapsed_s = max(abs(time_s[fix] - time_s[anchor]), GAP_S)
            if distance_m <= limit_m_s * elapsed_s:
                is_reached[fix] = True
                anchor = fix
    return is_reached


def spans_of(
    track: pd.DataFrame, least_speed: float, span_s: float = WINDOW_S
) -> pd.DataFrame:
    """Return the motion under command, summed over spans of time.

    If the time between fixes is longer than `span_s`, a span lasts from one fix to the
    next.

    Args:
        track: track from `track_of`; for slopes, with elevation `z` in metres.
        least_speed: minimum commanded speed of returned spans [m/s].
        span_s: duration of a span in seconds.

    Returns:
        A table with a row for each span:
            drive: index of the drive.
            duration_s: duration in seconds.
            moved: distance along the arc between positions, in metres.
            measured: distance at the measured speed, in metres.
            commanded: distance at the commanded speed, in metres.
            is_moving: whether positions or measured speed show motion.
            is_straight: whether the track is straight.
            is_steady: whether the command is constant.
            slope_deg: slope along the track in degrees, if the track has `z`.
    """
    knots = knots_of(track)
    span = _span_of(track, knots, span_s)
    sums = {}
    for name, column in (("measured", "speed"), ("commanded", "commanded")):
        distance_m = track[column] * track["step_s"]
        sums[name] = distance_m.groupby(track["segment"]).cumsum()
    table = track.assign(span=span, command=track["commanded"], **sums)
    # A span lasts from its first measured position to the first one of the next span.
    firsts = table.loc[knots.index].groupby(["segment", "span"]).first()
    commands = table.groupby(["segment", "span"])["command"].agg(["min", "max"])
    columns = [*sums, "x", "y", "time_s"]
    if "z" in firsts:
        columns.append("z")
    steps = firsts[columns].groupby("segment").diff(-1)
    chord_m = np.hypot(steps["x"], steps["y"])
    # On a circular arc, the angle between neighbouring chords equals the angle that
    # each chord subtends.
    next_steps = steps.groupby("segment").shift(-1)
    after = angle_between(steps, next_steps)
    before = after.groupby("segment").shift(1)
    bends = pd.concat([before, after], axis=1)
    usable_bends = bends.where(bends.abs() < _MAX_BEND)
    bend = usable_bends.mean(axis=1).fillna(0)
    moved = chord_m / np.sinc(bend / (2 * np.pi))
    duration_s = -steps["time_s"]
    spans = pd.DataFrame(
        {"drive": firsts["drive"], "duration_s": duration_s, "moved": moved}
    )
    for name in sums:
        spans[name] = steps[name].abs()
    min_m = least_speed * duration_s
    bend_cos = np.cos(bends.fillna(0))
    spans["is_moving"] = np.fmax(moved, spans["measured"]) >= min_m
    spans["is_straight"] = (bend_cos > _STRAIGHT_COS).all(axis=1)
    spans["is_steady"] = commands["min"] == commands["max"]
    if "z" in steps:
        spans["slope_deg"] = np.degrees(np.arctan2(-steps["z"], moved))
    return spans[spans["commanded"] >= min_m]


def _span_of(track: pd.DataFrame, knots: pd.DataFrame, span_s: float) -> pd.Series:
    """Return each row's span number, which is that of the last measured position."""
    period_s = knots.groupby("segment")["time_s"].diff().median()
    times = track.groupby("drive")["time_s"]
    longest_s = (times.max() - times.min()).max()
    window_s = np.fmax(span_s, period_s)
    # If times are logged in hours, the log seems short. Shortening the spans yields
    # enough of them for `drive_units` to detect that the unit is the hour.
    if 0 < longest_s < MIN_SPANS * window_s:
        window_s = longest_s / MIN_SPANS
    span = np.floor(knots["time_s"] / window_s)
    return span.reindex(track.index).ffill()


def angle_between(vectors: pd.DataFrame, others: pd.DataFrame) -> pd.Series:
    """Return signed angles in (−π, π] from `vectors` to `others`, row by row.

    Both tables have the columns `x` and `y`.
    """
    cross = vectors["x"] * others["y"] - vectors["y"] * others["x"]
    dot = vectors["x"] * others["x"] + vectors["y"] * others["y"]
    # Adding 0.0 turns -0.0 into 0.0: a zero vector has the angle 0 instead of π.
    return np.arctan2(cross + 0.0, dot + 0.0)
