"""An episode at one moment, with all that the figure of trajectories shows of it.

It is stored beside the recording, so that figures need neither the dataset nor a prediction.
Letters in shapes: N steps, H×W cells.
"""

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchnav.errors import ConfigError
from benchnav.eval.report.drawn_plan import DrawnPlan
from benchnav.files import replacing

# Half-way for most episodes; the paper shows 25 s, when robots here have mostly arrived.
SNAPSHOT_S = 15.0

_ARRAYS = ("rgb", "predicted", "free", "extent_m", "goal_m", "track", "traversability")
_GROUND = ("field", "soft", "holding")
_DAMAGE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)
_POINTS, _SIZES = "points_", "sizes_"


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """One panel of the trajectory figure.

    Args:
        about: `trial`, its labels, `seed`, `realisation`, `instance` and `outcome`, as text.
        rgb: uint8, shape [3, H, W].
        predicted: λ̂, the map the planner was given, shape [H, W].
        free: S_free, bool, shape [H, W].
        field: λ as it was through the episode, shape [H, W]; None where it was resampled.
        soft: ground with soft spots that do not show, bool, shape [H, W].
        holding: cells of the field that hold a robot for good, bool, shape [H, W].
        extent_m: size of the map along x and y, shape [2].
        goal_m: (x, y).
        dt_s: time step.
        track: driven positions to the end, shape [N + 1, 2].
        traversability: λ met, shape [N].
        plan: what was planned at that moment, or last before it.
    """

    about: Mapping[str, str]
    rgb: np.ndarray
    predicted: np.ndarray
    free: np.ndarray
    field: np.ndarray | None
    soft: np.ndarray
    holding: np.ndarray
    extent_m: np.ndarray
    goal_m: np.ndarray
    dt_s: float
    track: np.ndarray
    traversability: np.ndarray
    plan: DrawnPlan

    @property
    def now(self) -> int:
        """Index into `track` of the moment."""
        return min(self.plan.step, len(self.track) - 1)

    @property
    def time_s(self) -> float:
        """The moment."""
        return self.now * self.dt_s

    def save(self, path: Path) -> None:
        """Writes the snapshot, whole or not at all.

        Args:
            path: an `.npz` file.
        """
        arrays = {name: getattr(self, name) for name in (*_ARRAYS, *_GROUND)}
        if self.field is None:
            del arrays["field"]
        for name, lines in self.plan.lines.items():
            arrays[_POINTS + name] = np.concatenate([np.empty((0, 2), np.float32), *lines])
            arrays[_SIZES + name] = np.array([len(line) for line in lines], dtype=np.int64)
        scalars: dict[str, object] = {"about": dict(self.about), "dt_s": self.dt_s, "step": self.plan.step}
        scalars["layers"] = list(self.plan.lines)
        with replacing(path) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, scalars=np.array(json.dumps(scalars)), **arrays)

    @classmethod
    def load(cls, path: Path) -> "Snapshot":
        """Reads what `save` wrote; of the ground, earlier versions wrote nothing, which reads as none.

        Raises:
            ConfigError: the file is damaged.
        """
        try:
            with np.load(path, allow_pickle=False) as stored:
                scalars = json.loads(str(stored["scalars"]))
                arrays = {name: stored[name] for name in _ARRAYS}
                ground = {name: stored[name] for name in _GROUND if name in stored}
                lines = {
                    name: _cut(stored[_POINTS + name], stored[_SIZES + name]) for name in scalars["layers"]
                }
        except _DAMAGE as error:
            raise ConfigError(f"{path} is damaged: {error}. Remove it, or run the suite again.") from error
        plan = DrawnPlan(step=scalars["step"], lines=lines)
        none = np.zeros_like(arrays["free"])
        ground = {"field": None, "soft": none, "holding": none} | ground
        return cls(about=scalars["about"], dt_s=scalars["dt_s"], plan=plan, **arrays, **ground)


def _cut(points: np.ndarray, sizes: np.ndarray) -> list[np.ndarray]:
    ends = sizes.cumsum()
    return [points[end - size : end] for end, size in zip(ends, sizes, strict=True)]
