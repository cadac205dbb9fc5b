"""Log of a robot's drives: positions, speeds, and the resulting λ.

Each row describes one moment of a drive. The columns are:

- `time_s`: time in seconds;
- `x_m` and `y_m`: position in the coordinate reference system of the elevation model;
  or `longitude_deg` and `latitude_deg`: position in WGS 84;
- `commanded_m_s` and `measured_m_s`: forward speed over ground;
- `drive`: name of the drive, optional.

λ is the ratio of measured to commanded speed in rows with a command to move. The ratio
of a row may lie outside [0, 1], since robots slide back and run downhill. It is clipped
only when it is stored. Letters in shapes: N used rows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.core.errors import DatasetError, expect
from benchnav.core.sources import digest_of_path
from benchnav.datagen.files.robot_logs import (
    ENDINGS,
    read_log,
    read_names,
    read_numbers,
    require_columns,
)

# Thresholds that this package chooses without a source are marked "(choice)".
MIN_SPEED_M_S = 0.1
# Off-road robots are slower. A higher speed indicates another unit, km/h or cm/s.
MAX_SPEED_M_S = 15.0
# Ratio of speed to the highest commanded speed that no robot exceeds (choice).
TOP_RATIO = 1.5
# Ratio of speed to command that is rarely exceeded, due to noise or downhill (choice).
OVER_SPEED = 1.2
# Limits of the ratio of the distance by positions to the distance by measured speed,
# within which the two count as equal (choice).
PACE_LIMITS = (0.85, 1.15)
MAX_FAULTY = 0.1  # maximum fraction of rows with faults of one kind (choice)
POSITION_COLUMNS = {"crs": ("x_m", "y_m"), "WGS 84": ("longitude_deg", "latitude_deg")}
_SPEED_COLUMNS = ("commanded_m_s", "measured_m_s")
_METRES_PER_DEGREE = 111_320  # per degree of latitude
_LIMITS = {"longitude_deg": (-180.0, 360.0), "latitude_deg": (-90.0, 90.0)}
_TIME_REMEDY = "Convert clock times to seconds, such as since the start of the drive."

# Reasons why rows are left out, in the order of the checks.
REASONS = {
    "missing": "lack a value or neighbouring positions",
    "off_dem": "lie off the elevation model",
    "doubled": "repeat another row",
    "restarted": "have a time before an earlier row of their drive",
    "frozen": "have a position that stays the same while the robot moves",
    "jumped": f"have a position out of reach at {TOP_RATIO:g} times the top command",
    "off_pace": "belong to a drive whose positions and measured speed disagree by more "
    "than 15 %",
    "slow": "have a commanded speed below `least_speed` (standing, turning in place)",
    "implausible": f"have a speed above {MAX_SPEED_M_S:g} m/s or above {TOP_RATIO:g} "
    "times the top command",
    "between_maps": "lie between the maps",
    "other_split": "lie on the terrain of a split that their drive does not belong to",
}


@dataclass(frozen=True, kw_only=True)
class Drives:
    """File of a log of drives, and the selection of its rows.

    Args:
        file: Path of the table: CSV, TSV, one of these with .gz, or Parquet.
        least_speed: Minimum commanded speed of used rows, forward or backward [m/s].
        speed: Source of the speed over ground: `positions`, or `measured` for the
            logged speed without a comparison with positions. If empty, measured speed,
            which must agree with the positions.
    """

    file: str
    least_speed: float = MIN_SPEED_M_S
    speed: Literal["", "positions", "measured"] = ""

    def __post_init__(self) -> None:
        """Validate the settings."""
        expect(
            self.file.endswith(ENDINGS),
            f"`drives` to end in one of {', '.join(ENDINGS)}, got {self.file!r}. "
            "Save the log as a table in one of these formats, with a header.",
        )
        expect(
            0 < self.least_speed < np.inf,
            f"`least_speed` above 0 m/s and finite, got {self.least_speed:g}.",
        )
        expect(
            self.speed in ("", "positions", "measured"),
            f"`speed` to be 'positions', 'measured' or empty, got {self.speed!r}.",
        )


@dataclass(frozen=True, kw_only=True)
class DriveLog:
    """Used rows of a log, and the number of left-out rows.

    Args:
        settings: path of the file, and the selection of its rows.
        sha256: SHA-256 digest of the file.
        names: names of the drives.
        is_geographic: whether positions are longitude and latitude; else they are in
            the elevation model's CRS.
        rows: table of N rows: `x`, `y`, `time_s`, `commanded` and `speed` (m/s,
            signed), `drive` (index into `names`) and, once speeds are compared with
            positions, `traversability` (ratio of `speed` to `commanded`).
        left_out: number of unused rows by reason.
        motion: results of the comparison of positions with speeds, and `resolution_m`,
            the resolution of positions.
    """

    settings: Drives
    sha256: str
    names: tuple[str, ...]
    is_geographic: bool
    rows: pd.DataFrame
    left_out: Mapping[str, int] = field(default_factory=dict)
    motion: Mapping[str, Any] = field(default_factory=dict)

    @property
    def positions_m(self) -> ndarray:
        """Positions northward and eastward in metres, float64, shape [N, 2]."""
        return self.rows[["y", "x"]].to_numpy()

    @property
    def resolution_m(self) -> float:
        """Resolution of positions in metres; 0 if below centimetres or unknown."""
        return float(self.motion.get("resolution_m", 0.0))

    def without(self, reason: str, mask: ndarray) -> "DriveLog":
        """Return the log without some rows.

        Args:
            reason: key of `REASONS`.
            mask: mask of the rows to leave out, bool, shape [N].

        Raises:
            DatasetError: If no row remains.
        """
        left_out = {**self.left_out, reason: int(mask.sum())}
        if mask.all():
            raise self._no_row_error(left_out)
        rows = self.rows[~mask].reset_index(drop=True)
        return replace(self, rows=rows, left_out=left_out)

    def _no_row_error(self, left_out: Mapping[str, int]) -> DatasetError:
        counts = {name: count for name, count in left_out.items() if count}
        why = " below the header"
        if counts:
            reasons = [f"{count} {REASONS[name]}" for name, count in counts.items()]
            why = f": of {sum(counts.values())} rows, {', '.join(reasons)}"
        speeds = "both speeds"
        if self.settings.speed == "positions":
            speeds = "commanded speed"
        return DatasetError(
            f"Expected usable rows of drives in {self.settings.file}, got "
            f"none{why}. Log time, position and {speeds} while the robot moves."
        )


def read_drives(drives: Drives) -> DriveLog:
    """Return a log of drives, without rows that lack a value.

    If `drives.speed` is `positions`, the file need not contain measured speed.

    Raises:
        DatasetError: If the file is missing, cannot be read, lacks a column, contains
            invalid numbers or speeds that are not in m/s, or no row remains.
    """
    path = Path(drives.file)
    rows = read_log(path)
    by_positions = drives.speed == "positions"
    speed_names = _SPEED_COLUMNS[:1] if by_positions else _SPEED_COLUMNS
    has_crs = set(POSITION_COLUMNS["crs"]) <= set(rows)
    is_geographic = not has_crs and set(POSITION_COLUMNS["WGS 84"]) <= set(rows)
    position_names = POSITION_COLUMNS["WGS 84" if is_geographic else "crs"]
    columns = ("time_s", *position_names, *speed_names)
    _require_columns(rows, columns, path)
    values = {name: _read_column(rows, name, path) for name in columns}
    for name in speed_names:
        speed = np.abs(values[name])
        moving = speed[speed >= drives.least_speed]
        median_speed = pd.Series(moving).median()
        if median_speed > MAX_SPEED_M_S:
            raise DatasetError(
                f"Expected `{name}` in m/s in {path}, got a median of "
                f"{median_speed:.4g} while moving, which looks like "
                "another unit. Divide km/h by 3.6, cm/s by 100 and mm/s by 1000."
            )
    drive_names = np.array([path.name])
    drive = np.zeros(len(rows), dtype=np.int64)
    if "drive" in rows:
        names_by_row = read_names(rows, "drive", path)
        drive_names, drive = np.unique(names_by_row, return_inverse=True)
    x, y = (values[name] for name in position_names)
    measured = values.get("measured_m_s", np.full(len(rows), np.nan))
    if by_positions and "measured_m_s" in rows:
        # Measured speed is only compared with positions here, so it has no limits.
        measured = read_numbers(rows, "measured_m_s", path, (-np.inf, np.inf))
    table = pd.DataFrame(
        {
            "x": x,
            "y": y,
            "time_s": values["time_s"],
            "commanded": values["commanded_m_s"],
            "speed": measured,
            "drive": drive,
        }
    )
    resolution_m = _resolution_m(x, y, is_geographic=is_geographic)
    log = DriveLog(
        settings=drives,
        sha256=digest_of_path(path),
        names=tuple(map(str, drive_names)),
        is_geographic=is_geographic,
        rows=table,
        motion={"resolution_m": resolution_m},
    )
    is_missing = np.isnan(np.stack([*values.values()])).any(axis=0)
    return log.without("missing", is_missing)


def _require_columns(rows: pd.DataFrame, columns: Sequence[str], path: Path) -> None:
    """Raise an error with a remedy if a log lacks a column."""
    missing = set(columns) - set(rows)
    remedy = "Name positions x_m and y_m, or longitude_deg and latitude_deg for WGS 84."
    if missing.isdisjoint((*POSITION_COLUMNS["crs"], *POSITION_COLUMNS["WGS 84"])):
        remedy = ""
        if missing & {*_SPEED_COLUMNS} == {"measured_m_s"}:
            remedy = "Log speed over ground, or pass --speed positions."
    require_columns(rows, columns, path, remedy)


def _read_column(rows: pd.DataFrame, name: str, path: Path) -> ndarray:
    """Return the numbers of a column, or raise an error with a remedy."""
    limits = _LIMITS.get(name, (-np.inf, np.inf))
    swapped = "Swap `longitude_deg` and `latitude_deg`, or convert to degrees."
    number = "Convert the column to numbers."
    if name == "time_s":
        number = _TIME_REMEDY
    return read_numbers(rows, name, path, limits, swapped, number)


def _resolution_m(x: ndarray, y: ndarray, *, is_geographic: bool) -> float:
    """Return the largest power of ten that divides all positions, as metres.

    The result is 0 if it would be less than a few centimetres.

    Args:
        x: eastward coordinates in metres, or longitudes in degrees.
        y: northward coordinates in metres, or latitudes in degrees.
        is_geographic: whether positions are longitudes and latitudes.
    """
    max_decimals = 6 if is_geographic else 2
    metres = _METRES_PER_DEGREE if is_geographic else 1
    for decimals in range(max_decimals):
        scaled = np.stack([x, y]) * 10.0**decimals
        scaled = scaled[:, np.isfinite(scaled).all(axis=0)]
        distance = np.abs(scaled - np.rint(scaled))
        if scaled.size and (distance < 1e-3).all():
            step_m = 10.0**-decimals * metres
            return float(f"{step_m:.3g}")
    return 0.0
