"""Rows of tables: an episode's metrics, and its steps."""

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
class Draws:
    """Reference values of the maps of a batch and of the λ drawn on them.

    Args:
        reference_time_s: grid reference times at 1 m/s, shape [B]; NaN if missing.
        rejected_draws: number of draws of λ of each episode without a feasible path to
            the goal, length B.
        lower_bound_s: lower bound of the time to the goal, infinite if no trajectory
            reaches it, length B; empty if it was not computed.
    """

    reference_time_s: np.ndarray
    rejected_draws: Sequence[int]
    lower_bound_s: Sequence[float] = ()


def finished_episodes(
    problem: Problem, episodes: Episodes, draws: Draws
) -> list[Episode]:
    """Return each episode of a batch as metrics receive it.

    Args:
        problem: the problem of the batch.
        episodes: the episodes of the batch.
        draws: reference values of their maps and λ.
    """
    # In the tensor's own precision, in which planners compare.
    dtype = episodes.traversability.dtype
    above = torch.tensor(problem.task.rules.free_space.above, dtype=dtype)
    planning_s = episodes.planning_s / episodes.planned
    finished = []
    for b in range(len(episodes.steps)):
        steps = int(episodes.steps[b])
        lower_bound_s = draws.lower_bound_s[b] if len(draws.lower_bound_s) else np.nan
        finished.append(
            Episode(
                states=_float64(episodes.states[b, : steps + 1]),
                actions=_float64(episodes.actions[b, :steps]),
                action_names=problem.robot.action_names,
                speed_mps=_float64(episodes.speed_mps[b, :steps]),
                turn_rate_radps=_float64(episodes.turn_rate_radps[b, :steps]),
                traversability=_float64(episodes.traversability[b, :steps]),
                outcome=Outcome(int(episodes.outcome[b])).name.lower(),
                dt_s=problem.dt_s,
                time_budget_s=float(problem.time_budget_s[b]),
                reference_time_s=float(draws.reference_time_s[b]),
                goal_m=_float64(problem.goal_m[b]),
                goal_radius_m=problem.goal_radius_m,
                stuck_traversability=float(above),
                robot=problem.robot,
                planning_s=_float64(planning_s[:steps]),
                preparing_s=episodes.begin_s / len(episodes.steps),
                learning=_learning(episodes, b),
                rejected_draws=draws.rejected_draws[b],
                lower_bound_s=lower_bound_s,
            )
        )
    return finished


def unbegun_episodes(
    task: Task, places: Endpoints, time_budget_s: Tensor, outcome: Outcome
) -> list[Episode]:
    """Return episodes without a step, such as those whose model failed.

    Args:
        task: task of all episodes.
        places: starts and goals.
        time_budget_s: T in seconds, shape [B].
        outcome: outcome of all episodes.
    """
    starts = task.robot.initial_state(heading_to(places.start_m, places.goal_m))
    nothing = np.empty(0)
    return [
        Episode(
            states=_float64(start[None]),
            actions=np.empty((0, len(task.robot.action_names))),
            action_names=task.robot.action_names,
            speed_mps=nothing,
            turn_rate_radps=nothing,
            traversability=nothing,
            outcome=outcome.name.lower(),
            dt_s=task.robot.dt_s,
            time_budget_s=float(budget_s),
            reference_time_s=np.nan,
            goal_m=_float64(goal_m),
            goal_radius_m=task.rules.goal_radius_m,
            stuck_traversability=task.rules.free_space.above,
            robot=task.robot,
            planning_s=nothing,
            preparing_s=np.nan,
        )
        for start, goal_m, budget_s in zip(
            starts, places.goal_m, time_budget_s, strict=True
        )
    ]


def _float64(values: Tensor) -> np.ndarray:
    """Return a float64 copy."""
    return np.array(values.cpu().double().numpy())


def _learning(episodes: Episodes, member: int) -> LearningRecord | None:
    if (
        episodes.ahead is None
        or episodes.seen_cells is None
        or episodes.sensed_cells is None
    ):
        return None
    planned = int(episodes.planned.sum())
    return LearningRecord(
        revisions=int(episodes.revisions[member]),
        seen_cells=int(episodes.seen_cells[member]),
        sensed_cells=int(episodes.sensed_cells[member]),
        ahead=_float64(episodes.ahead[member, : int(episodes.steps[member])]),
        step_s=episodes.learning_s / planned if planned else np.nan,
    )


def episode_rows(
    unit: Unit,
    groups: np.ndarray,
    finished: Sequence[Episode],
    errors: Sequence[str],
    compiled: bool,
) -> pd.DataFrame:
    """Tabulate episodes, a row each.

    Args:
        unit: the unit, with its metrics in addition to the built-in ones.
        groups: group index of each map, shape [B].
        finished: episodes of the unit, length B.
        errors: message of each episode's fault, one line; empty if there was none.
        compiled: whether the planner ran compiled.

    Returns:
        The condition's id and labels, `seed`, `realisation`, `map`, `group`, `outcome`;
        the columns of `benchnav.metrics.SHIPPED`; `compiled`, `error`; and the columns
        of the unit's own metrics.

    Raises:
        MetricError: If a metric fails, or returns no finite number.
    """
    further = [part.create() for part in unit.metrics]
    rows = []
    for map_index, episode, error in zip(unit.maps, finished, errors, strict=True):
        row: dict[str, Any] = {"outcome": episode.outcome}
        row |= {metric.column: metric.value(episode) for metric in SHIPPED}
        row |= {"compiled": compiled, "error": error}
        try:
            row |= {metric.column: measure(metric, episode) for metric in further}
        except MetricError as fault:
            where = (
                f"{unit.condition.description}, seed {unit.seed}, realisation "
                f"{unit.realisation}, map {map_index}"
            )
            raise MetricError(f"{fault} It was given an episode of {where}.") from fault
        rows.append(row)
    return _named(unit, groups).join(pd.DataFrame(rows))


def _named(unit: Unit, groups: np.ndarray) -> pd.DataFrame:
    """Return the columns that identify episodes, a row each."""
    condition = unit.condition
    draw = {
        "seed": unit.seed,
        "realisation": unit.realisation,
        "map": unit.maps,
        "group": groups,
    }
    return pd.DataFrame({"condition": condition.id, **condition.labels, **draw})


def step_table(unit: Unit, problem: Problem, episodes: Episodes) -> pa.Table:
    """Tabulate driven paths, a row for each step and one for the last state.

    Args:
        unit: the unit.
        problem: the unit's problem.
        episodes: the unit's episodes.

    Returns:
        `seed`, `realisation`, `map`, `step`, `time_s`, `x_m`, `y_m`, `heading_rad`,
        each action by its name, if robots learn `AHEAD_COLUMNS` (NaN except at
        updates), and observed `traversability`; actions and `traversability`
        are NaN at the last state.
    """
    steps_axis = np.arange(episodes.states.shape[1])
    steps = episodes.steps.numpy()[:, None]
    inside = steps_axis <= steps
    step = np.broadcast_to(steps_axis, inside.shape)[inside]

    def of_steps(values: Tensor) -> np.ndarray:
        """Return one value a row, NaN at the last state of each episode."""
        padded = np.pad(values.numpy().astype(np.float32), ((0, 0), (0, 1)))
        return np.where(steps_axis < steps, padded, np.float32(np.nan))[inside]

    columns: dict[str, Any] = {
        "seed": np.full(len(step), unit.seed),
        "realisation": np.full(len(step), unit.realisation, np.int32),
        "map": np.repeat(np.array(unit.maps, np.int32), inside.sum(1)),
        "step": step.astype(np.int32),
        "time_s": step * problem.dt_s,
    }
    for index, name in enumerate(("x_m", "y_m", "heading_rad")):
        columns[name] = episodes.states[..., index].numpy().astype(np.float32)[inside]
    for index, name in enumerate(problem.robot.action_names):
        columns[name] = of_steps(episodes.actions[..., index])
    if episodes.ahead is not None:
        for index, name in enumerate(AHEAD_COLUMNS):
            columns[name] = of_steps(episodes.ahead[..., index])
    return pa.table(columns | {LAST_COLUMN: of_steps(episodes.traversability)})
