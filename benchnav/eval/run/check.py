"""Before a run: every condition is built on one map, so that what cannot be run is refused before anything is.

Nothing is predicted and nothing is planned, but a planner prepares itself on a tiny map of its own.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.settings import call, hint
from benchnav.core.terrain import Grid, Observation
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import load_recipe, shipped_recipes
from benchnav.eval.experiment.condition import KNOWLEDGE, PART_KINDS, Condition, conditions_of, is_checkpoint
from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.suite import Suite, check_size
from benchnav.eval.experiment.unit import BLOCK_MAPS, Extent
from benchnav.eval.run.unit import noise_key, read_maps
from benchnav.models.base import PrivilegedModel
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.predictor import class_mismatch, find_checkpoint, find_ground_statistics, load_model
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import Task, pose_problem
from benchnav.planning.sensing.belief import Fields, Law, Static
from benchnav.planning.world.realisation import check_known
from benchnav.planning.world.simulation import Simulation

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Checked:
    """What of a suite is to be run.

    Args:
        conditions: by id, with how often each is to be run.
        dropped: pairs of which the planner cannot steer the robot, by their labels, each with the reason.
        warnings: what readers of the results should know.
        hypotheses: from `fix_hypotheses`.
    """

    conditions: dict[str, tuple[Condition, Extent]]
    dropped: tuple[dict[str, str], ...]
    warnings: tuple[str, ...]
    hypotheses: dict[str, Any]


def check_suite(suite: Suite, elsewhere: bool) -> Checked:
    """Makes the conditions of a suite and refuses what cannot be run.

    Args:
        suite: what is evaluated.
        elsewhere: parts are made in other processes.

    Raises:
        ConfigError: a part, scenario, map or combination cannot be had, or no planner can steer any robot.
        DatasetError: there is no such dataset.
    """
    conditions = conditions_of(suite, scenarios_of)
    if not conditions:
        raise ConfigError(
            f"Expected a suite with at least one condition, got none; data has {scenarios_of(suite.data)}."
        )
    for condition in conditions:
        check_split(condition, suite.maps)
    most_maps = suite.maps or max(_open(one).map_count(one.split) for one in conditions)
    check_size(len(conditions), len(suite.all_seeds), suite.realisations, most_maps, BLOCK_MAPS)
    conditions, dropped = _steered(conditions)
    if elsewhere:
        check_everywhere(conditions)
    warnings, wanted = build_each(conditions, suite.all_seeds[0], suite.maps), {}
    for condition in conditions:
        dataset = _open(condition)
        warnings += _doubts(condition, dataset)
        maps = suite.maps or dataset.map_count(condition.split)
        wanted[condition.id] = (condition, Extent.product(suite.all_seeds, suite.realisations, maps))
    return Checked(
        conditions=wanted,
        dropped=tuple(dropped),
        warnings=tuple(dict.fromkeys(warnings)),
        hypotheses=fix_hypotheses(suite.hypotheses, wanted),
    )


def _open(condition: Condition) -> TerrainDataset:
    return TerrainDataset(find_dataset(condition.data))


def scenarios_of(data: str) -> list[str]:
    """The scenarios of a dataset's test splits."""
    splits = TerrainDataset(find_dataset(data)).splits
    return [name.removeprefix("test/") for name in splits if name.startswith("test/")]


def check_split(condition: Condition, maps: int) -> None:
    """Refuses a scenario that a dataset lacks, and more maps than it has."""
    dataset, known = _open(condition), scenarios_of(condition.data)
    if condition.scenario not in known:
        raise ConfigError(
            f"Expected `scenarios` among {known} of {dataset.path}, got {condition.scenario!r}."
            f"{hint(condition.scenario, known)}{_make_all(dataset, condition.split, 1)}"
        )
    count = dataset.map_count(condition.split)
    if maps > count:
        raise ConfigError(
            f"Expected `maps` at most {count}, the maps of {condition.split} in {dataset.path}, got {maps}. "
            f"0 takes all.{_make_all(dataset, condition.split, maps)}"
        )


def build_each(conditions: Iterable[Condition], seed: int, maps: int) -> list[str]:
    """Builds conditions on the first map of their splits; what is the same in several is built once.

    Args:
        conditions: what is built.
        seed: root seed of the draw of λ.
        maps: of each split; 0 for all.

    Returns:
        What readers of the results should know.

    Raises:
        BenchnavError: one cannot be run.
    """
    warnings: list[str] = []
    seen: set[str] = set()

    def is_new(*parts: Any) -> bool:
        new = repr(parts) not in seen
        seen.add(repr(parts))
        return new

    for condition in conditions:
        dataset, task, world = _open(condition), condition.make_task(), condition.world
        place = condition.data, condition.split
        posed = condition.robot, condition.objective, condition.rules, world.immobile
        if is_new("planner", condition.planner, condition.data, *posed):
            _check_planner(condition, task, dataset.grid.resolution_m)
        if not condition.blind:
            _check_told(condition)
        if is_new("ground", *place, world.noise):
            _check_known_ground(condition, dataset, maps)
        if is_new("world", *place, world, condition.rules, condition.robot):
            first = read_maps(dataset, condition.split, [0])
            noise = noise_key(seed, condition.split, 0)
            Simulation(first.terrain, task, world, first.places, noise, [0])
            warnings += _late(condition, task, dataset, maps)
        if is_new("knowledge", *place, condition.model, *(getattr(condition, kind) for kind in KNOWLEDGE)):
            _check_knowledge(condition, dataset)
        if not condition.blind and is_new(
            "model", condition.model, condition.data, condition.risk.part, condition.belief, condition.sensor
        ):
            warnings += _check_model(condition, dataset)
    return warnings


def _make_all(dataset: TerrainDataset, split: str, maps: int) -> str:
    """How to make the maps that a file lacks, where its shipped recipe has them."""
    if dataset.id not in shipped_recipes():
        return ""
    whole = load_recipe(dataset.id).splits.get(split)
    if whole is None or whole.maps < maps:
        return ""
    return f" All maps of {dataset.id} are made with `benchnav-datagen create {dataset.id}`."


def _steered(conditions: list[Condition]) -> tuple[list[Condition], list[dict[str, str]]]:
    """The conditions in which the planner can steer the robot, and the pairs in which it cannot."""
    reasons: dict[tuple[str, str], str] = {}
    for condition in conditions:
        pair = condition.planner.label, condition.robot.label
        if pair not in reasons:
            task, planner = condition.make_task(), condition.make_planner()
            try:
                check_steers(planner, task.robot, condition.planner.label)
                reasons[pair] = ""
            except ConfigError as error:
                reasons[pair] = str(error)
    left = [one for one in conditions if not reasons[one.planner.label, one.robot.label]]
    if not left:
        raise ConfigError(next(iter(reasons.values())))
    dropped = [
        {"planner": planner, "robot": robot, "reason": reason}
        for (planner, robot), reason in reasons.items()
        if reason
    ]
    return left, dropped


def _check_told(condition: Condition) -> None:
    """Refuses what a planner cannot be told."""
    planner, name = condition.make_planner(), condition.planner.label
    if planner.plans_once and condition.learns:
        raise ConfigError(
            f"Expected belief 'static' and sensor 'full' for planner {name!r}, which plans once, got "
            f"{condition.belief.label!r} and {condition.sensor.label!r}."
        )
    if planner.given_truth and condition.model.part != "clairvoyant":
        raise ConfigError(
            f"Expected model 'clairvoyant' for planner {name!r}, which is given λ itself, got "
            f"{condition.model.label!r}."
        )


def _check_planner(condition: Condition, task: Task, resolution_m: float) -> None:
    """Lets a shipped planner refuse what only its preparation can tell, such as its bounds."""
    if not registry.find("planner", condition.planner.part).shipped:
        return
    ground = torch.full((1, 4, 4), 0.9)
    grid = Grid(4, 4, resolution_m)
    seen = Observation(torch.zeros(1, 3, 4, 4, dtype=torch.uint8), 0 * ground, 0 * ground, grid)
    ones = torch.ones_like(ground).unsqueeze(1)
    mixture = TraversabilityMixture(ones, 0.9 * ones, 0 * ones)
    start, goal = (torch.full((1, 2), cells * resolution_m) for cells in (0.5, 3.5))

    def prepare() -> None:
        fields = Fields(Static(), Static().init(mixture, Law(grid=grid, correlation_m=0.0)), (0,))
        world = condition.world
        problem = pose_problem(
            task, seen, mixture, ground, start, goal, 1.0, immobile=world.immobile, fields=fields
        )
        condition.make_planner().init(problem, torch.Generator())

    labels = condition.labels
    call(
        f"Planner {labels['planner']!r} for robot {labels['robot']!r} and objective {labels['objective']!r}",
        prepare,
        {},
    )


def _check_knowledge(condition: Condition, dataset: TerrainDataset) -> None:
    """Makes what the robot learns by, which may refuse, and looks for the statistics of the ground that it needs."""
    for kind in KNOWLEDGE:
        condition.make(kind)
    if condition.needs_statistics:
        find_ground_statistics(condition.model, dataset)


def _check_known_ground(condition: Condition, dataset: TerrainDataset, maps: int) -> None:
    """Refuses maps with cells whose λ a world cannot tell, which only maps that were imported have."""
    if not any("source" in part for part in dataset.splits[condition.split]["parts"]):
        return
    chosen = range(maps or dataset.map_count(condition.split))
    for start in chosen[::BLOCK_MAPS]:
        check_known(dataset.terrain(condition.split, chosen[start : start + BLOCK_MAPS]), condition.world)


def _late(condition: Condition, task: Task, dataset: TerrainDataset, maps: int) -> list[str]:
    """Tells of goals that top speed does not reach within T; refuses a T without a step."""
    chosen = range(maps or dataset.map_count(condition.split))
    read = dataset.read(condition.split, chosen, ["start_m", "goal_m", "reference_time_s"])
    top_speed = task.robot.top_speed_mps
    budget = condition.world.budget_s(torch.from_numpy(read["reference_time_s"]), top_speed)
    condition.world.steps(budget, task.robot.dt_s)
    way = np.linalg.norm(read["goal_m"] - read["start_m"], axis=1) - task.rules.goal_radius_m
    late = way / top_speed > budget.numpy()
    if not late.any():
        return []
    return [
        f"in {late.sum()} of {len(late)} maps of {condition.split} a robot of {top_speed:g} m/s cannot reach the goal "
        "within the time budget T"
    ]


def _check_model(condition: Condition, dataset: TerrainDataset) -> list[str]:
    """Loads the model, which may refuse; tells of another class table, and refuses single-class where it has none."""
    part = condition.model.part
    model: Any = load_model(condition.model)
    knows_classes = bool(model.class_names) or isinstance(model, PrivilegedModel)
    if condition.risk.part == "single-class" and condition.make("belief").learns:
        raise ConfigError(
            "Expected a belief that does not learn for the risk setting 'single-class', got "
            f"{condition.belief.label!r}: what is learnt of λ is of no class. Take the belief static."
        )
    if condition.risk.part == "single-class" and not knows_classes:
        raise ConfigError(
            f"Expected a model that predicts classes for the risk setting 'single-class', got "
            f"{condition.model.label!r}, which has no `class_names`."
        )
    if is_checkpoint("model", part):
        model = load_checkpoint(find_checkpoint(part))  # which has a class table in any case
    line = class_mismatch(model, dataset.recipe, f"model {condition.model.label}")
    return [line] if line else []


def check_everywhere(conditions: Iterable[Condition]) -> None:
    """Refuses parts that other processes would not find.

    Raises:
        ConfigError: there are such.
    """
    for condition in conditions:
        for kind in PART_KINDS:
            source = getattr(condition, kind).part
            if not is_checkpoint(kind, source) and not registry.find(kind, source).everywhere:
                raise ConfigError(
                    f"Expected a {kind} that other processes can load (for `jobs` > 1, `scheduler` or "
                    f"`planner_limit_s`), got {source!r}, which is registered in this process alone. Name it as "
                    "path/to/file.py:Name."
                )


def _doubts(condition: Condition, dataset: TerrainDataset) -> list[str]:
    lines = []
    threshold = dataset.recipe.stuck_threshold
    if condition.rules.free_space.above != threshold:
        lines.append(
            f"maps of {dataset.id} have a feasible path over ground above {threshold:g}, but free ground is above "
            f"{condition.rules.free_space.above:g} in this run"
        )
    split = dataset.recipe.splits.get(condition.split)
    if split is not None and not split.solvable:
        lines.append(
            f"maps of {dataset.id} {condition.split} may have no feasible path to the goal (no `solvable: true`), "
            "so that a planner may fail on them for that alone"
        )
    return lines
