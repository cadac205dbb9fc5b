"""The log of a robot's drives: where it drove, what it was told and what it did, and the λ that follows.

A row is a moment of a drive. Columns: `time_s`; the position, `x_m` and `y_m` in the coordinate reference system of the
elevation model or `longitude_deg` and `latitude_deg` (WGS 84); `commanded_m_s` and `measured_m_s`, speeds forward over
ground; and perhaps `drive`, its name. λ is measured over commanded speed. That says something of the ground only where
the robot was to move, so rows with a slow command are left out, as are those of a ratio that no ground explains.
Letters in shapes: N rows that are used.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy import ndarray

from benchnav.core.errors import DatasetError, expect
from benchnav.core.sources import digest_of_path
from benchnav.datagen.files.robot_logs import ENDINGS, read_log, read_names, read_numbers, require_columns

LEAST_SPEED_M_S = 0.1
RATIO_LIMITS = (-0.2, 1.2)  # of measured to commanded speed; noise of a speed beyond 0 and 1 is clipped
MOST_SPEED_M_S = 15.0  # off-road robots are slower, unless they are logged in km/h or cm/s
_MOVES = ("commanded_m_s", "measured_m_s")
_PLACES = {"crs": ("x_m", "y_m"), "WGS 84": ("longitude_deg", "latitude_deg")}
_WINDOW_S = 2.0  # over which the noise of positions is small beside the way

# Why rows are left out, in the order of being found.
REASONS = {
    "missing": "lack a value",
    "slow": "were commanded less than the least speed (standing, turning on the spot)",
    "implausible": f"have a measured speed below {RATIO_LIMITS[0]:g} or above {RATIO_LIMITS[1]:g} of the commanded one",
    "off_dem": "lie off the elevation model",
    "between_maps": "lie between the maps",
    "other_split": "lie on the ground of a split that their drive does not belong to",
}


@dataclass(frozen=True, kw_only=True)
class Drives:
    """A log of drives, and what of it is used.

    Args:
        file: Table, CSV, TSV, one of these with .gz, or Parquet.
        least_speed: Least commanded speed of a row, forward or backward, m/s.
    """

    file: str
    least_speed: float = LEAST_SPEED_M_S

    def __post_init__(self) -> None:
        """Refuses what is no log or no speed."""
        expect(
            self.file.endswith(ENDINGS), f"`drives` to end in one of {', '.join(ENDINGS)}, got {self.file!r}."
        )
        expect(0 < self.least_speed < np.inf, f"`least_speed` above 0 m/s, got {self.least_speed:g}.")


@dataclass(frozen=True, kw_only=True)
class DriveLog:
    """What is used of a log.

    Args:
        settings: the file, and what of it is used.
        sha256: of the file.
        names: of its drives.
        is_geographic: whether positions are longitude and latitude; else they are in the elevation model's CRS.
        rows: a table of N rows: `x`, `y`, `time_s`, `speed` (measured, m/s), `traversability` (in [0, 1]) and `drive`
            (index into `names`).
        left_out: rows that are not, by reason.
    """

    settings: Drives
    sha256: str
    names: tuple[str, ...]
    is_geographic: bool
    rows: pd.DataFrame
    left_out: Mapping[str, int] = field(default_factory=dict)

    @property
    def places_m(self) -> ndarray:
        """Positions northward and eastward, float64, shape [N, 2]."""
        return self.rows[["y", "x"]].to_numpy()

    def without(self, reason: str, which: ndarray) -> "DriveLog":
        """Leaves rows out.

        Args:
            reason: why, one of `REASONS`.
            which: bool, shape [N].

        Raises:
            DatasetError: all that were left.
        """
        left_out = {**self.left_out, reason: int(which.sum())}
        if which.all():
            several = [f"{count} {REASONS[name]}" for name, count in left_out.items() if count] or ["none"]
            raise DatasetError(
                f"Expected rows of drives to learn from in {self.settings.file}, got none: of "
                f"{sum(left_out.values())}, {', '.join(several)}. Log time, position and both speeds on "
                "the move."
            )
        about = {**vars(self), "rows": self.rows[~which].reset_index(drop=True), "left_out": left_out}
        return DriveLog(**about)


def read_drives(drives: Drives) -> DriveLog:
    """Reads a log of drives and leaves out the rows that tell nothing of the ground.

    Raises:
        DatasetError: there is no such file, it cannot be read, lacks a column, holds what is no number, has speeds of
            another unit, or no row is left.
    """
    path = Path(drives.file)
    rows = read_log(path)
    kind = "WGS 84" if set(_PLACES["WGS 84"]) <= set(rows) and not set(_PLACES["crs"]) <= set(rows) else "crs"
    columns = ("time_s", *_PLACES[kind], *_MOVES)
    require_columns(rows, columns, path)
    limits = {"longitude_deg": (-180.0, 360.0), "latitude_deg": (-90.0, 90.0)}
    values = {name: read_numbers(rows, name, path, limits.get(name, (-np.inf, np.inf))) for name in columns}
    commanded, measured = (values[name] for name in _MOVES)
    for name in _MOVES:
        moving = np.abs(values[name])
        usual = pd.Series(moving[moving >= drives.least_speed]).median()
        if usual > MOST_SPEED_M_S:
            raise DatasetError(
                f"Expected `{name}` in m/s in {path}, got a median of {usual:.4g} while moving, which looks like "
                "another unit. Divide km/h by 3.6 and cm/s by 100."
            )
    names, drive = np.array([path.name]), np.zeros(len(rows), dtype=np.int64)
    if "drive" in rows:
        names, drive = np.unique(read_names(rows, "drive", path), return_inverse=True)
    x, y = (values[name] for name in _PLACES[kind])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = measured / commanded
    log = DriveLog(
        settings=drives,
        sha256=digest_of_path(path),
        names=tuple(map(str, names)),
        is_geographic=kind == "WGS 84",
        rows=pd.DataFrame(
            {
                "x": x,
                "y": y,
                "time_s": values["time_s"],
                "commanded": np.abs(commanded),
                "speed": np.abs(measured),
                "traversability": ratio,
                "drive": drive,
            }
        ),
    )
    log = log.without("missing", np.isnan(np.stack([*values.values()])).any(axis=0))
    log = log.without("slow", (log.rows["commanded"] < drives.least_speed).to_numpy())
    low, high = RATIO_LIMITS
    log = log.without("implausible", ~log.rows["traversability"].between(low, high).to_numpy())
    log.rows["traversability"] = log.rows["traversability"].clip(0, 1)
    return log


def pace(rows: pd.DataFrame) -> float | None:
    """How far positions moved beside what the measured speed says, in the middle over spans of two seconds.

    Near 1 where positions, times and speeds are in the same units; less on tight curves.

    Args:
        rows: of `DriveLog`, with positions in metres.

    Returns:
        The ratio, to three digits after the point; None where no drive goes on so long.
    """
    rows = rows.sort_values(["drive", "time_s"])
    step_s = rows.groupby("drive")["time_s"].diff().fillna(0)
    way_m = (rows["speed"] * step_s).groupby(rows["drive"]).cumsum()
    span = (rows["time_s"] // _WINDOW_S).rename("span")
    firsts = rows[["x", "y"]].assign(way=way_m).groupby([rows["drive"], span]).first()
    moved = firsts.groupby("drive").diff().dropna()
    moved = moved[moved["way"] > 0]
    ratio = (np.hypot(moved["x"], moved["y"]) / moved["way"]).median()
    return round(float(ratio), 3) if len(moved) else None
