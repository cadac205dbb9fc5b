"""Metrics of an episode: the paper's three, and what explains them.

Source: paper IV-A for success rate, total time and average traversability.
"""

import numpy as np
import pandas as pd

from benchnav.eval.rollout import Episodes
from benchnav.eval.suite import Unit
from benchnav.planning.problem import Problem
from benchnav.planning.simulation import Outcome


def episode_table(
    unit: Unit, problem: Problem, episodes: Episodes, reference_time_s: np.ndarray
) -> pd.DataFrame:
    """Tabulates episodes, a row each.

    Args:
        unit: what was run.
        problem: what was to be solved.
        episodes: what happened.
        reference_time_s: grid reference times, shape [B].

    Returns:
        Columns `planner`, `risk`, `scenario`, `instance`, `outcome`, `success`; `total_time_s`, where
        a failure counts as the whole time budget; `end_time_s`, when the episode ended;
        `traversability`, the mean of the λ met; `time_ratio`, over the grid reference time, NaN for
        failures; `path_length_m`; `stuck_share`, share of steps with λ ≤ λ_stuck; `roughness`, the
        mean change of commanded turn rate a step in rad/s.
    """
    rows = []
    for b, instance in enumerate(unit.instances):
        steps = int(episodes.steps[b])
        outcome = Outcome(int(episodes.outcome[b]))
        met = episodes.traversability[b, :steps].double().numpy()
        # Compared in the tensor's own precision, as the planners do.
        stuck = episodes.traversability[b, :steps] <= problem.stuck_threshold
        track = episodes.states[b, : steps + 1, :2].double().numpy()
        turn = episodes.actions[b, :steps, 1].double().numpy()
        success = outcome is Outcome.SUCCESS
        end_time_s = steps * problem.dt_s
        rows.append(
            {
                "planner": unit.planner,
                "risk": unit.risk,
                "scenario": unit.scenario,
                "instance": instance,
                "outcome": outcome.name.lower(),
                "success": success,
                "total_time_s": end_time_s if success else problem.time_budget_s,
                "end_time_s": end_time_s,
                "traversability": met.mean() if steps else np.nan,
                "reference_time_s": float(reference_time_s[b]),
                "time_ratio": end_time_s / float(reference_time_s[b]) if success else np.nan,
                "path_length_m": float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum()),
                "stuck_share": float(stuck.double().mean()) if steps else np.nan,
                "roughness": float(np.abs(np.diff(turn)).mean()) if steps > 1 else 0.0,
            }
        )
    return pd.DataFrame(rows)


def step_table(unit: Unit, problem: Problem, episodes: Episodes) -> pd.DataFrame:
    """Tabulates the driven paths, a row a step and one for the last state.

    Returns:
        Columns `planner`, `risk`, `scenario`, `instance`, `step`, `time_s`, `x_m`, `y_m`,
        `heading_rad`, and, NaN in an episode's last row, `speed_mps`, `turn_rate_radps` as commanded
        and `traversability` as met.
    """
    tables = []
    for b, instance in enumerate(unit.instances):
        steps = int(episodes.steps[b])
        states = episodes.states[b, : steps + 1].numpy()
        blank = np.full((1, episodes.actions.shape[2]), np.nan, np.float32)
        actions = np.concatenate((episodes.actions[b, :steps].numpy(), blank))
        met = np.append(episodes.traversability[b, :steps].numpy(), np.float32(np.nan))
        tables.append(
            pd.DataFrame(
                {
                    "planner": unit.planner,
                    "risk": unit.risk,
                    "scenario": unit.scenario,
                    "instance": instance,
                    "step": np.arange(steps + 1),
                    "time_s": np.arange(steps + 1) * problem.dt_s,
                    "x_m": states[:, 0],
                    "y_m": states[:, 1],
                    "heading_rad": states[:, 2],
                    "speed_mps": actions[:, 0],
                    "turn_rate_radps": actions[:, 1],
                    "traversability": met,
                }
            )
        )
    return pd.concat(tables, ignore_index=True)
