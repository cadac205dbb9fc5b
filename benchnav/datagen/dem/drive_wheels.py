"""Detection of logs whose measured speed is wheel speed, not the speed over ground.

Wheels follow the command on any terrain, so their speed hides slip.
"""

import math

import pandas as pd

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import MAX_FAULTY, PACE_LIMITS, DriveLog
from benchnav.datagen.dem.drive_tracks import WINDOW_S, spans_of
from benchnav.datagen.dem.drive_units import median_ratio

# All thresholds are choices of this package.
# The ratio of measured to commanded speed is constant if its relative spread is below
# this value. Terrain causes a larger spread.
_MAX_SPREAD = 0.02
_MIN_SPANS = 10  # minimum number of spans for a decision (20 s)
# Maximum fraction by which positions may move less far than measured speed implies, if
# measured speed equals the command.
_MAX_SHORTFALL = 0.05
# If the difference between the 5 % and 95 % quantiles of slope along a track reaches
# this value, λ must vary.
_VARIED_SLOPE_DEG = 10.0


def has_constant_ratio(spans: pd.DataFrame) -> bool:
    """Return whether the ratio of measured to commanded speed is constant.

    The result is False if there are too few spans.
    """
    low, middle, high = _ratio_quantiles(spans)
    return (high - low) / 2 < _MAX_SPREAD * middle


def equals_command(spans: pd.DataFrame) -> bool:
    """Return whether the ratio of measured to commanded speed is constant and 1."""
    low, middle, high = _ratio_quantiles(spans)
    is_constant = (high - low) / 2 < _MAX_SPREAD * middle
    return is_constant and abs(middle - 1) < _MAX_SPREAD


def _ratio_quantiles(spans: pd.DataFrame) -> list[float]:
    """Return the 16 %, 50 % and 84 % quantiles of measured over commanded speed.

    They are NaN if there are too few spans.
    """
    moving = spans[spans["is_moving"]]
    steady = moving[moving["is_steady"]]
    chosen = steady if len(steady) >= _MIN_SPANS else moving
    if len(chosen) < _MIN_SPANS:
        return [math.nan] * 3
    ratio = chosen["measured"] / chosen["commanded"]
    return ratio.quantile([0.16, 0.5, 0.84]).tolist()


def check_wheels(log: DriveLog, track: pd.DataFrame) -> None:
    """Reject a log whose measured speed is wheel speed, everywhere or in stretches.

    Spans of two durations are compared, and the duration with longer distances by
    positions decides: short spans follow alternating curves better, and noise can only
    increase these distances.

    Args:
        log: log of the drives.
        track: track of the log, with elevation `z` in metres.

    Raises:
        DatasetError: If measured speed is wheel speed.
    """
    least_speed = log.settings.least_speed
    spans = spans_of(track, least_speed, WINDOW_S)
    short_spans = spans_of(track, least_speed, WINDOW_S / 2)
    moving = spans[spans["is_moving"]]
    short_moving = short_spans[short_spans["is_moving"]]
    pace = max(median_ratio(spans, "measured"), median_ratio(short_spans, "measured"))
    wheel_fraction = min(_wheel_fraction(moving), _wheel_fraction(short_moving))
    gentle, steep = moving["slope_deg"].quantile([0.05, 0.95])
    reasons = []
    if equals_command(spans) and pace < 1 - _MAX_SHORTFALL:
        reasons.append(
            f"equals `commanded_m_s` while positions move only {pace:.3g} times as far"
        )
    elif wheel_fraction > MAX_FAULTY:
        shortfall = 1 - PACE_LIMITS[0]
        reasons.append(
            f"equals `commanded_m_s` while positions move over {shortfall:.0%} less "
            f"far in {wheel_fraction:.0%} of spans"
        )
    if has_constant_ratio(spans) and steep - gentle >= _VARIED_SLOPE_DEG:
        reasons.append(
            "has a constant ratio to `commanded_m_s`, to within "
            f"{_MAX_SPREAD:.0%}, on slopes of {gentle:.0f}° to {steep:.0f}°"
        )
    if reasons:
        raise DatasetError(
            f"Expected `measured_m_s` in {log.settings.file} to be the speed over "
            f"ground, got a speed that {' and '.join(reasons)}. This suggests wheel "
            "odometry. Log the speed over ground, or pass --speed positions. If the "
            "measured speed is right, pass --speed measured."
        )


def _wheel_fraction(moving: pd.DataFrame) -> float:
    """Return the fraction of spans in stretches with the speed of slipping wheels."""
    stretch_number = moving.groupby("drive").cumcount() // _MIN_SPANS
    n_wheel_spans = 0
    for _, stretch in moving.groupby([moving["drive"], stretch_number]):
        is_short = median_ratio(stretch, "measured") < PACE_LIMITS[0]
        if is_short and equals_command(stretch):
            n_wheel_spans += len(stretch)
    return n_wheel_spans / max(len(moving), 1)
