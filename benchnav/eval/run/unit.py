"""Running a unit of work: its maps, problem, simulation, episodes and files.

Only the unit's block of maps is read and predicted. A process reuses the prediction of
a block for all planners and risk settings.
"""

import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.device import CPU, GPU_FAULTS, find_device, gpu_failed
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.provenance import Origin, Origins, code_differences
from benchnav.eval.folder.run_folder import clear_unit, write_unit
from benchnav.eval.folder.steps import write_steps
from benchnav.eval.run.isolation import IsolatedPlanner
from benchnav.eval.run.knowledge import Learning
from benchnav.eval.run.recorder import Recorder
from benchnav.eval.run.rollout import Episodes, Observer, run_episodes
from benchnav.eval.run.rows import (
    References,
    episode_rows,
    episodes_without_steps,
    finished_episodes,
    step_table,
)
from benchnav.models.base import predict
from benchnav.models.predictor import Clairvoyant, loaded, nugget_of
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Prediction, Problem, heading_to, pose_problem
from benchnav.planning.sensing.belief import CovarianceModel, Fields
from benchnav.planning.sensing.knowledge import (
    KnowledgeError,
    Truth,
    call_user_code,
    sensor_keys,
)
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.lower_bound import BOUNDED_ROBOTS, Motion, lower_bound_s
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.tracks import create_simulation
from benchnav.planning.world.world import Endpoints


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of units.

    Args:
        planner_limit_s: time limit of each call of a planner in seconds; 0 for no
            limit.
        device: device of all computation, "cpu" or "cuda".
    """

    planner_limit_s: float = 0.0
    device: str = "cpu"

    @classmethod
    def on(cls, device: str, planner_limit_s: float = 0.0) -> "Settings":
        """Return the settings for a device: "cpu", "cuda", or "auto" (CUDA if any)."""
        return cls(planner_limit_s=planner_limit_s, device=find_device(device).type)

    def origins(self) -> Origins:
        """Return the current origins of units with these settings."""
        return Origins(self.planner_limit_s, self.device)


def run_unit(unit: Unit, folder: Path, origin: Origin, settings: Settings) -> None:
    """Run one unit on one thread, and write its recordings, its steps and its rows.

    Args:
        unit: unit to run.
        folder: the run folder.
        origin: origin of the unit when the run was begun.
        settings: settings of the run.

    Raises:
        ConfigError: If the unit's code or maps have changed since the run was begun.
    """
    _check_origin(unit, origin, settings)
    clear_unit(folder, unit)
    device = torch.device(settings.device)
    with one_thread():
        block = read_block(unit, origin, device)
        try:
            inputs = build(unit, origin, device)
        except KnowledgeError as error:
            rows = _failed_rows(unit, block, error)
            write_unit(folder, unit, origin, rows, [str(error)], traceback.format_exc())
            return
        problem = inputs.problem
        simulation = inputs.simulation
        recordable = unit.possibly_recorded()
        recorder = Recorder(unit, problem, simulation, block.terrain, recordable)
        observer = recorder.observer if recordable else Observer()
        episodes, compiled = simulate(unit, inputs, settings, observer=observer)
        bounds_s = None
        if not all(episodes.errors):  # e.g. all fail if the planner cannot be created
            bounds_s = _lower_bounds_s(unit, inputs)
    succeeded = (episodes.outcome == Outcome.SUCCESS).tolist()
    for episode_index in unit.recorded(succeeded):
        recording = recorder.recording(episodes, episode_index)
        recording.save(folder / unit.recording_path(episode_index))
    if unit.record != "none":
        steps = step_table(unit, problem, episodes)
        write_steps(folder, unit, origin.key(unit), steps)
    rejected = simulation.attempts - 1
    references = References(
        reference_time_s=block.endpoints.reference_time_s.cpu().numpy(),
        rejected_draws=rejected.tolist(),
        lower_bound_s=bounds_s or (),
    )
    finished = finished_episodes(problem, episodes, references)
    rows = episode_rows(unit, block.groups, finished, episodes.errors, compiled)
    errors = sorted({error for error in episodes.errors if error})
    write_unit(folder, unit, origin, rows, errors, episodes.traceback)


def _failed_rows(unit: Unit, block: "Block", error: KnowledgeError) -> pd.DataFrame:
    """Return the rows of a unit whose model, sensor or belief failed at the start."""
    task = unit.condition.task
    budgets_s = unit.condition.world.budget_s(
        block.endpoints.reference_time_s, task.robot.top_speed_mps
    )
    episodes = episodes_without_steps(task, block.endpoints, budgets_s, error.outcome)
    errors = [str(error)] * len(episodes)
    return episode_rows(unit, block.groups, episodes, errors, compiled=False)


def _check_origin(unit: Unit, origin: Origin, settings: Settings) -> None:
    """Reject code or maps that have changed since the run was begun."""
    now = settings.origins().of(unit)
    changed = code_differences(origin.code, now.code)
    if now.maps != origin.maps:
        changed.append(f"maps of {unit.condition.data} {unit.condition.split}")
    if changed or now != origin:
        raise ConfigError(
            "Expected the code and the maps with which the run was begun, got changes: "
            f"{'; '.join(changed)}. Repeat the command of the run; finished units are "
            "kept."
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """A block of B maps; equality is identity, so that a prediction can be cached.

    Args:
        terrain: the true maps.
        endpoints: starts, goals and grid reference times.
        groups: group index of each map, int64, shape [B]; overlapping maps have the
            same index.
    """

    terrain: Terrain
    endpoints: Endpoints
    groups: np.ndarray

    def to(self, device: torch.device) -> "Block":
        """Return the block on a device."""
        return replace(
            self, terrain=self.terrain.to(device), endpoints=self.endpoints.to(device)
        )


def read_maps(dataset: TerrainDataset, split: str, maps: Sequence[int]) -> Block:
    """Read maps of a split; if no groups are stored, each map is a group."""
    endpoints = dataset.read(split, maps, ["start_m", "goal_m", "reference_time_s"])
    groups: Any = maps
    if "group" in dataset.field_names:
        groups = dataset.read(split, maps, ["group"])["group"]
    tensors = {name: torch.from_numpy(values) for name, values in endpoints.items()}
    return Block(
        terrain=dataset.terrain(split, maps),
        endpoints=Endpoints(**tensors),
        groups=np.asarray(groups, dtype=np.int64).reshape(-1),
    )


def read_block(unit: Unit, origin: Origin, device: torch.device = CPU) -> Block:
    """Return a unit's maps and endpoints on a device, cached for later units."""
    condition = unit.condition
    return _block(condition.data, condition.split, unit.maps, origin.maps, device)


@dataclass(frozen=True, kw_only=True)
class UnitInputs:
    """Inputs of a unit's episodes.

    Args:
        problem: problem of all episodes at their start.
        simulation: simulation with the true terrain.
        learning: sensing and belief of the robots; None if they do not learn.
    """

    problem: Problem
    simulation: Simulation
    learning: Learning | None


def build(unit: Unit, origin: Origin, device: torch.device = CPU) -> UnitInputs:
    """Create the problem, the simulation and the initial knowledge of a unit.

    Args:
        unit: unit whose episodes are run.
        origin: origin of the unit; its digests of maps are keys of the cache.
        device: device of all computation.

    Raises:
        KnowledgeError: If a sensor, the model, the belief or the risk measure failed.
        DeviceError: If the GPU failed.
        BenchnavError: If the maps cannot be read, or lack data that the world needs.
    """
    condition = unit.condition
    block = read_block(unit, origin, device)
    task = condition.task
    noise = noise_key(unit.seed, condition.split, unit.realisation)
    simulation = create_simulation(
        block.terrain, task, condition.world, block.endpoints, noise, unit.maps
    )
    start_m = condition.world.starts_m(block.endpoints.start_m)
    goal_m = block.endpoints.goal_m
    try:
        learner = _learner(condition, block)
        field = block.terrain.traversability
        if condition.learns:
            field = simulation.field_at(0)
        keys = sensor_keys(noise, unit.maps)
        truth = Truth(terrain=block.terrain, field=field, keys=keys)
        predicted = None
        if learner.sensor.sees_all:
            prediction_of_block = partial(
                _predict, condition.model.key, block, simulation.field
            )
            predicted = call_user_code(Outcome.MODEL_ERROR, prediction_of_block)
        start = task.robot.initial_state(heading_to(start_m, goal_m))
        knowledge = learner.begin(truth, start, predicted)
        prediction = Prediction(
            observation=knowledge.observation,
            distribution=learner.distribution(knowledge),
            risk_map=knowledge.risk_map,
            free=knowledge.free,
            fields=Fields(learner.belief, knowledge.belief_state, tuple(unit.maps)),
        )
        problem = pose_problem(
            task,
            prediction,
            start_m,
            goal_m,
            simulation.time_budget_s,
            condition.world.immobile,
        )
    except GPU_FAULTS as error:
        raise gpu_failed(error) from error
    if not condition.learns:
        return UnitInputs(problem=problem, simulation=simulation, learning=None)
    is_resampled = simulation.field is None
    learning = Learning(
        learner=learner,
        start=knowledge,
        truth=truth,
        field_at=simulation.field_at if is_resampled else None,
    )
    return UnitInputs(problem=problem, simulation=simulation, learning=learning)


def _learner(condition: Condition, block: Block) -> Learner:
    """Return the sensors and the belief of a unit's robots."""
    dataset = condition.dataset
    world = condition.world
    sensor = call_user_code(Outcome.SENSOR_ERROR, condition.sensor.create)
    robot = condition.task.robot
    ground = call_user_code(
        Outcome.SENSOR_ERROR, lambda: condition.ground.create().mounted(robot)
    )
    belief = call_user_code(Outcome.BELIEF_ERROR, condition.belief.create)
    model = call_user_code(Outcome.MODEL_ERROR, lambda: condition.model.object)
    correlation_m = world.correlation_m
    if world.noise == "stored":
        correlation_m = dataset.recipe.correlation_m
    recipe_names = tuple(item.name for item in dataset.recipe.classes)
    covariance = CovarianceModel(
        grid=block.terrain.grid,
        correlation_m=correlation_m,
        nugget=nugget_of(model),
        statistics=condition.statistics,
        class_names=model.class_names or recipe_names,
    )
    return Learner(
        sensor=sensor,
        ground=ground,
        belief=belief,
        covariance=covariance,
        measure=call_user_code(Outcome.MODEL_ERROR, condition.risk.create),
        rules=condition.rules,
        predict=partial(predict, model),
    )


def _predict(
    model_key: str, block: Block, field: Tensor | None
) -> TraversabilityDistribution:
    """Return the prediction of a block, cached unless the model receives λ."""
    model = loaded(model_key)
    if not isinstance(model, Clairvoyant):
        return _prediction(model_key, block)
    assert field is not None  # `check_suite` leaves out resampled λ
    return predict(model, replace(block.terrain, traversability=field))


def noise_key(seed: int, split: str, realisation: int) -> int:
    """Return the simulation's noise key, which is the same for all conditions.

    Conditions are thus compared with common random numbers.
    """
    return rng.stream_key(seed, "simulation", *_draw(split, realisation))


def _draw(split: str, realisation: int) -> tuple[str | int, ...]:
    """Return the stream keys of a draw of λ: split, and realisation unless it is 0."""
    return (split, realisation) if realisation else (split,)


def simulate(
    unit: Unit, inputs: UnitInputs, settings: Settings, **options: Any
) -> tuple[Episodes, bool]:
    """Run a unit's episodes; return them, and whether the planner ran compiled.

    Args:
        unit: unit whose episodes are run.
        inputs: inputs of its episodes.
        settings: settings with the time limit of planners.
        **options: further arguments of `run_episodes`.
    """
    condition = unit.condition
    planner: Any
    with ExitStack() as stack:
        try:
            if settings.planner_limit_s:
                isolated = IsolatedPlanner(condition, settings.planner_limit_s)
                planner = stack.enter_context(closing(isolated))
            else:
                planner = condition.planner.create()
        except (Exception, SystemExit) as error:
            planner = _FailedPlanner(error)
        draw = _draw(condition.split, unit.realisation)
        if condition.world.start_shift_m:
            draw += ("shifted start",)
        key = rng.stream_key(unit.seed, "planner", *draw)
        episodes = run_episodes(
            planner,
            inputs.problem,
            inputs.simulation,
            rng.generator(key),
            learning=inputs.learning,
            **options,
        )
    return episodes, bool(planner.compiled)


def _lower_bounds_s(unit: Unit, inputs: UnitInputs) -> list[float] | None:
    """Return lower bounds of the time to the goal, in seconds.

    The result is None if the planner is not given λ, or if no bound exists for the
    robot or the world.
    """
    problem = inputs.problem
    field = inputs.simulation.field
    condition = unit.condition
    has_bound = field is not None and type(problem.robot) in BOUNDED_ROBOTS
    if not has_bound or condition.model.part != "clairvoyant":
        return None
    if not condition.planner.object.given_truth:
        return None
    assert field is not None
    motion = Motion(
        robot=problem.robot,
        goal_radius_m=problem.goal_radius_m,
        immobile=condition.world.immobile,
    )
    fields = field.cpu().numpy()
    starts_m = problem.start[:, :2].cpu().numpy()
    goals_m = problem.goal_m.cpu().numpy()
    bounds_s = []
    for values, start_m, goal_m in zip(fields, starts_m, goals_m, strict=True):
        bound_s = lower_bound_s(values, problem.grid, motion, start_m, goal_m)
        bounds_s.append(bound_s)
    return bounds_s


class _FailedPlanner(Planner[None]):
    """Substitute for a planner that could not be created; it raises the error."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def init(self, problem: Problem, generator: torch.Generator) -> None:
        raise self.error

    def plan(self, step: Step, plan_state: None) -> tuple[Tensor, None, Plan]:
        raise self.error


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit PyTorch to one thread, so that results do not depend on the machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


# Keys of the caches contain digests, so that changed maps and models are read again.


@lru_cache(maxsize=2)
def _block(
    data: str,
    split: str,
    maps: tuple[int, ...],
    digests: tuple[str, ...],
    device: torch.device,
) -> Block:
    dataset = TerrainDataset(find_dataset(data))
    return read_maps(dataset, split, maps).to(device)


@lru_cache(maxsize=2)
def _prediction(model_key: str, block: Block) -> TraversabilityDistribution:
    return predict(loaded(model_key), block.terrain)
