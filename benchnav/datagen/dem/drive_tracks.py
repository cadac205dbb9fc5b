"""Tracks of a drive log: positions over time, their faults and the motion that they
show.

A *track* is the rows of a log, ordered by drive and time. A *segment* is a part of it
without a gap. A *fix* is its rows of one position, since logs repeat a position until
the receiver gives the next. Distances are horizontal, in metres.

Letters in shapes: N rows.
"""

import math

import numpy as np
import pandas as pd
from numpy import ndarray

# Thresholds that are someone's choice are marked (choice).
WINDOW_S = 2.0  # over which the noise of positions is small compared with the distance
MIN_SPANS = 5  # that a median needs (choice)
_GAP_S = 1.0  # without a row, after which nothing is said of the motion between
_FREEZE_FIXES = 3  # periods of positions that one may stay the same (choice)
# between neighbouring spans, so that a chord is at most 1 % shorter than its arc
_STRAIGHT_COS = 0.9
# between neighbouring spans of an arc; more is a reversal (choice)
_MAX_BEND = math.radians(150)
# between rows of one command; no robot turns by over 120° at once (choice)
_SLIDES_COS = -0.5
MAX_PERIOD_S = (
    0.8  # between fixes, in which no robot turns by over 120°, at 2.5 rad/s (choice)
)
_CLEAR_ERRORS = 5.0  # standard errors of a velocity whose direction counts (choice)
_MAX_REST_WINDOWS = (
    2.0  # without such a velocity, after which a robot may have turned (choice)
)
_ROWS_AT_ONCE = 4096


def find_restarted(rows: pd.DataFrame) -> ndarray:
    """Return a mask of rows whose time is before that of an earlier row of their drive.

    Rows that are only out of order are not a restart: sorted by time, their track is
    shorter than in the order of the file.

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
    return (
        np.hypot(by_drive["x"].diff(), by_drive["y"].diff())
        .groupby(rows["drive"])
        .sum()
    )


def track_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Order rows by drive and time.

    Args:
        rows: of a log.

    Returns:
        The rows with their index, and with `step_s` since the row before (0 after a
        gap), `segment` and `fix`.
    """
    track = rows.sort_values(["drive", "time_s"], kind="stable")
    step_s = track.groupby("drive")["time_s"].diff()
    usual_s = step_s.groupby(track["drive"]).transform("median")
    # the first row of a drive too
    starts = ~(step_s <= np.maximum(_GAP_S, 3 * usual_s))
    changes = (track[["drive", "x", "y"]].diff() != 0).any(axis=1)
    return track.assign(
        step_s=step_s.where(~starts, 0.0), segment=starts.cumsum(), fix=changes.cumsum()
    )


def _fixes(track: pd.DataFrame) -> pd.DataFrame:
    """Return the first row of each fix with its number of `rows`, by `fix`."""
    grouped = track.groupby("fix")
    return grouped.first().assign(rows=grouped.size())


def _period_s(fixes: pd.DataFrame) -> pd.Series:
    """Return the median time between fixes of each fix's drive; 0 for one fix."""
    drive = fixes["drive"]
    return (
        fixes.groupby("drive")["time_s"]
        .diff()
        .groupby(drive)
        .transform("median")
        .fillna(0)
    )


def period_of(track: pd.DataFrame) -> float:
    """Return the median time between fixes of all drives in seconds; 0 for one fix."""
    return float(f"{_period_s(_fixes(track)).median():.3g}")


def _knots(track: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with a measured position: starts of fixes, and long repeats.

    A position that stays the same for more than three fixes is that of a robot at rest,
    measured once a period.
    """
    fixes = _fixes(track)
    period_s = _period_s(fixes)[track["fix"]].to_numpy()
    since_s = track["time_s"] - fixes["time_s"][track["fix"]].to_numpy()
    is_long = since_s.groupby(track["fix"]).transform("max") > np.maximum(
        _FREEZE_FIXES * period_s, _GAP_S
    )
    repeat = np.floor(since_s / np.where(period_s > 0, period_s, 1e-9) + 1e-6).where(
        is_long, 0
    )
    return track[~track[["segment", "fix"]].assign(repeat=repeat).duplicated()]


def find_standing(
    track: pd.DataFrame, least_speed: float, *, by_positions: bool
) -> pd.DataFrame:
    """Return masks of rows whose position does not change for more than three fixes.

    Only rows under a command count. If the robot moves, the receiver is frozen: either
    measured speed or a distant next position shows this. A robot that stands still
    under its command is immobilised, which is not a fault.

    Args:
        track: from `track_of`; `speed` is NaN where it was not measured.
        least_speed: m/s, of commands that count and of a robot that moves.
        by_positions: whether the next position must be far away too.

    Returns:
        Masks by the track's index, without the first row of each such fix: `is_frozen`;
        `is_unmeasured`, immobilised by positions only; `is_unknown`, the part of them
        without a next position either.
    """
    fixes = _fixes(track)
    by_drive, period_s = fixes.groupby("drive"), _period_s(fixes)
    step_m = np.hypot(by_drive["x"].diff(), by_drive["y"].diff())
    usual_m = step_m.groupby(fixes["drive"]).transform("median").fillna(0)
    repeats = track["fix"].diff() == 0
    counts = repeats & (track["commanded"].abs() >= least_speed)
    still_s = track["step_s"].where(counts, 0).groupby(track["fix"]).sum()
    distance_m = (track["speed"] * track["step_s"]).where(counts)
    measured_m = distance_m.groupby(track["fix"]).sum(min_count=1).abs()
    next_m = step_m.groupby(fixes["drive"]).shift(-1)
    moving_m = np.maximum(_FREEZE_FIXES * usual_m, least_speed * still_s)
    is_still = still_s > np.maximum(_FREEZE_FIXES * period_s, _GAP_S)
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
    return masks.loc[track["fix"]].set_axis(track.index).where(repeats, False)


def find_jumped(track: pd.DataFrame, limit_m_s: float) -> pd.Index:
    """Return rows whose position is out of reach of the others of their drive.

    The longest stretch without a jump is correct. From there, forward and backward, a
    position is correct if it is in reach of the last correct one. Within less than a
    second, noise may exceed the reach, so times count as at least a second.

    Args:
        track: from `track_of`.
        limit_m_s: speed that a robot cannot exceed.

    Returns:
        Their labels.
    """
    fixes, jumped = _fixes(track), []
    for _, drive in fixes.groupby("drive"):
        time, x, y = (drive[name].to_numpy() for name in ("time_s", "x", "y"))
        reach_m = limit_m_s * np.maximum(np.diff(time), _GAP_S)
        breaks = np.hypot(np.diff(x), np.diff(y)) > reach_m
        if not breaks.any():
            continue
        stretch = np.concatenate([[0], np.cumsum(breaks)])
        is_right = stretch == np.bincount(stretch, drive["rows"]).argmax()
        first, last = np.flatnonzero(is_right)[[0, -1]]
        for anchor, others in (
            (last, range(last + 1, len(drive))),
            (first, range(first - 1, -1, -1)),
        ):
            right = anchor
            for fix in others:
                away_m = math.hypot(x[fix] - x[right], y[fix] - y[right])
                if away_m <= limit_m_s * max(abs(time[fix] - time[right]), _GAP_S):
                    is_right[fix], right = True, fix
        jumped.append(drive.index[~is_right])
    return (
        track.index[track["fix"].isin(np.concatenate(jumped))]
        if jumped
        else track.index[:0]
    )


def spans_of(
    track: pd.DataFrame, least_speed: float, span_s: float = WINDOW_S
) -> pd.DataFrame:
    """Return motion under command, summed over spans of a time, or from fix to fix.

    Args:
        track: from `track_of`; with `z`, elevation in metres, too for slopes.
        least_speed: m/s, of the command of spans that count.
        span_s: of a span.

    Returns:
        A table with a row for each span: `drive`, `duration_s`, `moved` (metres along
        the arc between positions), `measured` and `commanded` (metres by speed),
        `is_moving`, `is_straight`, `is_steady` (one command), perhaps `slope_deg` along
        the track.
    """
    knots = _knots(track)
    period_s = knots.groupby("segment")["time_s"].diff().median()
    times = track.groupby("drive")["time_s"]
    longest_s = (times.max() - times.min()).max()
    window_s = np.fmax(span_s, period_s)
    if 0 < longest_s < MIN_SPANS * window_s:  # perhaps hours: their ratio says so
        window_s = longest_s / MIN_SPANS
    sums = {}
    for name, column in (("measured", "speed"), ("commanded", "commanded")):
        sums[name] = (
            (track[column] * track["step_s"]).groupby(track["segment"]).cumsum()
        )
    # of the last position
    span = np.floor(knots["time_s"] / window_s).reindex(track.index).ffill()
    table = track.assign(span=span, command=track["commanded"], **sums)
    # A span reaches from its first measured position to that of the next one.
    firsts = table.loc[knots.index].groupby(["segment", "span"]).first()
    commands = table.groupby(["segment", "span"])["command"].agg(["min", "max"])
    steps = (
        firsts[[*sums, "x", "y", "time_s", *{"z"}.intersection(firsts)]]
        .groupby("segment")
        .diff(-1)
    )
    chord = np.hypot(steps["x"], steps["y"])
    # On an arc the chords of two neighbours differ in direction by the angle of each.
    after = _angle_between(steps, steps.groupby("segment").shift(-1))
    before = after.groupby("segment").shift(1)
    bends = pd.concat([before, after], axis=1)
    bend = bends.where(bends.abs() < _MAX_BEND).mean(axis=1).fillna(0)
    moved = chord / np.sinc(bend / (2 * np.pi))
    spans = pd.DataFrame(
        {"drive": firsts["drive"], "duration_s": -steps["time_s"], "moved": moved}
    )
    spans = spans.assign(**{name: steps[name].abs() for name in sums})
    least_m = least_speed * spans["duration_s"]
    spans["is_moving"] = np.fmax(moved, spans["measured"]) >= least_m
    spans["is_straight"] = (np.cos(bends.fillna(0)) > _STRAIGHT_COS).all(axis=1)
    spans["is_steady"] = commands["min"] == commands["max"]
    if "z" in steps:
        spans["slope_deg"] = np.degrees(np.arctan2(-steps["z"], moved))
    return spans[spans["commanded"] >= least_m]


def _angle_between(vectors: pd.DataFrame, others: pd.DataFrame) -> pd.Series:
    """Return signed angles in (-π, π] from vectors to others, in columns `x`, `y`."""
    cross = vectors["x"] * others["y"] - vectors["y"] * others["x"]
    dot = vectors["x"] * others["x"] + vectors["y"] * others["y"]
    # of a vector of 0 it is 0, which -0.0 would make π
    return np.arctan2(cross + 0.0, dot + 0.0)


def velocity_of(track: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Return derivatives of a line fit through the fixes around each row.

    The fit uses fixes within a second, or within 1.5 periods of fixes if these are
    longer. For fixes of equal steps it is the derivative of Savitzky and Golay (1964),
    "Smoothing and differentiation of data by simplified least squares procedures".

    Args:
        track: from `track_of`.
        columns: of coordinates, in metres.

    Returns:
        A table by the track's index: derivatives in m/s, NaN where fixes do not reach
        over half of the time; `error`, their standard error in m/s, from the scatter of
        these fixes and at least from that of the drive; `window_s`; `reach_s`, half of
        the time that the fixes take, as if they were dense.
    """
    fits = [
        pd.DataFrame(columns=[*columns, "error", "window_s", "reach_s"], dtype=float)
    ]
    marked = track.assign(is_knot=track.index.isin(_knots(track).index))
    for _, drive in marked.groupby("drive"):
        fit = pd.concat(
            [
                _fit(rows, rows[rows["is_knot"]], columns)
                for _, rows in drive.groupby("segment")
            ]
        )
        freedom = ((fit["count"] - 2) * len(columns)).where(
            (fit["count"] > 2) & fit["residual"].notna()
        )
        usual = fit["residual"].sum() / max(freedom.sum(), 1)
        variance = np.fmax(fit["residual"] / freedom, usual)
        error, reach_s = (
            np.sqrt(variance / fit["spread_s2"]),
            np.sqrt(3 * fit["spread_s2"] / fit["count"]),
        )
        fits.append(fit.assign(error=error, reach_s=reach_s)[fits[0].columns])
    return pd.concat(fits[1:] or fits).reindex(track.index)


def _fit(rows: pd.DataFrame, knots: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Fit lines through the knots around each row of a segment.

    Returns:
        A table by the rows' index: slopes; `count` of knots; `residual`, the sum of
        squares in m² over the columns; `spread_s2`, the sum of squares of times about
        their mean; `window_s`.
    """
    time_s, values = knots["time_s"].to_numpy(), knots[columns].to_numpy()
    period_s = np.median(np.diff(time_s)) if len(time_s) > 1 else 0.0
    half_s = max(WINDOW_S, 3 * period_s) / 2
    slack_s = 1e-6 * half_s  # times are decimal fractions
    fits = []
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        now_s = rows["time_s"].to_numpy()[start : start + _ROWS_AT_ONCE]
        low = np.searchsorted(time_s, now_s - half_s - slack_s)
        high = np.searchsorted(time_s, now_s + half_s + slack_s)
        index = low[:, None] + np.arange((high - low).max(initial=1))
        is_near = index < high[:, None]
        index = np.minimum(index, len(time_s) - 1)
        reach_s = (
            time_s[np.maximum(high - 1, 0)] - time_s[np.minimum(low, len(time_s) - 1)]
        )
        count = is_near.sum(axis=1, keepdims=True)
        offset_s = np.where(is_near, time_s[index], 0)
        offset_s = np.where(
            is_near,
            offset_s - offset_s.sum(axis=1, keepdims=True) / count.clip(min=1),
            0,
        )
        # The offsets sum to 0, so that a constant of the values does not count; less of
        # it rounds less.
        near = values[index] - values[index[:, :1]]
        near = np.where(is_near[..., None], near, 0)
        spread_s2 = np.square(offset_s).sum(axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            slopes = np.einsum("nk,nkc->nc", offset_s, near) / spread_s2
        slopes = np.where((reach_s >= half_s - slack_s)[:, None], slopes, np.nan)
        middle = near.sum(axis=1, keepdims=True) / count.clip(min=1)[..., None]
        misfit = near - middle - slopes[:, None, :] * offset_s[..., None]
        residual = np.square(np.where(is_near[..., None], misfit, 0)).sum(axis=(1, 2))
        fits.append(np.column_stack([slopes, count, residual, spread_s2]))
    table = pd.DataFrame(
        np.concatenate(fits), rows.index, [*columns, "count", "residual", "spread_s2"]
    )
    return table.assign(window_s=2 * half_s)


def speed_of_positions(track: pd.DataFrame, least_speed: float) -> pd.Series:
    """Return the speed along the robot from its positions.

    Positions have no heading, so that of the command counts: a robot moves as
    commanded. Where its track reverses under one command, it slides back until the
    track reverses again. Only velocities of at least five standard errors have a
    direction, since noise turns that of a robot at rest. After a rest of more than two
    windows of the fit, the robot moves as commanded again. Where fixes are seldom, it
    may have turned between them, and no reversal counts.

    In a curve the fitted line is shorter than the arc, by the rate at which its
    direction turns.

    Args:
        track: from `track_of`.
        least_speed: m/s, of commands that count; slower ones may turn the robot round.

    Returns:
        Speed in m/s, signed as the command, by the track's index; NaN where
        `velocity_of` is.
    """
    sign, fit = np.sign(track["commanded"]), velocity_of(track, ["x", "y"])
    toward = fit[["x", "y"]].mul(sign, axis=0)
    speed = np.hypot(toward["x"], toward["y"])
    is_slow = track["commanded"].abs() < least_speed
    block = (is_slow | (track["segment"].diff() != 0)).cumsum()
    is_clear = ~is_slow & (
        speed >= np.fmax(least_speed / 2, _CLEAR_ERRORS * fit["error"])
    )
    rest_s = track["time_s"][is_clear].diff()
    starts = (block[is_clear].diff() != 0) | (
        rest_s > _MAX_REST_WINDOWS * fit["window_s"][is_clear]
    )
    stretch = starts.cumsum()
    unit = toward[is_clear].div(speed[is_clear], axis=0)
    turn = (unit * unit.groupby(stretch).shift(1)).sum(axis=1, min_count=2)
    reverses = (turn < _SLIDES_COS) & (
        fit["window_s"][is_clear] <= max(WINDOW_S, 3 * MAX_PERIOD_S)
    )
    backward = (reverses.groupby(stretch).cumsum() % 2).astype(bool)
    # A stretch may start by sliding, but robots are not logged sliding most of the
    # time.
    mostly = backward.groupby(stretch).transform("mean") > 0.5
    is_back = backward != mostly
    speed *= _arc_over_fit(
        track, fit["reach_s"], unit.mul(np.where(is_back, -1.0, 1.0), axis=0)
    )
    is_back = (
        is_back.reindex(track.index).groupby(block).ffill().fillna(False).astype(bool)
    )
    return speed * sign * np.where(is_back, -1.0, 1.0)


def _arc_over_fit(
    track: pd.DataFrame, reach_s: pd.Series, heading: pd.DataFrame
) -> pd.Series:
    """Return the ratio of the speed on an arc to that of a fitted line; 1 by default.

    On an arc of rate ω, fixes within ±T give a line of 3 (sin a - a cos a) / a³ of the
    speed, a = ω T.

    Args:
        track: from `track_of`.
        reach_s: T of each row.
        heading: unit vectors of the rows of clear velocity.
    """
    segment = track["segment"][heading.index]
    turn = _angle_between(heading.groupby(segment).shift(1), heading)
    turned = turn.where(np.cos(turn) > _SLIDES_COS, 0).groupby(segment).cumsum()
    turned = turned.reindex(track.index).interpolate().fillna(0)
    rate = velocity_of(track.assign(turned=turned), ["turned"])["turned"].abs()
    a = (rate * reach_s).clip(upper=np.pi / 2)  # a half circle; more is no arc
    wide = a.clip(lower=0.01)
    factor = (wide**3 / (3 * (np.sin(wide) - wide * np.cos(wide)))).where(
        a == wide, 1 + a**2 / 10
    )
    return factor[heading.index].reindex(track.index).fillna(1)
