"""Detection of measured speeds that come from wheels instead of motion over ground.

Wheels follow the command on any terrain, so their speed hides slip.
"""

import math

import pandas as pd

from benchnav.core.errors import DatasetError
from benchnav.datagen.dem.drive_log import MAX_FAULTY, PACE_LIMITS, DriveLog
from benchnav.datagen.dem.drive_tracks import WINDOW_S, spans_of
from benchnav.datagen.dem.drive_units import median_ratio

# All thresholds are choices of this package.
# Spread of the ratio of measured to commanded speed, below which it counts as constant.
# Terrain causes a larger spread.
_STEADY = 0.02
_MIN_SPANS = 10  # 20 s
# Distance by which positions may fall short of wheels that equal the command.
_WHEEL_PACE = 0.05
# Difference of the 5 % and 95 % quantiles of slope along a track, at which λ varies too.
_VARIED_SLOPE_DEG = 10.0


def follows_command(spans: pd.DataFrame) -> bool:
    """Return whether the ratio of measured to commanded speed is constant.

    It is false if there are too few spans.
    """
    low, middle, high = _ratio_quantiles(spans)
    return (high - low) / 2 < _STEADY * middle


def equals_command(spans: pd.DataFrame) -> bool:
    """Return whether the ratio of measured to commanded speed is constant and 1."""
    low, middle, high = _ratio_quantiles(spans)
    is_constant = (high - low) / 2 < _STEADY * middle
    return is_constant and abs(middle - 1) < _STEADY


def _ratio_quantiles(spans: pd.DataFrame) -> list[float]:
    """Return quantiles of measured over commanded speed; NaN for too few spans."""
    moving = spans[spans["is_moving"]]
    steady = moving[moving["is_steady"]]
    chosen = steady if len(steady) >= _MIN_SPANS else moving
    if len(chosen) < _MIN_SPANS:
        return [math.nan] * 3
    ratio = chosen["measured"] / chosen["commanded"]
    return ratio.quantile([0.16, 0.5, 0.84]).tolist()


def check_wheels(log: DriveLog, track: pd.DataFrame) -> None:
    """Reject a measured speed of wheels, in the whole log or in stretches of it.

    Spans of two lengths are compared. Shorter spans follow curves that alternate, and
    noise only adds to the distance of positions.

    Args:
        log: the log.
        track: its track, with elevation `z` in metres.

    Raises:
        DatasetError: If measured speed is that of wheels.
    """
    least_speed = log.settings.least_speed
    spans = spans_of(track, least_speed, WINDOW_S)
    short = spans_of(track, least_speed, WINDOW_S / 2)
    moving = spans[spans["is_moving"]]
    short_moving = short[short["is_moving"]]
    pace = max(median_ratio(spans, "measured"), median_ratio(short, "measured"))
    off = min(_off_stretches(moving), _off_stretches(short_moving))
    gentle, steep = moving["slope_deg"].quantile([0.05, 0.95])
    reasons = []
    if equals_command(spans) and pace < 1 - _WHEEL_PACE:
        reasons.append(
            f"equals `commanded_m_s` where positions do not, which move {pace:.3g} "
            "times as far"
        )
    elif off > MAX_FAULTY:
        shortfall = 1 - PACE_LIMITS[0]
        reasons.append(
            "equals `commanded_m_s` where positions do not (over "
            f"{shortfall:.0%} less far in {off:.0%} of spans)"
        )
    if follows_command(spans) and steep - gentle >= _VARIED_SLOPE_DEG:
        reasons.append(
            f"follows `commanded_m_s` to {_STEADY:.0%} on slopes of {gentle:.0f}° to "
            f"{steep:.0f}°"
        )
    if reasons:
        raise DatasetError(
            f"Expected `measured_m_s` over ground in {log.settings.file}, got one "
            f"that {' and '.join(reasons)}, "
            "as wheel odometry does. Log the speed over ground, or pass --speed "
            "positions; pass --speed measured if it "
            "is right."
        )


def _off_stretches(moving: pd.DataFrame) -> float:
    """Return the fraction of spans in stretches with the speed of slipping wheels."""
    stretch_number = moving.groupby("drive").cumcount() // _MIN_SPANS
    n_off = 0
    for _, stretch in moving.groupby([moving["drive"], stretch_number]):
        is_short = median_ratio(stretch, "measured") < PACE_LIMITS[0]
        if is_short and equals_command(stretch):
            n_off += len(stretch)
    return n_off / max(len(moving), 1)
