"""From a unit of work to its problem and its simulation.

Only the unit's own block of maps is read and predicted. A prediction serves all planners and risk settings
of its block that a process runs one after another.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.device import CPU, GPU_FAULTS, gpu_failed
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.isolation import IsolatedPlanner
from benchnav.eval.run.rollout import Episodes, Watcher, fault, run_episodes
from benchnav.models.base import predict
from benchnav.models.predictor import Clairvoyant
from benchnav.planning import risk
from benchnav.planning.planners.planner import Plan, Planner, Step
from benchnav.planning.problem import Problem, pose_problem
from benchnav.planning.world.places import Places
from benchnav.planning.world.simulation import Simulation


@dataclass(frozen=True, kw_only=True)
class Block:
    """What is stored of a block of maps.

    Args:
        terrain: the true maps.
        places: starts, goals and grid reference times.
        groups: which maps go together, as overlapping ones do: those of one number; int64, shape [B].
    """

    terrain: Terrain
    places: Places
    groups: np.ndarray

    def to(self, device: torch.device) -> "Block":
        """The same on a device."""
        return replace(self, terrain=self.terrain.to(device), places=self.places.to(device))


def read_maps(dataset: TerrainDataset, split: str, maps: Sequence[int]) -> Block:
    """Reads some maps of a split, with starts, goals, reference times and groups; else each map is one."""
    places = dataset.read(split, maps, ["start_m", "goal_m", "reference_time_s"])
    groups: Any = maps
    if "group" in dataset.field_names:
        groups = dataset.read(split, maps, ["group"])["group"]
    return Block(
        terrain=dataset.terrain(split, maps),
        places=Places(**{name: torch.from_numpy(values) for name, values in places.items()}),
        groups=np.asarray(groups, dtype=np.int64).reshape(-1),
    )


def read_block(unit: Unit, run_id: str, device: torch.device = CPU) -> Block:
    """Reads a unit's maps and places onto a device; they are kept for one run alone."""
    return _block(run_id, unit.condition.data, unit.condition.split, unit.maps, device)


class PredictionError(BenchnavError):
    """A model or a risk measure raised; the cause says what."""


def build(unit: Unit, run_id: str, device: torch.device = CPU) -> tuple[Problem, Simulation]:
    """Makes the problem and the simulation of a unit.

    Args:
        unit: what is to be run.
        run_id: predictions are kept for one run alone.
        device: where all is computed.

    Raises:
        PredictionError: the model or the risk measure failed.
        DeviceError: the GPU failed.
        BenchnavError: the data cannot be read, or are not enough for the world.
    """
    condition = unit.condition
    block, task = read_block(unit, run_id, device), condition.make_task()
    noise = noise_key(unit.seed, condition.split, unit.realisation)
    simulation = Simulation(block.terrain, task, condition.world, block.places, noise, unit.maps)
    try:
        mixture = _predict(unit, run_id, device, simulation.field)
        risk_map = risk.apply(condition.make_risk(), mixture)
    except GPU_FAULTS as error:
        raise gpu_failed(error) from error
    except (Exception, SystemExit) as error:
        raise PredictionError(fault(error)) from error
    problem = pose_problem(
        task,
        block.terrain.observe(),
        mixture,
        risk_map,
        block.places.start_m,
        block.places.goal_m,
        simulation.time_budget_s,
    )
    return problem, simulation


def time_budgets(unit: Unit, run_id: str) -> Tensor:
    """T of each episode of a unit, shape [B]."""
    top_speed = unit.condition.make_task().robot.top_speed_mps
    return unit.condition.world.budget_s(read_block(unit, run_id).places.reference_time_s, top_speed)


def _predict(unit: Unit, run_id: str, device: torch.device, field: Tensor | None) -> TraversabilityMixture:
    """The prediction of a unit's block, kept for other settings; of the clairvoyant's λ, of this unit alone."""
    condition = unit.condition
    model = _model(run_id, _ModelOf(condition))
    if not isinstance(model, Clairvoyant):
        return _prediction(run_id, _ModelOf(condition), condition.data, condition.split, unit.maps, device)
    if field is None:
        raise ConfigError("Expected λ that stays what it is for the clairvoyant, got resampled λ.")
    return predict(model, replace(read_block(unit, run_id, device).terrain, traversability=field))


def noise_key(seed: int, split: str, realisation: int) -> int:
    """Key of the simulation's noise: the same for every condition (common random numbers)."""
    return rng.stream_key(seed, "simulation", *_draw(split, realisation))


def planner_generator(unit: Unit) -> torch.Generator:
    """The planner's randomness: keyed by seed and split, never by the batch."""
    return rng.generator(rng.stream_key(unit.seed, "planner", *_draw(unit.condition.split, unit.realisation)))


def _draw(split: str, realisation: int) -> tuple[str | int, ...]:
    return (split, realisation) if realisation else (split,)


def simulate(
    unit: Unit,
    problem: Problem,
    simulation: Simulation,
    watch: Watcher | None = None,
    watch_every: int = 1,
    planner_limit_s: float = 0.0,
    **options: Any,
) -> tuple[Episodes, bool]:
    """Runs a unit's episodes; gives what happened, and whether the planner ran compiled.

    Args:
        unit: what is run.
        problem: the unit's.
        simulation: the unit's.
        watch: see `run_episodes`, as of `watch_every` and `options`.
        watch_every: as there.
        planner_limit_s: time limit of each call of the planner; 0 for none.
        **options: further arguments of `run_episodes`.
    """
    condition = unit.condition
    planner: Any
    with ExitStack() as stack:
        try:
            if planner_limit_s:
                planner = stack.enter_context(IsolatedPlanner(condition, planner_limit_s))
            else:
                planner = condition.make_planner()
        except (Exception, SystemExit) as error:
            planner = _Unmade(error)
        generator = planner_generator(unit)
        episodes = run_episodes(planner, problem, simulation, generator, watch, watch_every, **options)
    return episodes, bool(planner.compiled)


class _Unmade(Planner[None]):
    """Stands for a planner that could not be made: it fails in each unit as one that raises."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def init(self, problem: Problem, generator: torch.Generator) -> None:
        raise self.error

    def plan(self, step: Step, plan_state: None) -> tuple[Tensor, None, Plan]:
        raise self.error


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread for PyTorch, whose results do not then depend on the machine; what was is put back."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _ModelOf:
    """A condition's model as a key of a cache: the same for all conditions of one model."""

    def __init__(self, condition: Condition) -> None:
        self.condition, self.key = condition, repr((condition.model.part, condition.model.options))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ModelOf) and self.key == other.key


@lru_cache(maxsize=2)
def _block(run_id: str, data: str, split: str, maps: tuple[int, ...], device: torch.device) -> Block:
    return read_maps(_dataset(run_id, data), split, maps).to(device)


@lru_cache(maxsize=2)
def _dataset(run_id: str, data: str) -> TerrainDataset:
    return TerrainDataset(find_dataset(data))


@lru_cache(maxsize=2)
def _prediction(
    run_id: str, model: _ModelOf, data: str, split: str, maps: tuple[int, ...], device: torch.device
) -> TraversabilityMixture:
    return predict(_model(run_id, model), _block(run_id, data, split, maps, device).terrain)


@lru_cache(maxsize=2)
def _model(run_id: str, model: _ModelOf) -> Any:
    return model.condition.make_model()
