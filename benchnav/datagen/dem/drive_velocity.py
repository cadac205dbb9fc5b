"""Velocities of a drive log's positions, and the speed along the robot.

Lines are fitted through the fixes of a track (`drive_tracks`). Distances are
horizontal, in metres.
"""

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.datagen.dem.drive_tracks import WINDOW_S, angle_between, knots_of

# Thresholds that are a choice of this package are marked (choice).
# Longest period of fixes in which no robot turns by over 120°, at 2.5 rad/s (choice).
MAX_PERIOD_S = 0.8
# Cosine of 120°, by which no robot turns between rows of one command (choice).
_SLIDES_COS = -0.5
_CLEAR_ERRORS = 5.0  # standard errors of a velocity whose direction counts (choice)
# Windows without a clear velocity, after which a robot may have turned (choice).
_MAX_REST_WINDOWS = 2.0
_ROWS_AT_ONCE = 4096


def velocity_of(track: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Return derivatives of a line fitted through the fixes around each row.

    The fit uses fixes within a second, or within 1.5 periods of fixes if these are
    longer. For fixes of equal steps it is the derivative of Savitzky and Golay (1964),
    "Smoothing and differentiation of data by simplified least squares procedures".

    Args:
        track: track from `track_of`.
        columns: columns of coordinates in metres.

    Returns:
        A table by the track's index: derivatives in m/s, NaN where fixes span less than
        half of the time; `error`, their standard error in m/s, from the scatter of
        these fixes and at least from that of the drive; `window_s`; `reach_s`, half of
        the time that the fixes span, as if they were dense.
    """
    results = [*columns, "error", "window_s", "reach_s"]
    fits = [pd.DataFrame(columns=results, dtype=float)]
    is_knot = track.index.isin(knots_of(track).index)
    marked = track.assign(is_knot=is_knot)
    for _, drive in marked.groupby("drive"):
        segments = []
        for _, rows in drive.groupby("segment"):
            knots = rows[rows["is_knot"]]
            segments.append(_fit(rows, knots, columns))
        fit = pd.concat(segments)
        freedom = (fit["count"] - 2) * len(columns)
        is_free = (fit["count"] > 2) & fit["residual"].notna()
        freedom = freedom.where(is_free)
        usual = fit["residual"].sum() / max(freedom.sum(), 1)
        variance = np.fmax(fit["residual"] / freedom, usual)
        error = np.sqrt(variance / fit["spread_s2"])
        reach_s = np.sqrt(3 * fit["spread_s2"] / fit["count"])
        fit = fit.assign(error=error, reach_s=reach_s)
        fits.append(fit[results])
    table = pd.concat(fits[1:] or fits)
    return table.reindex(track.index)


def _fit(rows: pd.DataFrame, knots: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Fit lines through the knots around each row of a segment.

    Returns:
        A table by the rows' index: slopes; `count` of knots; `residual`, the sum of
        squares in m² over the columns; `spread_s2`, the sum of squares of times about
        their mean; `window_s`.
    """
    row_s = rows["time_s"].to_numpy()
    knot_s = knots["time_s"].to_numpy()
    values = knots[columns].to_numpy()
    period_s = 0.0
    if len(knot_s) > 1:
        period_s = np.median(np.diff(knot_s))
    half_s = max(WINDOW_S, 3 * period_s) / 2
    fits = []
    for start in range(0, len(rows), _ROWS_AT_ONCE):
        chunk_s = row_s[start : start + _ROWS_AT_ONCE]
        fits.append(_fit_at(chunk_s, knot_s, values, half_s))
    results = [*columns, "count", "residual", "spread_s2"]
    table = pd.DataFrame(np.concatenate(fits), rows.index, results)
    return table.assign(window_s=2 * half_s)


def _fit_at(row_s: ndarray, knot_s: ndarray, values: ndarray, half_s: float) -> ndarray:
    """Fit a line around each of some times.

    Letters in shapes: M times, K knots, C coordinates.

    Args:
        row_s: times, shape [M].
        knot_s: times of the knots, ascending, shape [K].
        values: coordinates of the knots, shape [K, C].
        half_s: half width of the window in seconds.

    Returns:
        Slopes, count, residual and spread, shape [M, C + 3].
    """
    slack_s = 1e-6 * half_s  # times are decimal fractions
    low = np.searchsorted(knot_s, row_s - half_s - slack_s)
    high = np.searchsorted(knot_s, row_s + half_s + slack_s)
    last = len(knot_s) - 1
    index = low[:, None] + np.arange((high - low).max(initial=1))
    is_near = index < high[:, None]
    index = np.minimum(index, last)
    first_s = knot_s[np.minimum(low, last)]
    last_s = knot_s[np.maximum(high - 1, 0)]
    is_covered = last_s - first_s >= half_s - slack_s
    count = is_near.sum(axis=1, keepdims=True)
    divisor = count.clip(min=1)
    offset_s = np.where(is_near, knot_s[index], 0)
    mean_s = offset_s.sum(axis=1, keepdims=True) / divisor
    offset_s = np.where(is_near, offset_s - mean_s, 0)
    # The offsets sum to 0, so a constant in the values cancels; a smaller one causes
    # smaller rounding errors.
    near = values[index] - values[index[:, :1]]
    near = np.where(is_near[..., None], near, 0)
    spread_s2 = np.square(offset_s).sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.einsum("nk,nkc->nc", offset_s, near) / spread_s2
    slopes = np.where(is_covered[:, None], slopes, np.nan)
    middle = near.sum(axis=1, keepdims=True) / divisor[..., None]
    misfit = near - middle - slopes[:, None, :] * offset_s[..., None]
    misfit = np.where(is_near[..., None], misfit, 0)
    residual = np.square(misfit).sum(axis=(1, 2))
    return np.column_stack([slopes, count, residual, spread_s2])


def speed_of_positions(track: pd.DataFrame, least_speed: float) -> pd.Series:
    """Return the speed along the robot from its positions.

    Positions have no heading, so the direction of the command counts: a robot moves as
    commanded. If its track reverses under one command, it slides back until the track
    reverses again. Only velocities of at least five standard errors have a direction,
    since noise turns that of a robot at rest. After a rest of more than two windows of
    the fit, the robot moves as commanded again. If fixes are rare, the robot may have
    turned between them, and no reversal counts.

    In a curve, the fitted line is shorter than the arc. The turn rate of the
    track yields the correction.

    Args:
        track: track from `track_of`.
        least_speed: minimum speed of commands that count; under slower ones, the robot
            may turn round [m/s].

    Returns:
        Speed in m/s, signed as the command, by the track's index; NaN where
        `velocity_of` is.
    """
    sign = np.sign(track["commanded"])
    fit = velocity_of(track, ["x", "y"])
    toward = fit[["x", "y"]].mul(sign, axis=0)
    speed = np.hypot(toward["x"], toward["y"])
    is_slow = track["commanded"].abs() < least_speed
    is_boundary = is_slow | (track["segment"].diff() != 0)
    block = is_boundary.cumsum()
    min_speed = np.fmax(least_speed / 2, _CLEAR_ERRORS * fit["error"])
    is_clear = ~is_slow & (speed >= min_speed)
    window_s = fit["window_s"][is_clear]
    rest_s = track["time_s"][is_clear].diff()
    is_new_block = block[is_clear].diff() != 0
    starts = is_new_block | (rest_s > _MAX_REST_WINDOWS * window_s)
    stretch = starts.cumsum()
    unit = toward[is_clear].div(speed[is_clear], axis=0)
    previous_unit = unit.groupby(stretch).shift(1)
    turn_cos = (unit * previous_unit).sum(axis=1, min_count=2)
    is_dense = window_s <= max(WINDOW_S, 3 * MAX_PERIOD_S)
    reverses = (turn_cos < _SLIDES_COS) & is_dense
    n_reversals = reverses.groupby(stretch).cumsum()
    is_backward = (n_reversals % 2).astype(bool)
    # A stretch may start by sliding, but robots rarely slide most of the time.
    is_mostly_backward = is_backward.groupby(stretch).transform("mean") > 0.5
    is_back = is_backward != is_mostly_backward
    heading = unit.mul(np.where(is_back, -1.0, 1.0), axis=0)
    speed *= _arc_over_fit(track, fit["reach_s"], heading)
    is_back = is_back.reindex(track.index).groupby(block).ffill()
    is_back = is_back.fillna(False).astype(bool)
    return speed * sign * np.where(is_back, -1.0, 1.0)


def _arc_over_fit(
    track: pd.DataFrame, reach_s: pd.Series, heading: pd.DataFrame
) -> pd.Series:
    """Return the ratio of the speed on an arc to that of a fitted line; 1 by default.

    On an arc with turn rate ω, fixes within ±T give a line with 3 (sin a - a cos a) /
    a³ of the speed, a = ω T.

    Args:
        track: track from `track_of`.
        reach_s: T of each row.
        heading: unit vectors of the rows with a clear velocity.
    """
    segment = track["segment"][heading.index]
    previous = heading.groupby(segment).shift(1)
    turn = angle_between(previous, heading)
    turn = turn.where(np.cos(turn) > _SLIDES_COS, 0)
    turned = turn.groupby(segment).cumsum()
    turned = turned.reindex(track.index).interpolate().fillna(0)
    turning = velocity_of(track.assign(turned=turned), ["turned"])
    rate = turning["turned"].abs()
    a = (rate * reach_s).clip(upper=np.pi / 2)  # at most a half circle is an arc
    wide = a.clip(lower=0.01)
    exact = wide**3 / (3 * (np.sin(wide) - wide * np.cos(wide)))
    series = 1 + a**2 / 10
    factor = exact.where(a == wide, series)
    return factor[heading.index].reindex(track.index).fillna(1)
