"""What is refused, and what a user is told, before anything of a suite is run or dropped."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch

from benchnav import registry
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.datagen.recipe.recipe import load_recipe, shipped_recipes
from benchnav.errors import BenchnavError, ConfigError
from benchnav.eval.hypotheses import fix_hypotheses
from benchnav.eval.run.check_world import check_budgets, check_known_ground, check_luck
from benchnav.eval.suite import Suite
from benchnav.eval.trial import PART_KINDS, Trial, trials_of
from benchnav.eval.unit import Extent
from benchnav.mixture import TraversabilityMixture
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.predictor import class_mismatch, find_checkpoint, predict
from benchnav.options import one_line
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import pose_problem
from benchnav.terrain import Grid, Observation

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
        trials: by id, with how often each is to be run.
        dropped: pairs of which the planner cannot steer the robot, by their labels, each with the reason.
        warnings: what readers of the results should know.
        hypotheses: from `fix_hypotheses`.
    """

    trials: dict[str, tuple[Trial, Extent]]
    dropped: tuple[dict[str, str], ...]
    warnings: tuple[str, ...]
    hypotheses: dict[str, Any]


def check_suite(suite: Suite, elsewhere: bool) -> Checked:
    """Makes the trials of a suite and refuses what cannot be run.

    Args:
        suite: what is evaluated.
        elsewhere: parts are made in other processes.

    Raises:
        ConfigError: a part, scenario, instance or combination cannot be had, or no planner can steer any robot.
        DatasetError: there is no such dataset.
    """
    warnings: list[str] = []
    datasets: dict[str, TerrainDataset] = {}

    def scenarios_of(data: str) -> list[str]:
        if data not in datasets:
            datasets[data] = TerrainDataset(find_dataset(data))
        return [name.removeprefix("test/") for name in datasets[data].splits if name.startswith("test/")]

    trials = trials_of(suite, scenarios_of)
    if not trials:
        raise ConfigError(
            f"Expected a suite with at least one trial, got none; data has {scenarios_of(suite.data)}."
        )
    for trial in trials:
        _check_split(trial, scenarios_of(trial.data), datasets[trial.data], suite.instances)
    for trial in _distinct(trials, ("planner", "robot", "objective")):
        _check_members(trial)
    trials, dropped = _steered(trials)
    for trial in _distinct(trials, ("planner", "robot", "objective")):
        _check_first_plan(trial)
    check_budgets(trials, datasets, suite.instances, warnings.append)
    check_known_ground(trials, datasets, suite.instances)
    check_luck(trials, datasets, suite)
    _check_single_class(trials, datasets)
    if elsewhere:
        check_everywhere(trials)
    for trial in _distinct(trials, ("model",)):
        model = _class_table(trial)
        for data in {other.data for other in trials if other.model == trial.model and not other.blind}:
            warnings += filter(None, [class_mismatch(model, datasets[data], f"model {trial.model.label}")])
    warnings += [line for trial in trials for line in _doubts(trial, datasets[trial.data])]
    wanted = {}
    for trial in trials:
        there = datasets[trial.data].map_count(trial.split)
        extent = Extent.product(suite.all_seeds, suite.realisations, suite.instances or there)
        wanted[trial.id] = (trial, extent)
    return Checked(
        trials=wanted,
        dropped=tuple(dropped),
        warnings=tuple(dict.fromkeys(warnings)),
        hypotheses=fix_hypotheses(
            suite.hypotheses,
            {i: trial for i, (trial, _) in wanted.items()},
            {i: sum(count for _, _, count in extent.draws) for i, (_, extent) in wanted.items()},
        ),
    )


def _steered(trials: list[Trial]) -> tuple[list[Trial], list[dict[str, str]]]:
    """The trials in which the planner can steer the robot, and the pairs in which it cannot."""
    unfit: dict[str, dict[str, str]] = {}
    for trial in _distinct(trials, ("planner", "robot")):
        planner, robot = trial.planner.label, trial.robot.label
        try:
            check_steers(trial.make_planner(), trial.make_task().robot, planner)
        except ConfigError as error:
            unfit[_pair(trial)] = {"planner": planner, "robot": robot, "reason": str(error)}
    left = [trial for trial in trials if _pair(trial) not in unfit]
    if not left:
        raise ConfigError(next(iter(unfit.values()))["reason"])
    return left, list(unfit.values())


def _pair(trial: Trial) -> str:
    return repr([trial.planner, trial.robot])


def _class_table(trial: Trial) -> Any:
    """What knows the class table of a trial's model, which is thereby tried: its checkpoint where it has one."""
    model = trial.make_model()
    if ":" in trial.model.part or trial.model.part in registry.names("model"):
        return model
    return load_checkpoint(find_checkpoint(trial.model.part))


def _check_split(trial: Trial, known: list[str], dataset: TerrainDataset, instances: int) -> None:
    if trial.scenario not in known:
        raise ConfigError(
            f"Expected `scenarios` among {known} of {dataset.path}, got {trial.scenario!r}."
            f"{registry.hint(trial.scenario, known)}{_make_all(dataset, trial.split, 1)}"
        )
    there = dataset.map_count(trial.split)
    if instances > there:
        raise ConfigError(
            f"Expected `instances` at most {there}, the maps of {trial.split} in {dataset.path}, "
            f"got {instances}. 0 takes all.{_make_all(dataset, trial.split, instances)}"
        )


def _make_all(dataset: TerrainDataset, split: str, maps: int) -> str:
    """How to make the maps that a file lacks, where its shipped recipe has them."""
    if dataset.id not in shipped_recipes():
        return ""
    whole = load_recipe(dataset.id).splits.get(split)
    if whole is None or whole.maps < maps:
        return ""
    return f" All maps of {dataset.id} are made with `benchnav-datagen create {dataset.id}`."


def _check_single_class(trials: list[Trial], datasets: dict[str, TerrainDataset]) -> None:
    """Refuses the single-class option of a model whose components are no classes, by its first prediction."""
    for trial in _distinct(trials, ("model", "risk")):
        if trial.risk.part != "single-class" or trial.blind:
            continue
        try:
            mixture = predict(trial.make_model(), datasets[trial.data].terrain(trial.split, [0]))
        except (Exception, SystemExit):
            continue  # a model that fails is its episodes' own matter
        trial.make_risk()(mixture)


def _check_members(trial: Trial) -> None:
    """Refuses a part that stands in the place of another kind."""
    task = trial.make_task()
    made = {"planner": trial.make_planner(), "robot": task.robot, "objective": task.objective}
    for kind, names in _MEMBERS.items():
        missing = [name for name in names if not hasattr(made[kind], name)]
        if missing:
            raise ConfigError(
                f"Expected {kind} {getattr(trial, kind).part!r} with {', '.join(names)}, got "
                f"{type(made[kind]).__name__} without {', '.join(missing)}."
            )


def _check_first_plan(trial: Trial) -> None:
    """Lets a shipped planner refuse what only its preparation can tell, such as its bounds."""
    if not registry.find("planner", trial.planner.part).shipped:
        return
    ground = torch.full((1, 4, 4), 0.9)
    seen = Observation(torch.zeros(1, 3, 4, 4, dtype=torch.uint8), 0 * ground, 0 * ground, Grid(4, 4, 1.0))
    ones = torch.ones_like(ground).unsqueeze(1)
    mixture = TraversabilityMixture(ones, 0.9 * ones, 0 * ones)
    places = torch.tensor([[0.5, 0.5]]), torch.tensor([[3.5, 3.5]])
    try:
        problem = pose_problem(trial.make_task(), seen, mixture, ground, *places, 1.0)
        trial.make_planner().init(problem, torch.Generator())
    except BenchnavError:
        raise
    except Exception as error:
        raise ConfigError(
            f"Planner {trial.planner.label!r} cannot be prepared for robot {trial.robot.label!r} and objective "
            f"{trial.objective.label!r}: {one_line(error)}"
        ) from error


def check_everywhere(trials: Iterable[Trial]) -> None:
    """Refuses parts that other processes would not find.

    Raises:
        ConfigError: there are such.
    """
    for trial in trials:
        for kind in PART_KINDS:
            source = getattr(trial, kind).part
            known = kind != "model" or source in registry.names("model") or ":" in source
            if known and not registry.find(kind, source).everywhere:
                raise ConfigError(
                    f"Expected {kind} {source!r} to be found by other processes, which `jobs` > 1, "
                    "`scheduler` and `planner_limit_s` need, but it is registered in this one alone. Name it as "
                    "path/to/file.py:Name."
                )


def _doubts(trial: Trial, dataset: TerrainDataset) -> list[str]:
    lines = []
    threshold = dataset.recipe.stuck_threshold
    if trial.rules.free_space.above != threshold:
        lines.append(
            f"each map of {dataset.id} has a way over ground above {threshold:g}, and ground is free above "
            f"{trial.rules.free_space.above:g} here"
        )
    split = dataset.recipe.splits.get(trial.split)
    if split is not None and not split.solvable:
        lines.append(
            f"the maps of {dataset.id} {trial.split} were not asked to have a free way to the goal; "
            "a failure may be the map's"
        )
    return lines


def _distinct(trials: list[Trial], kinds: tuple[str, ...]) -> list[Trial]:
    found: dict[str, Trial] = {}
    for trial in trials:
        found.setdefault(repr([getattr(trial, kind) for kind in kinds]), trial)
    return list(found.values())
