import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product
from typing import Any

import pytest
import torch
import torch._dynamo.config
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.store import text_digest
from benchnav.planning.free_space import PENALTY, Immobile
from benchnav.planning.objective import GoalDistance, Objective, TravelTime
from benchnav.planning.planners import compilation
from benchnav.planning.planners.astar.astar_mppi import AStarMPPI, AStarMPPIConfig
from benchnav.planning.planners.cost_risk import (
    advance_entrapped,
    pad_fields,
    tail_cost,
    within_reach,
)
from benchnav.planning.planners.mppi import MPPI, MPPIState
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.mppi_rollouts import (
    Dwell,
    TerminalInputs,
    advance_chunk,
    cost_spread,
    roll_out,
    weigh,
)
from benchnav.planning.planners.noise_bank import Sampled
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.belief import CovarianceModel, Fields, Static
from tests import factories
from tests.planning.planners.driving import first, generator, rollout_cost

SMALL = MPPIConfig(samples=64, horizon_s=1.5)


@dataclass(frozen=True)
class Given:
    """Fields that are given, as many as are asked for of [B, M, H, W]; notes the keys
    that they are asked by.
    """

    fields: Tensor
    keys: list[int]

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        self.keys.append(key)
        return self.fields[:, :count]

    def select(self, members: Tensor) -> "Given":
        return Given(self.fields[members], self.keys)


def varied(batch: int = 2, **changes: Any) -> Problem:
    maps = 0.31 + 0.6 * torch.rand(batch, 16, 16, generator=generator())
    return factories.problem(maps, **changes)


def fields(problem: Problem, count: int) -> Tensor:
    return torch.rand(len(problem), count, 16, 16, generator=generator(5))


def drives(planner: Any, problem: Problem, steps: int = 3) -> tuple[list[Tensor], Any]:
    """Actions of some steps, and the last plan state."""
    plan_state, state, found = planner.init(problem, generator()), problem.start, []
    for _ in range(steps):
        action, plan_state, _ = planner.plan(
            replace(first(problem), state=state), plan_state
        )
        found.append(action)
        state = problem.robot(state, action, problem.traversability_at(state))
    return found, plan_state


@settings(max_examples=60, deadline=None)
@given(count=st.integers(1, 40), level=st.floats(0, 0.99), seed=st.integers(0, 99))
def test_the_tail_of_a_cost_is_the_mean_over_its_worst_fields_and_a_part_of_one(
    count: int, level: float, seed: int
) -> None:
    cost = torch.rand(2, count, 3, generator=generator(seed), dtype=torch.float64)
    found = tail_cost(cost, level)
    left, total = (1 - level) * count, torch.zeros(2, 3, dtype=torch.float64)
    for values in cost.sort(1, descending=True).values.unbind(1):
        total += min(1.0, left) * values
        left = max(left - 1, 0)
    torch.testing.assert_close(found, total / ((1 - level) * count))
    if level == 0:
        torch.testing.assert_close(found, cost.mean(1))


def test_one_field_that_is_sure_is_the_map_bit_for_bit() -> None:
    problem = varied(3)
    sure = replace(problem, fields=Given(problem.risk_map[:, None], []))
    for planner in (MPPI, lambda config: AStarMPPI(AStarMPPIConfig(mppi=config))):
        wanted, _ = drives(planner(SMALL), problem)
        found, _ = drives(planner(replace(SMALL, risk_on="cost", fields=1)), sure)
        assert all(torch.equal(*pair) for pair in zip(found, wanted, strict=True))


def test_fields_of_ground_that_is_known_for_sure_are_the_map_bit_for_bit() -> None:
    problem, belief = varied(3), Static()
    sure = factories.normal(problem.risk_map, torch.zeros_like(problem.risk_map))
    source = Fields(
        belief,
        belief.init(sure, CovarianceModel(grid=problem.grid, correlation_m=1.0)),
        (7, 3, 5),
    )
    posed = replace(problem, distribution=sure, fields=source)
    wanted, _ = drives(MPPI(SMALL), problem)
    found, _ = drives(MPPI(replace(SMALL, risk_on="cost", fields=1)), posed)
    assert all(torch.equal(*pair) for pair in zip(found, wanted, strict=True))


def test_ground_that_is_not_free_has_its_penalty_on_every_field() -> None:
    problem = varied()
    problem = replace(
        problem,
        free=problem.free
        & (torch.rand(problem.free.shape, generator=generator(1)) > 0.5),
    )
    ground = pad_fields(problem, fields(problem, 3)).unflatten(0, (2, 3))
    assert torch.equal(
        ground > 0, (problem.padded_ground > 0)[:, None].expand_as(ground)
    )


@pytest.mark.parametrize("level", [0.0, 0.4])
def test_what_a_sequence_costs_is_the_tail_over_all_fields(level: float) -> None:
    """Each field is a problem of its own, whose costs are enumerated."""
    count = 20
    problem = varied()
    drawn = fields(problem, count)
    posed = replace(problem, fields=Given(drawn, []))
    planner = MPPI(
        replace(SMALL, risk_on="cost", fields=count, level=level, temperature=0.7)
    )
    plan_state = planner.init(posed, generator())
    action, _, _ = planner.plan(first(posed), plan_state)
    noise = plan_state.noise.at(0)
    costs = torch.stack([
        rollout_cost(
            replace(problem, risk_map=field), problem.start, plan_state.mean, noise, problem.goal_m
        )
        for field in drawn.unbind(1)
    ], dim=1)  # fmt: skip
    worst = (
        costs.sort(1, descending=True)
        .values[:, : round((1 - level) * count)]
        .mean(1)
        .double()
    )
    weights = torch.softmax((worst.amin(1, keepdim=True) - worst) / 0.7, dim=1)
    moved = (noise[0].double() * weights[:, None]).sum(-1)
    wanted = moved.clamp(*(bound.double() for bound in problem.action_bounds))
    torch.testing.assert_close(action.double(), wanted, atol=2e-4, rtol=1e-3)


def test_the_tail_over_drawn_fields_is_that_over_all_that_there_are() -> None:
    """Three cells on the way have one of two λ each: eight fields, whose costs and
    chances are enumerated.
    """
    count, chance = 200, torch.tensor([0.3, 0.5, 0.2])
    posed = factories.problem(
        torch.ones(1, 4, 10), start=(0.75, 1.25), goal=(4.25, 1.25)
    )
    weights, means = torch.zeros(1, 2, 4, 10), torch.ones(1, 2, 4, 10)
    weights[:, 1] = 1.0
    weights[0, :, :, 2:5] = torch.stack((chance, 1 - chance))[:, None]
    means[0, 0, :, 2:5] = 0.3
    known = TraversabilityMixture(weights, means, torch.zeros_like(means))
    belief = Static(correlated=False)
    source = Fields(
        belief,
        belief.init(known, CovarianceModel(grid=posed.grid, correlation_m=1.0)),
        (7,),
    )
    posed = replace(posed, distribution=known, fields=source)
    plan_state = MPPI(replace(SMALL, samples=16)).init(posed, generator())
    noise = plan_state.noise.at(0)

    def costs_on(fields: Tensor) -> Tensor:
        ground = pad_fields(posed, fields[None])
        return roll_out(
            posed,
            posed.start,
            plan_state.mean,
            noise,
            posed.goal_m,
            advance_chunk,
            ground,
        )[1].double()

    slow = torch.tensor(list(product((True, False), repeat=3)))
    all_fields = torch.ones(8, 4, 10)
    all_fields[:, :, 2:5] = torch.where(slow, 0.3, 1.0)[:, None]
    cost, chances = (
        costs_on(all_fields),
        torch.where(slow, chance, 1 - chance).prod(1).double(),
    )
    order = cost.argsort(0, descending=True)
    share = chances[:, None].expand_as(cost).gather(0, order)
    drawn = costs_on(posed.sample_fields(count, 5)[0])
    tails = []
    for level in (0.0, 0.5, 0.8):
        counted = (1 - level - (share.cumsum(0) - share)).clamp(min=0).minimum(share)
        wanted = (counted * cost.gather(0, order)).sum(0) / (1 - level)
        error = drawn.std(0) / math.sqrt((1 - level) * count)
        assert bool(
            (
                (tail_cost(drawn[None], level)[0] - wanted).abs() <= 4 * error + 1e-4
            ).all()
        )
        tails.append(wanted)
    assert all(float((more - less).max()) > 0.1 for less, more in pairwise(tails))


def test_fields_are_drawn_anew_at_each_step_and_once_if_that_is_asked_for() -> None:
    for once, asked in ((False, 3), (True, 1)):
        problem = varied()
        source = Given(fields(problem, 4), [])
        planner = MPPI(replace(SMALL, risk_on="cost", fields=4, once=once))
        _, plan_state = drives(planner, replace(problem, fields=source))
        assert len(set(source.keys)) == len(source.keys) == asked
        again = Given(source.fields, [])
        drives(planner, replace(problem, fields=again))
        assert again.keys == source.keys
        # What is known of the map has changed.
        other = Given(1 - source.fields, [])
        revised = planner.revise(plan_state, replace(problem, fields=other))
        assert len(other.keys) == once
        assert (
            torch.equal(
                planner._padded_ground(revised, problem.start).abs().max(),
                other.fields.max(),
            )
            or not once
        )


def test_fields_of_a_seed_are_others_than_those_of_another() -> None:
    problem, keys = varied(), []
    for seed in (0, 1):
        source = Given(fields(problem, 4), [])
        planner = MPPI(replace(SMALL, risk_on="cost", fields=4))
        planner.plan(
            first(problem),
            planner.init(replace(problem, fields=source), generator(seed)),
        )
        keys.append(source.keys[0])
    assert keys[0] != keys[1]


@pytest.mark.parametrize("once", [False, True])
def test_an_episode_alone_does_as_it_does_in_a_batch(once: bool) -> None:
    problem = varied(3)
    belief = Static()
    covariance = CovarianceModel(grid=problem.grid, correlation_m=1.0)
    doubtful = factories.normal(
        problem.risk_map, torch.full_like(problem.risk_map, 0.2)
    )
    source = Fields(belief, belief.init(doubtful, covariance), (7, 3, 5))
    problem = replace(problem, distribution=doubtful, fields=source)
    planner = MPPI(replace(SMALL, risk_on="cost", fields=20, level=0.5, once=once))
    whole, state = drives(planner, problem, steps=1)
    member = torch.tensor([1])
    alone, _ = drives(planner, problem.select(member), steps=1)
    torch.testing.assert_close(whole[0][1:2], alone[0], atol=1e-5, rtol=1e-4)
    # An ended episode leaves, and the fields of the others are theirs as before.
    step = replace(first(problem), state=problem.start + 0.1)
    kept = planner.select(state, member)
    wanted = planner.plan(step, state)[0][member]
    found = planner.plan(
        replace(
            step, state=step.state[member], traversability=step.traversability[member]
        ),
        kept,
    )
    torch.testing.assert_close(found[0], wanted, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("compiled", "to_go"), [(False, "objective"), (True, "expected-time")]
)
def test_each_episode_has_its_own_start_goal_fields_and_time_held(
    compiled: bool, to_go: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alone and in a batch that shrinks; what is compiled for one number of episodes
    serves all.
    """
    traced: list[bool] = []
    real = compilation._compiling
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="eager"))
    monkeypatch.setattr(compilation, "worth_compiling", lambda *_: compiled)
    monkeypatch.setattr(
        compilation,
        "_compiling",
        lambda checked: traced.append(checked) or real(checked),
    )
    problem = varied(3)
    doubtful = factories.normal(
        problem.risk_map, torch.full_like(problem.risk_map, 0.3)
    )
    # One begins where another is to go.
    start = torch.tensor([[6.0, 1.5, 2.4], [5.25, 2.25, 2.0], [3.0, 6.0, -1.0]])
    goal = torch.tensor([[1.75, 6.75], [1.75, 5.25], [6.25, 1.25]])
    source = Fields(
        Static(),
        Static().init(doubtful, CovarianceModel(grid=problem.grid, correlation_m=1.0)),
        (7, 3, 5),
    )
    problem = replace(
        problem, distribution=doubtful, fields=source, start=start, goal_m=goal,
        immobile=Immobile(below=0.4, for_s=0.5),
        time_budget_s=torch.tensor([20.0, 30.0, 40.0], dtype=torch.float64),
    )  # fmt: skip
    planner = MPPI(
        replace(
            SMALL, samples=40, risk_on="cost", fields=20, level=0.5, control_cost=0.1, entrapment=True,
            cost_to_go=to_go,
        )
    )  # fmt: skip
    objective = TravelTime(robot=Unicycle(), goal_radius_m=1.0)
    problem = replace(problem, task=replace(problem.task, objective=objective))
    observed = torch.tensor([0.2, 0.9, 0.3])  # of which two are held
    with torch._dynamo.config.patch(disable=False):
        found = {}
        for members in ([0, 1, 2], [2, 0], [1], [0], [2]):
            posed, own = problem.select(torch.tensor(members)), observed[members]
            plan_state = planner.init(posed, generator())
            action, plan_state, _ = planner.plan(
                replace(first(posed), traversability=own), plan_state
            )
            step = replace(
                first(posed), state=posed.start + 0.1, traversability=own, time_s=0.1
            )
            action, plan_state, _ = planner.plan(step, plan_state)
            found |= {
                (len(members), member): action[place]
                for place, member in enumerate(members)
            }
    for (_, member), action in found.items():
        torch.testing.assert_close(action, found[3, member], atol=1e-5, rtol=1e-4)
    assert planner.compiled is compiled
    # Two chunks of the horizon, whose fields are many even of one episode, and what
    # weighs them, of several and of one.
    assert len(traced) == (4 if compiled else 0)


def test_cells_that_rollouts_cannot_reach_are_not_looked_up_and_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = varied(2, start=(1.25, 2.25), goal=(6.75, 5.25))
    doubtful = factories.normal(
        problem.risk_map, torch.full_like(problem.risk_map, 0.3)
    )
    source = Fields(
        Static(),
        Static().init(doubtful, CovarianceModel(grid=problem.grid, correlation_m=1.0)),
        (7, 3),
    )
    problem = replace(problem, distribution=doubtful, fields=source)
    planner = MPPI(replace(SMALL, risk_on="cost", fields=4))
    plan_state = planner.init(problem, generator())
    found, _, _ = planner.plan(first(problem), plan_state)
    ground = planner._padded_ground(plan_state, problem.start)
    # in 1.5 s of 8 m × 8 m
    assert 0.5 < float((ground.abs() < 1e-20).double().mean()) < 0.9
    monkeypatch.setattr(
        Static, "sample_cells", lambda self, *given: self.sample_fields(*given[:3])
    )
    wanted, _, _ = planner.plan(first(problem), plan_state)
    assert torch.equal(found, wanted)
    assert (
        float((planner._padded_ground(plan_state, problem.start) > 0).double().mean())
        > 0.7
    )


def test_what_is_within_reach_is_what_top_speed_reaches() -> None:
    problem = varied(2)
    state = torch.tensor([[2.25, 2.25, 0.0], [7.9, 4.25, 1.0]])
    found = within_reach(problem, state, 1.5)
    assert found[0].sum() == 49  # points of a grid within 4 of one of them
    for member in range(2):
        for row in range(16):
            for column in range(16):
                away = math.dist(
                    (0.5 * column + 0.25, 0.5 * row + 0.25), state[member, :2]
                )
                assert bool(found[member, row, column]) is (away <= 2.0)


def held_cost(
    problem: Problem,
    ground: Tensor,
    actions: Tensor,
    held: int,
    time_s: float,
    immobile: Immobile,
) -> float:
    """What one sequence [T, 2] costs on a map by a plain loop, the last state included."""
    state, cost, most = problem.start[0].double(), 0.0, round(immobile.for_s / 0.1)
    left = round((float(problem.time_budget_s[0]) - time_s) / 0.1)
    target, arrived = problem.goal_m[0].double(), False
    for place, action in enumerate(actions.double()):
        row, column = int(state[1] // 0.5), int(state[0] // 0.5)
        value, off = (
            ground[row, column].double(),
            PENALTY * (not problem.free[0, row, column]),
        )
        cost += float(problem.objective.stage(state, action, value, target)) + off
        arrived = arrived or math.dist(state[:2], target) < problem.goal_radius_m
        held = held + 1 if value < immobile.below and not arrived else 0
        if held >= most:
            standing = problem.objective.stage(state, torch.zeros(2), value, target)
            return cost + (float(standing) + off) * (left - place - 1)
        clamped = value.clamp(min=problem.task.rules.min_traversability)
        state = problem.robot(state, action, clamped)
    row, column = int(state[1] // 0.5), int(state[0] // 0.5)
    off = PENALTY * (not problem.free[0, row, column])
    return (
        cost
        + float(problem.objective.terminal(state, ground[row, column].double(), target))
        + off
    )


@pytest.mark.parametrize("case", ["", "held by now", "closed", "behind the goal"])
@pytest.mark.parametrize(
    "objective", [GoalDistance(), TravelTime(robot=Unicycle(), goal_radius_m=1.0)]
)
def test_a_rollout_that_is_held_pays_what_is_left_of_the_time(
    objective: Objective, case: str
) -> None:
    ground = torch.full((1, 16, 16), 0.9)
    ground[:, 4:, 5:8] = 0.05
    immobile = Immobile(below=0.1, for_s=0.5)
    passed = case == "behind the goal"
    least, radius_m = (0.4, 0.15) if passed else (0.2, 0.3)
    rules = replace(
        factories.task().rules, min_traversability=least, goal_radius_m=radius_m
    )
    goal, held = (2.6 if passed else 6.75, 2.25), 3 * (case == "held by now")
    problem = factories.problem(
        ground,
        start=(2.2, 2.25),
        goal=goal,
        objective=objective,
        rules=rules,
        time_budget_s=9.0,
    )
    free = torch.ones_like(problem.free)
    free[:, 4:, 5:8] = case != "closed"
    problem = replace(problem, immobile=immobile, free=free)
    mean = torch.zeros(1, 25, 2)
    noise = torch.rand(25, 2, 6, generator=generator(3))
    noise[:, 1] -= 0.5
    states, cost, going = roll_out(
        problem,
        problem.start,
        mean,
        noise,
        problem.goal_m,
        advance_entrapped,
        None,
        Dwell(torch.tensor([float(held)]), 2.0),
    )
    assert going is not None
    last = problem.terminal_cost(states, problem.goal_m[:, None])
    found = cost + torch.where(going, last, 0)
    actions = noise.movedim(2, 0).clamp(
        torch.tensor([0.0, -1.0]), torch.tensor([1.0, 1.0])
    )
    wanted = [
        held_cost(problem, ground[0], one, held, 2.0, immobile) for one in actions
    ]
    assert found[0].tolist() == pytest.approx(wanted, rel=1e-4)
    if passed:  # and held by nothing
        behind = (states[0, :, 0] > 2.8) & (found[0] < 3)
        assert bool((behind & going[0]).any()) or isinstance(objective, GoalDistance)
        return
    assert bool((~going).any())
    if isinstance(objective, TravelTime) and case != "closed":
        assert found[0][~going[0]].tolist() == pytest.approx(
            [7.0] * int((~going).sum()), rel=1e-4
        )


def test_rollouts_that_have_stopped_have_no_last_cost() -> None:
    problem = varied(1)
    states = problem.start[:, None].expand(-1, 4, -1).clone()
    cost, going = (
        torch.tensor([[3.0, 3.0, 3.0, 4.0]]),
        torch.tensor([[True, False, True, False]]),
    )
    given = (
        problem.padded_ground,
        problem.goal_m[:, None],
        problem.grid,
        problem.objective,
    )
    sampled = Sampled(
        torch.zeros(1, 1, 2), torch.zeros(1, 2, 4), *problem.action_bounds
    )
    weights, _ = weigh(
        states, cost, sampled, TerminalInputs(*given, is_mobile=going), 1.0, 0.1
    )
    last = problem.terminal_cost(states, problem.goal_m[:, None])
    assert float(last.min()) > 1
    wanted = torch.softmax(-(cost + torch.where(going, last, 0)), dim=1)
    torch.testing.assert_close(weights, wanted)


def test_a_step_off_free_ground_on_one_field_does_not_set_the_temperature() -> None:
    """The spread is that of the samples that have no such step, however little it adds
    to the cost of M fields.
    """
    cost = torch.tensor([[3.0, 1.0, 2.0, 901.0]])[:, None].repeat(1, 20, 1)
    cost[:, 4, 2] += PENALTY
    wanted = (2.0 + 0.0 + 900.0) / 3  # what is not a penalty counts, however much it is
    for level in (0.0, 0.5):
        tail = tail_cost(cost, level)
        assert float(tail[0, 2]) == pytest.approx(2.0 + PENALTY / (20 * (1 - level)))
        problem = varied(1)
        states = problem.goal_m[:, None].repeat(20, 4, 1)
        states = torch.cat((states, torch.zeros(20, 4, 1)), 2)
        ground = pad_fields(problem, fields(problem, 20))
        sampled = Sampled(
            torch.zeros(1, 1, 2), torch.zeros(1, 2, 4), *problem.action_bounds
        )
        target = problem.goal_m[:, None].repeat(20, 1, 1)
        ends = TerminalInputs(ground, target, problem.grid, GoalDistance(), 20, level)
        weights, _ = weigh(states, cost[0], sampled, ends, None, 1.0)
        assert float(weights[0, 0] / weights[0, 1]) == pytest.approx(
            math.exp(-2 / wanted), rel=1e-4
        )


def test_samples_that_are_held_on_more_fields_than_the_best_do_not_set_the_temperature() -> (
    None
):
    cost = torch.tensor([[3.0, 1.0, 80.0, 2.0]])
    assert float(
        cost_spread(cost, stopped=torch.tensor([[1, 1, 3, 0]]))
    ) == pytest.approx(1.0)
    assert float(cost_spread(cost)) == pytest.approx((2 + 0 + 79 + 1) / 4)
    problem = varied(1)
    states = torch.cat(
        (problem.goal_m[:, None].repeat(2, 4, 1), torch.zeros(2, 4, 1)), 2
    )
    going = torch.ones(2, 4, dtype=torch.bool)
    going[1, 2] = False
    ground = pad_fields(problem, fields(problem, 2))
    sampled = Sampled(
        torch.zeros(1, 1, 2), torch.zeros(1, 2, 4), *problem.action_bounds
    )
    ends = TerminalInputs(
        ground,
        problem.goal_m[:, None].repeat(2, 1, 1),
        problem.grid,
        GoalDistance(),
        2,
        0.0,
        going,
    )
    weights, _ = weigh(states, cost.repeat(2, 1), sampled, ends, None, 1.0)
    assert float(weights[0, 0] / weights[0, 1]) == pytest.approx(math.exp(-2), rel=1e-4)


def trap() -> Problem:
    """Soft ground straight ahead, and firm ground around it; the map says that it is
    only slow.
    """
    ground = torch.full((1, 24, 24), 0.9)
    ground[:, 8:15, 8:12] = 0.08
    rules = replace(factories.task().rules, min_traversability=0.05)
    objective = TravelTime(robot=Unicycle(), goal_radius_m=0.5)
    problem = factories.problem(
        ground, (3.6, 5.75), (7.75, 5.75), objective=objective, rules=rules
    )
    return replace(
        problem,
        immobile=Immobile(below=0.1, for_s=1.0),
        free=torch.ones_like(problem.free),
    )


def longest_held(planner: MPPI, problem: Problem, seed: int) -> int:
    """Steps for which the robot was on ground that holds it at a stretch, at the most."""
    plan_state, state, longest, now = (
        planner.init(problem, generator(seed)),
        problem.start,
        0,
        0,
    )
    for _ in range(60):
        step = replace(
            first(problem), state=state, traversability=problem.traversability_at(state)
        )
        action, plan_state, _ = planner.plan(step, plan_state)
        state = problem.robot(state, action, problem.traversability_at(state))
        now = now + 1 if float(problem.traversability_at(state)) < 0.1 else 0
        longest = max(longest, now)
    return longest


@pytest.mark.parametrize("cost", [False, True])
def test_with_entrapment_it_keeps_off_ground_that_holds(cost: bool) -> None:
    problem = trap()
    if cost:
        problem = replace(problem, fields=Given(problem.risk_map[:, None], []))
    for seed in range(2):
        held = []
        for entrapment in (False, True):
            # With 3 s a robot cuts the corner of the soft ground under some seeds.
            config = replace(SMALL, samples=512, horizon_s=4.0, entrapment=entrapment)
            planner = MPPI(
                replace(config, risk_on="cost", fields=1) if cost else config
            )
            held.append(longest_held(planner, problem, seed))
        assert held[1] < 10 <= held[0]


def test_a_robot_remembers_for_how_long_it_was_held() -> None:
    problem = trap()
    planner = MPPI(replace(SMALL, entrapment=True))
    plan_state: MPPIState = planner.init(problem, generator())
    for observed, wanted in ((math.nan, 0), (0.05, 1), (0.02, 2), (0.3, 0), (0.05, 1)):
        step = replace(first(problem), traversability=torch.tensor([observed]))
        _, plan_state, _ = planner.plan(step, plan_state)
        assert plan_state.dwell_steps.tolist() == [wanted]
    # In a world that holds nobody there is nothing to plan for.
    free = replace(problem, immobile=None)
    wanted, _ = drives(MPPI(SMALL), free)
    found, _ = drives(planner, free)
    assert all(torch.equal(*pair) for pair in zip(found, wanted, strict=True))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"risk_on": "field"}, "`risk_on` 'map' or 'cost'"),
        ({"risk_on": "cost", "level": 1.0}, "`level` in"),
        ({"level": 0.5}, "`risk_on` 'cost' for MPPI with `level`"),
        ({"once": True}, "`risk_on` 'cost' for MPPI with `level`"),
        ({"fields": 128}, "`risk_on` 'cost' for MPPI with `level`, `fields`"),
        ({"risk_on": "cost", "level": 0.8, "fields": 49}, "= 50 for MPPI, got 49"),
        ({"risk_on": "cost", "fields": 0}, "`fields` > 0"),
    ],
)
def test_risk_that_cannot_be_told_is_refused(
    changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        replace(SMALL, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        (
            {"risk_on": "cost", "level": 0.8, "fields": 128},
            "CVaR 0.8 of J over 128 fields of λ",
        ),
        ({"risk_on": "cost"}, "mean of J over 64 fields of λ"),
        ({"entrapment": True}, "J, plus the remaining time of immobilised rollouts"),
        ({"cost_to_go": "map"}, "J, plus A*'s cost to go from the last state under λ̂"),
        (
            {"risk_on": "cost", "cost_to_go": "expected-time"},
            "mean of J over 64 fields of λ, plus A*'s cost to go from the last state under λ̂ of expected-time",
        ),
    ],
)
def test_it_says_what_it_minimises_in_place_of_the_objective(
    changes: dict[str, Any], words: str
) -> None:
    config, task = (
        replace(SMALL, **changes),
        factories.task(objective=TravelTime(Unicycle(), 1.0)),
    )
    assert MPPI(config).follows(task) == words
    guided = AStarMPPI(AStarMPPIConfig(mppi=config))
    assert guided.follows(task) == (words and f"J (A*), {words} (MPPI)")
    assert (
        guided.follows(factories.task())
        == f"3D path length (A*), {words or 'J'} (MPPI)"
    )


def test_its_defaults_move_no_id_and_others_do() -> None:
    for part, path in (("mppi", ()), ("astar_mppi", ("mppi",))):
        ids = set()
        for options in (
            {},
            {"risk_on": "map"},
            {"risk_on": "cost"},
            {"entrapment": True},
        ):
            given: dict[str, Any] = options
            for name in path:
                given = {name: given}
            done = registry.complete(
                "planner",
                registry.read_part("planner", {"part": part, "options": given}),
            )
            ids.add(text_digest(dict(done.options)))
            recorded = done.options["mppi"] if path else done.options
            assert set(recorded).isdisjoint(MPPIConfig.added) is (
                options in ({}, {"risk_on": "map"})
            )
        assert len(ids) == 3


def test_as_few_fields_as_the_tail_needs_are_taken() -> None:
    assert replace(SMALL, risk_on="cost", level=0.8, fields=50).fields == 50
    assert replace(SMALL, risk_on="cost", level=0.0, fields=1).fields == 1
