"""Running a unit of work: its maps, its problem and simulation, its episodes, and the
files that hold them.

Only the unit's own block of maps is read and predicted. A prediction serves all
planners and risk settings of its block that a process runs one after another.
"""

import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
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
    Draws,
    episode_rows,
    finished_episodes,
    step_table,
    unbegun_episodes,
)
from benchnav.models.base import predict
from benchnav.models.predictor import Clairvoyant, loaded, nugget_of
from benchnav.planning.planners.planner import Plan, Planner
from benchnav.planning.problem import Prediction, Problem, heading_to, pose_problem
from benchnav.planning.sensing.belief import CovarianceModel, Fields
from benchnav.planning.sensing.knowledge import KnowledgeError, Truth, call, sensor_keys
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.lower_bound import BOUNDED_ROBOTS, Motion, lower_bound_s
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import Endpoints


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How units are run.

    Args:
        planner_limit_s: time limit of each call of a planner; 0 for none.
        device: where all is computed, "cpu" or "cuda".
    """

    planner_limit_s: float = 0.0
    device: str = "cpu"

    @classmethod
    def on(cls, device: str, planner_limit_s: float = 0.0) -> "Settings":
        """Choose the settings on a device: "cpu", "cuda", or "auto" for CUDA if there
        is a GPU.
        """
        return cls(planner_limit_s=planner_limit_s, device=find_device(device).type)

    def origins(self) -> Origins:
        """Looks up what units come from that are run so."""
        return Origins(self.planner_limit_s, self.device)


def run_unit(unit: Unit, folder: Path, origin: Origin, settings: Settings) -> None:
    """Runs one unit on one thread and writes its file, and before it its recordings and
    steps.

    Args:
        unit: what is run.
        folder: the run folder.
        origin: of the unit as the run was begun.
        settings: how it is run.

    Raises:
        ConfigError: its code or its maps are others here and now.
    """
    _check_origin(unit, origin, settings)
    clear_unit(folder, unit)
    device = torch.device(settings.device)
    with one_thread():
        block = read_block(unit, origin, device)
        try:
            built = build(unit, origin, device)
        except KnowledgeError as error:
            task, places = unit.condition.task, block.places
            budgets = unit.condition.world.budget_s(
                places.reference_time_s, task.robot.top_speed_mps
            )
            unbegun = unbegun_episodes(task, places, budgets, error.outcome)
            rows = episode_rows(
                unit, block.groups, unbegun, [str(error)] * len(unbegun), compiled=False
            )
            write_unit(folder, unit, origin, rows, [str(error)], traceback.format_exc())
            return
        problem, simulation = built.problem, built.simulation
        watched = unit.watched()
        recorder = Recorder(unit, problem, simulation, block.terrain, watched)
        episodes, compiled = simulate(
            unit, built, settings, observer=recorder.observer if watched else Observer()
        )
        failed = all(episodes.errors)  # a planner that cannot be made, say
        least_s = None if failed else _lower_bounds_s(unit, built)
    succeeded = (episodes.outcome == Outcome.SUCCESS).tolist()
    for member in unit.recorded(succeeded):
        recorder.recording(episodes, member).save(folder / unit.recording_path(member))
    if unit.record != "none":
        write_steps(folder, unit, origin.key(unit), step_table(unit, problem, episodes))
    draws = Draws(
        reference_time_s=block.places.reference_time_s.cpu().numpy(),
        rejected_draws=(simulation.attempts - 1).tolist(),
        lower_bound_s=least_s or (),
    )
    finished = finished_episodes(problem, episodes, draws)
    rows = episode_rows(unit, block.groups, finished, episodes.errors, compiled)
    errors = sorted({error for error in episodes.errors if error})
    write_unit(folder, unit, origin, rows, errors, episodes.traceback)


def _check_origin(unit: Unit, origin: Origin, settings: Settings) -> None:
    """Refuses to make rows of other code or maps than those that the run was begun
    with.
    """
    now = settings.origins().of(unit)
    changed = code_differences(origin.code, now.code)
    if now.maps != origin.maps:
        changed.append(f"maps of {unit.condition.data} {unit.condition.split}")
    if changed or now != origin:
        raise ConfigError(
            "Expected the code and the maps that the run was begun with, got "
            f"changes: {'; '.join(changed)}. "
            "Give the run's command again; finished units are kept."
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """What is stored of a block of maps; what is kept for it is kept for this very one.

    Args:
        terrain: the true maps.
        places: starts, goals and grid reference times.
        groups: which maps go together, as overlapping ones do: those of one number;
            int64, shape [B].
    """

    terrain: Terrain
    places: Endpoints
    groups: np.ndarray

    def to(self, device: torch.device) -> "Block":
        """The same on a device."""
        return replace(
            self, terrain=self.terrain.to(device), places=self.places.to(device)
        )


def read_maps(dataset: TerrainDataset, split: str, maps: Sequence[int]) -> Block:
    """Reads some maps of a split, with starts, goals, reference times and groups; else
    each map is one.
    """
    places = dataset.read(split, maps, ["start_m", "goal_m", "reference_time_s"])
    groups: Any = maps
    if "group" in dataset.field_names:
        groups = dataset.read(split, maps, ["group"])["group"]
    return Block(
        terrain=dataset.terrain(split, maps),
        places=Endpoints(
            **{name: torch.from_numpy(values) for name, values in places.items()}
        ),
        groups=np.asarray(groups, dtype=np.int64).reshape(-1),
    )


def read_block(unit: Unit, origin: Origin, device: torch.device = CPU) -> Block:
    """Reads a unit's maps and places onto a device; they are kept for other settings."""
    return _block(
        unit.condition.data, unit.condition.split, unit.maps, origin.maps, device
    )


@dataclass(frozen=True, kw_only=True)
class Built:
    """What a unit's episodes are run with.

    Args:
        problem: of all episodes, when they begin.
        simulation: with the truth.
        learning: how the robots learn; None where they learn nothing.
    """

    problem: Problem
    simulation: Simulation
    learning: Learning | None


def build(unit: Unit, origin: Origin, device: torch.device = CPU) -> Built:
    """Makes the problem and the simulation of a unit, and what its robots know when
    they set out.

    Args:
        unit: what is to be run.
        origin: of the unit; what is kept of predictions is kept for it.
        device: where all is computed.

    Raises:
        KnowledgeError: a sensor, the model, the belief or the risk measure failed.
        DeviceError: the GPU failed.
        BenchnavError: the data cannot be read, or are not enough for the world.
    """
    condition = unit.condition
    block, task = read_block(unit, origin, device), condition.task
    noise = noise_key(unit.seed, condition.split, unit.realisation)
    simulation = Simulation(
        block.terrain, task, condition.world, block.places, noise, unit.maps
    )
    try:
        learner = _learner(condition, block)
        redrawn = simulation.field is None
        field = (
            simulation.field_at(0) if condition.learns else block.terrain.traversability
        )
        truth = Truth(
            terrain=block.terrain, field=field, keys=sensor_keys(noise, unit.maps)
        )
        predicted = None
        if learner.sensor.sees_all:
            predicted = call(
                Outcome.MODEL_ERROR,
                lambda: _predict(condition.model.key, block, simulation.field),
            )
        start = task.robot.initial_state(
            heading_to(block.places.start_m, block.places.goal_m)
        )
        known = learner.begin(truth, start, predicted)
        fields = Fields(learner.belief, known.belief_state, tuple(unit.maps))
        prediction = Prediction(
            known.observation,
            learner.distribution(known),
            known.risk_map,
            known.free,
            fields,
        )
        problem = pose_problem(
            task,
            prediction,
            block.places.start_m,
            block.places.goal_m,
            simulation.time_budget_s,
            condition.world.immobile,
        )
    except GPU_FAULTS as error:
        raise gpu_failed(error) from error
    if not condition.learns:
        return Built(problem=problem, simulation=simulation, learning=None)
    learning = Learning(
        learner=learner,
        start=known,
        truth=truth,
        field_at=simulation.field_at if redrawn else None,
    )
    return Built(problem=problem, simulation=simulation, learning=learning)


def _learner(condition: Condition, block: Block) -> Learner:
    """How the robots of a unit learn."""
    dataset, world = condition.dataset, condition.world
    sensor = call(Outcome.SENSOR_ERROR, condition.sensor.create)
    belief = call(Outcome.BELIEF_ERROR, condition.belief.create)
    model = call(Outcome.MODEL_ERROR, lambda: condition.model.object)
    covariance = CovarianceModel(
        grid=block.terrain.grid,
        correlation_m=dataset.recipe.correlation_m
        if world.noise == "stored"
        else world.correlation_m,
        nugget=nugget_of(model),
        statistics=condition.statistics,
        class_names=model.class_names
        or tuple(item.name for item in dataset.recipe.classes),
    )

    return Learner(
        sensor=sensor,
        ground=call(Outcome.SENSOR_ERROR, condition.ground.create),
        belief=belief,
        covariance=covariance,
        measure=call(Outcome.MODEL_ERROR, condition.risk.create),
        rules=condition.rules,
        predict=partial(predict, model),
    )


def _predict(
    model_key: str, block: Block, field: Tensor | None
) -> TraversabilityDistribution:
    """The prediction of a block, kept for other settings; of the clairvoyant's λ, of
    one unit alone.
    """
    model = loaded(model_key)
    if not isinstance(model, Clairvoyant):
        return _prediction(model_key, block)
    assert field is not None  # suites are refused in which λ cannot be known
    return predict(model, replace(block.terrain, traversability=field))


def noise_key(seed: int, split: str, realisation: int) -> int:
    """Key of the simulation's noise: the same for every condition (common random
    numbers).
    """
    return rng.stream_key(seed, "simulation", *_draw(split, realisation))


def _draw(split: str, realisation: int) -> tuple[str | int, ...]:
    return (split, realisation) if realisation else (split,)


def simulate(
    unit: Unit, built: Built, settings: Settings, **options: Any
) -> tuple[Episodes, bool]:
    """Runs a unit's episodes; gives what happened, and whether the planner ran
    compiled.

    Args:
        unit: what is run.
        built: the unit's.
        settings: of them the time limit of planners.
        **options: further arguments of `run_episodes`.
    """
    condition = unit.condition
    planner: Any
    with ExitStack() as stack:
        try:
            if settings.planner_limit_s:
                planner = stack.enter_context(
                    closing(IsolatedPlanner(condition, settings.planner_limit_s))
                )
            else:
                planner = condition.planner.create()
        except (Exception, SystemExit) as error:
            planner = _Unmade(error)
        # Keyed by seed and split, never by the batch.
        key = rng.stream_key(
            unit.seed, "planner", *_draw(condition.split, unit.realisation)
        )
        generator = rng.generator(key)
        episodes = run_episodes(
            planner,
            built.problem,
            built.simulation,
            generator,
            learning=built.learning,
            **options,
        )
    return episodes, bool(planner.compiled)


def _lower_bounds_s(unit: Unit, built: Built) -> list[float] | None:
    """Lower bounds of the time to the goal where the planner is given λ, of robots and
    worlds that have one.
    """
    problem, field, condition = built.problem, built.simulation.field, unit.condition
    if (
        field is None
        or type(problem.robot) not in BOUNDED_ROBOTS
        or condition.model.part != "clairvoyant"
    ):
        return None
    if not condition.planner.object.given_truth:
        return None
    motion = Motion(
        robot=problem.robot,
        goal_radius_m=problem.goal_radius_m,
        immobile=condition.world.immobile,
    )
    ends = problem.start[:, :2].cpu().numpy(), problem.goal_m.cpu().numpy()
    each = zip(field.cpu().numpy(), *ends, strict=True)
    return [
        lower_bound_s(values, problem.grid, motion, start_m, goal_m)
        for values, start_m, goal_m in each
    ]


class _Unmade(Planner[None]):
    """Stands for a planner that could not be made: it fails in each unit as one that
    raises.
    """

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def init(self, problem: Problem, generator: torch.Generator) -> None:
        raise self.error

    def plan(self, step: Step, plan_state: None) -> tuple[Tensor, None, Plan]:
        raise self.error


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for PyTorch, whose results do not then depend on the machine; what was
    is put back.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


# What is kept of maps and models is kept for what they are now: other digests are read
# and loaded anew.


@lru_cache(maxsize=2)
def _block(
    data: str,
    split: str,
    maps: tuple[int, ...],
    digests: tuple[str, ...],
    device: torch.device,
) -> Block:
    return read_maps(TerrainDataset(find_dataset(data)), split, maps).to(device)


@lru_cache(maxsize=2)
def _prediction(model_key: str, block: Block) -> TraversabilityDistribution:
    return predict(loaded(model_key), block.terrain)
