"""Snapshots in run folders of format version 2, which held one moment of an episode and no whole recording."""

import json
import zipfile
import zlib
from pathlib import Path

import numpy as np

from benchnav.errors import ConfigError
from benchnav.eval.report.recorded.drawn_plan import DrawnPlan, cut
from benchnav.eval.report.recorded.snapshot import Snapshot

_ARRAYS = ("rgb", "predicted", "free", "extent_m", "goal_m", "track", "traversability")
_GROUND = ("field", "soft", "holding")
# What reading a damaged archive raises.
DAMAGE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


def is_snapshot(path: Path) -> bool:
    """Tells a snapshot of version 2 from a recording."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            return "track" in stored
    except DAMAGE:
        return False


def read_snapshot(path: Path) -> Snapshot:
    """Reads a snapshot; of the ground, the first of them tell nothing, which reads as none.

    Args:
        path: an `.npz` file.

    Raises:
        ConfigError: the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            scalars = json.loads(str(stored["scalars"]))
            arrays = {name: stored[name] for name in _ARRAYS}
            ground = {name: stored[name] for name in _GROUND if name in stored}
            lines = {n: cut(stored[f"points_{n}"], stored[f"sizes_{n}"]) for n in scalars["layers"]}
    except DAMAGE as error:
        raise ConfigError(f"{path} is damaged: {error}. Remove it; `replay` makes it again.") from error
    none = np.zeros_like(arrays["free"])
    ground = {"field": None, "soft": none, "holding": none} | ground
    plan = DrawnPlan(step=scalars["step"], lines=lines)
    return Snapshot(about=scalars["about"], dt_s=scalars["dt_s"], plan=plan, **arrays, **ground)
