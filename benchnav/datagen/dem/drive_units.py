"""Units that explain why positions of a drive log disagree with its speeds."""

import math

import pandas as pd

from benchnav.datagen.dem.drive_tracks import MIN_SPANS, spans_of, track_of

# Thresholds are choices of this package.
_UNIT_TOLERANCE = 0.08  # maximum relative difference from a unit's ratio
_MIN_LAMBDA = 0.05  # minimum median λ of a log
_MAX_LAMBDA = 1.3  # maximum median λ of a log
# A larger ratio of distance by positions to commanded distance indicates a wrong unit.
_MAX_COMMAND_RATIO = 5.0
# Quantile of λ over spans that counts as the maximum. In most spans, the robot may be
# immobilised.
_FAST_QUANTILE = 0.95
# If the ratio of measured to commanded speed is lower, measured speed is the speed over
# ground, not wheel speed.
_MIN_WHEEL_RATIO = 0.9
# Positions are coarse if the ratio of their resolution to the distance of a span is
# higher.
_COARSE = 0.25

# Ratio of distance by positions to distance by measured speed, by the unit of speed.
_SPEEDS = {
    "knots": 0.5144,
    "km/h": 1 / 3.6,
    "mph": 1 / 2.237,
    "ft/s": 1 / 3.281,
    "cm/s": 0.01,
}
# Seconds in each unit of time.
_TIMES = {
    "milliseconds": 1e-3,
    "microseconds": 1e-6,
    "nanoseconds": 1e-9,
    "minutes": 60.0,
    "hours": 3600.0,
}
# Units of length per metre.
_LENGTHS = {"feet": 3.281, "centimetres": 100.0, "millimetres": 1000.0}
_NO_UNIT = "no known unit"
_CONVERT = "Convert speeds to m/s, times to s and positions to m"


def median_ratio(spans: pd.DataFrame, speed: str) -> float:
    """Return the median ratio of distance by positions to distance by a speed.

    If there are enough straight spans, only these are used.

    Args:
        spans: spans from `drive_tracks.spans_of`.
        speed: column of the distance by speed, `measured` or `commanded`.
    """
    usable = spans[spans["is_moving"] & spans[speed].notna()]
    straight = usable[usable["is_straight"]]
    chosen = straight if len(straight) >= MIN_SPANS else usable
    ratio = chosen["moved"] / chosen[speed]
    return float(ratio.median())


def no_unit_text(spans: pd.DataFrame, resolution_m: float) -> str:
    """Return the words "no known unit", with a reason if one is found."""
    if is_coarse(spans, resolution_m):
        return f"{_NO_UNIT}, since positions are multiples of {resolution_m:.2g} m"
    if _is_winding(spans):
        return f"{_NO_UNIT}, since the track winds between positions"
    return _NO_UNIT


def _n_straight(spans: pd.DataFrame) -> int:
    return int((spans["is_moving"] & spans["is_straight"]).sum())


def _is_winding(spans: pd.DataFrame) -> bool:
    """Return whether the track winds, so that positions show too short distances."""
    min_straight = min(MIN_SPANS, len(spans))
    return _n_straight(spans) < min_straight and median_ratio(spans, "measured") < 1


def is_coarse(spans: pd.DataFrame, resolution_m: float) -> bool:
    """Return whether positions have too few decimals to measure a span's distance."""
    distance_m = spans["commanded"].median()
    return bool(resolution_m > _COARSE * distance_m)


def _is_plausible(traversability: float) -> bool:
    return _MIN_LAMBDA <= traversability <= _MAX_LAMBDA


def unit_of(
    rows: pd.DataFrame,
    spans: pd.DataFrame,
    least_speed: float,
    *,
    is_geographic: bool,
    resolution_m: float,
) -> tuple[str, str, bool]:
    """Return the unit that explains the ratio of positions to measured speed.

    Args:
        rows: rows of a log.
        spans: spans of these rows.
        least_speed: minimum commanded speed of used spans [m/s].
        is_geographic: whether positions are longitudes and latitudes, always in
            degrees.
        resolution_m: resolution of positions in metres.

    Returns:
        The unit, empty if no unit fits; the remedy, without a full stop; and whether
        it is a unit of times or positions rather than of speeds.
    """
    ratio = median_ratio(spans, "measured")
    for name, seconds in _TIMES.items():
        # Spans are computed again, since 2 s in another unit contain other rows.
        in_unit = _in_seconds(rows, seconds, least_speed)
        if _is_close(median_ratio(in_unit, "measured"), 1):
            return name, f"Multiply `time_s` by {seconds:.4g}", True
    # A wrong unit of positions also changes the ratio to the command, in contrast to a
    # wrong unit of measured speed.
    by_command = median_ratio(spans, "commanded")
    if not _is_plausible(by_command) and not is_geographic:
        for name, value in _LENGTHS.items():
            if _is_close(ratio, value):
                return name, f"Multiply `x_m` and `y_m` by {1 / value:.4g}", True
    if is_coarse(spans, resolution_m):
        return "", "Log positions with more decimals", False
    if _is_winding(spans):
        return "", f"{_CONVERT}, log positions more often", False
    if _n_straight(spans) >= MIN_SPANS:
        errors = {name: abs(ratio / value - 1) for name, value in _SPEEDS.items()}
        name = min(errors, key=errors.__getitem__)
        if errors[name] <= _UNIT_TOLERANCE:
            value = _SPEEDS[name]
            also = f" (`commanded_m_s` too, if it is in {name})"
            return name, f"Multiply `measured_m_s` by {value:.4g}{also}", False
    return "", _CONVERT, False


def _is_close(ratio: float, expected: float) -> bool:
    return abs(ratio / expected - 1) <= _UNIT_TOLERANCE


def _in_seconds(rows: pd.DataFrame, seconds: float, least_speed: float) -> pd.DataFrame:
    """Return the spans of rows whose times are in a unit of `seconds`."""
    in_seconds = rows.assign(time_s=rows["time_s"] * seconds)
    return spans_of(track_of(in_seconds), least_speed)


def unit_of_command(
    rows: pd.DataFrame, spans: pd.DataFrame, least_speed: float, *, is_geographic: bool
) -> tuple[float, str, str] | None:
    """Return the unit that explains the ratio of positions to the command.

    If the units are correct, the ratio of the distance by positions to the commanded
    distance is λ. Only an implausible λ indicates a wrong unit.

    Args:
        rows: rows of a log.
        spans: spans of these rows.
        least_speed: minimum commanded speed of used spans [m/s].
        is_geographic: whether positions are longitudes and latitudes, always in
            degrees.

    Returns:
        The ratio, the units that explain it, and the remedy, without a full stop; None
        if the ratio is a plausible λ.
    """
    ratios = spans["moved"] / spans["commanded"]
    ratio = float(ratios.median())
    fast_ratio = float(ratios.quantile(_FAST_QUANTILE))
    measured_ratio = (spans["measured"] / spans["commanded"]).median()
    if measured_ratio < _MIN_WHEEL_RATIO:  # measured speed shows that the robot slipped
        fast_ratio = ratio
    is_slow = fast_ratio < _MIN_LAMBDA
    is_fast = ratio > _MAX_COMMAND_RATIO
    if math.isnan(ratio) or not (is_slow or ratio > _MAX_LAMBDA):
        return None
    units = []
    remedies = []
    for name, seconds in _TIMES.items():
        in_unit = _in_seconds(rows, seconds, least_speed)
        traversability = float((in_unit["moved"] / in_unit["commanded"]).median())
        is_off = is_slow
        if seconds >= 1:
            is_off = traversability * seconds > _MAX_COMMAND_RATIO
        if is_off and _is_plausible(traversability):
            units.append(name)
            remedies.append(f"multiply `time_s` by {seconds:.4g}")
    if is_fast and not is_geographic:
        for name, value in _LENGTHS.items():
            if _is_plausible(ratio / value):
                units.append(name)
                remedies.append(f"multiply `x_m` and `y_m` by {1 / value:.4g}")
    if not (units or is_slow or is_fast):
        return None
    if not units:
        units = [_NO_UNIT]
        remedies = [
            "log `time_s` in seconds and positions in metres, or `measured_m_s` where "
            "the robot was immobilised"
        ]
    remedy = " or ".join(remedies)
    return ratio, " or ".join(units), remedy[0].upper() + remedy[1:]
