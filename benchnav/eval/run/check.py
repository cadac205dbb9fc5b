"""What is refused, and what a user is told, before anything of a suite is run or dropped."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch

from benchnav.core import registry
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.settings import one_line
from benchnav.core.terrain import Grid, Observation
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.datagen.recipe.recipe import load_recipe, shipped_recipes
from benchnav.eval.experiment.condition import PART_KINDS, Condition, conditions_of
from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent
from benchnav.eval.run.check_world import check_budgets, check_draws, check_known_ground
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.predictor import class_mismatch, find_checkpoint, predict
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import pose_problem

_MEMBERS = {
    "planner": ("init", "plan"),
    "robot": (
        "dt_s",
        "action_names",
        "action_low",
        "action_high",
        "top_speed_mps",
        "initial_state",
        "__call__",
    ),
    "objective": ("stage", "terminal"),
}


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
    warnings: list[str] = []
    datasets: dict[str, TerrainDataset] = {}

    def scenarios_of(data: str) -> list[str]:
        if data not in datasets:
            datasets[data] = TerrainDataset(find_dataset(data))
        return [name.removeprefix("test/") for name in datasets[data].splits if name.startswith("test/")]

    conditions = conditions_of(suite, scenarios_of)
    if not conditions:
        raise ConfigError(
            f"Expected a suite with at least one condition, got none; data has {scenarios_of(suite.data)}."
        )
    for condition in conditions:
        _check_split(condition, scenarios_of(condition.data), datasets[condition.data], suite.maps)
    for condition in _distinct(conditions, ("planner", "robot", "objective")):
        _check_members(condition)
    conditions, dropped = _steered(conditions)
    for condition in _distinct(conditions, ("planner", "robot", "objective")):
        _check_first_plan(condition)
    check_budgets(conditions, datasets, suite.maps, warnings.append)
    check_known_ground(conditions, datasets, suite.maps)
    check_draws(conditions, datasets, suite)
    _check_single_class(conditions, datasets)
    if elsewhere:
        check_everywhere(conditions)
    for condition in _distinct(conditions, ("model",)):
        model = _class_table(condition)
        for data in {
            other.data for other in conditions if other.model == condition.model and not other.blind
        }:
            warnings += filter(
                None, [class_mismatch(model, datasets[data], f"model {condition.model.label}")]
            )
    warnings += [line for condition in conditions for line in _doubts(condition, datasets[condition.data])]
    wanted = {}
    for condition in conditions:
        there = datasets[condition.data].map_count(condition.split)
        extent = Extent.product(suite.all_seeds, suite.realisations, suite.maps or there)
        wanted[condition.id] = (condition, extent)
    return Checked(
        conditions=wanted,
        dropped=tuple(dropped),
        warnings=tuple(dict.fromkeys(warnings)),
        hypotheses=fix_hypotheses(
            suite.hypotheses,
            {i: condition for i, (condition, _) in wanted.items()},
            {i: sum(count for _, _, count in extent.draws) for i, (_, extent) in wanted.items()},
        ),
    )


def _steered(conditions: list[Condition]) -> tuple[list[Condition], list[dict[str, str]]]:
    """The conditions in which the planner can steer the robot, and the pairs in which it cannot."""
    unfit: dict[str, dict[str, str]] = {}
    for condition in _distinct(conditions, ("planner", "robot")):
        planner, robot = condition.planner.label, condition.robot.label
        try:
            check_steers(condition.make_planner(), condition.make_task().robot, planner)
        except ConfigError as error:
            unfit[_pair(condition)] = {"planner": planner, "robot": robot, "reason": str(error)}
    left = [condition for condition in conditions if _pair(condition) not in unfit]
    if not left:
        raise ConfigError(next(iter(unfit.values()))["reason"])
    return left, list(unfit.values())


def _pair(condition: Condition) -> str:
    return repr([condition.planner, condition.robot])


def _class_table(condition: Condition) -> Any:
    """What knows the class table of a condition's model, which is thereby tried: its checkpoint where it has one."""
    model = condition.make_model()
    if ":" in condition.model.part or condition.model.part in registry.names("model"):
        return model
    return load_checkpoint(find_checkpoint(condition.model.part))


def _check_split(condition: Condition, known: list[str], dataset: TerrainDataset, maps: int) -> None:
    if condition.scenario not in known:
        raise ConfigError(
            f"Expected `scenarios` among {known} of {dataset.path}, got {condition.scenario!r}."
            f"{registry.hint(condition.scenario, known)}{_make_all(dataset, condition.split, 1)}"
        )
    there = dataset.map_count(condition.split)
    if maps > there:
        raise ConfigError(
            f"Expected `maps` at most {there}, the maps of {condition.split} in {dataset.path}, "
            f"got {maps}. 0 takes all.{_make_all(dataset, condition.split, maps)}"
        )


def _make_all(dataset: TerrainDataset, split: str, maps: int) -> str:
    """How to make the maps that a file lacks, where its shipped recipe has them."""
    if dataset.id not in shipped_recipes():
        return ""
    whole = load_recipe(dataset.id).splits.get(split)
    if whole is None or whole.maps < maps:
        return ""
    return f" All maps of {dataset.id} are made with `benchnav-datagen create {dataset.id}`."


def _check_single_class(conditions: list[Condition], datasets: dict[str, TerrainDataset]) -> None:
    """Refuses the single-class option of a model whose components are no classes, by its first prediction."""
    for condition in _distinct(conditions, ("model", "risk")):
        if condition.risk.part != "single-class" or condition.blind:
            continue
        try:
            mixture = predict(condition.make_model(), datasets[condition.data].terrain(condition.split, [0]))
        except (Exception, SystemExit):
            continue  # a model that fails is its episodes' own matter
        condition.make_risk()(mixture)


def _check_members(condition: Condition) -> None:
    """Refuses a part that stands in the place of another kind."""
    task = condition.make_task()
    made = {"planner": condition.make_planner(), "robot": task.robot, "objective": task.objective}
    for kind, names in _MEMBERS.items():
        missing = [name for name in names if not hasattr(made[kind], name)]
        if missing:
            raise ConfigError(
                f"Expected {kind} {getattr(condition, kind).part!r} with {', '.join(names)}, got "
                f"{type(made[kind]).__name__} without {', '.join(missing)}."
            )


def _check_first_plan(condition: Condition) -> None:
    """Lets a shipped planner refuse what only its preparation can tell, such as its bounds."""
    if not registry.find("planner", condition.planner.part).shipped:
        return
    ground = torch.full((1, 4, 4), 0.9)
    seen = Observation(torch.zeros(1, 3, 4, 4, dtype=torch.uint8), 0 * ground, 0 * ground, Grid(4, 4, 1.0))
    ones = torch.ones_like(ground).unsqueeze(1)
    mixture = TraversabilityMixture(ones, 0.9 * ones, 0 * ones)
    places = torch.tensor([[0.5, 0.5]]), torch.tensor([[3.5, 3.5]])
    try:
        problem = pose_problem(condition.make_task(), seen, mixture, ground, *places, 1.0)
        condition.make_planner().init(problem, torch.Generator())
    except BenchnavError:
        raise
    except Exception as error:
        raise ConfigError(
            f"Planner {condition.planner.label!r} cannot be prepared for robot {condition.robot.label!r} and objective "
            f"{condition.objective.label!r}: {one_line(error)}"
        ) from error


def check_everywhere(conditions: Iterable[Condition]) -> None:
    """Refuses parts that other processes would not find.

    Raises:
        ConfigError: there are such.
    """
    for condition in conditions:
        for kind in PART_KINDS:
            source = getattr(condition, kind).part
            known = kind != "model" or source in registry.names("model") or ":" in source
            if known and not registry.find(kind, source).everywhere:
                raise ConfigError(
                    f"Expected {kind} {source!r} to be found by other processes, which `jobs` > 1, "
                    "`scheduler` and `planner_limit_s` need, but it is registered in this one alone. Name it as "
                    "path/to/file.py:Name."
                )


def _doubts(condition: Condition, dataset: TerrainDataset) -> list[str]:
    lines = []
    threshold = dataset.recipe.stuck_threshold
    if condition.rules.free_space.above != threshold:
        lines.append(
            f"each map of {dataset.id} has a way over ground above {threshold:g}, and ground is free above "
            f"{condition.rules.free_space.above:g} here"
        )
    split = dataset.recipe.splits.get(condition.split)
    if split is not None and not split.solvable:
        lines.append(
            f"the maps of {dataset.id} {condition.split} were not asked to have a free way to the goal; "
            "a failure may be the map's"
        )
    return lines


def _distinct(conditions: list[Condition], kinds: tuple[str, ...]) -> list[Condition]:
    found: dict[str, Condition] = {}
    for condition in conditions:
        found.setdefault(repr([getattr(condition, kind) for kind in kinds]), condition)
    return list(found.values())
