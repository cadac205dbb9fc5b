"""Rows of tables: the metrics of each episode, and its steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import torch
from torch import Tensor

from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.steps import AHEAD_COLUMNS, LAST_COLUMN
from benchnav.eval.run.rollout import Episodes
from benchnav.metrics.base import Episode, LearningRecord, MetricError, measure
from benchnav.metrics.shipped import SHIPPED
from benchnav.planning.problem import Problem, Task, heading_to
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.world import Endpoints


@dataclass(frozen=True, kw_only=True, eq=False)
class References:
    """Reference values of B episodes, from their maps and draws of λ.

    Args:
        reference_time_s: grid reference time of each map at 1 m/s, in seconds, shape
            [B]; NaN if missing.
        rejected_draws: number of draws of λ that were rejected for each episode, since
            they had no feasible path to the goal, length B.
        lower_bound_s: lower bound of the time to the goal for each episode, in seconds,
            length B; infinite if no trajectory reaches the goal. Empty if no bound was
            computed.
    """

    reference_time_s: np.ndarray
    rejected_draws: Sequence[int]
    lower_bound_s: Sequence[float] = ()


def finished_episodes(
    problem: Problem, episodes: Episodes, references: References
) -> list[Episode]:
    """Return each episode of a batch as metrics receive it.

    Args:
        problem: the problem of the batch.
        episodes: the episodes of the batch.
        references: reference values of the episodes.
    """
    # The threshold has the precision of observed λ, in which planners compare.
    dtype = episodes.traversability.dtype
    above = torch.tensor(problem.task.rules.free_space.above, dtype=dtype)
    n_episodes = len(episodes.steps)
    planning_s = episodes.planning_s / episodes.planned
    preparing_s = episodes.begin_s / n_episodes
    finished = []
    for b in range(n_episodes):
        steps = int(episodes.steps[b])
        outcome = Outcome(int(episodes.outcome[b]))
        lower_bound_s = (
            references.lower_bound_s[b] if len(references.lower_bound_s) else np.nan
        )
        episode = Episode(
            states=_float64(episodes.states[b, : steps + 1]),
            actions=_float64(episodes.actions[b, :steps]),
            action_names=problem.robot.action_names,
            speed_mps=_float64(episodes.unhindered_speed_mps[b, :steps]),
            turn_rate_radps=_float64(episodes.unhindered_turn_rate_radps[b, :steps]),
            traversability=_float64(episodes.traversability[b, :steps]),
            outcome=outcome.name.lower(),
            dt_s=problem.dt_s,
            time_budget_s=float(problem.time_budget_s[b]),
            reference_time_s=float(references.reference_time_s[b]),
            goal_m=_float64(problem.goal_m[b]),
            goal_radius_m=problem.goal_radius_m,
            stuck_traversability=float(above),
            robot=problem.robot,
            planning_s=_float64(planning_s[:steps]),
            preparing_s=preparing_s,
            learning=_learning(episodes, b),
            rejected_draws=references.rejected_draws[b],
            lower_bound_s=lower_bound_s,
        )
        finished.append(episode)
    return finished


def episodes_without_steps(
    task: Task, endpoints: Endpoints, time_budget_s: Tensor, outcome: Outcome
) -> list[Episode]:
    """Return episodes without steps, for a unit whose model failed.

    Args:
        task: task of all episodes.
        endpoints: starts and goals of B episodes.
        time_budget_s: T in seconds, shape [B].
        outcome: outcome of all episodes.
    """
    robot = task.robot
    poses = heading_to(endpoints.start_m, endpoints.goal_m)
    starts = robot.initial_state(poses)
    no_steps = np.empty(0)
    no_actions = np.empty((0, len(robot.action_names)))
    episodes = []
    for start, goal_m, budget_s in zip(
        starts, endpoints.goal_m, time_budget_s, strict=True
    ):
        episode = Episode(
            states=_float64(start[None]),
            actions=no_actions,
            action_names=robot.action_names,
            speed_mps=no_steps,
            turn_rate_radps=no_steps,
            traversability=no_steps,
            outcome=outcome.name.lower(),
            dt_s=robot.dt_s,
            time_budget_s=float(budget_s),
            reference_time_s=np.nan,
            goal_m=_float64(goal_m),
            goal_radius_m=task.rules.goal_radius_m,
            stuck_traversability=task.rules.free_space.above,
            robot=robot,
            planning_s=no_steps,
            preparing_s=np.nan,
        )
        episodes.append(episode)
    return episodes


def _float64(values: Tensor) -> np.ndarray:
    """Return a float64 copy."""
    return np.array(values.cpu().double().numpy())


def _learning(episodes: Episodes, episode_index: int) -> LearningRecord | None:
    """Return the learning record of an episode; None if robots do not learn."""
    seen_cells = episodes.seen_cells
    sensed_cells = episodes.sensed_cells
    if episodes.ahead is None or seen_cells is None or sensed_cells is None:
        return None
    steps = int(episodes.steps[episode_index])
    n_planned = int(episodes.planned.sum())
    step_s = episodes.learning_s / n_planned if n_planned else np.nan
    return LearningRecord(
        revisions=int(episodes.revisions[episode_index]),
        seen_cells=int(seen_cells[episode_index]),
        sensed_cells=int(sensed_cells[episode_index]),
        ahead=_float64(episodes.ahead[episode_index, :steps]),
        step_s=step_s,
    )


def episode_rows(
    unit: Unit,
    groups: np.ndarray,
    finished: Sequence[Episode],
    errors: Sequence[str],
    compiled: bool,
) -> pd.DataFrame:
    """Tabulate episodes, one row each.

    Args:
        unit: the unit, with its metrics in addition to the built-in ones.
        groups: group index of each map, shape [B].
        finished: episodes of the unit, length B.
        errors: one-line description of each episode's error, length B; empty without
            an error.
        compiled: whether the planner ran compiled.

    Returns:
        The condition's id and labels, `seed`, `realisation`, `map`, `group`, `outcome`;
        the columns of `benchnav.metrics.SHIPPED`; `compiled`, `error`; and the columns
        of the unit's additional metrics.

    Raises:
        MetricError: If a metric raises, or returns an infinite or non-numeric value.
    """
    further = [part.create() for part in unit.metrics]
    rows = []
    for map_index, episode, error in zip(unit.maps, finished, errors, strict=True):
        row: dict[str, Any] = {"outcome": episode.outcome}
        for metric in SHIPPED:
            row[metric.column] = metric.value(episode)
        row["compiled"] = compiled
        row["error"] = error
        try:
            for metric in further:
                row[metric.column] = measure(metric, episode)
        except MetricError as fault:
            origin = (
                f"{unit.condition.description}, seed {unit.seed}, realisation "
                f"{unit.realisation}, map {map_index}"
            )
            message = f"{fault} The episode is one of {origin}."
            raise MetricError(message) from fault
        rows.append(row)
    return _identities(unit, groups).join(pd.DataFrame(rows))


def _identities(unit: Unit, groups: np.ndarray) -> pd.DataFrame:
    """Return the columns that identify the episodes of a unit, one row per episode."""
    columns: dict[str, Any] = {"condition": unit.condition.id}
    columns |= unit.condition.labels
    columns["seed"] = unit.seed
    columns["realisation"] = unit.realisation
    columns["map"] = unit.maps
    columns["group"] = groups
    return pd.DataFrame(columns)


def step_table(unit: Unit, problem: Problem, episodes: Episodes) -> pa.Table:
    """Tabulate the steps of episodes: one row for each step and for the last state.

    Args:
        unit: unit that was run.
        problem: the unit's problem.
        episodes: the unit's episodes.

    Returns:
        `seed`, `realisation`, `map`, `step`, `time_s`, `x_m`, `y_m`, `heading_rad`; a
        column for each action dimension; if robots learn, `AHEAD_COLUMNS` (NaN except
        at updates); and observed `traversability`. Actions and `traversability` are NaN
        at the last state.
    """
    step_axis = np.arange(episodes.states.shape[1])
    n_steps = episodes.steps.numpy()[:, None]
    is_row = step_axis <= n_steps
    is_step = step_axis < n_steps
    step = np.broadcast_to(step_axis, is_row.shape)[is_row]
    n_rows = len(step)

    def step_values(values: Tensor) -> np.ndarray:
        """Return one value per row; NaN at the last state of each episode."""
        numbers = values.numpy().astype(np.float32)
        padded = np.pad(numbers, ((0, 0), (0, 1)))
        return np.where(is_step, padded, np.float32(np.nan))[is_row]

    columns: dict[str, Any] = {}
    columns["seed"] = np.full(n_rows, unit.seed)
    columns["realisation"] = np.full(n_rows, unit.realisation, np.int32)
    columns["map"] = np.repeat(np.array(unit.maps, np.int32), is_row.sum(1))
    columns["step"] = step.astype(np.int32)
    columns["time_s"] = step * problem.dt_s
    for index, name in enumerate(("x_m", "y_m", "heading_rad")):
        numbers = episodes.states[..., index].numpy()
        columns[name] = numbers.astype(np.float32)[is_row]
    for index, name in enumerate(problem.robot.action_names):
        columns[name] = step_values(episodes.actions[..., index])
    if episodes.ahead is not None:
        for index, name in enumerate(AHEAD_COLUMNS):
            columns[name] = step_values(episodes.ahead[..., index])
    columns[LAST_COLUMN] = step_values(episodes.traversability)
    return pa.table(columns)
