"""Problems and steps for checking planners.

Letters in shapes: B episodes.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.planning.problem import Prediction, Problem, Task, pose_problem
from benchnav.planning.sensing.belief import CovarianceModel, Fields, Static
from benchnav.planning.sensing.sensor import Step

_RESOLUTION_M = 0.5


def invert_prediction(problem: Problem) -> Problem:
    """Return the problem with λ replaced by 1 − λ in the risk map and distribution."""
    inverted = change_input(problem, "risk_map")
    return change_input(inverted, "distribution")


def change_input(problem: Problem, name: str) -> Problem:
    """Return the problem with one input changed, and its free space updated to match.

    Args:
        problem: the problem.
        name: name of the input, one of `INPUTS`.
    """
    mixture = problem.distribution
    # `create_problem` always sets a mixture.
    assert isinstance(mixture, TraversabilityMixture)
    inverted = replace(mixture, means=1 - mixture.means)
    others: dict[str, Any] = {
        "risk_map": 1 - problem.risk_map,
        "distribution": inverted,
        "fields": _samples_of(inverted, problem.grid),
    }
    is_source = problem.task.rules.free_space.source == name
    free = problem.free ^ is_source
    return replace(problem, free=free, **{name: others[name]})


def first_step(problem: Problem) -> Step:
    """Return the first step, before λ was observed."""
    unobserved = torch.full_like(problem.start[:, 0], torch.nan)
    return Step(state=problem.start, traversability=unobserved, time_s=0.0)


def step_after(problem: Problem, step: Step, action: Tensor) -> Step:
    """Return the step that follows an action."""
    observed = problem.traversability_at(step.state)
    command = action.clamp(*problem.action_bounds)
    state = problem.robot(step.state, command, observed)
    return replace(step, state=state, traversability=observed)


def numbered_step(problem: Problem, step: Step, ended: Tensor, number: int) -> Step:
    """Return the step of index `number`, at which some episodes have ended.

    The robot of the first ended episode is off the map; the robots of other ended
    episodes are at the goal.

    Args:
        problem: problem of all episodes.
        step: step with the states of running robots.
        ended: mask of ended episodes, bool, shape [B].
        number: index of the step, from 0; `draw` is set at odd steps.
    """
    first_ended = ended.nonzero()[:1, 0]
    position_m = problem.goal_m.index_fill(0, first_ended, -0.3)
    state = step.state.clone()
    state[ended, :2] = position_m[ended]
    time_s = number * problem.dt_s
    is_odd = number % 2 == 1
    return replace(step, state=state, time_s=time_s, draw=is_odd)


def create_problem(
    task: Task, height: int, width: int, device: torch.device, is_certain: bool
) -> Problem:
    """Return a problem on four maps.

    The maps are free terrain, a closed wall, a start on terrain of λ̂ = 0, and a wall
    with a gap.

    Args:
        task: task of all episodes.
        height: number of rows.
        width: number of columns.
        device: device of the problem.
        is_certain: whether the predicted distribution has a spread of 0.
    """
    rows = torch.arange(height, device=device)[:, None]
    columns = torch.arange(width, device=device)
    # λ varies in waves, so that cells differ.
    waves = 0.8 + 0.1 * torch.sin(0.7 * rows + 1.3 * columns)
    traversability = waves.repeat(4, 1, 1)
    wall = slice(height // 2, height // 2 + 2)
    traversability[1, wall] = 0.1
    traversability[2, :5, :5] = 0
    traversability[3, wall, : width - 7] = 0
    traversability[3, wall, width - 3 :] = 0
    hills = 0.2 * torch.sin(0.4 * rows) * torch.cos(0.3 * columns)
    elevation = hills.repeat(4, 1, 1)
    grey = (255 * traversability).to(torch.uint8)
    rgb = grey[:, None].repeat(1, 3, 1, 1)
    spread = 0.0 if is_certain else 1.0
    half_gap = 0.05 * spread
    means = torch.stack((traversability - half_gap, traversability + half_gap), dim=1)
    weights = torch.full_like(means, 0.5)
    stds = torch.full_like(means, 0.1 * spread)
    mixture = TraversabilityMixture(weights, means, stds)
    grid = Grid(height, width, _RESOLUTION_M)
    observation = Observation(rgb, elevation, 10 * elevation.abs(), grid)
    start = means.new_tensor([1.2, 1.3]).repeat(4, 1)
    corner = means.new_tensor(grid.extent_m)
    margin = means.new_tensor([1.7, 1.4])
    goal = (corner - margin).repeat(4, 1)
    fields = _samples_of(mixture, grid)
    prediction = Prediction(observation, mixture, traversability, fields=fields)
    return pose_problem(task, prediction, start, goal, 60.0)


def _samples_of(mixture: TraversabilityMixture, grid: Grid) -> Fields:
    """Return a source of joint samples of λ, with a correlation length of 1 m."""
    covariance = CovarianceModel(grid=grid, correlation_m=1.0)
    belief = Static()
    state = belief.init(mixture, covariance)
    keys = tuple(range(mixture.shape[0]))
    return Fields(belief, state, keys)
