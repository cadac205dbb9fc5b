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
from benchnav.planning.free_space import INFLATIONS
from benchnav.planning.planners.planner import check_steers
from benchnav.planning.problem import Prediction, pose_problem
from benchnav.planning.sensing.belief import CovarianceModel, Fields, Static
from benchnav.planning.world.tracks import check_backend

LeftOut = dict[str, str]  # incompatible labels by column, and `reason`


def find_left_out(conditions: Iterable[Condition]) -> dict[str, LeftOut]:
    """Find the conditions whose parts are incompatible.

    Args:
        conditions: conditions of a suite.

    Returns:
        Incompatible labels and the reason, by id, in the order of the conditions.

    Raises:
        ConfigError: If a shipped planner rejects its settings in each of its
            combinations in the suite.
    """
    reasons: dict[tuple[Any, ...], str] = {}
    left_out: dict[str, LeftOut] = {}
    rejections: dict[str, str] = {}  # by planner; empty if any condition is accepted
    for condition in conditions:
        for columns, rule in _RULES.items():
            labels = {column: condition.labels[column] for column in columns}
            # The label of several risk settings may be `NOT_USED`; their parts differ.
            key = (rule, condition.risk.part, *labels.values())
            if key not in reasons:
                reasons[key] = rule(condition)
            reason = reasons[key]
            if rule is _unprepared:
                planner = condition.planner.label
                earlier = rejections.get(planner, reason)
                rejections[planner] = earlier if reason else ""
            if reason:
                left_out[condition.id] = {**labels, "reason": reason}
                break
    for reason in rejections.values():
        if reason:  # The planner's settings are invalid in each combination.
            raise ConfigError(reason)
    return left_out


def _unsteered(condition: Condition) -> str:
    planner = condition.planner
    try:
        check_steers(planner.object, condition.task.robot, planner.label)
    except ConfigError as error:
        return str(error)
    return ""


def _unsuited(condition: Condition) -> str:
    grid = condition.dataset.grid
    is_point = condition.task.robot.footprint is None
    if is_point and condition.rules.inflation != INFLATIONS[0]:
        return (
            "Expected a robot with a footprint for `task.inflation` "
            f"{condition.rules.inflation!r}, got {condition.robot.label!r}, which is a "
            "point."
        )
    try:
        check_backend(condition.task, condition.world, grid)
    except ConfigError as error:
        return str(error)
    return ""


def _plans_once(condition: Condition) -> str:
    plans_once = not condition.blind and condition.planner.object.plans_once
    if not plans_once or not condition.learns:
        return ""
    return (
        "Expected belief 'static' and sensor 'full' for planner "
        f"{condition.planner.label!r}, got {condition.belief.label!r} and "
        f"{condition.sensor.label!r}. This planner plans only once."
    )


def _given_truth(condition: Condition) -> str:
    is_given = not condition.blind and condition.planner.object.given_truth
    if not is_given or condition.model.part == "clairvoyant":
        return ""
    return (
        f"Expected model 'clairvoyant' for planner {condition.planner.label!r}, got "
        f"{condition.model.label!r}. This planner needs the true λ."
    )


def _resampled(condition: Condition) -> str:
    if condition.model.part != "clairvoyant" or condition.world.noise != "resampled":
        return ""
    return (
        "Expected a world with constant λ for the model 'clairvoyant', got "
        f"{condition.world_label!r}, which resamples λ at each step. Use the world "
        "stakes, or set `world.noise` to frozen or stored."
    )


def _learns_no_class(condition: Condition) -> str:
    if not _is_single_class(condition) or not condition.belief.object.learns:
        return ""
    return (
        "Expected a belief that does not learn for the risk setting 'single-class', "
        f"got {condition.belief.label!r}, whose updated distributions have no classes. "
        "Use the belief static."
    )


def _without_classes(condition: Condition) -> str:
    if not _is_single_class(condition):
        return ""
    model = condition.model.object
    if model.class_names or isinstance(model, PrivilegedModel):
        return ""
    return (
        "Expected a model that predicts classes for the risk setting 'single-class', "
        f"got {condition.model.label!r}, which has no `class_names`."
    )


def _is_single_class(condition: Condition) -> bool:
    return not condition.blind and condition.risk.part == "single-class"


def _unprepared(condition: Condition) -> str:
    """Return why a shipped planner rejects its options; empty if it accepts them."""
    planner: Part = condition.planner
    if not planner.found.shipped:
        return ""
    traversability = torch.full((1, 4, 4), 0.9)
    flat = 0 * traversability
    grid = Grid(4, 4, condition.dataset.grid.resolution_m)
    rgb = torch.zeros(1, 3, 4, 4, dtype=torch.uint8)
    observation = Observation(rgb, flat, flat, grid)
    ones = torch.ones_like(traversability).unsqueeze(1)
    mixture = TraversabilityMixture(ones, 0.9 * ones, 0 * ones)
    start_m = torch.full((1, 2), 0.5 * grid.resolution_m)
    goal_m = torch.full((1, 2), 3.5 * grid.resolution_m)

    def prepare() -> None:
        covariance = CovarianceModel(grid=grid, correlation_m=0.0)
        state = Static().init(mixture, covariance)
        fields = Fields(Static(), state, (0,))
        prediction = Prediction(observation, mixture, traversability, fields=fields)
        problem = pose_problem(
            condition.task, prediction, start_m, goal_m, 1.0, condition.world.immobile
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


# Rules by the columns on which they depend. A rule returns a reason, or "" if the parts
# are compatible. Slow rules come last.
_RULES: Mapping[tuple[str, ...], Callable[[Condition], str]] = {
    ("planner", "robot"): _unsteered,
    ("robot", "world", "data"): _unsuited,
    ("planner", "sensor", "belief"): _plans_once,
    ("planner", "model"): _given_truth,
    ("model", "world"): _resampled,
    ("risk", "belief"): _learns_no_class,
    ("planner", "robot", "objective", "world", "data"): _unprepared,
    ("model", "risk"): _without_classes,
}
