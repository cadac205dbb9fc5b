"""Velocities from the positions of a drive log, and speeds along the robot's heading.

Lines are fitted through the fixes of a track; `drive_tracks` defines both terms.
Distances are horizontal, in metres.
"""

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.datagen.dem.drive_tracks import WINDOW_S, angle_between, knots_of

# Thresholds that this package chooses without a source are marked "(choice)".
# Maximum time between fixes in which no robot can turn by more than 120°: robots turn
# at up to 2.5 rad/s (choice).
MAX_PERIOD_S = 0.8
# Cosine of 120°. A larger turn between rows under one command is a reversal (choice).
_REVERSAL_COS = -0.5
# Minimum ratio of a velocity to its standard error for a reliable direction (choice).
_CLEAR_ERRORS = 5.0
# After more than this number of windows without a reliable direction, a robot may have
# turned (choice).
_MAX_REST_WINDOWS = 2.0
_ROWS_AT_ONCE = 4096


def velocity_of(track: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Return the slopes of lines that are fitted through the fixes around each row.

    The fit uses fixes within ±1 s, or within ±1.5 periods of the fixes if that is
    longer. For equally spaced fixes, the slope is the derivative of Savitzky and Golay
    (1964), "Smoothing and differentiation of data by simplified least squares
    procedures".

    Args:
        track: track from `track_of`.
        columns: columns of coordinates in metres.

    Returns:
        A table by the track's index:
            `columns`: slopes in m/s, NaN where the fixes span less than half of the
                window.
            error: standard error of the slopes in m/s, from the scatter of the fixes in
                the window, or in the whole drive if that scatter is larger.
            window_s: duration of the window in seconds.
            reach_s: half of the time in seconds that the fixes would span if they were
                dense.
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
        degrees_of_freedom = (fit["count"] - 2) * len(columns)
        is_estimable = (fit["count"] > 2) & fit["residual"].notna()
        degrees_of_freedom = degrees_of_freedom.where(is_estimable)
        drive_variance = fit["residual"].sum() / max(degrees_of_freedom.sum(), 1)
        variance = np.fmax(fit["residual"] / degrees_of_freedom, drive_variance)
        error = np.sqrt(variance / fit["spread_s2"])
        reach_s = np.sqrt(3 * fit["spread_s2"] / fit["count"])
        fit = fit.assign(error=error, reach_s=reach_s)
        fits.append(fit[results])
    table = pd.concat(fits[1:] or fits)
    return table.reindex(track.index)


def _fit(rows: pd.DataFrame, knots: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Fit lines through the knots (rows with a measured position) around each row.

    Args:
        rows: rows of a segment.
        knots: rows of the segment with a measured position.
        columns: columns of coordinates in metres.

    Returns:
        A table by the index of `rows`:
            `columns`: slopes in m/s.
            count: number of knots.
            residual: sum of squared residuals over the columns, in m².
            spread_s2: sum of squared deviations of the times from their mean, in s².
            window_s: duration of the window in seconds.
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
    """Fit a line through the knots around each time.

    Letters in shapes: M times, K knots, C coordinates.

    Args:
        row_s: times in seconds, shape [M].
        knot_s: times of the knots in seconds, ascending, shape [K].
        values: coordinates of the knots in metres, shape [K, C].
        half_s: half width of the window in seconds.

    Returns:
        Slopes, count, residual and spread as in `_fit`, float64, shape [M, C + 3].
    """
    slack_s = 1e-6 * half_s  # tolerance for rounding errors of decimal times
    low = np.searchsorted(knot_s, row_s - half_s - slack_s)
    high = np.searchsorted(knot_s, row_s + half_s + slack_s)
    last = len(knot_s) - 1
    index = low[:, None] + np.arange((high - low).max(initial=1))
    is_in_window = index < high[:, None]
    index = np.minimum(index, last)
    first_s = knot_s[np.minimum(low, last)]
    last_s = knot_s[np.maximum(high - 1, 0)]
    is_covered = last_s - first_s >= half_s - slack_s
    count = is_in_window.sum(axis=1, keepdims=True)
    divisor = count.clip(min=1)
    offset_s = np.where(is_in_window, knot_s[index], 0)
    mean_s = offset_s.sum(axis=1, keepdims=True) / divisor
    offset_s = np.where(is_in_window, offset_s - mean_s, 0)
    # A constant in the values does not change the slope. Subtracting the first value
    # makes the values small, and with them the rounding errors.
    offset_m = values[index] - values[index[:, :1]]
    offset_m = np.where(is_in_window[..., None], offset_m, 0)
    spread_s2 = np.square(offset_s).sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = np.einsum("nk,nkc->nc", offset_s, offset_m) / spread_s2
    slopes = np.where(is_covered[:, None], slopes, np.nan)
    mean_m = offset_m.sum(axis=1, keepdims=True) / divisor[..., None]
    misfit = offset_m - mean_m - slopes[:, None, :] * offset_s[..., None]
    misfit = np.where(is_in_window[..., None], misfit, 0)
    residual = np.square(misfit).sum(axis=(1, 2))
    return np.column_stack([slopes, count, residual, spread_s2])


def speed_of_positions(track: pd.DataFrame, least_speed: float) -> pd.Series:
    """Return the speed along the robot's heading from its positions.

    Positions contain no heading, so a robot is assumed to move in the direction of the
    command, forward or backward. If its track reverses under one command, the robot
    slides back until the track reverses again. Only velocities of at least five
    standard errors have a direction, since noise dominates the direction of a robot at
    rest. After a rest of more than two windows of the fit, the robot is assumed to move
    as commanded again. If fixes are rare, the robot may have turned between them, so
    reversals are ignored.

    In a curve, the slope of the fitted line is less than the speed on the arc. The turn
    rate of the track is used to correct this.

    Args:
        track: track from `track_of`.
        least_speed: minimum commanded speed of used rows [m/s]; under slower commands,
            the robot may turn round.

    Returns:
        Speed in m/s by the track's index, positive forward; NaN where the velocity of
        `velocity_of` is NaN.
    """
    sign = np.sign(track["commanded"])
    fit = velocity_of(track, ["x", "y"])
    velocity = fit[["x", "y"]].mul(sign, axis=0)  # reversed under backward commands
    speed = np.hypot(velocity["x"], velocity["y"])
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
    unit = velocity[is_clear].div(speed[is_clear], axis=0)
    previous_unit = unit.groupby(stretch).shift(1)
    turn_cos = (unit * previous_unit).sum(axis=1, min_count=2)
    is_dense = window_s <= max(WINDOW_S, 3 * MAX_PERIOD_S)
    reverses = (turn_cos < _REVERSAL_COS) & is_dense
    n_reversals = reverses.groupby(stretch).cumsum()
    is_backward = (n_reversals % 2).astype(bool)
    # A stretch may start while the robot slides back, but robots rarely slide back for
    # most of a stretch.
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
    """Return the ratio of the speed on an arc to the slope of the fitted line.

    On an arc with turn rate ω, the line through fixes within ±T has a slope of
    3 (sin a − a cos a) / a³ times the speed, with a = ω T. The ratio is 1 where no turn
    rate is known.

    Args:
        track: track from `track_of`.
        reach_s: T of each row in seconds.
        heading: unit vectors of the rows with a reliable direction.
    """
    segment = track["segment"][heading.index]
    previous = heading.groupby(segment).shift(1)
    turn = angle_between(previous, heading)
    turn = turn.where(np.cos(turn) > _REVERSAL_COS, 0)
    angle = turn.groupby(segment).cumsum()
    angle = angle.reindex(track.index).interpolate().fillna(0)
    turn_rates = velocity_of(track.assign(angle=angle), ["angle"])
    rate = turn_rates["angle"].abs()
    a = (rate * reach_s).clip(upper=np.pi / 2)  # the formula holds up to a half circle
    clipped_a = a.clip(lower=0.01)
    exact = clipped_a**3 / (3 * (np.sin(clipped_a) - clipped_a * np.cos(clipped_a)))
    series = 1 + a**2 / 10
    factor = exact.where(a == clipped_a, series)
    return factor[heading.index].reindex(track.index).fillna(1)
