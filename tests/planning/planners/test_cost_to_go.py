"""MPPI's cost of the last state by A*: which map it is of, that all fields share it,
and what it is good for.
"""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.planning import risk
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import GoalDistance, Objective, TravelTime
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.astar.astar_mppi import AStarMPPI, AStarMPPIConfig
from benchnav.planning.planners.mppi import MPPI
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.mppi_rollouts import (
    TerminalInputs,
    advance_chunk,
    roll_out,
    weigh,
)
from benchnav.planning.planners.noise_bank import Sampled
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import drive, first, generator
from tests.planning.planners.test_cost_risk import Given

SMALL = MPPIConfig(samples=128, horizon_s=1.5)


def posed(
    batch: int = 2, objective: Objective | None = None, **changes: Any
) -> Problem:
    """Maps of which the distribution has a spread, so that risk settings differ."""
    mean = 0.31 + 0.6 * torch.rand(batch, 16, 16, generator=generator())
    objective = objective or TravelTime(robot=Unicycle(), goal_radius_m=0.5)
    problem = factories.problem(
        mean, (1.25, 1.25), (6.25, 6.75), objective=objective, **changes
    )
    return replace(
        problem, distribution=factories.normal(mean, torch.full_like(mean, 0.2))
    )


def last_cost(problem: Problem, of: Problem, states: Tensor) -> Tensor:
    """Of the last states by A*'s paths on the map of another problem, and the penalty."""
    costs = astar.pad_costs(of, astar.search(of))
    paths = astar.cost_at(problem.grid, costs, states[..., 0], states[..., 1])
    return paths + PENALTY * ~problem.free_at(states)


@pytest.mark.parametrize("wanted", ["objective", "map", "expected-time"])
@pytest.mark.parametrize("guided", [False, True])
def test_the_last_state_pays_what_the_setting_says(wanted: str, guided: bool) -> None:
    problem = posed()
    config = replace(SMALL, temperature=0.7, cost_to_go=wanted)
    planner = AStarMPPI(AStarMPPIConfig(mppi=config)) if guided else MPPI(config)
    whole = planner.init(problem, generator())
    plan_state, local = (whole.local, planner.local) if guided else (whole, planner)
    # With a cost to go both costs run to the goal, of its radius, whatever guides it.
    if wanted == "objective":
        _, following, _ = local.plan_toward(first(problem), plan_state, problem.goal_m)
    else:
        assert plan_state.problem.objective == problem.objective
        following = planner.plan(first(problem), whole)[1]
        following = following.local if guided else following
    own, noise = plan_state.problem, plan_state.noise.at(0)
    states, cost, _ = roll_out(
        own, problem.start, plan_state.mean, noise, problem.goal_m, advance_chunk
    )
    if wanted == "objective":
        last = own.terminal_cost(states, problem.goal_m[:, None])
    else:
        neutral = replace(problem, risk_map=risk.ExpectedTime()(problem.distribution))
        assert not torch.equal(neutral.risk_map, problem.risk_map)
        last = last_cost(problem, problem if wanted == "map" else neutral, states)
    cost = cost + last
    weights = torch.softmax((cost.amin(1, keepdim=True) - cost) / 0.7, dim=1)
    mean = (plan_state.mean + (noise * weights[:, None, None]).sum(-1)).clamp(
        *problem.action_bounds
    )
    torch.testing.assert_close(
        following.mean[:, :-1], mean[:, 1:], rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize(("closed", "temperature"), [(0.0, 1.0), (0.3, 1e4)])
def test_all_fields_share_the_cost_to_go(closed: float, temperature: float) -> None:
    problem, count = posed(), 3
    problem = replace(
        problem, free=torch.rand(2, 16, 16, generator=generator(7)) >= closed
    )
    fields = 0.3 + 0.7 * torch.rand(2, count, 16, 16, generator=generator(4))
    states = problem.start[:, None, None].repeat(1, count, 5, 1)
    states[..., :2] += 3 * torch.rand(2, count, 5, 2, generator=generator(5))
    costs = astar.pad_costs(problem, astar.search(problem))
    cost = torch.rand(2, count, 5, generator=generator(6))
    mean, noise = torch.zeros(2, 1, 2), torch.zeros(1, 2, 5)
    ground = torch.stack(
        [replace(problem, risk_map=field).padded_ground for field in fields.unbind(1)],
        1,
    )
    target = problem.goal_m[:, None].repeat_interleave(count, 0)
    sampled = Sampled(mean, noise, *problem.action_bounds)
    ends = TerminalInputs(
        ground.flatten(0, 1),
        target,
        problem.grid,
        problem.objective,
        count,
        cost_to_go=costs,
    )
    weights, _ = weigh(
        states.flatten(0, 1), cost.flatten(0, 1), sampled, ends, temperature, 0.1
    )
    each = torch.stack(
        [cost[:, i] + last_cost(problem, problem, states[:, i]) for i in range(count)],
        1,
    )
    # Some end on ground that is not free, and pay for that beside their paths.
    assert bool(problem.free_at(states).all()) is (closed == 0)
    torch.testing.assert_close(
        weights, torch.softmax(-each.mean(1) / temperature, dim=1), rtol=1e-3, atol=1e-6
    )


def test_a_map_that_changes_has_another_cost_to_go() -> None:
    problem = posed()
    planner = MPPI(replace(SMALL, cost_to_go="map"))
    before = planner.init(problem, generator())
    changed = replace(problem, risk_map=problem.risk_map.flip(1))
    after = planner.revise(before, changed)
    wanted = astar.pad_costs(changed, astar.search(changed))
    assert torch.equal(after.cost_to_go, wanted)
    assert not torch.equal(before.cost_to_go, wanted)


@pytest.mark.parametrize("cost", [False, True])
def test_it_leads_out_of_a_dead_end_that_a_straight_line_leads_into(cost: bool) -> None:
    ground = torch.full((1, 32, 32), 0.9)
    ground[:, 8:24, 18] = ground[:, 8, 10:18] = ground[:, 23, 10:18] = 0.05
    objective = TravelTime(robot=Unicycle(), goal_radius_m=0.5)
    problem = factories.problem(ground, (7.25, 8.0), (13.25, 8.0), objective=objective)
    if cost:
        problem = replace(
            problem, fields=Given(problem.risk_map[:, None].expand(-1, 2, -1, -1), [])
        )
    outcomes = []
    for wanted in ("objective", "map"):
        changes: dict[str, Any] = {"cost_to_go": wanted}
        config = replace(SMALL, samples=256, horizon_s=4.0, **changes)
        config = replace(config, risk_on="cost", fields=2) if cost else config
        # Along the map it takes 19 s.
        outcomes.append(
            int(drive(MPPI(config), problem, time_budget_s=25.0).outcome[0])
        )
    assert outcomes == [Outcome.TIMEOUT, Outcome.SUCCESS]


def test_under_a_cost_to_go_a_guide_takes_no_action_of_mppi_elsewhere() -> None:
    """Steps to a waypoint and a last cost to the goal would be two targets: to stand on
    the waypoint costs nothing.
    """
    problem = posed()
    config = replace(SMALL, cost_to_go="map")
    guided = drive(AStarMPPI(AStarMPPIConfig(mppi=config)), problem, time_budget_s=3.0)
    alone = drive(MPPI(config), problem, time_budget_s=3.0)
    assert torch.equal(guided.actions, alone.actions)
    assert float(guided.actions[..., 0].mean()) > 0.5


@pytest.mark.parametrize("wanted", ["map", "expected-time"])
def test_an_episode_alone_does_as_it_does_in_a_batch(wanted: str) -> None:
    problem = posed(3)
    planner = MPPI(replace(SMALL, cost_to_go=wanted))
    state = planner.init(problem, generator())
    together, after, _ = planner.plan(first(problem), state)
    member = torch.tensor([1])
    alone, _, _ = planner.plan(
        first(problem.select(member)), planner.select(state, member)
    )
    assert torch.equal(together[member], alone)
    assert planner.select(after, member).cost_to_go.shape == (1, 2, 18 * 18)


class OwnUnit(GoalDistance):
    """Says nothing of what a path costs."""

    path_cost = Objective.path_cost


def test_what_cannot_be_told_is_refused() -> None:
    with pytest.raises(
        ConfigError,
        match="`cost_to_go` among objective, map, expected-time for MPPI, got 'a'",
    ):
        replace(SMALL, cost_to_go="a")
    problem = posed(objective=OwnUnit())
    MPPI(SMALL).init(problem, generator())
    with pytest.raises(
        ConfigError, match="`path_cost` for option `cost_to_go` of MPPI, got OwnUnit"
    ):
        MPPI(replace(SMALL, cost_to_go="map")).init(problem, generator())
    with pytest.raises(
        ConfigError, match=r"`explore` = 0 for A\*\+MPPI with `cost_to_go` 'map'"
    ):
        AStarMPPIConfig(explore=0.5, mppi=replace(SMALL, cost_to_go="map"))
