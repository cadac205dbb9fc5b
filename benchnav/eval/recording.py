"""Recordings of episodes, and their files.

Viewer files, videos and figures of episodes are created from recordings only; they need
neither dataset nor prediction. Letters in shapes: N steps, H×W cells, S state and A
action dimensions, P points, W wheels or other contacts.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from benchnav.core.grid import Grid
from benchnav.core.store import replacing
from benchnav.eval.folder.run_folder import damaged
from benchnav.eval.recorded_plans import (
    DrawnPlan,
    KnownMap,
    pack_known,
    pack_plans,
    thinned,
    under,
    unpack_known,
    unpack_plans,
)
from benchnav.planning.world.outcome import Outcome

# File of a run folder with the map on which figures show driven paths.
GROUND = "ground.npz"
# Columns that identify a map with one draw of λ.
MAP = ["data", "scenario", "world", "seed", "realisation", "map"]
# Time of the plan that figures show: about half the length of most episodes. The paper
# shows 25 s, when most robots in BenchNav have reached the goal.
MOMENT_S = 15.0
_DRAW_EVERY_S = 0.5  # time between drawn plans


@dataclass(frozen=True, kw_only=True)
class RecordedMap:
    """A map with one draw of λ, on which figures show driven paths.

    Args:
        about: columns that identify the map and the draw of λ (`MAP`), with values.
        resolution_m: edge length of a cell in metres.
        rgb: colour image, uint8, shape [3, H, W].
        field: λ of all cells, shape [H, W]; None if λ is resampled at each step.
        immobilising: cells whose λ immobilises a robot, bool, shape [H, W].
        goal_m: position of the goal (x, y) in metres, shape [2].
    """

    about: Mapping[str, Any]
    resolution_m: float
    rgb: np.ndarray
    field: np.ndarray | None
    immobilising: np.ndarray
    goal_m: np.ndarray

    _REMEDY: ClassVar[str] = "Remove the file; the run's command creates it again."

    @property
    def grid(self) -> Grid:
        """Grid of the map."""
        height, width = self.immobilising.shape
        return Grid(height, width, self.resolution_m)

    def save(self, path: Path) -> None:
        """Write an `.npz` file atomically: arrays by name, other values as JSON."""
        arrays: dict[str, Any] = {}
        scalars = {}
        for name, value in self._stored().items():
            if isinstance(value, np.ndarray):
                arrays[name] = value
            else:
                scalars[name] = value
        text = np.array(json.dumps(scalars))
        with replacing(path) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, scalars=text, **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a file that `save` wrote.

        Raises:
            ConfigError: If the file is damaged.
        """
        with damaged(path, cls._REMEDY), np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
            scalars = json.loads(str(arrays.pop("scalars")))
            return cls._read(scalars | arrays)

    def _stored(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @classmethod
    def _read(cls, values: dict[str, Any]) -> Self:
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class Recording(RecordedMap):
    """An episode from its start to its end, on its map.

    `about` contains all labels of the episode, `condition` and `outcome`, all as text.

    Args:
        elevation_m: elevation in metres, shape [H, W].
        true_mean: mean of the true distribution of λ, shape [H, W].
        soft: cells of classes with soft spots, which no image shows, bool, shape
            [H, W].
        predicted: λ̂, the planner's map at the start, shape [H, W].
        free: free mask S_free at the start, bool, shape [H, W].
        free_by: map that determines free cells: `risk` (λ̂) or `mean` (E[λ]).
        free_above: threshold in [0, 1] that this map exceeds in free cells.
        dt_s: time step in seconds.
        time_budget_s: time budget T in seconds.
        action_names: name and unit of each action dimension, length A.
        states: robot states, each beginning with (x, y, θ), shape [N + 1, S].
        actions: commanded actions, shape [N, A].
        traversability: observed λ, shape [N].
        plans: plans in order of steps, up to the episode's end.
        layers: optional layers of the map, by name, each of shape [H, W].
        known: the robot's known maps, in order of steps; empty if the robot does not
            learn.
        body: values of the robot's body by name, each of shape [N + 1, ...]; empty for
            a point. Robots with a footprint have `contacts_m`, and rigid bodies all
            values of `PhysicsSimulation.drawn`.
    """

    elevation_m: np.ndarray
    true_mean: np.ndarray
    soft: np.ndarray
    predicted: np.ndarray
    free: np.ndarray
    free_by: str
    free_above: float
    dt_s: float
    time_budget_s: float
    action_names: tuple[str, ...]
    states: np.ndarray
    actions: np.ndarray
    traversability: np.ndarray
    plans: Sequence[DrawnPlan] = ()
    layers: Mapping[str, np.ndarray] = field(default_factory=dict)
    known: tuple[KnownMap, ...] = ()
    body: Mapping[str, np.ndarray] = field(default_factory=dict)

    _REMEDY: ClassVar[str] = (
        "Remove the file and its .rrd; `replay` creates both again."
    )

    @property
    def title(self) -> str:
        """Labels and outcome, for readers."""
        named = ("planner", "risk", "model", "scenario", "map", "outcome")
        return ", ".join(self.about[name] for name in named)

    @property
    def outcome(self) -> str:
        """Outcome in words."""
        return self.about["outcome"].replace("_", " ")

    @property
    def track(self) -> np.ndarray:
        """Driven positions (x, y) in metres, shape [N + 1, 2]."""
        return self.states[:, :2]

    @property
    def end_s(self) -> float:
        """Time of the end of the episode, in seconds."""
        return len(self.traversability) * self.dt_s

    @property
    def contacts_m(self) -> np.ndarray | None:
        """Contacts (x, y) with the terrain, shape [N + 1, W, 2]; None for a point."""
        return self.body.get("contacts_m")

    @property
    def ruts_m(self) -> np.ndarray | None:
        """Depths of ruts in metres, shape [N + 1, W]; None without recorded ruts."""
        return self.body.get("ruts_m")

    @property
    def immobilised_at(self) -> np.ndarray | None:
        """Position (x, y) of an immobilised robot; None for any other outcome."""
        is_immobilised = self.about["outcome"] == Outcome.IMMOBILISED.name.lower()
        return self.track[-1] if is_immobilised else None

    @property
    def predicted_at_end(self) -> float:
        """λ̂ at the last position; NaN outside the map."""
        cell = self.track[-1].astype(np.float64) / self.resolution_m
        column, row = np.floor(cell).astype(int)
        inside = 0 <= row < self.grid.height and 0 <= column < self.grid.width
        return float(self.predicted[row, column]) if inside else float("nan")

    @property
    def own_plans(self) -> list[DrawnPlan]:
        """Plans up to the last step; if the episode has no step, the first plan."""
        last = max(len(self.traversability) - 1, 0)
        return [plan for plan in self.plans if plan.step <= last]

    @property
    def plan(self) -> DrawnPlan:
        """The plan that figures show: at `MOMENT_S`, or at half the time of the end."""
        return self.plan_at(min(MOMENT_S, self.end_s / 2))

    @property
    def now(self) -> int:
        """The step that figures show: the step of `plan`, else the last step."""
        last = len(self.traversability)
        return min(self.plan.step, last) if self.own_plans else last

    def plan_at(self, time_s: float) -> DrawnPlan:
        """Return the last plan up to a time; an empty plan before the first plan."""
        last_step = time_s / self.dt_s + 1e-6
        plans = [plan for plan in self.own_plans if plan.step <= last_step]
        return plans[-1] if plans else DrawnPlan(step=0, lines={})

    def known_at(self, step: int) -> KnownMap | None:
        """Return the robot's known map at a step; None if the robot does not learn."""
        for known_map in reversed(self.known):
            if known_map.step <= step:
                return known_map
        return None

    def given_at(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the planner's λ̂ and S_free at a step, each of shape [H, W]."""
        known_map = self.known_at(step)
        if known_map is None:
            return self.predicted, self.free
        return known_map.predicted, known_map.free

    def _stored(self) -> dict[str, Any]:
        """Return the values, with plans and known maps packed into few arrays.

        Plans are thinned, except the plan that figures show.
        """
        values = super()._stored()
        del values["plans"]
        values |= pack_known(values.pop("known"))
        for group in ("layers", "body"):
            for name, array in values.pop(group).items():
                values[f"{group}:{name}"] = array
        shown = self.plan.step
        plans = []
        for plan in self.own_plans:
            plans.append(plan if plan.step == shown else thinned(plan))
        return values | pack_plans(plans)

    @classmethod
    def _read(cls, values: dict[str, Any]) -> Self:
        layers = under("layers:", values)
        body = under("body:", values)
        plans = under("plans:", values)
        known_maps = under("known:", values)
        scalars = {name: value for name, value in values.items() if ":" not in name}
        scalars["action_names"] = tuple(scalars["action_names"])
        return cls(
            **scalars,
            layers=layers,
            body=body,
            plans=unpack_plans(plans),
            known=unpack_known(known_maps) if known_maps else (),
        )


def read_recordings(folder: Path) -> list[Recording]:
    """Read all recorded episodes of a run."""
    return [
        Recording.load(path) for path in sorted((folder / "playback").glob("*.npz"))
    ]


def drawing_interval(dt_s: float) -> int:
    """Return the number of steps between plans that are drawn."""
    return max(1, round(_DRAW_EVERY_S / dt_s))
