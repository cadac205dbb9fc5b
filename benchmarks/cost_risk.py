"""How far the cost that MPPI chose on its own fields is from what it costs on others, against how many fields it had.

    python benchmarks/cost_risk.py --maps_in datasets

MPPI with risk on the cost chooses actions that cost little on the M fields that it drew, so that they could cost more
on others (the optimism of a chosen minimum). Robots begin on maps of `stakes-v1 --seed 1` under the
prediction of `stakes-v1`, with the time to go of `expected-time`, and drive on the mean of the prediction. After 0, 2
and 4 seconds the chosen actions are rolled out on 1 024 fresh fields. Told are the mean of fresh less own over maps and
moments with its 95 % interval by maps (Student's t), in seconds, and how long a solve takes for one robot of a batch.
CVaR of few fields is too low for any actions: so the same is told of those of the step before, which these fields did
not choose, and how much more it is of the chosen ones.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.stats import t
from torch import Tensor

from benchnav.core import rng
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent, units
from benchnav.eval.run.unit import Settings, build, one_thread
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.cost_risk import framed_fields, tail_cost
from benchnav.planning.planners.mppi import MPPI, MPPIConfig, MPPIState, advance_chunk, roll_out
from benchnav.planning.problem import Problem
from benchnav.planning.sensing.sensor import Step

MOMENTS, FRESH, AT_ONCE = (0, 20, 40), 1024, 512
CASES = ((0.0, (1, 4, 16, 64, 256)), (0.5, (20, 64, 256)), (0.8, (50, 64, 128, 256)))


def problem_of(data: Path, maps: int) -> Problem:
    """What robots are given before they set out."""
    suite = Suite(
        data=str(data), planners=("mppi",), models=("stakes-v1",), risks=("expected-time",),
        objectives=("travel_time",), scenarios=("std",), record="none", world=("stakes",), seeds=(1,),
    )  # fmt: skip
    condition = next(iter(conditions_of(suite, lambda data: ["std"])))
    (unit,) = units({condition.id: (condition, Extent.product((1,), 1, maps))})
    return build(unit, Settings().origins().of(unit)).problem


def costs_on(problem: Problem, state: Tensor, actions: Tensor, ground: Tensor, to_go: Tensor) -> Tensor:
    """What a sequence of actions [B, T, A] costs on each of M fields, [B·M, N], shape [B, M]."""
    noise = actions.new_zeros(actions.shape[1], actions.shape[2], 1)
    states, cost, _ = roll_out(problem, state, actions, noise, problem.goal_m, advance_chunk, ground)
    ends = states.unflatten(0, (len(problem), -1))[:, :, 0]
    paths = astar.cost_at(problem.grid, to_go, ends[..., 0], ends[..., 1])
    return cost.view(len(problem), -1) + paths


def optimism(problem: Problem, level: float, count: int, samples: int) -> tuple[np.ndarray, float]:
    """Fresh less own cost in seconds, of what was chosen and of the step before, [B, moments, 2]; ms of a solve."""
    planner = MPPI(
        MPPIConfig(risk_on="cost", level=level, fields=count, samples=samples, cost_to_go="expected-time")
    )
    plan_state: MPPIState = planner.init(problem, rng.generator(rng.stream_key(0, "cost risk")))
    assert plan_state.to_go is not None
    state, found, took = problem.start, [], []
    observed = torch.full_like(state[:, 0], torch.nan)
    for step in range(MOMENTS[-1] + 1):
        # The fields that it is about to draw.
        ground = framed_fields(
            problem, problem.sample_fields(count, rng.stream_key(plan_state.key, plan_state.step))
        )
        begun = time.perf_counter()
        now = Step(state=state, traversability=observed, time_s=step * problem.dt_s)
        action, after, _ = planner.plan(now, plan_state)
        took.append(time.perf_counter() - begun)
        if step in MOMENTS:
            chosen = torch.cat((action[:, None], after.mean[:, :-1]), 1)
            found.append(torch.zeros(len(problem), 2))
            for place, actions in enumerate((chosen, plan_state.mean)):
                own = costs_on(problem, state, actions, ground, plan_state.to_go)
                fresh = [
                    costs_on(
                        problem, state, actions,
                        framed_fields(
                            problem, problem.sample_fields(AT_ONCE, rng.stream_key(7, "fresh", step, part))
                        ),
                        plan_state.to_go,
                    )
                    for part in range(FRESH // AT_ONCE)
                ]  # fmt: skip
                costs = (torch.cat(fresh, 1), own)
                fresh_cost, own_cost = (tail_cost(cost[..., None], level)[:, 0] for cost in costs)
                found[-1][:, place] = fresh_cost - own_cost
        mean = problem.distribution.mean().to(state)
        padded = problem.grid.pad(mean, outside=0.0)
        met = problem.grid.lookup(padded, state[:, 0], state[:, 1])
        state, plan_state = problem.robot(state, action, met), after
    return torch.stack(found, 1).double().numpy(), 1000 * float(np.median(took)) / len(problem)


def with_interval(values: np.ndarray) -> str:
    """The mean of maps, with its 95 % interval by Student's t."""
    mean, error = values.mean(), t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return f"{mean:+.2f} ({mean - error:+.2f} to {mean + error:+.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--maps_in", type=Path, default=Path("datasets"), help="folder of the study's maps")
    parser.add_argument("--maps", type=int, default=20)
    parser.add_argument("--samples", type=int, default=1024)
    given = parser.parse_args()
    data = (given.maps_in / "stakes-v1-seed1.h5").resolve()
    os.chdir(Path(__file__).parents[1])  # where the shipped checkpoints are
    table = Table(
        "level",
        "fields",
        "fresh less own, s (95 % interval)",
        "of the actions before",
        "chosen less before",
        "ms a solve",
    )
    with one_thread():
        problem = problem_of(data, given.maps)
        for level, counts in CASES:
            for count in counts:
                gaps, took = optimism(problem, level, count, given.samples)
                chosen, before = gaps.mean(1).T
                words = map(with_interval, (chosen, before, chosen - before))
                table.add_row(f"{level:g}", f"{count}", *words, f"{took:.1f}")
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
