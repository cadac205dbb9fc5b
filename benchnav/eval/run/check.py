"""Before a run: its conditions are built and tried, so that what cannot be run is
rejected before anything is run.

Nothing is predicted and nothing is planned. A suite is a product, and some of its
combinations make no sense: a planner that cannot steer a robot, `single-class` with a
model that knows no classes. They are left out, each with its reason.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantity import Quantity
from benchnav.core.registry import Part
from benchnav.core.settings import call, hint
from benchnav.core.store import text_digest
from benchnav.core.terrain import Grid, Observation
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import shipped_recipes, shipped_sizes
from benchnav.eval.experiment.condition import (
    KNOWLEDGE,
    Condition,
    conditions_of,
    scenarios_of,
)
from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.metrics import NamedMetric, quantities, read_metrics
from benchnav.eval.experiment.suite import Suite, check_size
from benchnav.eval.experiment.sweep import read_parts
from benchnav.eval.experiment.unit import BLOCK_MAPS, Conditions, Extent
from benchnav.eval.folder.run_folder import caveats
from benchnav.eval.run.unit import read_maps
from benchnav.models.base import PrivilegedModel
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.predictor import class_mismatch
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import Prediction, pose_problem
from benchnav.planning.sensing.belief import Fields, Law, Static
from benchnav.planning.world.realisation import check_known, draw_frozen

Say = Callable[[str], None]
# the labels that do not go together, by column, and the `reason`
LeftOut = dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Checked:
    """What of a suite is to be run.

    Args:
        conditions: by id, with how often each is to be run.
        dropped: combinations that cannot be run.
        warnings: what readers of the results should know.
        hypotheses: from `fix_hypotheses`.
        metrics: that rows have besides those that every run has.
    """

    conditions: dict[str, tuple[Condition, Extent]]
    dropped: tuple[LeftOut, ...]
    warnings: tuple[str, ...]
    hypotheses: dict[str, Any]
    metrics: tuple[NamedMetric, ...] = ()

    @property
    def caveats(self) -> list[str]:
        """What readers of the run's tables should know, a line each."""
        return caveats(vars(self))


def check_suite(suite: Suite, elsewhere: bool) -> Checked:
    """Build the conditions of a suite, and reject what cannot be run.

    Args:
        suite: what is evaluated.
        elsewhere: whether parts are created in other processes.

    Raises:
        ConfigError: If a part, scenario or map is missing, no combination can be run,
            or a hypothesis names one that cannot.
        DatasetError: If there is no such dataset.
    """
    conditions = conditions_of(suite)
    if not conditions:
        raise ConfigError(
            "Expected a suite with at least one condition, got none; data has "
            f"{scenarios_of(suite.data)}."
        )
    maps = {
        condition.id: check_split(condition, suite.maps) for condition in conditions
    }
    check_size(
        len(conditions),
        len(suite.all_seeds),
        suite.realisations,
        max(maps.values()),
        BLOCK_MAPS,
    )
    left_out = find_left_out(conditions)
    kept = [condition for condition in conditions if condition.id not in left_out]
    if not kept:
        raise ConfigError(next(iter(left_out.values()))["reason"])
    for figure in suite.figures:
        for part in read_parts("figure", figure):
            _ = part.object  # which may reject its options
    metrics = read_metrics(
        suite.metrics, {one.robot.label: one.task.robot for one in kept}.values()
    )
    known = quantities(metric.quantity for metric in metrics)
    if elsewhere:
        check_everywhere(kept, metrics)
    every = {
        one.id: (
            one,
            Extent(draws=tuple((*draw, maps[one.id]) for draw in suite.draws)),
        )
        for one in conditions
    }
    hypotheses = _fix_hypotheses(suite, every, left_out, known)
    warnings = build_each(kept, suite.maps)
    lone = [part for condition in kept for part in condition.unreproducible]
    lone += [f"metric {metric.quantity.name}" for metric in metrics if metric.is_object]
    warnings += [
        f"not reproducible: {part} is an object of one process" for part in lone
    ]
    return Checked(
        conditions={condition.id: every[condition.id] for condition in kept},
        dropped=tuple(
            {json.dumps(entry): entry for entry in left_out.values()}.values()
        ),
        warnings=tuple(dict.fromkeys(warnings)),
        hypotheses=hypotheses,
        metrics=metrics,
    )


def _fix_hypotheses(
    suite: Suite,
    conditions: Conditions,
    left_out: Mapping[str, LeftOut],
    known: Mapping[str, Quantity],
) -> dict[str, Any]:
    """Fix the hypotheses of a suite on the conditions that are run.

    Raises:
        ConfigError: If a hypothesis compares a condition that is run with one that is
            left out, or is invalid.
    """
    try:
        tests = fix_hypotheses(suite.hypotheses, conditions, known).get("tests", ())
    except ConfigError:  # perhaps of a combination that is left out
        tests = ()
    for test in tests:
        lost = [
            left_out[test[side]] for side in ("one", "other") if test[side] in left_out
        ]
        if len(lost) == 1:
            raise ConfigError(
                "Expected hypotheses on conditions that can be run, got "
                f"{test['claim']!r}, which names one that "
                f"cannot: {lost[0]['reason']}"
            )
    kept = {i: entry for i, entry in conditions.items() if i not in left_out}
    return fix_hypotheses(suite.hypotheses, kept, known)


def check_split(condition: Condition, maps: int) -> int:
    """Return how many maps of a condition's split are run; reject a missing scenario,
    and more maps than there are.

    Args:
        condition: its data and scenario.
        maps: how many are asked for; 0 for all.
    """
    dataset, known = condition.dataset, scenarios_of(condition.data)
    if condition.scenario not in known:
        raise ConfigError(
            f"Expected `scenarios` among {known} of {dataset.path}, got "
            f"{condition.scenario!r}."
            f"{hint(condition.scenario, known)}{_remedy(dataset, condition.split, 1)}"
        )
    count = dataset.map_count(condition.split)
    if maps > count:
        raise ConfigError(
            f"Expected `maps` at most {count}, the maps of {condition.split} in "
            f"{dataset.path}, got {maps}. "
            f"0 takes all.{_remedy(dataset, condition.split, maps)}"
        )
    return maps or count


def _remedy(dataset: TerrainDataset, split: str, maps: int) -> str:
    """Return how to make the maps that a file lacks, if its shipped recipe has them."""
    if (
        dataset.id not in shipped_recipes()
        or shipped_sizes(dataset.id).get(split, 0) < maps
    ):
        return ""
    return (
        f" All maps of {dataset.id} are made with `benchnav-datagen create "
        f"{dataset.id}`."
    )


def check_everywhere(
    conditions: Iterable[Condition], metrics: Iterable[NamedMetric] = ()
) -> None:
    """Reject parts that other processes would not find.

    Raises:
        ConfigError: If there are such.
    """
    parts = [part for condition in conditions for part in condition.parts.values()]
    for part in (*parts, *(metric.part for metric in metrics)):
        if not part.found.everywhere:
            raise ConfigError(
                f"Expected a {part.kind} that other processes can load (for `jobs` > "
                "1, `scheduler` or "
                f"`planner_limit_s`), got {part.part!r}, which only this process has. "
                "Write its class into a file, "
                "and import it from there or name it as path/to/file.py:Name."
            )


# --- each condition on one map ---


def build_each(conditions: Sequence[Condition], maps: int) -> list[str]:
    """Build conditions on the first map of their splits, without a prediction or a
    plan.

    Args:
        conditions: what is built; what several share is built once.
        maps: number of maps of each split; 0 for all.

    Returns:
        What readers of the results should know.

    Raises:
        BenchnavError: If a condition cannot be run.
    """
    warnings: list[str] = []
    for condition in _distinct(
        conditions, "data", "scenario", "world", "rules", "robot"
    ):
        warnings += _check_world(condition, condition.dataset, maps)
    for condition in _distinct(conditions, "data", "scenario", "model", *KNOWLEDGE):
        _ = condition.statistics  # which may be missing
    for condition in _distinct(
        [one for one in conditions if not one.blind], "data", "model"
    ):
        warnings += _check_model(condition)
    for condition in conditions:
        warnings += _doubts(condition, condition.dataset)
    return warnings


def _distinct(conditions: Sequence[Condition], *names: str) -> list[Condition]:
    """Return the first condition of each combination of values of some fields."""
    first: dict[str, Condition] = {}
    for condition in conditions:
        value = {**condition.value, "scenario": condition.scenario}
        first.setdefault(
            text_digest({name: value.get(name) for name in names}), condition
        )
    return list(first.values())


def _check_model(condition: Condition) -> list[str]:
    """Load the model, which may reject its options, and warn of another class table."""
    model, name = condition.model.object, f"model {condition.model.label}"
    folder = condition.model.folder
    # A checkpoint has a class table, whether or not its model predicts classes.
    known = load_checkpoint(folder) if folder else model
    line = class_mismatch(known, condition.dataset.recipe, name)
    return [line] if line else []


def _check_world(condition: Condition, dataset: TerrainDataset, maps: int) -> list[str]:
    """Draw λ of the first map, and warn of goals that top speed does not reach within
    T.
    """
    task, world, split = condition.task, condition.world, condition.split
    chosen = range(maps or dataset.map_count(split))
    read = dataset.read(split, chosen, ["start_m", "goal_m", "reference_time_s"])
    top_speed = task.robot.top_speed_mps
    budget = world.budget_s(torch.from_numpy(read["reference_time_s"]), top_speed)
    world.steps(budget, task.robot.dt_s)
    # Only imported maps have cells of which λ is missing.
    is_imported = any("source" in part for part in dataset.splits[split]["parts"])
    for start in chosen[::BLOCK_MAPS] if is_imported else chosen[:1]:
        block = read_maps(
            dataset, split, chosen[start : start + BLOCK_MAPS] if is_imported else [0]
        )
        check_known(block.terrain, world)
        if world.noise == "frozen" and start == 0:
            first = (
                block.terrain.select(torch.tensor([0])),
                block.places.select(torch.tensor([0])),
            )
            draw_frozen(first[0], world, first[1], key=0, maps=[0])
    distance_m = (
        np.linalg.norm(read["goal_m"] - read["start_m"], axis=1)
        - task.rules.goal_radius_m
    )
    late = distance_m / top_speed > budget.numpy()
    if not late.any():
        return []
    return [
        f"in {late.sum()} of {len(late)} maps of {condition.split} a robot of "
        f"{top_speed:g} m/s cannot reach the goal "
        "within the time budget T"
    ]


def _doubts(condition: Condition, dataset: TerrainDataset) -> Iterator[str]:
    """Yield what of the maps does not fit the rules of the task."""
    threshold = dataset.recipe.stuck_threshold
    if condition.rules.free_space.above != threshold:
        yield (
            f"maps of {dataset.id} have a feasible path over ground above "
            f"{threshold:g}, but free ground is above "
            f"{condition.rules.free_space.above:g} in this run"
        )
    split = dataset.recipe.splits.get(condition.split)
    if split is not None and not split.solvable:
        yield (
            f"maps of {dataset.id} {condition.split} may have no feasible path to the "
            "goal (no `solvable: true`), "
            "so that a planner may fail on them for that alone"
        )


# --- combinations that cannot be run ---


def find_left_out(conditions: Iterable[Condition]) -> dict[str, LeftOut]:
    """Find the conditions whose parts do not go together.

    Args:
        conditions: of a suite.

    Returns:
        Why each of them is not run, by its id, in the order of the conditions.

    Raises:
        ConfigError: If a shipped planner rejects its settings in each combination that
            the suite has of it.
    """
    reasons: dict[tuple[Any, ...], str] = {}
    left_out: dict[str, LeftOut] = {}
    # by planner; empty if it can be prepared for some condition
    refusals: dict[str, str] = {}
    for condition in conditions:
        for columns, rule in _RULES.items():
            labels = {column: condition.labels[column] for column in columns}
            # With the part, since all parts that are not used have one label.
            key = rule, condition.risk.part, *labels.values()
            if key not in reasons:
                reasons[key] = rule(condition)
            if rule is _unprepared:
                planner = condition.planner.label
                refusals[planner] = reasons[key] and refusals.get(planner, reasons[key])
            if reasons[key]:
                left_out[condition.id] = {**labels, "reason": reasons[key]}
                break
    for reason in filter(None, refusals.values()):
        raise ConfigError(reason)  # of the planner's own settings
    return left_out


def _unsteered(condition: Condition) -> str:
    try:
        check_steers(
            condition.planner.object, condition.task.robot, condition.planner.label
        )
    except ConfigError as error:
        return str(error)
    return ""


def _plans_once(condition: Condition) -> str:
    if (
        condition.blind
        or not condition.planner.object.plans_once
        or not condition.learns
    ):
        return ""
    return (
        "Expected belief 'static' and sensor 'full' for planner "
        f"{condition.planner.label!r}, which plans once, got "
        f"{condition.belief.label!r} and {condition.sensor.label!r}."
    )


def _given_truth(condition: Condition) -> str:
    is_given = not condition.blind and condition.planner.object.given_truth
    if not is_given or condition.model.part == "clairvoyant":
        return ""
    return (
        f"Expected model 'clairvoyant' for planner {condition.planner.label!r}, which "
        "is given λ itself, got "
        f"{condition.model.label!r}."
    )


def _resampled(condition: Condition) -> str:
    if condition.model.part != "clairvoyant" or condition.world.noise != "resampled":
        return ""
    return (
        "Expected a world with λ that stays for the model 'clairvoyant', got "
        f"{condition.world_label!r}, which "
        "resamples λ at each step. Take the world stakes, or `world.noise` frozen or "
        "stored."
    )


def _learns_no_class(condition: Condition) -> str:
    if not _is_single_class(condition) or not condition.belief.object.learns:
        return ""
    return (
        "Expected a belief that does not learn for the risk setting 'single-class', "
        "got "
        f"{condition.belief.label!r}: what is learnt of λ is of no class. Take the "
        "belief static."
    )


def _without_classes(condition: Condition) -> str:
    if not _is_single_class(condition):
        return ""
    model = condition.model.object
    if model.class_names or isinstance(model, PrivilegedModel):
        return ""
    return (
        "Expected a model that predicts classes for the risk setting 'single-class', "
        f"got {condition.model.label!r}, "
        "which has no `class_names`."
    )


def _is_single_class(condition: Condition) -> bool:
    return not condition.blind and condition.risk.part == "single-class"


def _unprepared(condition: Condition) -> str:
    """Return why a shipped planner rejects what only its preparation can tell, such as
    its bounds.
    """
    planner: Part = condition.planner
    if not planner.found.shipped:
        return ""
    ground = torch.full((1, 4, 4), 0.9)
    grid = Grid(4, 4, condition.dataset.grid.resolution_m)
    seen = Observation(
        torch.zeros(1, 3, 4, 4, dtype=torch.uint8), 0 * ground, 0 * ground, grid
    )
    ones = torch.ones_like(ground).unsqueeze(1)
    mixture = TraversabilityMixture(ones, 0.9 * ones, 0 * ones)
    start, goal = (
        torch.full((1, 2), cells * grid.resolution_m) for cells in (0.5, 3.5)
    )

    def prepare() -> None:
        fields = Fields(
            Static(), Static().init(mixture, Law(grid=grid, correlation_m=0.0)), (0,)
        )
        prediction = Prediction(seen, mixture, ground, fields=fields)
        problem = pose_problem(
            condition.task, prediction, start, goal, 1.0, condition.world.immobile
        )
        planner.object.init(problem, torch.Generator())

    labels = condition.labels
    what = (
        f"Planner {labels['planner']!r} for robot {labels['robot']!r} and "
        f"objective {labels['objective']!r}"
    )
    try:
        call(what, prepare, {})
    except ConfigError as error:
        return str(error)
    return ""


# By the columns whose labels decide it; what takes longest comes last.
_RULES: Mapping[tuple[str, ...], Callable[[Condition], str]] = {
    ("planner", "robot"): _unsteered,
    ("planner", "sensor", "belief"): _plans_once,
    ("planner", "model"): _given_truth,
    ("model", "world"): _resampled,
    ("risk", "belief"): _learns_no_class,
    ("planner", "robot", "objective", "world", "data"): _unprepared,
    ("model", "risk"): _without_classes,
}
