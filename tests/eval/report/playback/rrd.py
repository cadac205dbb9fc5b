"""Reading `.rrd` files back, for tests."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader


def verify(path: Path) -> None:
    """Lets the viewer's own program check a file."""
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = ["rerun", "rrd", "verify", str(path)]
    subprocess.run(
        command, check=True, capture_output=True, env={**os.environ, "PATH": programs}
    )


def chunks(path: Path) -> dict[str, list[pa.RecordBatch]]:
    """What is logged, by entity."""
    found: dict[str, list[pa.RecordBatch]] = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def column(path: Path, entity: str, name: str) -> tuple[np.ndarray, list[object]]:
    """Times in seconds and values of a component, in order of time."""
    found = []
    for batch in chunks(path).get(entity, []):
        if "time" not in batch.schema.names:
            continue
        times = (
            batch.column("time")
            .to_numpy(zero_copy_only=False)
            .astype("timedelta64[ns]")
            .astype(np.int64)
        )
        values = batch.column(
            next(n for n in batch.schema.names if n.endswith(name))
        ).to_pylist()
        found += list(zip(times * 1e-9, values, strict=True))
    found.sort(key=lambda pair: pair[0])
    return np.array([time for time, _ in found]), [value for _, value in found]


def static(path: Path, entity: str, name: str) -> np.ndarray:
    """The value of a component that is logged once for all times."""
    for batch in chunks(path)[entity]:
        column_name = next((n for n in batch.schema.names if n.endswith(name)), None)
        if "time" not in batch.schema.names and column_name:
            (value,) = batch.column(column_name).to_pylist()
            return np.array(value)
    raise KeyError(f"{entity} {name}")


def image(path: Path, entity: str, shape: tuple[int, int] = (40, 60)) -> np.ndarray:
    """An image as the map has it: its first row is at the bottom."""
    return static(path, entity, "buffer").astype(np.uint8).reshape(*shape, 3)[::-1]


def read_path(
    path: Path, entity: str = "/world/robot"
) -> tuple[np.ndarray, np.ndarray]:
    """A robot's path: times in seconds, [N + 1], and positions (x, y, z) in metres, [N
    + 1, 3].
    """
    times, positions = column(path, entity, "positions")
    return times, np.array([place for (place,) in positions], np.float32)  # type: ignore[misc]
