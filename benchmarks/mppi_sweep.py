"""How long MPPI takes to the goal, over its noise and its temperature: what its defaults were chosen by.

    python benchmarks/mppi_sweep.py [--seed 1] [--maps 10] [--samples 5000] [--noise 0.3 …] [--temperature 0.1 …]

Noise is a share of each action's range, temperature a share of the spread of costs. Told are mean times in seconds
under each objective, a failure counted at 100 s: on open ground (λ and λ̂ 0.9, three ways of 22.6 m; `straight` is the
bound), and on the first maps of each scenario of `paper-v1-test` with the model `paper-v1`, the mean of `mean` and
`cvar:0.9`. The last column is the worst of their ratios to the best of a column.
"""

import argparse
import itertools

import pandas as pd
import torch
from rich.console import Console
from rich.progress import track

from benchnav.core import registry, rng
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.unit import Settings, build, simulate
from benchnav.planning.objective import distance
from benchnav.planning.planners.planner import Planner
from benchnav.planning.problem import Rules, Task, pose_problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome

OBJECTIVES, SCENARIOS, BUDGET_S = ("goal_distance", "travel_time"), ("std", "hg", "hs"), 100.0
START_M = torch.tensor([[8.0, 8.0], [4.7, 16.0], [16.0, 27.3]])
GOAL_M = torch.tensor([[24.0, 24.0], [27.3, 16.0], [16.0, 4.7]])


def on_open_ground(planner: Planner[object], objective: str, seed: int) -> float:
    """Mean time on ground of λ 0.9."""
    rules, robot, flat = Rules(), Unicycle(), torch.zeros(3, 64, 64)
    made = registry.make("objective", objective, robot=robot, goal_radius_m=rules.goal_radius_m)
    seen = Observation(flat[:, None].expand(-1, 3, -1, -1).byte(), flat, flat, Grid(64, 64, 0.5))
    known = TraversabilityMixture(*(value.expand(3, 1, 64, 64) for value in torch.tensor([1.0, 0.9, 0.0])))
    task = Task(robot=robot, objective=made, rules=rules)
    problem = pose_problem(task, seen, known, known.mean(), START_M, GOAL_M, BUDGET_S)
    plan_state, state = planner.init(problem, rng.generator(seed)), problem.start
    time_s = torch.full((3,), BUDGET_S)
    for count in range(1, round(BUDGET_S / robot.dt_s) + 1):
        step = Step(state=state, traversability=torch.full((3,), torch.nan), time_s=(count - 1) * robot.dt_s)
        action, plan_state, _ = planner.plan(step, plan_state)
        state = robot(state, action, torch.full((3,), 0.9))
        arrived = distance(state, GOAL_M) < rules.goal_radius_m
        time_s = torch.where(arrived, time_s.clamp(max=count * robot.dt_s), time_s)
        if bool((time_s < BUDGET_S).all()):
            break
    return float(time_s.mean())


def on_maps(options: dict[str, object], objective: str, scenario: str, seed: int, maps: int) -> float:
    """Mean time on shipped maps over both risk settings."""
    planner = {"part": "mppi", "options": options}
    suite = Suite(
        data="paper-v1-test", planners=(planner,), risks=("mean", "cvar:0.9"), objectives=(objective,)
    )
    times = []
    for condition in conditions_of(suite, lambda data: [scenario]):
        unit = Unit(condition=condition, seed=seed, realisation=0, maps=tuple(range(maps)))
        settings = Settings()
        built = build(unit, settings.origins().of(unit))
        episodes, _ = simulate(unit, built, settings)
        arrived = episodes.outcome == int(Outcome.SUCCESS)
        times.append(torch.where(arrived, episodes.steps * built.problem.dt_s, BUDGET_S).mean())
    return float(torch.stack(times).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("seed", 1), ("maps", 10), ("samples", 5000)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.15, 0.25, 0.35, 0.5])
    parser.add_argument("--temperature", type=float, nargs="+", default=[0.02, 0.05, 0.1, 0.2])
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    rows = {}
    for noise, share in track(list(itertools.product(chosen.noise, chosen.temperature)), transient=True):
        options = {"noise_share": noise, "temperature_share": share, "samples": chosen.samples}
        planner, row = registry.make("planner", {"part": "mppi", "options": options}), {}
        for objective in OBJECTIVES:
            row["open", objective] = on_open_ground(planner, objective, chosen.seed)
            for scenario in SCENARIOS if chosen.maps else ():
                row[scenario, objective] = on_maps(options, objective, scenario, chosen.seed, chosen.maps)
        rows[f"noise {noise:g}, temperature {share:g}"] = row
    for objective in OBJECTIVES:
        bound = on_open_ground(registry.make("planner", "straight"), objective, chosen.seed)
        rows.setdefault("straight", {})["open", objective] = bound
    table = pd.DataFrame(rows).T
    table["worst ratio", ""] = (table / table.min()).max(axis=1)
    Console(width=200).print(table.round(2).to_string(), highlight=False)


if __name__ == "__main__":
    main()
