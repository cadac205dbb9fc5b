"""An episode with all that is played back of it, and the file that holds it.

Playback files, videos, comparisons and figures are made of that file alone, without dataset or prediction.
Letters in shapes: N steps, H×W cells, S state and A action dimensions.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchnav.core.grid import Grid
from benchnav.core.store import replacing
from benchnav.eval.folder.folder import damaged
from benchnav.eval.report.recorded.drawn_plan import DrawnPlan, join_plans, split_plans, thinned
from benchnav.eval.report.recorded.snapshot import SNAPSHOT_S, Snapshot

_ARRAYS = (
    *("rgb", "elevation_m", "true_mean", "predicted", "free", "soft", "immobilising"),
    *("goal_m", "states", "actions", "traversability"),
)
_PLANS = "plans:"


@dataclass(frozen=True, kw_only=True)
class Recording:
    """An episode of any robot, from its start to its end.

    Args:
        about: `condition`, its labels, `seed`, `realisation`, `map` and `outcome`, as text.
        grid: of the maps.
        rgb: uint8, shape [3, H, W].
        elevation_m: shape [H, W].
        true_mean: E[λ] of the truth, shape [H, W].
        predicted: λ̂, the map the planner was given, shape [H, W].
        free: S_free, bool, shape [H, W].
        free_by: the map that decides what is free, `risk` or `mean`.
        free_above: what that map has to exceed.
        field: λ as it was through the episode, shape [H, W]; None where it was resampled.
        soft: ground with soft spots that do not show, bool, shape [H, W].
        immobilising: cells of the field that immobilise a robot, bool, shape [H, W].
        goal_m: (x, y).
        dt_s: time step.
        time_budget_s: T.
        action_names: what each action is, with its unit, A of them.
        states: robot states beginning with (x, y, θ), shape [N + 1, S].
        actions: shape [N, A].
        traversability: observed λ, shape [N].
        plans: what was planned, in order of steps; those after the episode's end are left out.
    """

    about: Mapping[str, str]
    grid: Grid
    rgb: np.ndarray
    elevation_m: np.ndarray
    true_mean: np.ndarray
    predicted: np.ndarray
    free: np.ndarray
    free_by: str
    free_above: float
    field: np.ndarray | None
    soft: np.ndarray
    immobilising: np.ndarray
    goal_m: np.ndarray
    dt_s: float
    time_budget_s: float
    action_names: tuple[str, ...]
    states: np.ndarray
    actions: np.ndarray
    traversability: np.ndarray
    plans: Sequence[DrawnPlan]

    @property
    def title(self) -> str:
        """What it is, for people."""
        named = ("planner", "risk", "model", "scenario", "map", "outcome")
        return ", ".join(self.about[name] for name in named)

    @property
    def outcome(self) -> str:
        """How it ended, in words."""
        return self.about["outcome"].replace("_", " ")

    @property
    def end_s(self) -> float:
        """When it ended."""
        return len(self.traversability) * self.dt_s

    @property
    def own_plans(self) -> list[DrawnPlan]:
        """Plans up to the last step that was taken; the first is one of them, also where none was taken."""
        last = max(len(self.traversability) - 1, 0)
        return [plan for plan in self.plans if plan.step <= last]

    @property
    def moment_s(self) -> float:
        """The moment that figures show: `SNAPSHOT_S`, or half-way where the episode was short."""
        return min(SNAPSHOT_S, self.end_s / 2)

    def plan_at(self, time_s: float) -> DrawnPlan:
        """The last plan that was drawn by a time; an empty one where there is none."""
        due = time_s / self.dt_s + 1e-6
        known = [plan for plan in self.own_plans if plan.step <= due]
        return known[-1] if known else DrawnPlan(step=0, lines={})

    def save(self, path: Path) -> None:
        """Writes the recording, whole or not at all; plans are thinned but the one of figures.

        Args:
            path: an `.npz` file.
        """
        moment = self.plan_at(self.moment_s).step
        plans = [plan if plan.step == moment else thinned(plan) for plan in self.own_plans]
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {_PLANS + name: values for name, values in join_plans(plans).items()}
        if self.field is not None:
            arrays["field"] = self.field
        scalars = {
            "about": dict(self.about),
            "resolution_m": self.grid.resolution_m,
            "free": [self.free_by, self.free_above],
            "dt_s": self.dt_s,
            "time_budget_s": self.time_budget_s,
            "action_names": list(self.action_names),
        }
        with replacing(path) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, scalars=np.array(json.dumps(scalars)), **arrays)

    @classmethod
    def load(cls, path: Path) -> "Recording":
        """Reads what `save` wrote.

        Raises:
            ConfigError: the file is damaged.
        """
        with damaged(path, "Remove it and its .rrd; `replay` makes them again."):
            with np.load(path, allow_pickle=False) as stored:
                scalars = json.loads(str(stored["scalars"]))
                plans = {n.removeprefix(_PLANS): stored[n] for n in stored if n.startswith(_PLANS)}
                field = stored.get("field")
                arrays = {name: stored[name] for name in _ARRAYS}
            height, width = arrays["predicted"].shape
            return cls(
                about=scalars["about"],
                grid=Grid(height, width, scalars["resolution_m"]),
                field=field,
                free_by=scalars["free"][0],
                free_above=scalars["free"][1],
                dt_s=scalars["dt_s"],
                time_budget_s=scalars["time_budget_s"],
                action_names=tuple(scalars["action_names"]),
                plans=split_plans(plans),
                **arrays,
            )


def take_snapshot(recording: Recording, time_s: float | None = None) -> Snapshot:
    """Takes an episode at a moment, or at its last plan where it had ended by then.

    Args:
        recording: the episode.
        time_s: the moment; the last plan that was drawn by then is taken. None for that of figures.
    """
    return Snapshot(
        about=recording.about,
        rgb=recording.rgb,
        predicted=recording.predicted,
        free=recording.free,
        field=recording.field,
        soft=recording.soft,
        immobilising=recording.immobilising,
        extent_m=np.array(recording.grid.extent_m),
        goal_m=recording.goal_m,
        dt_s=recording.dt_s,
        track=recording.states[:, :2],
        traversability=recording.traversability,
        plan=recording.plan_at(recording.moment_s if time_s is None else time_s),
    )


def read_snapshots(folder: Path) -> list[Snapshot]:
    """Takes every recorded episode of a run at the moment of figures."""
    return [take_snapshot(Recording.load(path)) for path in sorted((folder / "playback").glob("*.npz"))]
