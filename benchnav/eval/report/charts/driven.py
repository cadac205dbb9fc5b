"""The map that whole driven paths are shown on: of a run, the one on which outcomes differ most."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.store import replacing
from benchnav.eval.folder.folder import EPISODES, damaged, read_table
from benchnav.eval.folder.steps import STEPS, read_steps

GROUND = "ground.npz"
# What one map under one draw of λ is known by.
MAP = ("data", "scenario", "world", "seed", "realisation", "map")

_ARRAYS = ("rgb", "immobilising", "goal_m")


@dataclass(frozen=True, kw_only=True)
class DrivenGround:
    """The map of the figure.

    Args:
        about: which map and draw, by the names of `MAP`.
        resolution_m: edge length of a cell.
        rgb: uint8, shape [3, H, W].
        field: λ as it was, shape [H, W]; None where it was resampled.
        immobilising: cells of the field that immobilise a robot, bool, shape [H, W].
        goal_m: (x, y).
    """

    about: Mapping[str, Any]
    resolution_m: float
    rgb: np.ndarray
    field: np.ndarray | None
    immobilising: np.ndarray
    goal_m: np.ndarray

    def save(self, path: Path) -> None:
        """Writes the map, whole or not at all."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {} if self.field is None else {"field": self.field}
        text = json.dumps({"about": dict(self.about), "resolution_m": self.resolution_m})
        with replacing(path) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, scalars=np.array(text), **arrays)

    @classmethod
    def load(cls, path: Path) -> "DrivenGround":
        """Reads what `save` wrote.

        Raises:
            ConfigError: the file is damaged.
        """
        remedy = "Remove it; the run's command makes it again."
        with damaged(path, remedy), np.load(path, allow_pickle=False) as stored:
            scalars = json.loads(str(stored["scalars"]))
            arrays = {name: stored[name] for name in _ARRAYS}
            return cls(**scalars, field=stored.get("field"), **arrays)


def telling_map(episodes: pd.DataFrame) -> dict[str, Any]:
    """Chooses the map and the draw of λ on which about as many conditions succeed as fail.

    Of several such the one that most conditions were run on, then the first.

    Args:
        episodes: rows of a run.

    Returns:
        What the map is known by, by the names of `MAP`.
    """
    groups = episodes.groupby(list(MAP), sort=False)["success"]
    counted = pd.DataFrame({"conditions": groups.size(), "successes": groups.sum()}).reset_index()
    counted["differing"] = np.minimum(counted["successes"], counted["conditions"] - counted["successes"])
    best = counted.sort_values(["differing", "conditions"], ascending=False, kind="stable").iloc[0]
    return {
        name: value.item() if hasattr(value, "item") else value for name, value in best[list(MAP)].items()
    }


def read_driven(folder: Path) -> tuple[DrivenGround, pd.DataFrame, list[np.ndarray]] | None:
    """Reads whole driven paths on the map that a run kept; nothing where it kept none, or no steps.

    Args:
        folder: a finished run.

    Returns:
        The map; of each condition its episode there; and the driven positions of each, shape [N + 1, 2].
    """
    path = folder / GROUND
    if not path.exists() or not (folder / STEPS).is_dir():
        return None
    ground, rows = DrivenGround.load(path), read_table(folder, EPISODES)
    rows = rows[np.logical_and.reduce([rows[name] == ground.about[name] for name in MAP])]
    place = {name: ground.about[name] for name in ("seed", "realisation", "map")}
    steps = [read_steps(folder, condition=condition, **place) for condition in rows["condition"]]
    kept = [len(own) > 0 for own in steps]
    tracks = [own[["x_m", "y_m"]].to_numpy() for own in steps if len(own)]
    return (ground, rows[kept], tracks) if tracks else None
