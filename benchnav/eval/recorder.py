"""Recordings of episodes, taken while a unit runs or by running it again."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchnav.errors import BenchnavError, ConfigError
from benchnav.eval.report.drawn_plan import DrawnPlan, drawing_interval, drawn_plan
from benchnav.eval.report.playback import playback_path, write_playback
from benchnav.eval.report.recording import Recording
from benchnav.eval.run.episode import build, one_thread, read_block, simulate
from benchnav.eval.run.folder import STEPS, open_run, read_table
from benchnav.eval.run.rollout import Episodes
from benchnav.eval.run.unit import Unit, units
from benchnav.planning.planners.planner import Plan
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation
from benchnav.terrain import Terrain


class Recorder:
    """Keeps what was planned for the first episodes of a unit.

    Args:
        unit: what is run.
        problem: the unit's.
        simulation: the unit's; of it the λ that stays what it is.
        terrain: the unit's true maps; of them the soft ground.
    """

    def __init__(self, unit: Unit, problem: Problem, simulation: Simulation, terrain: Terrain) -> None:
        """Begins with nothing."""
        self.unit, self.problem, self.simulation, self.terrain = unit, problem, simulation, terrain
        self.every = drawing_interval(problem.dt_s)
        self._plans: list[list[DrawnPlan]] = [[] for _ in range(unit.recorded)]

    def watch(self, step: int, plan: Plan) -> None:
        """Keeps a step's plan."""
        for member, plans in enumerate(self._plans):
            plans.append(drawn_plan(step, plan.lines(member)))

    def write(self, episodes: Episodes, folder: Path) -> None:
        """Writes the recordings into a run folder."""
        for member in range(self.unit.recorded):
            write_playback(folder, self.unit.stem(member), self.recording(episodes, member))

    def recording(self, episodes: Episodes, member: int) -> Recording:
        """All that is played back of one episode."""
        unit, problem, steps = self.unit, self.problem, int(episodes.steps[member])
        about = {
            "trial": unit.trial.id,
            **unit.trial.labels,
            "seed": str(unit.seed),
            "realisation": str(unit.realisation),
            "instance": str(unit.instances[member]),
            "outcome": Outcome(int(episodes.outcome[member])).name.lower(),
        }
        return Recording(
            about=about,
            grid=problem.grid,
            rgb=problem.observation.rgb[member].cpu().numpy(),
            elevation_m=problem.elevation_m[member].cpu().numpy(),
            predicted=problem.risk_map[member].cpu().numpy(),
            free=problem.free[member].cpu().numpy(),
            **self._ground(member),
            goal_m=problem.goal_m[member].cpu().numpy(),
            dt_s=problem.dt_s,
            action_names=problem.robot.action_names,
            states=episodes.states[member, : steps + 1].cpu().numpy(),
            actions=episodes.actions[member, :steps].cpu().numpy(),
            traversability=episodes.traversability[member, :steps].cpu().numpy(),
            plans=self._plans[member],
        )

    def _ground(self, member: int) -> dict[str, Any]:
        """What the ground is like, of which planners are told nothing."""
        soft = (self.terrain.truth.weights[member, 1:] > 0).any(dim=0).cpu().numpy()
        ground = {"field": None, "soft": soft, "holding": np.zeros_like(soft)}
        immobile = self.unit.trial.world.immobile
        if self.simulation.field is not None:
            field = self.simulation.field[member].cpu()
            ground["field"] = field.numpy()
            if immobile is not None:
                ground["holding"] = (field < immobile.below).numpy()
        return ground


def record_episode(
    folder: Path, labels: Mapping[str, str], seed: int | None, realisation: int, instance: int
) -> Path:
    """Gives the recording of an episode, running its unit again where it was not recorded.

    Args:
        folder: a finished run.
        labels: what tables call the trial, by column; the first trial that fits is taken.
        seed: root seed; the trial's first when None.
        realisation: draw of the world's luck.
        instance: instance of the split.

    Raises:
        ConfigError: the run has no such episode.
        BenchnavError: the unit did not repeat what the run holds.
    """
    unit = _find(folder, labels, seed, realisation, instance)
    member = unit.instances.index(instance)
    path = playback_path(folder, unit.stem(member))
    if path.exists():
        return path
    known = read_table(folder, STEPS)
    known = known[(known["trial"] == unit.trial.id) & (known["seed"] == unit.seed)]
    known = known[(known["realisation"] == realisation) & (known["instance"] == instance)]
    with one_thread():
        run_id = open_run(folder).about["run_id"]
        problem, simulation = build(unit, run_id)
        recorder = Recorder(unit, problem, simulation, read_block(unit, run_id).terrain)
        episodes, _ = simulate(unit, problem, simulation, recorder.watch, recorder.every)
    track = episodes.states[member, : int(episodes.steps[member]) + 1, :2].numpy()
    if not np.array_equal(known[["x_m", "y_m"]].to_numpy(np.float32), track):
        raise BenchnavError(
            f"The episode did not repeat: {folder} was made with other versions or on another machine type. "
            "Run the suite again here to replay it."
        )
    return write_playback(folder, unit.stem(member), recorder.recording(episodes, member))


def _find(folder: Path, labels: Mapping[str, str], seed: int | None, realisation: int, instance: int) -> Unit:
    run = open_run(folder)
    if run.version == 1:
        raise ConfigError(f"Expected a run of this version to replay, got {folder} of benchnav 0.1.")
    fitting = {
        trial_id: (trial, extent)
        for trial_id, (trial, extent) in run.trials.items()
        if all(trial.labels[name] == label for name, label in labels.items())
    }
    for trial_id, entry in fitting.items():
        wanted = entry[1].seeds[0] if seed is None else seed
        for unit in units({trial_id: entry}, 0):
            if (unit.seed, unit.realisation) == (wanted, realisation) and instance in unit.instances:
                return replace(unit, recorded=unit.instances.index(instance) + 1)
    asked = [f"{name} {label!r}" for name, label in labels.items()]
    asked += [f"realisation {realisation}", f"instance {instance}"] + (
        [] if seed is None else [f"seed {seed}"]
    )
    columns = ("planner", "risk", "scenario", "model", "robot", "objective", "world", "data")
    there = {name: list(dict.fromkeys(t.labels[name] for t, _ in run.trials.values())) for name in columns}
    raise ConfigError(
        f"Expected an episode of the run, got {', '.join(asked)}. "
        f"It has {', '.join(f'{name}s {values}' for name, values in there.items())}."
    )
