"""Combinations of parts that cannot be run: their conditions drop out of a suite, each with its reason.

A suite is a product, and some of its cells make no sense: a planner that cannot steer a robot, `single-class` with a
model that knows no classes. A rule looks at a few kinds of parts only and is asked once for each combination of them,
so that a run says what is left out before anything is predicted.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.settings import call
from benchnav.core.terrain import Grid, Observation
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.condition import Condition
from benchnav.models.base import PrivilegedModel
from benchnav.models.predictor import load_model
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import pose_problem
from benchnav.planning.sensing.belief import Fields, Law, Static


class LeftOut(NamedTuple):
    """Why a condition is not run.

    Args:
        labels: those that do not go together, by column.
        reason: one line.
    """

    labels: Mapping[str, str]
    reason: str

    @property
    def entry(self) -> dict[str, str]:
        """The entry of `dropped` in `run.json`."""
        return {**self.labels, "reason": self.reason}


def find_left_out(conditions: Iterable[Condition]) -> dict[str, LeftOut]:
    """Finds the conditions whose parts do not go together.

    Args:
        conditions: of a suite.

    Returns:
        Why each of them is not run, by its id, in the order of the conditions.

    Raises:
        ConfigError: If a shipped planner refuses its settings in each combination that the suite has of it.
    """
    reasons: dict[tuple[Any, ...], str] = {}
    left_out: dict[str, LeftOut] = {}
    prepared: dict[
        str, str
    ] = {}  # by planner why it cannot be prepared; empty where it can be for some condition
    for condition in conditions:
        for columns, rule in _RULES.items():
            labels = {column: condition.labels[column] for column in columns}
            # With the part, since all parts that are not used have one label.
            key = rule, condition.risk.part, *labels.values()
            if key not in reasons:
                reasons[key] = rule(condition)
            if rule is _unprepared:
                planner = condition.planner.label
                prepared[planner] = reasons[key] and prepared.get(planner, reasons[key])
            if reasons[key]:
                left_out[condition.id] = LeftOut(labels, reasons[key])
                break
    for reason in filter(None, prepared.values()):
        raise ConfigError(reason)  # of the planner's own settings
    return left_out


def _unsteered(condition: Condition) -> str:
    planner, robot = condition.planner.object, condition.task.robot
    return _said(partial(check_steers, planner, robot, condition.planner.label))


def _plans_once(condition: Condition) -> str:
    if condition.blind or not condition.planner.object.plans_once or not condition.learns:
        return ""
    return (
        f"Expected belief 'static' and sensor 'full' for planner {condition.planner.label!r}, which plans once, got "
        f"{condition.belief.label!r} and {condition.sensor.label!r}."
    )


def _given_truth(condition: Condition) -> str:
    is_given = not condition.blind and condition.planner.object.given_truth
    if not is_given or condition.model.part == "clairvoyant":
        return ""
    return (
        f"Expected model 'clairvoyant' for planner {condition.planner.label!r}, which is given λ itself, got "
        f"{condition.model.label!r}."
    )


def _resampled(condition: Condition) -> str:
    if condition.model.part != "clairvoyant" or condition.world.noise != "resampled":
        return ""
    return (
        f"Expected a world with λ that stays for the model 'clairvoyant', got {condition.world_label!r}, which "
        "resamples λ at each step. Take the world stakes, or `world.noise` frozen or stored."
    )


def _learns_no_class(condition: Condition) -> str:
    if not _is_single_class(condition) or not condition.belief.object.learns:
        return ""
    return (
        "Expected a belief that does not learn for the risk setting 'single-class', got "
        f"{condition.belief.label!r}: what is learnt of λ is of no class. Take the belief static."
    )


def _without_classes(condition: Condition) -> str:
    if not _is_single_class(condition):
        return ""
    model: Any = load_model(condition.model)
    if model.class_names or isinstance(model, PrivilegedModel):
        return ""
    return (
        f"Expected a model that predicts classes for the risk setting 'single-class', got {condition.model.label!r}, "
        "which has no `class_names`."
    )


def _is_single_class(condition: Condition) -> bool:
    return not condition.blind and condition.risk.part == "single-class"


def _unprepared(condition: Condition) -> str:
    """Why a shipped planner rejects what only its preparation can tell, such as its bounds."""
    if not registry.find("planner", condition.planner.part).shipped:
        return ""
    task, planner = condition.task, condition.planner.object
    dataset = TerrainDataset(find_dataset(condition.data))
    ground = torch.full((1, 4, 4), 0.9)
    grid = Grid(4, 4, dataset.grid.resolution_m)
    seen = Observation(torch.zeros(1, 3, 4, 4, dtype=torch.uint8), 0 * ground, 0 * ground, grid)
    ones = torch.ones_like(ground).unsqueeze(1)
    mixture = TraversabilityMixture(ones, 0.9 * ones, 0 * ones)
    start, goal = (torch.full((1, 2), cells * grid.resolution_m) for cells in (0.5, 3.5))

    def prepare() -> None:
        fields = Fields(Static(), Static().init(mixture, Law(grid=grid, correlation_m=0.0)), (0,))
        immobile = condition.world.immobile
        problem = pose_problem(
            task, seen, mixture, ground, start, goal, 1.0, immobile=immobile, fields=fields
        )
        planner.init(problem, torch.Generator())

    labels = condition.labels
    what = (
        f"Planner {labels['planner']!r} for robot {labels['robot']!r} and objective {labels['objective']!r}"
    )
    return _said(partial(call, what, prepare, {}))


def _said(check: Callable[[], Any]) -> str:
    """What a check raises; empty where it passes."""
    try:
        check()
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
