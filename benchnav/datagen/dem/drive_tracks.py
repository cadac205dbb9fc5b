"""Tracks of a drive log: positions over time, their faults and the motion that they show.

A *track* is the rows of a log, ordered by drive and time. A *segment* is a part of it without a gap. A *fix* is its
rows of one position, since logs repeat a position until the receiver gives the next. Distances are horizontal, in
metres.
Letters in shapes: N rows.
"""

import math

import numpy as np
import pandas as pd
from numpy import ndarray

# Thresholds that are someone's choice are marked (choice).
WINDOW_S = 2.0  # over which the noise of positions is small beside the distance
MIN_SPANS = 5  # that a median needs (choice)
_GAP_S = 1.0  # without a row, after which nothing is said of the motion between
_FREEZE_FIXES = 3  # periods of positions that one may stay the same (choice)
_STRAIGHT_COS = 0.9  # between neighbouring spans, so that a chord is at most 1 % shorter than its arc
_SLIDES_COS = -0.5  # between rows of one command; no robot turns by over 120° at once (choice)
_ROWS_AT_ONCE = 4096


def find_restarted(rows: pd.DataFrame) -> ndarray:
    """Find rows whose time is before that of an earlier row of their drive.

    Rows that are only out of order are no restart: by time they are a shorter track than in the order of the file.

    Returns:
        bool, shape [N].
    """
    drive, time = rows["drive"], rows["time_s"]
    before = (time < time.groupby(drive).cummax()).to_numpy()
    if before.any():
        ordered = rows.sort_values(["drive", "time_s"], kind="stable")
        before = before & (_length_m(ordered) > _length_m(rows))[drive].to_numpy()
    return before


def _length_m(rows: pd.DataFrame) -> pd.Series:
    """Return the length of each drive, as its rows stand."""
    by_drive = rows.groupby("drive")
    return np.hypot(by_drive["x"].diff(), by_drive["y"].diff()).groupby(rows["drive"]).sum()


def track_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Order rows by drive and time.

    Returns:
        The rows with their index, and with `step_s` since the row before (0 after a gap), `segment` and `fix`.
    """
    track = rows.sort_values(["drive", "time_s"], kind="stable")
    step_s = track.groupby("drive")["time_s"].diff()
    usual_s = step_s.groupby(track["drive"]).transform("median")
    starts = ~(step_s <= np.maximum(_GAP_S, 3 * usual_s))  # the first row of a drive too
    changes = (track[["drive", "x", "y"]].diff() != 0).any(axis=1)
    return track.assign(step_s=step_s.where(~starts, 0.0), segment=starts.cumsum(), fix=changes.cumsum())


def _fixes(track: pd.DataFrame) -> pd.DataFrame:
    """Return the first row of each fix with its number of `rows`, by `fix`."""
    grouped = track.groupby("fix")
    return grouped.first().assign(rows=grouped.size())


def find_frozen(track: pd.DataFrame, speed: str, least_speed: float) -> pd.Index:
    """Find rows of a position that stays the same for more than three fixes while the robot moves.

    A robot that stands still under its command is immobilised, which is no fault.

    Args:
        track: as of `track_of`.
        speed: column of the speed by which the robot moves.
        least_speed: m/s, of commands that count and of a robot that moves.

    Returns:
        Their labels, without the first row of each such fix.
    """
    fixes = _fixes(track)
    by_drive = fixes.groupby("drive")
    period_s = by_drive["time_s"].diff().groupby(fixes["drive"]).transform("median").fillna(0)
    step_m = np.hypot(by_drive["x"].diff(), by_drive["y"].diff())
    step_m = step_m.groupby(fixes["drive"]).transform("median").fillna(0)
    repeats = track["fix"].diff() == 0
    counts = repeats & (track["commanded"].abs() >= least_speed)
    still_s = track["step_s"].where(counts, 0).groupby(track["fix"]).sum()
    by_speed_m = (track[speed] * track["step_s"]).where(counts, 0).groupby(track["fix"]).sum().abs()
    is_frozen = still_s > np.maximum(_FREEZE_FIXES * period_s, _GAP_S)
    is_frozen &= by_speed_m >= np.maximum(_FREEZE_FIXES * step_m, least_speed * still_s)
    return track.index[repeats.to_numpy() & is_frozen[track["fix"]].to_numpy()]


def find_jumped(track: pd.DataFrame, limit_m_s: float) -> pd.Index:
    """Find rows whose position is out of reach of the others of their drive.

    The longest stretch without a jump is right. From there, forward and backward, a position is right that is in reach
    of the last right one. Over less than a second noise may exceed the reach, so that a second counts.

    Args:
        track: as of `track_of`.
        limit_m_s: speed that a robot cannot exceed.

    Returns:
        Their labels.
    """
    fixes, jumped = _fixes(track), []
    for _, own in fixes.groupby("drive"):
        time, x, y = (own[name].to_numpy() for name in ("time_s", "x", "y"))
        reach_m = limit_m_s * np.maximum(np.diff(time), _GAP_S)
        breaks = np.hypot(np.diff(x), np.diff(y)) > reach_m
        if not breaks.any():
            continue
        stretch = np.concatenate([[0], np.cumsum(breaks)])
        is_right = stretch == np.bincount(stretch, own["rows"]).argmax()
        first, last = np.flatnonzero(is_right)[[0, -1]]
        for anchor, others in ((last, range(last + 1, len(own))), (first, range(first - 1, -1, -1))):
            right = anchor
            for fix in others:
                away_m = math.hypot(x[fix] - x[right], y[fix] - y[right])
                if away_m <= limit_m_s * max(abs(time[fix] - time[right]), _GAP_S):
                    is_right[fix], right = True, fix
        jumped.append(own.index[~is_right])
    return track.index[track["fix"].isin(np.concatenate(jumped))] if jumped else track.index[:0]


def spans_of(track: pd.DataFrame, least_speed: float) -> pd.DataFrame:
    """Sum up motion under command over spans of two seconds, longer where positions come more seldom.

    Args:
        track: as of `track_of`; with `z`, elevation in metres, too for slopes.
        least_speed: m/s, of the command of spans that count.

    Returns:
        A table with a row for each span: `drive`, `duration_s`, `moved` (metres between positions), `measured` and
        `commanded` (metres by speed), `is_moving`, `is_straight`, `is_steady` (one command), perhaps `slope_deg` along
        the track.
    """
    period_s = _fixes(track).groupby("drive")["time_s"].diff().median()
    times = track.groupby("drive")["time_s"]
    longest_s = (times.max() - times.min()).max()
    window_s = max(WINDOW_S, 4 * period_s) if period_s > 0 else WINDOW_S
    if 0 < longest_s < MIN_SPANS * window_s:  # perhaps hours: their ratio says so
        window_s = longest_s / MIN_SPANS
    sums = {}
    for name, column in (("measured", "speed"), ("commanded", "commanded")):
        sums[name] = (track[column] * track["step_s"]).groupby(track["segment"]).cumsum()
    table = track.assign(span=np.floor(track["time_s"] / window_s), command=track["commanded"], **sums)
    grouped = table.groupby(["segment", "span"])
    # A span reaches from its first row to that of the next one.
    firsts, commands = grouped.first(), grouped["command"].agg(["min", "max"])
    ways = firsts[[*sums, "x", "y", "time_s", *{"z"}.intersection(firsts)]].groupby("segment").diff(-1)
    moved = np.hypot(ways["x"], ways["y"])
    after = ways.groupby("segment").shift(-1)
    cosine = (ways["x"] * after["x"] + ways["y"] * after["y"]) / (moved * np.hypot(after["x"], after["y"]))
    before = cosine.groupby("segment").shift(1)
    spans = pd.DataFrame({"drive": firsts["drive"], "duration_s": -ways["time_s"], "moved": moved})
    spans = spans.assign(**{name: ways[name].abs() for name in sums})
    least_m = least_speed * spans["duration_s"]
    spans["is_moving"] = np.fmax(moved, spans["measured"]) >= least_m
    spans["is_straight"] = (cosine.fillna(1) > _STRAIGHT_COS) & (before.fillna(1) > _STRAIGHT_COS)
    spans["is_steady"] = commands["min"] == commands["max"]
    if "z" in ways:
        spans["slope_deg"] = np.degrees(np.arctan2(-ways["z"], moved))
    return spans[spans["commanded"] >= least_m]


def velocity_of(track: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Fit a line through the fixes within a second of each row, or within 1.5 periods of fixes where they are seldom.

    On fixes of equal steps it is the derivative of Savitzky and Golay (1964), "Smoothing and differentiation of data by
    simplified least squares procedures".

    Args:
        track: as of `track_of`.
        columns: of coordinates, in metres.

    Returns:
        Derivatives in m/s by the track's index; NaN where fixes do not reach over half of the time.
    """
    velocity = pd.DataFrame(np.nan, index=track.index, columns=columns)
    for _, own in track.groupby("segment"):
        fixes = _fixes(own)
        time_s, values = fixes["time_s"].to_numpy(), fixes[columns].to_numpy()
        period_s = np.median(np.diff(time_s)) if len(time_s) > 1 else 0.0
        half_s = max(WINDOW_S, 3 * period_s) / 2
        for start in range(0, len(own), _ROWS_AT_ONCE):
            rows = own.iloc[start : start + _ROWS_AT_ONCE]
            now_s = rows["time_s"].to_numpy()
            slack_s = 1e-6 * half_s  # times are decimal fractions
            low = np.searchsorted(time_s, now_s - half_s - slack_s)
            high = np.searchsorted(time_s, now_s + half_s + slack_s)
            index = low[:, None] + np.arange((high - low).max(initial=1))
            is_near = index < high[:, None]
            index = np.minimum(index, len(time_s) - 1)
            reach_s = time_s[np.maximum(high - 1, 0)] - time_s[np.minimum(low, len(time_s) - 1)]
            count = is_near.sum(axis=1, keepdims=True).clip(min=1)
            offset_s = np.where(is_near, time_s[index], 0)
            offset_s = np.where(is_near, offset_s - offset_s.sum(axis=1, keepdims=True) / count, 0)
            # The offsets sum to 0, so that a constant of the values does not count; less of it rounds less.
            near = values[index] - values[index[:, :1]]
            with np.errstate(divide="ignore", invalid="ignore"):
                slopes = np.einsum("nk,nkc->nc", offset_s, near)
                slopes /= np.square(offset_s).sum(axis=1, keepdims=True)
            velocity.loc[rows.index] = np.where((reach_s >= half_s - slack_s)[:, None], slopes, np.nan)
    return velocity


def speed_of_positions(track: pd.DataFrame, least_speed: float) -> pd.Series:
    """Return the speed along the robot from its positions.

    Positions have no heading, so that of the command counts: a robot moves as commanded. Where its track reverses from
    one row to the next under one command, it slides back until the track reverses again.

    Args:
        track: as of `track_of`.
        least_speed: m/s, of commands that count; slower ones may turn the robot round.

    Returns:
        Speed in m/s, signed as the command, by the track's index; NaN where `velocity_of` is.
    """
    sign = np.sign(track["commanded"])
    toward = velocity_of(track, ["x", "y"]).mul(sign, axis=0)
    speed = np.hypot(toward["x"], toward["y"])
    is_slow = track["commanded"].abs() < least_speed
    block = (is_slow | (track["segment"].diff() != 0)).cumsum()
    moving = toward[~is_slow & (speed >= least_speed / 2)]
    unit = moving.div(speed[moving.index], axis=0)
    own = block[moving.index]
    turn = (unit * unit.groupby(own).shift(1)).sum(axis=1, min_count=2)
    backward = ((turn < _SLIDES_COS).groupby(own).cumsum() % 2).astype(bool)
    # A block may start by sliding, but robots are not logged sliding most of the time.
    mostly = backward.groupby(own).transform("mean") > 0.5
    is_back = (backward != mostly).reindex(track.index)
    is_back = is_back.groupby(block).ffill().fillna(False).astype(bool)
    return speed * sign * np.where(is_back, -1.0, 1.0)
