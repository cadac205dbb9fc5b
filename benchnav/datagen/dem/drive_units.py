"""Units that explain why positions of a drive log disagree with its speeds."""

import math

import pandas as pd

from benchnav.datagen.dem.drive_tracks import MIN_SPANS, spans_of, track_of

_UNIT_TOLERANCE = 0.08  # of a ratio to that of a unit (choice)
_PLAUSIBLE = (0.05, 1.3)  # λ of a whole log (choice)
# of positions to the command, beyond which a time is in another unit (choice)
_COMMAND_LIMITS = (
    _PLAUSIBLE[0],
    5.0,
)
# quantile of the spans of a log, some of which may show an immobilised robot (choice)
_FASTEST = 0.95
_SLIPS = 0.9  # of measured to commanded speed, which is not that of wheels (choice)
_COARSE = 0.25  # of a span's distance (choice)

# The ratio of positions to measured speed that each unit gives.
_SPEEDS = {
    "knots": 0.5144,
    "km/h": 1 / 3.6,
    "mph": 1 / 2.237,
    "ft/s": 1 / 3.281,
    "cm/s": 0.01,
}
_TIMES = {
    "milliseconds": 1e-3,
    "microseconds": 1e-6,
    "nanoseconds": 1e-9,
    "minutes": 60.0,
    "hours": 3600.0,
}
_LENGTHS = {"feet": 3.281, "centimetres": 100.0, "millimetres": 1000.0}
_METRES = "Bring speeds to m/s, times to s and positions to m"


def median_ratio(spans: pd.DataFrame, of: str) -> float:
    """Return the median ratio of distances by positions and by a speed.

    Only straight spans count, if they suffice.
    """
    spans = spans[spans["is_moving"] & spans[of].notna()]
    straight = spans[spans["is_straight"]]
    chosen = straight if len(straight) >= MIN_SPANS else spans
    return float((chosen["moved"] / chosen[of]).median())


def no_unit(spans: pd.DataFrame, resolution_m: float) -> str:
    """Return the text of messages if no unit fits, with the reason."""
    why = ""
    if _is_winding(spans):
        why = ", since the track winds between positions"
    if is_coarse(spans, resolution_m):
        why = f", since positions are multiples of {resolution_m:.2g} m"
    return "no unit that is known" + why


def _n_straight(spans: pd.DataFrame) -> int:
    return int((spans["is_moving"] & spans["is_straight"]).sum())


def _is_winding(spans: pd.DataFrame) -> bool:
    """Return whether the track winds between positions, which shortens distances."""
    return (
        _n_straight(spans) < min(MIN_SPANS, len(spans))
        and median_ratio(spans, "measured") < 1
    )


def is_coarse(spans: pd.DataFrame, resolution_m: float) -> bool:
    """Return whether positions have too few decimals to measure a span's distance."""
    return bool(resolution_m > _COARSE * spans["commanded"].median())


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
        least_speed: minimum command of spans that count, in m/s.
        is_geographic: whether positions are angles, which have no other unit.
        resolution_m: resolution of positions in metres.

    Returns:
        The unit, empty if none fits; the remedy without a full stop; whether it is a
        unit of times or positions.
    """
    ratio, by_command = (
        median_ratio(spans, name) for name in ("measured", "commanded")
    )
    # Times and positions are off against the command too, a measured speed is not.
    is_plausible = _PLAUSIBLE[0] <= by_command <= _PLAUSIBLE[1]
    for name, value in _TIMES.items():
        # Spans of 2 s are others in another unit, and their arcs too.
        if (
            abs(median_ratio(_in_seconds(rows, value, least_speed), "measured") - 1)
            <= _UNIT_TOLERANCE
        ):
            return name, f"Multiply `time_s` by {value:.4g}", True
    if not is_plausible:
        for name, value in {} if is_geographic else _LENGTHS.items():
            if abs(ratio / value - 1) <= _UNIT_TOLERANCE:
                return name, f"Multiply `x_m` and `y_m` by {1 / value:.4g}", True
    if is_coarse(spans, resolution_m):
        return "", "Log positions with more decimals", False
    if _is_winding(spans):
        return "", f"{_METRES}, log positions more often", False
    for name, value in sorted(
        _SPEEDS.items(), key=lambda item: abs(ratio / item[1] - 1)
    ):
        if (
            abs(ratio / value - 1) <= _UNIT_TOLERANCE
            and _n_straight(spans) >= MIN_SPANS
        ):
            also = f" (`commanded_m_s` too, if it is in {name})"
            return name, f"Multiply `measured_m_s` by {value:.4g}{also}", False
    return "", _METRES, False


def _in_seconds(rows: pd.DataFrame, value: float, least_speed: float) -> pd.DataFrame:
    """Return the spans of rows whose times are in a unit of `value` seconds."""
    return spans_of(track_of(rows.assign(time_s=rows["time_s"] * value)), least_speed)


def unit_of_command(
    rows: pd.DataFrame, spans: pd.DataFrame, least_speed: float, *, is_geographic: bool
) -> tuple[float, str, str] | None:
    """Return the unit that explains the ratio of positions to the command.

    The ratio is λ. Only an implausible λ indicates another unit.

    Args:
        rows: rows of a log.
        spans: spans of these rows.
        least_speed: minimum command of spans that count, in m/s.
        is_geographic: whether positions are angles, which have no other unit.

    Returns:
        The ratio, the units that explain it, and the remedy; None if the ratio may be
        λ.
    """
    ratios = spans["moved"] / spans["commanded"]
    ratio, fastest = float(ratios.median()), float(ratios.quantile(_FASTEST))
    if (
        spans["measured"] / spans["commanded"]
    ).median() < _SLIPS:  # so that the robot did move at that speed
        fastest = ratio
    is_slow, is_fast = fastest < _COMMAND_LIMITS[0], ratio > _COMMAND_LIMITS[1]
    if math.isnan(ratio) or not (is_slow or ratio > _PLAUSIBLE[1]):
        return None
    units, remedies = [], []
    for name, value in _TIMES.items():
        in_unit = _in_seconds(rows, value, least_speed)
        traversability = float((in_unit["moved"] / in_unit["commanded"]).median())
        is_off = is_slow if value < 1 else traversability * value > _COMMAND_LIMITS[1]
        if is_off and _PLAUSIBLE[0] <= traversability <= _PLAUSIBLE[1]:
            units.append(name)
            remedies.append(f"multiply `time_s` by {value:.4g}")
    for name, value in _LENGTHS.items() if is_fast and not is_geographic else ():
        if _PLAUSIBLE[0] <= ratio / value <= _PLAUSIBLE[1]:
            units.append(name)
            remedies.append(f"multiply `x_m` and `y_m` by {1 / value:.4g}")
    if not (units or is_slow or is_fast):
        return None
    if not units:
        remedies = [
            "log `time_s` in seconds and positions in metres, or `measured_m_s` where "
            "the robot was immobilised"
        ]
    remedy = " or ".join(remedies)
    return (
        ratio,
        " or ".join(units) or "no unit that is known",
        remedy[0].upper() + remedy[1:],
    )
