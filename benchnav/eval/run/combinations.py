"""Combinations of a suite that cannot be run, each with its reason."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.registry import Part
from benchnav.core.settings import call
from benchnav.core.terrain import Grid, Observation
from benchnav.eval.experiment.condition import Condition
from benchnav.models.base import PrivilegedModel
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import Prediction, pose_problem
from benchnav.planning.sensing.belief import CovarianceModel, Fields, Static

LeftOut = dict[str, str]  # incompatible labels, by column, and the `reason`


def find_left_out(conditions: Iterable[Condition]) -> dict[str, LeftOut]:
    """Find the conditions whose parts are incompatible.

    Args:
        conditions: conditions of a suite.

    Returns:
        Incompatible labels and reason by id, in the order of the conditions.

    Raises:
        ConfigError: If a shipped planner rejects its settings in each of its
            combinations in the suite.
    """
    reasons: dict[tuple[Any, ...], str] = {}
    left_out: dict[str, LeftOut] = {}
    refusals: dict[str, str] = {}  # by planner; empty if some condition is accepted
    for condition in conditions:
        for columns, rule in _RULES.items():
            labels = {column: condition.labels[column] for column in columns}
            # Includes the part, since all unused parts have one label.
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
    """Return why a shipped planner's preparation rejects its options, or ""."""
    planner: Part = condition.planner
    if not planner.found.shipped:
        return ""
    traversability = torch.full((1, 4, 4), 0.9)
    grid = Grid(4, 4, condition.dataset.grid.resolution_m)
    seen = Observation(
        torch.zeros(1, 3, 4, 4, dtype=torch.uint8),
        0 * traversability,
        0 * traversability,
        grid,
    )
    ones = torch.ones_like(traversability).unsqueeze(1)
    mixture = TraversabilityMixture(ones, 0.9 * ones, 0 * ones)
    start = torch.full((1, 2), 0.5 * grid.resolution_m)
    goal = torch.full((1, 2), 3.5 * grid.resolution_m)

    def prepare() -> None:
        state = Static().init(mixture, CovarianceModel(grid=grid, correlation_m=0.0))
        fields = Fields(Static(), state, (0,))
        prediction = Prediction(seen, mixture, traversability, fields=fields)
        problem = pose_problem(
            condition.task, prediction, start, goal, 1.0, condition.world.immobile
        )
        planner.object.init(problem, torch.Generator())

    labels = condition.labels
    subject = (
        f"Planner {labels['planner']!r} for robot {labels['robot']!r} and "
        f"objective {labels['objective']!r}"
    )
    try:
        call(subject, prepare, {})
    except ConfigError as error:
        return str(error)
    return ""


# Rules by the columns that they depend on; slow ones come last.
_RULES: Mapping[tuple[str, ...], Callable[[Condition], str]] = {
    ("planner", "robot"): _unsteered,
    ("planner", "sensor", "belief"): _plans_once,
    ("planner", "model"): _given_truth,
    ("model", "world"): _resampled,
    ("risk", "belief"): _learns_no_class,
    ("planner", "robot", "objective", "world", "data"): _unprepared,
    ("model", "risk"): _without_classes,
}
