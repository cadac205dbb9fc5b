"""Rows of tables: an episode's metrics, and its steps.

Sources: paper IV-A for success rate, total time and average traversability; Perille et al. (2020),
"Benchmarking metric ground navigation" (BARN), for the score.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from torch import Tensor

from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.steps import AHEAD_COLUMNS, LAST_COLUMN
from benchnav.eval.run.rollout import Episodes
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome

# Columns of an episode's results, in the order of tables.
_RESULTS = (
    *("outcome", "success", "total_time_s", "end_time_s", "traversability", "reference_time_s", "time_ratio"),
    *("score", "path_length_m", "stuck_share", "roughness_radps2", "planning_ms", "planning_ms_p95"),
    *("planning_start_ms", "revisions", "seen_cells", "sensed_cells", "ahead_rmse", "ahead_log_score"),
    *("learning_ms", "rejected_draws", "lower_bound_s", "compiled", "error"),
)


def episode_rows(
    unit: Unit,
    groups: np.ndarray,
    problem: Problem,
    episodes: Episodes,
    reference_time_s: np.ndarray,
    rejected_draws: Sequence[int],
    compiled: bool,
    lower_bound_s: Sequence[float] | None = None,
) -> pd.DataFrame:
    """Tabulates episodes, a row each.

    Args:
        unit: what was run.
        groups: which maps go together, shape [B].
        problem: what was to be solved.
        episodes: what happened.
        reference_time_s: grid reference times at 1 m/s, shape [B]; NaN where there is none.
        rejected_draws: draws of λ of each episode in which no feasible path joins start and goal, B of them.
        compiled: the planner ran compiled.
        lower_bound_s: time to the goal that no trajectory undercuts, infinite where none arrives, B of them; None where
            it was not computed.

    Returns:
        The condition's id and labels, `seed`, `realisation`, `map`, `group`; `outcome`, `success`; `total_time_s`,
        where a failure counts as the whole time budget; `end_time_s`, when the episode ended;
        `traversability`, the mean of the observed λ; `reference_time_s`; `time_ratio`, over the reference time at
        the robot's top speed, NaN for failures; `score`, BARN's, 0 for failures; `path_length_m`;
        `stuck_share`, share of steps with λ at most λ_stuck; `roughness_radps2`, the mean change of the
        commanded turn rate; wall times of planning as of `planning_times`; what was learnt on the way, as of
        `_learnt`; `rejected_draws`; `lower_bound_s`; `compiled`; `error`.
        What an episode that ended at once does not have is NaN.
    """
    top_speed, rows = problem.robot.top_speed_mps, []
    for b in range(len(unit.maps)):
        steps = int(episodes.steps[b])
        outcome = Outcome(int(episodes.outcome[b]))
        met = episodes.traversability[b, :steps].double().numpy()
        # Compared in the tensor's own precision, as the planners do.
        stuck = episodes.traversability[b, :steps] <= problem.task.rules.free_space.above
        track = episodes.states[b, : steps + 1, :2].double().numpy()
        turn = episodes.turn_rate_radps[b, :steps].double().numpy()
        success = outcome is Outcome.SUCCESS
        end_time_s = steps * problem.dt_s
        reference = float(reference_time_s[b]) / top_speed
        rows.append(
            {
                "outcome": outcome.name.lower(),
                "success": success,
                "total_time_s": end_time_s if success else float(problem.time_budget_s[b]),
                "end_time_s": end_time_s,
                "traversability": met.mean() if steps else np.nan,
                "reference_time_s": float(reference_time_s[b]),
                "time_ratio": end_time_s / reference if success else np.nan,
                "score": score(end_time_s, reference) if success else 0.0,
                "path_length_m": path_length_m(track) if steps else np.nan,
                "stuck_share": float(stuck.double().mean()) if steps else np.nan,
                "roughness_radps2": np.abs(np.diff(turn)).mean() / problem.dt_s if steps > 1 else np.nan,
                **planning_times(episodes, b),
                **_learnt(episodes, b, steps),
                "rejected_draws": rejected_draws[b],
                "lower_bound_s": np.nan if lower_bound_s is None else lower_bound_s[b],
                "compiled": compiled,
                "error": episodes.errors[b],
            }
        )
    return _named(unit, groups).join(pd.DataFrame(rows))


def error_rows(
    unit: Unit, groups: np.ndarray, time_budget_s: Tensor, outcome: Outcome, error: str
) -> pd.DataFrame:
    """Rows of episodes that could not begin, since their model, say, failed; T of shape [B]."""
    failed = dict.fromkeys(_RESULTS, np.nan) | {
        **{"outcome": outcome.name.lower(), "success": False, "end_time_s": 0.0, "score": 0.0},
        **{"rejected_draws": 0, "compiled": False, "error": error},
    }
    return _named(unit, groups).assign(**failed | {"total_time_s": time_budget_s.tolist()})


def _named(unit: Unit, groups: np.ndarray) -> pd.DataFrame:
    """What episodes are known by, a row each."""
    condition = unit.condition
    draw = {"seed": unit.seed, "realisation": unit.realisation, "map": unit.maps, "group": groups}
    return pd.DataFrame({"condition": condition.id, **condition.labels, **draw})


def _learnt(episodes: Episodes, member: int, steps: int) -> dict[str, float]:
    """What a robot learnt: `revisions` of its map, how many cells it saw and sensed, errors ahead, and the time.

    Args:
        episodes: what happened.
        member: which episode.
        steps: how many it took.

    Returns:
        NaN where robots learn nothing. `ahead_rmse` and `ahead_log_score` are means over the updates of the episode;
        `learning_ms` is the wall time of a step of the batch over its episodes.
    """
    names = ("revisions", "seen_cells", "sensed_cells", "ahead_rmse", "ahead_log_score", "learning_ms")
    if episodes.ahead is None or episodes.seen_cells is None or episodes.sensed_cells is None:
        return dict.fromkeys(names, np.nan)
    ahead = episodes.ahead[member, :steps].double().numpy()
    known = ahead[~np.isnan(ahead[:, 0])]
    means = known.mean(0) if len(known) else (np.nan, np.nan)
    planned = int(episodes.planned.sum())
    values = (
        *(episodes.revisions[member], episodes.seen_cells[member], episodes.sensed_cells[member]),
        *(*means, 1e3 * episodes.learning_s / planned if planned else np.nan),
    )
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def planning_times(episodes: Episodes, member: int) -> dict[str, float]:
    """Wall times of planning for one robot: those of a batch over the number of episodes that it was for.

    Args:
        episodes: what happened.
        member: which episode.

    Returns:
        `planning_ms` a step, the median over the episode's own steps but the first, and its 95th percentile
        `planning_ms_p95`; `planning_start_ms`, what is prepared and the first step, compilation among it.
        NaN where there is no such step.
    """
    steps = int(episodes.steps[member])
    own = 1e3 * (episodes.planning_s / episodes.planned)[:steps].numpy()
    begin_ms = 1e3 * episodes.begin_s / len(episodes.steps)
    middle, high = np.percentile(own[1:], (50, 95)) if len(own) > 1 else (np.nan, np.nan)
    return {
        "planning_ms": float(middle),
        "planning_ms_p95": float(high),
        "planning_start_ms": begin_ms + float(own[0]) if len(own) else np.nan,
    }


def path_length_m(track: np.ndarray) -> float:
    """Length of a driven path, positions of shape [N, 2]."""
    return float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum())


def score(time_s: float, reference_s: float) -> float:
    """BARN's score of a success: OT over the time, kept within 2 OT and 8 OT; at most 0.5.

    OT is half the reference time at the robot's top speed, so that arriving in that time is the best.
    """
    least = reference_s / 2
    return least / min(max(time_s, 2 * least), 8 * least)


def step_table(unit: Unit, problem: Problem, episodes: Episodes) -> pa.Table:
    """Tabulates driven paths, a row a state: one a step and one for the last state.

    Args:
        unit: what was run.
        problem: what was to be solved.
        episodes: what happened.

    Returns:
        `seed`, `realisation`, `map`, `step`, `time_s`, `x_m`, `y_m`, `heading_rad`, each action by its
        name, where robots learn `AHEAD_COLUMNS` (NaN but where what is known was updated), and `traversability` as
        met; actions and `traversability` are NaN at the last state.
    """
    every, steps = np.arange(episodes.states.shape[1]), episodes.steps.numpy()[:, None]
    inside = every <= steps
    step = np.broadcast_to(every, inside.shape)[inside]

    def of_steps(values: Tensor) -> np.ndarray:
        """One value a row, NaN at the last state of each episode."""
        padded = np.pad(values.numpy().astype(np.float32), ((0, 0), (0, 1)))
        return np.where(every < steps, padded, np.float32(np.nan))[inside]

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
