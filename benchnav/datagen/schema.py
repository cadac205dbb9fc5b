"""Dataset format 1.0: fields, manifest and content digest.

One HDF5 file is one dataset. Groups are splits; each holds the fields of `FIELDS`. The manifest is
a JSON text in the dataset `manifest`. A digest covers a split's logical arrays, not the file's
bytes, so it is the same whatever compression, machine or number of workers wrote the file.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

FORMAT = "benchnav-dataset"
FORMAT_VERSION = (1, 0)
MANIFEST = "manifest"


@dataclass(frozen=True)
class Field:
    """What one array of a split holds.

    Args:
        dtype: NumPy dtype in little-endian order.
        shape: shape of one map's entry; "H" and "W" stand for the grid.
        unit: SI unit, or "1".
        least: smallest value allowed.
        most: largest value allowed.
        meaning: one line for readers.
    """

    dtype: str
    shape: tuple[str | int, ...]
    unit: str
    least: float
    most: float
    meaning: str

    def entry_shape(self, height: int, width: int) -> tuple[int, ...]:
        """Shape of one map's entry on a grid."""
        sizes = {"H": height, "W": width}
        return tuple(sizes[n] if isinstance(n, str) else n for n in self.shape)


FIELDS: dict[str, Field] = {
    "rgb": Field("|u1", (3, "H", "W"), "1", 0, 255, "top-down colour image, shaded"),
    "class_id": Field("|u1", ("H", "W"), "1", 0, 255, "index into the class table"),
    "elevation_m": Field("<f4", ("H", "W"), "m", -1e4, 1e4, "elevation, in steps of 2^-13 m"),
    "slope_deg": Field("<f4", ("H", "W"), "deg", 0, 90, "slope by Horn's method, in steps of 2^-10 deg"),
    "traversability": Field("<f4", ("H", "W"), "1", 0, 1, "realised traversability, in steps of 2^-16"),
    "environment": Field("<i2", (), "1", 0, 32767, "environment of the map"),
    "start_m": Field("<f4", (2,), "m", 0, 1e6, "start position (x, y)"),
    "goal_m": Field("<f4", (2,), "m", 0, 1e6, "goal position (x, y)"),
    "reference_time_s": Field(
        "<f4", (), "s", 0, np.inf, "grid reference time at a commanded 1 m/s; NaN where not asked for"
    ),
}


def quantise(values: np.ndarray, bits: int) -> np.ndarray:
    """Rounds to multiples of 2^−bits, so that the last bits of a machine's arithmetic do not show."""
    return np.round(values * 2.0**bits) / 2.0**bits


class SplitDigest:
    """SHA-256 over the fields of a split, fed a block of maps at a time in order.

    Each field has a running hash of its little-endian bytes; the digest is the hash of the fields'
    names, dtypes, shapes and hashes. So it does not depend on how maps are cut into blocks.
    """

    def __init__(self) -> None:
        """Starts with no maps."""
        self._hashes = {name: hashlib.sha256() for name in FIELDS}
        self._shapes: dict[str, list[int]] = {name: [] for name in FIELDS}
        self._maps = 0

    def update(self, block: Mapping[str, np.ndarray]) -> None:
        """Adds a block of maps, each field of shape [B, *entry shape]."""
        for name, field in FIELDS.items():
            array = np.ascontiguousarray(block[name], dtype=field.dtype)
            self._hashes[name].update(array.tobytes())
            self._shapes[name] = list(array.shape[1:])
        self._maps += len(block["rgb"])

    def hexdigest(self) -> str:
        """The digest of all maps so far."""
        whole = hashlib.sha256()
        for name, field in FIELDS.items():
            whole.update(f"{name} {field.dtype} {[self._maps, *self._shapes[name]]} ".encode())
            whole.update(self._hashes[name].digest())
        return whole.hexdigest()


def field_table(height: int, width: int) -> dict[str, Any]:
    """Describes the fields for the manifest."""
    return {
        name: {
            "dtype": field.dtype,
            "shape": list(field.entry_shape(height, width)),
            "unit": field.unit,
            "meaning": field.meaning,
        }
        for name, field in FIELDS.items()
    }
