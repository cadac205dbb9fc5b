"""Recordings of episodes, taken while a unit runs or by running it again."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchnav.core.device import device_of_run
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.terrain import Terrain
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.folder import EPISODES, open_run, read_table
from benchnav.eval.report.playback.files import playback_path, write_playback
from benchnav.eval.report.recorded.drawn_plan import DrawnPlan, drawing_interval, drawn_plan, thinned
from benchnav.eval.report.recorded.recording import Recording
from benchnav.eval.report.recorded.snapshot import SNAPSHOT_S
from benchnav.eval.run.episode import build, one_thread, read_block, simulate
from benchnav.eval.run.rollout import Episodes
from benchnav.eval.run.rows import path_length_m
from benchnav.planning.planners.planner import Plan
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation


class Recorder:
    """Keeps what was planned for some episodes of a unit.

    Args:
        unit: what is run.
        problem: the unit's.
        simulation: the unit's; of it the λ that stays what it is.
        terrain: the unit's true maps; of them the truth of λ, which no planner is told.
        members: which of the unit's episodes.
    """

    def __init__(
        self, unit: Unit, problem: Problem, simulation: Simulation, terrain: Terrain, members: Iterable[int]
    ) -> None:
        """Begins with nothing."""
        self.unit, self.problem, self.simulation, self.terrain = unit, problem, simulation, terrain
        self.every = drawing_interval(problem.dt_s)
        self._plans: dict[int, list[DrawnPlan]] = {member: [] for member in members}

    def watch(self, step: int, plan: Plan, planned: list[int]) -> None:
        """Keeps a step's plan; those that no figure will show are thinned, since there may be many.

        Args:
            step: its number.
            plan: of some episodes.
            planned: which of the unit's these are.
        """
        whole = step * self.problem.dt_s <= SNAPSHOT_S + 1e-6
        places = {member: place for place, member in enumerate(planned)}
        for member, plans in self._plans.items():
            if member not in places:
                continue  # it has ended
            drawn = drawn_plan(step, plan.lines(places[member]))
            plans.append(drawn if whole else thinned(drawn))

    def write(self, episodes: Episodes, member: int, folder: Path) -> None:
        """Writes the recording of an episode into a run folder."""
        write_playback(folder, self.unit.stem(member), self.recording(episodes, member))

    def recording(self, episodes: Episodes, member: int) -> Recording:
        """All that is played back of one episode."""
        unit, problem, steps = self.unit, self.problem, int(episodes.steps[member])
        about = {
            "condition": unit.condition.id,
            **unit.condition.labels,
            "seed": str(unit.seed),
            "realisation": str(unit.realisation),
            "map": str(unit.maps[member]),
            "outcome": Outcome(int(episodes.outcome[member])).name.lower(),
        }
        free = problem.task.rules.free_space
        return Recording(
            about=about,
            grid=problem.grid,
            rgb=problem.observation.rgb[member].cpu().numpy(),
            elevation_m=problem.elevation_m[member].cpu().numpy(),
            predicted=problem.risk_map[member].cpu().numpy(),
            free=problem.free[member].cpu().numpy(),
            free_by=free.by,
            free_above=free.above,
            **self._ground(member),
            goal_m=problem.goal_m[member].cpu().numpy(),
            dt_s=problem.dt_s,
            time_budget_s=float(problem.time_budget_s[member]),
            action_names=problem.robot.action_names,
            states=episodes.states[member, : steps + 1].cpu().numpy(),
            actions=episodes.actions[member, :steps].cpu().numpy(),
            traversability=episodes.traversability[member, :steps].cpu().numpy(),
            plans=self._plans[member],
        )

    def _ground(self, member: int) -> dict[str, Any]:
        """What the ground is like, of which planners are told nothing."""
        truth = self.terrain.truth
        soft = (truth.weights[member, 1:] > 0).any(dim=0).cpu().numpy()
        mean = truth.select(torch.tensor([member])).mean()[0].float().cpu().numpy()
        field = None if self.simulation.field is None else self.simulation.field[member].cpu().numpy()
        immobilising = self.simulation.immobilising[member].cpu().numpy()
        return {"true_mean": mean, "field": field, "soft": soft, "immobilising": immobilising}


def find_recording(folder: Path, unit: Unit, member: int, out: Path | None = None) -> Recording:
    """Gives the recording of an episode, running its unit again where it was not recorded.

    Args:
        folder: a finished run.
        unit: the episode's.
        member: which of the unit's episodes.
        out: folder that the recording of an episode that is run again is written to; the run's when not given.

    Raises:
        ConfigError: the run has no row of the episode, or the device that it was computed on is not there.
        BenchnavError: the unit did not repeat what the run holds.
    """
    out = out or folder
    for place in (folder, out):
        stored = playback_path(place, unit.stem(member), ".npz")
        if stored.exists():
            return Recording.load(stored)
    row = _row(folder, unit, unit.maps[member])
    with one_thread():
        about = open_run(folder).about
        run_id, device = about["run_id"], device_of_run(about)
        problem, simulation = build(unit, run_id, device)
        recorder = Recorder(unit, problem, simulation, read_block(unit, run_id, device).terrain, [member])
        episodes, _ = simulate(unit, problem, simulation, recorder.watch, recorder.every)
    recording = recorder.recording(episodes, member)
    if not _repeats(row, recording):
        raise BenchnavError(
            f"The episode did not repeat: {folder} was made with other versions or on another machine type. "
            "Run the suite again here to replay it."
        )
    write_playback(out, unit.stem(member), recording)
    return recording


def _row(folder: Path, unit: Unit, map_index: int) -> dict[str, Any]:
    """What a finished run holds of an episode."""
    rows = read_table(folder, EPISODES)
    own = (rows["condition"] == unit.condition.id) & (rows["seed"] == unit.seed)
    own &= (rows["realisation"] == unit.realisation) & (rows["map"] == map_index)
    if not own.any():
        raise ConfigError(
            f"Expected a finished run, got {folder} without that episode. Run the same command again to finish it."
        )
    return rows[own].to_dict("records")[0]


def _repeats(row: Mapping[str, Any], recording: Recording) -> bool:
    """Whether an episode that was run again came out as its row says."""
    ended = np.isclose(row["end_time_s"], recording.end_s, atol=1e-6)
    if row["outcome"] != recording.about["outcome"] or not ended:
        return False
    if not len(recording.traversability):
        return True
    length_m = path_length_m(recording.states[:, :2].astype(np.float64))
    met = recording.traversability.astype(np.float64).mean()
    return bool(row["path_length_m"] == length_m and row["traversability"] == met)
