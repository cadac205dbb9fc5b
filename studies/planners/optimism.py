"""Optimism of MPPI with risk on the cost: cost on new fields of λ minus that on its own.

MPPI chooses actions whose cost is low on the M fields that it drew. On other fields
they can cost more (the optimism of a chosen minimum). Robots start on maps of
`stakes-v1 --seed 1` and plan with the prediction of `stakes-v1` and the time to go of
`expected-time`. Their λ is the mean of the prediction. After 0, 2 and 4 seconds, the
chosen actions are rolled out on 1 024 new fields. The table has the mean difference in
seconds over maps and times with its 95 % interval by maps (Student's t), and the
planning time for one robot of a batch.

CVaR over few fields is biased low for any actions. The table therefore has the same
difference for the actions of the previous step, which these fields did not select.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.planning import MPPI, MPPIConfig, Problem, Step
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.cost_risk import pad_fields, tail_cost
from benchnav.planning.planners.mppi import MPPIState
from benchnav.planning.planners.mppi_rollouts import advance_chunk, roll_out
from benchnav.stats.intervals import mean_interval
from studies.study import Rows, Work
from studies.units import build_unit, one_unit, stakes_suite

MOMENTS, FRESH, AT_ONCE = (0, 20, 40), 1024, 512
CASES = ((0.0, (1, 4, 16, 64, 256)), (0.5, (20, 64, 256)), (0.8, (50, 64, 128, 256)))


def costs_on(
    problem: Problem, state: Tensor, actions: Tensor, ground: Tensor, to_go: Tensor
) -> Tensor:
    """Return the cost of actions [B, T, A] on each of M fields [B·M, N], shape [B, M]."""
    noise = actions.new_zeros(actions.shape[1], actions.shape[2], 1)
    states, cost, _ = roll_out(
        problem, state, actions, noise, problem.goal_m, advance_chunk, ground
    )
    ends = states.unflatten(0, (len(problem), -1))[:, :, 0]
    paths = astar.cost_at(problem.grid, to_go, ends[..., 0], ends[..., 1])
    return cost.view(len(problem), -1) + paths


def optimism(
    problem: Problem, level: float, count: int, samples: int
) -> tuple[np.ndarray, float]:
    """Return cost differences in seconds, and the planning time in milliseconds.

    Returns:
        The cost on new fields minus that on the planner's own, of shape [B, times, 2]
        (chosen actions, actions of the previous step), and the median planning time of
        a step per robot.
    """
    planner = MPPI(
        MPPIConfig(
            risk_on="cost",
            level=level,
            fields=count,
            samples=samples,
            cost_to_go="expected-time",
        )
    )
    plan_state: MPPIState = planner.init(
        problem, rng.generator(rng.stream_key(0, "cost risk"))
    )
    assert plan_state.cost_to_go is not None
    state, gaps_by_moment, elapsed_s = problem.start, [], []
    observed = torch.full_like(state[:, 0], torch.nan)

    def fields(count: int, *key: Any) -> Tensor:
        return pad_fields(problem, problem.sample_fields(count, rng.stream_key(*key)))

    for step in range(MOMENTS[-1] + 1):
        # The fields that the planner will draw in this step.
        own_fields = fields(count, plan_state.key, plan_state.step)
        started = time.perf_counter()
        now = Step(state=state, traversability=observed, time_s=step * problem.dt_s)
        action, after, _ = planner.plan(now, plan_state)
        elapsed_s.append(time.perf_counter() - started)
        if step in MOMENTS:
            chosen = torch.cat((action[:, None], after.mean[:, :-1]), 1)
            gaps = []
            for actions in (chosen, plan_state.mean):
                own_fields_cost = costs_on(
                    problem, state, actions, own_fields, plan_state.cost_to_go
                )
                fresh = [
                    costs_on(
                        problem,
                        state,
                        actions,
                        fields(AT_ONCE, 7, "fresh", step, part),
                        plan_state.cost_to_go,
                    )
                    for part in range(FRESH // AT_ONCE)
                ]
                fresh_cost, own_cost = (
                    tail_cost(cost[..., None], level)[:, 0]
                    for cost in (torch.cat(fresh, 1), own_fields_cost)
                )
                gaps.append(fresh_cost - own_cost)
            gaps_by_moment.append(torch.stack(gaps, 1))
        mean = problem.distribution.mean().to(state)
        traversability = problem.grid.lookup(
            problem.grid.pad(mean, outside=0.0), state[:, 0], state[:, 1]
        )
        state, plan_state = problem.robot(state, action, traversability), after
    return torch.stack(gaps_by_moment, 1).double().numpy(), 1000 * float(
        np.median(elapsed_s)
    ) / len(problem)


def with_interval(values: np.ndarray) -> str:
    """Format the mean over maps with its 95 % interval by Student's t."""
    mean, low, high = (float(end[0]) for end in mean_interval(values[None]))
    return f"{mean:+.2f} ({low:+.2f} to {high:+.2f})"


def table(
    work: Work, folder: Path, maps: int = 20, samples: int = 1024
) -> dict[str, Rows]:
    """Return the optimism of chosen actions, by level and number of fields."""
    data = work.maps_in / "stakes-v1-seed1.h5"
    suite = stakes_suite(
        data, planners=("mppi",), models=("stakes-v1",), risks=("expected-time",)
    )
    problem = build_unit(one_unit(suite, maps)).problem
    rows = []
    for level, counts in CASES:
        for count in counts:
            gaps, solve_ms = optimism(problem, level, count, samples)
            chosen, before = gaps.mean(1).T
            rows.append(
                {
                    "level": f"{level:g}",
                    "fields": count,
                    "fresh less own cost [s] (95 %)": with_interval(chosen),
                    "the same of the actions of the step before": with_interval(before),
                    "chosen less before": with_interval(chosen - before),
                    "ms a solve": f"{solve_ms:.1f}",
                }
            )
    return {"optimism": rows}
