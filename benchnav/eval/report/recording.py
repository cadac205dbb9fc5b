"""An episode with all that is played back of it.

Letters in shapes: N steps, H×W cells, S state and A action dimensions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchnav.eval.report.drawn_plan import DrawnPlan
from benchnav.eval.report.snapshot import SNAPSHOT_S, Snapshot
from benchnav.terrain import Grid


@dataclass(frozen=True, kw_only=True)
class Recording:
    """An episode of any robot, from its start to its end.

    Args:
        about: `trial`, its labels, `seed`, `realisation`, `instance` and `outcome`, as text.
        grid: of the maps.
        rgb: uint8, shape [3, H, W].
        elevation_m: shape [H, W].
        predicted: λ̂, the map the planner was given, shape [H, W].
        free: S_free, bool, shape [H, W].
        field: λ as it was through the episode, shape [H, W]; None where it was resampled.
        soft: ground with soft spots that do not show, bool, shape [H, W].
        holding: cells of the field that hold a robot for good, bool, shape [H, W].
        goal_m: (x, y).
        dt_s: time step.
        action_names: what each action is, with its unit, A of them.
        states: robot states beginning with (x, y, θ), shape [N + 1, S].
        actions: shape [N, A].
        traversability: λ met, shape [N].
        plans: what was planned, in order of steps; those after the episode's end are left out.
    """

    about: Mapping[str, str]
    grid: Grid
    rgb: np.ndarray
    elevation_m: np.ndarray
    predicted: np.ndarray
    free: np.ndarray
    field: np.ndarray | None
    soft: np.ndarray
    holding: np.ndarray
    goal_m: np.ndarray
    dt_s: float
    action_names: tuple[str, ...]
    states: np.ndarray
    actions: np.ndarray
    traversability: np.ndarray
    plans: Sequence[DrawnPlan]

    @property
    def title(self) -> str:
        """What it is, for people."""
        told = ("planner", "risk", "model", "scenario", "instance", "outcome")
        return ", ".join(self.about[name] for name in told)

    @property
    def own_plans(self) -> list[DrawnPlan]:
        """Plans up to the last step that was taken; the first is one of them, also where none was taken."""
        last = max(len(self.traversability) - 1, 0)
        return [plan for plan in self.plans if plan.step <= last]


def take_snapshot(recording: Recording, time_s: float = SNAPSHOT_S) -> Snapshot:
    """Takes an episode at a moment, or at its last plan where it had ended by then.

    Args:
        recording: the episode.
        time_s: the moment; the last plan that was drawn by then is taken.
    """
    due = time_s / recording.dt_s + 1e-6
    known = [plan for plan in recording.own_plans if plan.step <= due]
    return Snapshot(
        about=recording.about,
        rgb=recording.rgb,
        predicted=recording.predicted,
        free=recording.free,
        field=recording.field,
        soft=recording.soft,
        holding=recording.holding,
        extent_m=np.array(recording.grid.extent_m),
        goal_m=recording.goal_m,
        dt_s=recording.dt_s,
        track=recording.states[:, :2],
        traversability=recording.traversability,
        plan=known[-1] if known else DrawnPlan(step=0, lines={}),
    )
