import math
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.free_space import PENALTY, FreeSpace, Immobile, Rules
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.planners.optimal.optimal import (
    NearOptimal,
    NearOptimalConfig,
    Optimal,
    OptimalConfig,
)
from benchnav.planning.planners.optimal.primitives import path_of, primitives_from
from benchnav.planning.planners.optimal.value import UNREACHED, Moves, headings_of
from benchnav.planning.planners.planner import Plan, PlanStatus
from benchnav.planning.planners.straight import Straight
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Bicycle, DifferentialDrive, Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import (
    drive,
    first,
    generator,
    known_world,
    step_at,
    with_start,
)

RULES = Rules(min_traversability=0.01, free_space=FreeSpace(above=0.0))


def problem(
    ground: Tensor,
    start: tuple[float, float],
    goal: tuple[float, float],
    **changes: Any,
) -> Problem:
    return factories.problem(ground, start, goal, rules=RULES, **changes)


def time_to_go(planner: Any, posed: Problem) -> Tensor:
    """By value iteration only."""
    state = Optimal.init(planner, posed, generator())
    return primitives_from(posed.start, state.dwell_s, state).cost.min(1).values


class Solved:
    """A planner that solves its first problem once, for all calls of `init`."""

    def __init__(self, planner: Optimal, posed: Problem) -> None:
        self.planner = planner
        self.state = planner.init(posed, generator())
        self.plan = planner.plan

    def init(self, *_: Any) -> Any:
        return self.state

    def time_to_go(self) -> Tensor:
        """By value iteration only."""
        state = self.state
        cost = primitives_from(state.problem.start, state.dwell_s, state).cost
        return cost.min(1).values


def curve(x: float, y: float, heading: float, radius_m: float = 1.0) -> float:
    """Least time to a disc around 0 along a circle of radius 1 and straight on;
    infinite within that circle.
    """
    found = math.inf
    for side in (1, -1):
        centre_x, centre_y = x - side * math.sin(heading), y + side * math.cos(heading)
        away = math.hypot(centre_x, centre_y)
        if away < 1:
            continue
        # From the centre: where the robot is, and where the straight begins, which ends
        # at 0.
        begin = math.atan2(y - centre_y, x - centre_x)
        ends = math.atan2(-centre_y, -centre_x) - side * math.acos(1 / away)
        arc = (side * (ends - begin)) % (2 * math.pi)
        found = min(
            found, arc * (arc < 2 * math.pi - 1e-6) + math.sqrt(away**2 - 1) - radius_m
        )
    return found


def least_time(x: float, y: float, heading: float) -> float:
    """The same, where the robot may turn on the spot first."""
    away = (math.atan2(-y, -x) - heading + math.pi) % (2 * math.pi) - math.pi
    turns = (away * share / 200 for share in range(201))
    straight = abs(away) + math.hypot(x, y) - 1
    return min(straight, *(abs(turn) + curve(x, y, heading + turn) for turn in turns))


def test_on_free_ground_the_cost_to_go_is_the_least_time() -> None:
    goal = (20.25, 12.0)
    posed = problem(torch.ones(1, 64, 64), (4.0, 4.0), goal)
    value = Optimal().init(posed, generator()).to_go.value[0, 0]
    drawn, far, near = torch.Generator().manual_seed(0), [], []
    while len(far) < 200 or len(near) < 40:
        heading, row, column = (
            int(torch.randint(most, (), generator=drawn)) for most in (32, 64, 64)
        )
        x, y = (column + 0.5) / 2 - goal[0], (row + 0.5) / 2 - goal[1]
        if math.hypot(x, y) < 2:
            continue
        wanted = least_time(x, y, heading * math.pi / 16)
        more = float(value[heading, row, column]) - wanted
        far, near = (
            ([*far, more / wanted], near) if wanted > 10 else (far, [*near, more])
        )
    # It is never less than what can be done.
    assert min(*far, *near) > -0.001
    assert max(far) < 0.02
    assert max(near) < 0.2


def test_on_free_terrain_it_drives_in_the_minimum_time() -> None:
    turned = torch.tensor([0.0, 1.5, -2.2, 3.1])
    posed = problem(torch.ones(4, 64, 64), (4.1, 4.3), (27.0, 20.0))
    start = posed.start.clone()
    start[:, 2] += turned
    posed = replace(posed, start=start)
    solved = Solved(Optimal(), posed)
    done = drive(solved, posed)
    assert (done.outcome == Outcome.SUCCESS).all()
    times_s = []
    for x, y, heading in posed.start.tolist():
        times_s.append(least_time(x - 27, y - 20, heading))
    assert (0.1 * done.steps).tolist() == pytest.approx(times_s, rel=0.03)
    assert solved.time_to_go().tolist() == pytest.approx(times_s, rel=0.02)


def test_through_strips_the_time_adds_up_and_slow_ground_is_gone_around_where_that_is_quicker() -> (
    None
):
    ground = torch.full((2, 40, 40), 0.8)
    ground[0, :, 15:25] = 0.2
    ground[1, 15:25, 15:25] = 0.1
    posed = problem(ground, (2.25, 10.25), (17.25, 10.25))
    solved = Solved(Optimal(), posed)
    found = solved.time_to_go()
    through = 9.0 / 0.8 + 5 / 0.2
    assert float(found[0]) == pytest.approx(through, rel=0.03)
    # By two corners, of which it keeps half a cell at most.
    around = 2 * math.hypot(5.25, 2.75) + 5 - 1
    assert 0.98 * around / 0.8 < float(found[1]) < 1.06 * around / 0.8
    done = drive(solved, posed)
    assert done.outcome.tolist() == [Outcome.SUCCESS] * 2
    assert (0.1 * done.steps).tolist() == pytest.approx(found.tolist(), rel=0.03)


def test_half_the_traversability_takes_twice_the_time() -> None:
    drawn = 0.3 + 0.7 * torch.rand(1, 24, 24, generator=generator())
    both = torch.cat((drawn, drawn / 2))
    whole, half = time_to_go(
        Optimal(), problem(both, (2.25, 2.25), (9.25, 8.25))
    ).tolist()
    assert half == pytest.approx(2 * whole, rel=1e-4)


def test_finer_grids_tell_about_the_same_time() -> None:
    drawn = torch.rand(2, 1, 28, 28, generator=generator(2))
    ground = 0.15 + 0.85 * torch.nn.functional.avg_pool2d(drawn, 5, 1)[:, 0]
    posed = problem(ground, (2.25, 2.25), (9.25, 8.25))
    coarse = time_to_go(Optimal(), posed)
    one = posed.select(torch.tensor([0]))
    finer = Optimal(OptimalConfig(refine=3)).init(one, generator())
    assert finer.to_go.value.shape == (1, 1, 32, 72, 72)
    fine = time_to_go(Optimal(OptimalConfig(refine=2, headings=64)), posed)
    torch.testing.assert_close(coarse, fine, rtol=0.02, atol=0)
    assert not torch.equal(coarse, fine)
    headings = time_to_go(Optimal(OptimalConfig(headings=16)), posed)
    torch.testing.assert_close(headings, fine, rtol=0.05, atol=0)
    assert not torch.equal(coarse, headings)


def test_what_the_ground_is_like_where_it_has_arrived_costs_nothing() -> None:
    ground = torch.ones(2, 24, 24)
    ground[1, 12, 18] = 0.05  # where the goal is
    found = time_to_go(Optimal(), problem(ground, (2.25, 6.25), (9.25, 6.25)))
    assert found.tolist() == pytest.approx([6.0, 6.0], rel=0.03)
    narrow = replace(RULES, goal_radius_m=0.36)
    posed = factories.problem(ground[:1], (2.25, 6.25), (9.4, 6.3), rules=narrow)
    assert float(time_to_go(Optimal(), posed)) == pytest.approx(6.79, rel=0.03)
    assert drive(Optimal(), posed).outcome.tolist() == [Outcome.SUCCESS]


def test_the_time_held_is_counted_while_it_drives() -> None:
    solved = solved_bar(4.0)
    posed, planner, state = solved.state.problem, solved.planner, solved.state
    for met, wanted in ((0.05, 0.1), (0.02, 0.2), (0.5, 0.0)):
        step = replace(first(posed), traversability=torch.tensor([met]))
        state = planner.plan(step, state)[1]
        assert state.dwell_s.tolist() == pytest.approx([wanted])


def test_ground_that_is_not_free_is_gone_around_and_crossed_where_there_is_no_other_way() -> (
    None
):
    ground = torch.full((2, 24, 24), 0.9)
    wall = torch.zeros(24, 24, dtype=torch.bool)
    wall[:, 11] = True
    posed = problem(ground, (2.25, 6.25), (9.25, 6.25))
    free = torch.ones(2, 24, 24, dtype=torch.bool)
    free[:, wall] = False
    free[0, 21, 11] = True  # a gap of one cell
    posed = replace(posed, free=free)
    solved = Solved(Optimal(), posed)
    found = solved.time_to_go()
    around = math.hypot(3.5, 4.5) * 2 - 1
    turn = 2 * math.atan(4.5 / 3.5)
    assert around / 0.9 < float(found[0]) < 1.01 * (around + turn) / 0.9
    assert float(found[1]) == pytest.approx(PENALTY * 0.5, rel=0.3)
    done = drive(solved, posed)
    assert done.outcome.tolist() == [Outcome.SUCCESS] * 2
    column = (done.states[0, :, 0] / 0.5).long()
    assert set((done.states[0, column == 11, 1] / 0.5).long().tolist()) == {21}


def test_moves_end_where_the_robot_does() -> None:
    moves = Moves.of(Unicycle(), 0.5, 32)
    angles = headings_of(32)
    offsets = moves.offsets(angles, torch.ones(1, dtype=torch.float64))[:, :, 0]
    for place, (action, seconds) in enumerate(
        zip(moves.actions, moves.seconds.tolist(), strict=True)
    ):
        state = torch.cat((torch.zeros(32, 2, dtype=torch.float64), angles[:, None]), 1)
        robot = Unicycle(dt_s=seconds / 2000)
        for _ in range(2000):
            state = robot(
                state, action.expand(32, 2), torch.ones(32, dtype=torch.float64)
            )
        torch.testing.assert_close(offsets[:, place], state[:, :2], atol=1e-3, rtol=0)
        turned = (state[:, 2] - angles) / (math.pi / 16)
        torch.testing.assert_close(
            turned, torch.full_like(turned, moves.turns[place]), atol=1e-6, rtol=0
        )
        assert float(offsets[:, place].norm(dim=1).max()) <= 0.5 + 1e-9


def held_ground(below: float, for_s: float) -> Problem:
    """A bar of ground that holds right across the way, around which it is far."""
    ground = torch.full((1, 40, 24), 0.9)
    ground[:, :36, 11] = below
    posed = problem(ground, (2.25, 2.25), (9.25, 2.25))
    return replace(
        posed,
        immobile=Immobile(below=0.1, for_s=for_s),
        distribution=factories.certain(ground),
    )


@cache
def solved_bar(for_s: float) -> Solved:
    return Solved(NearOptimal(), held_ground(0.08, for_s))


def test_the_reference_crosses_what_does_not_hold_for_long_enough() -> None:
    across = 6 - 0.5
    crossed = across / 0.9 + 0.5 / 0.08  # 6.3 s on ground that holds
    entry = NearOptimal(NearOptimalConfig(levels=0))
    for for_s, crosses in ((4.0, False), (9.0, True)):
        solved = solved_bar(for_s)
        posed = solved.state.problem
        found = float(solved.time_to_go())
        lost = float(time_to_go(entry, posed))
        assert lost > 30
        if crosses:
            assert found == pytest.approx(crossed, rel=0.05)
        else:
            assert found == pytest.approx(lost, rel=0.02)
        done = drive(solved, posed, world=known_world(posed))
        assert done.outcome.tolist() == [Outcome.SUCCESS]
        ends = int(done.steps[0])
        met = posed.traversability_at(done.states[0, None, : ends + 1])[0]
        longest = run = 0
        for value in met.tolist():
            run = run + 1 if value < 0.1 else 0
            longest = max(longest, run)
        assert (longest > 40) is crosses
        assert 0.1 * longest < for_s


def test_between_two_bars_the_time_held_is_over() -> None:
    ground = torch.full((1, 40, 24), 0.9)
    ground[:, :36, 8] = ground[:, :36, 14] = 0.08
    posed = replace(
        problem(ground, (2.25, 2.25), (10.25, 2.25)),
        immobile=Immobile(below=0.1, for_s=7.0),
        distribution=factories.certain(ground),
    )
    wanted = (7 - 1.0) / 0.9 + 2 * 0.5 / 0.08
    solved = Solved(NearOptimal(), posed)
    assert float(solved.time_to_go()) == pytest.approx(wanted, rel=0.05)
    # What it simulates is what the world does.
    simulated = solved.state.drive
    done = drive(solved, posed, world=known_world(posed))
    assert simulated is not None
    assert simulated.steps.tolist() == done.steps.tolist()
    assert torch.equal(simulated.states[0, : int(done.steps[0]) + 1], done.states[0])


def wide_bar(for_s: float) -> Problem:
    """A closed bar of three cells, on each of which a robot is 5.26 s."""
    ground = torch.full((1, 24, 40), 0.9)
    ground[:, :, 12:15] = 0.095
    posed = problem(ground, (2.25, 6.25), (17.25, 6.25), time_budget_s=90.0)
    return replace(
        posed,
        immobile=Immobile(below=0.1, for_s=for_s),
        distribution=factories.certain(ground),
    )


@cache
def solved_wide_bar(for_s: float) -> Solved:
    return Solved(NearOptimal(), wide_bar(for_s))


@pytest.mark.parametrize(("for_s", "crosses"), [(15.0, False), (16.5, True)])
def test_over_several_cells_dwell_time_adds_up(for_s: float, crosses: bool) -> None:
    solved = solved_wide_bar(for_s)
    posed = solved.state.problem
    found = float(solved.time_to_go())
    done = drive(solved, posed, world=known_world(posed))
    assert done.outcome.tolist() == [
        Outcome.SUCCESS if crosses else Outcome.IMMOBILISED
    ]
    if crosses:
        assert found == pytest.approx((14 - 1.5) / 0.9 + 1.5 / 0.095, rel=0.02)
        assert 0.1 * int(done.steps[0]) == pytest.approx(found, rel=0.02)
    else:
        assert found > 90


def test_dwell_time_that_is_left_is_exact_along_a_bar() -> None:
    """A robot that faces the far side may have spent all but what the rest of the bar
    takes.
    """
    posed = wide_bar(18.0)
    for levels in (1, 3):
        planner = NearOptimal(NearOptimalConfig(levels=levels))
        to_go = Optimal.init(planner, posed, generator()).to_go
        assert to_go.max_dwell_s is not None
        for column in range(12, 15):
            left_s = (14.5 - column) * 0.5 / 0.095
            assert float(to_go.max_dwell_s[0, 0, 0, 12, column]) == pytest.approx(
                18 - left_s, abs=0.35
            )
        # Of other terrain, all of it.
        assert float(to_go.max_dwell_s[0, 0, 0, 12, 8]) == 18


@pytest.mark.parametrize(
    ("crossing", "cells", "below", "share"),
    [
        (0.79, 3, 0.8, 0.95),
        (0.65, 4, 0.7, 0.96),
        (0.45, 3, 0.5, 0.5),
        (0.3, 2, 0.35, 0.98),
        (0.2, 3, 0.25, 0.99),
    ],
)
def test_a_wall_that_straight_crosses_is_crossed_as_soon(
    crossing: float, cells: int, below: float, share: float
) -> None:
    """It takes a share of the dwell time that immobilises a robot."""
    ground = torch.ones(1, 12, 24)
    ground[0, :, 10 : 10 + cells] = crossing
    posed = problem(ground, (3.25, 3.25), (10.0, 3.25), time_budget_s=20.0)
    immobile = Immobile(below=below, for_s=cells * 0.5 / crossing / share)
    posed = replace(posed, immobile=immobile, distribution=factories.certain(ground))
    solved = Solved(NearOptimal(), posed)
    straight = drive(Straight(), posed, world=known_world(posed))
    reference = drive(solved, posed, world=known_world(posed))
    assert straight.outcome.tolist() == reference.outcome.tolist() == [Outcome.SUCCESS]
    assert int(reference.steps[0]) <= int(straight.steps[0])
    # Value iteration finds it too.
    found = float(solved.time_to_go())
    assert found == pytest.approx(0.1 * int(straight.steps[0]), rel=0.05)


def small_worlds(seed: int, for_s: float) -> Problem:
    """Rough fields with a closed wall right across, thin enough in places."""
    drawn = torch.rand(4, 1, 18, 26, generator=generator(seed))
    ground = (
        torch.nn.functional.avg_pool2d(drawn, 3, 1)[:, 0]
        .sub(0.2)
        .mul(2.0)
        .clamp(0.02, 1)
    )
    where = torch.rand(4, generator=generator(seed + 1)).mul(8).long() + 8
    for member, column in enumerate(where.tolist()):
        ground[member, :, column : column + 1 + member % 3] = 0.3
    posed = problem(ground, (2.25, 4.25), (10.25, 4.25), time_budget_s=25.0)
    return replace(
        posed,
        immobile=Immobile(below=0.35, for_s=for_s),
        distribution=factories.certain(ground),
    )


def test_it_succeeds_wherever_a_star_with_dwa_or_straight_do_and_no_later() -> None:
    posed = small_worlds(10, 4.0)
    reference, *others = (
        drive(planner, posed, world=known_world(posed))
        for planner in (NearOptimal(), AStarDWA(), Straight())
    )
    for other in others:
        succeeds = other.outcome == Outcome.SUCCESS
        assert bool(succeeds.any())
        assert not bool(succeeds.all())
        assert bool((reference.outcome == Outcome.SUCCESS)[succeeds].all())
        assert bool((reference.steps <= other.steps)[succeeds].all())


def test_where_value_iteration_fails_it_follows_the_earlier_of_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ground = torch.full((2, 16, 24), 0.9)
    ground[1, :12, 11] = 0.02
    posed = problem(ground, (2.25, 3.25), (9.25, 3.25), time_budget_s=30.0)
    # On the first map the wall is quick, but not free.
    free = torch.ones_like(ground).bool()
    free[:, :12, 11] = False
    posed = replace(
        posed, immobile=Immobile(), distribution=factories.certain(ground), free=free
    )
    world = known_world(posed)
    guided, straight = (
        drive(planner, posed, world=world) for planner in (AStarDWA(), Straight())
    )
    assert straight.outcome.tolist() == [Outcome.SUCCESS, Outcome.IMMOBILISED]
    assert guided.outcome.tolist() == [Outcome.SUCCESS] * 2
    assert int(straight.steps[0]) < int(guided.steps[0])

    def stand(self: Optimal, step: Any, plan_state: Any) -> Any:
        observed = self.observe(step, plan_state)
        return (
            torch.zeros_like(step.state[:, :2]),
            observed,
            Plan.empty(len(step.state)),
        )

    monkeypatch.setattr(Optimal, "plan", stand)
    done = drive(NearOptimal(), posed, world=world)
    assert done.outcome.tolist() == [Outcome.SUCCESS] * 2
    assert done.steps.tolist() == [int(straight.steps[0]), int(guided.steps[1])]


def test_a_robot_that_is_off_its_drive_goes_on_by_value_iteration() -> None:
    solved = solved_wide_bar(16.5)
    posed, planner, state = solved.state.problem, solved.planner, solved.state
    for x, on in ((2.25, True), (2.75, False)):
        pose = torch.tensor([[x, 6.25, 0.2 * (not on)]])
        step = replace(first(posed, draw=True), state=pose)
        action, following, plan = planner.plan(step, state)
        steered = Optimal.plan(planner, step, state)
        assert following.n_steps.tolist() == [1]
        if not on:
            assert torch.equal(action, steered[0])
        path = plan.path[0][~plan.path[0].isnan().any(1)]
        torch.testing.assert_close(path[0], pose[0, :2])
        assert float((path[-1] - posed.goal_m[0]).norm()) < 1.0


@pytest.mark.parametrize(("held", "crosses"), [(3.0, True), (13.0, False)])
def test_who_has_no_time_left_to_leave_such_ground_is_lost_by_every_way(
    held: float, crosses: bool
) -> None:
    """It takes 3.7 s to the last cell of the bar, and 2.6 s to leave that."""
    posed = with_start(wide_bar(18.0), 6.9, 6.25, 0.0)
    state = Optimal.init(NearOptimal(), posed, generator())
    found = float(primitives_from(posed.start, torch.tensor([held]), state).cost.min())
    assert (found < 90) is crosses
    assert crosses or found >= UNREACHED / 2


@pytest.mark.parametrize("levels", [1, 2, 3, 4, 5])
def test_there_are_as_many_levels_as_are_asked_for(levels: int) -> None:
    planner = NearOptimal(NearOptimalConfig(levels=levels))
    assert (
        Optimal.init(planner, wide_bar(4.0), generator()).to_go.value.shape[1] == levels
    )


def test_deep_in_a_bar_a_robot_with_little_time_left_takes_the_dearer_side() -> None:
    """Ahead is the near side, behind it the goal: to leave takes 7 s of 20, to turn and
    cross twice that.
    """
    ground = torch.full((1, 40, 34), 0.9)
    ground[:, :36, 10:22] = 0.4
    posed = replace(
        problem(ground, (7.75, 5.25), (14.25, 5.25), time_budget_s=120.0),
        immobile=Immobile(below=0.5, for_s=20.0),
        distribution=factories.certain(ground),
    )
    state = Optimal.init(NearOptimal(), posed, generator())
    pose = torch.tensor([[7.75, 5.25, math.pi]])
    some, more, most = (
        float(primitives_from(pose, torch.tensor([held]), state).cost.min())
        for held in (0.0, 8.0, 15.0)
    )
    across = 3.25 / 0.4 + 2.25 / 0.9
    assert across < some < 1.02 * (across + math.pi / 0.4)
    assert 1.5 * some < more < 120
    assert most >= UNREACHED / 2


def test_a_robot_that_was_held_has_less_time_left() -> None:
    posed = held_ground(0.08, 7.0)
    state = Optimal.init(NearOptimal(), with_start(posed, 5.3, 2.25, 0.0), generator())
    pose = torch.tensor([[5.6, 2.25, 0.0]])
    some, more = (
        float(primitives_from(pose, torch.tensor([held]), state).cost.min())
        for held in (0.0, 6.5)
    )
    assert some == pytest.approx(0.4 / 0.08 + 2.25 / 0.9, rel=0.1)
    assert more > 3 * some or more >= UNREACHED / 2


def test_levels_of_a_world_that_holds_at_once_are_entry_as_loss() -> None:
    drawn = torch.rand(2, 1, 36, 36, generator=generator(4))
    ground = (
        torch.nn.functional.avg_pool2d(drawn, 5, 1)[:, 0]
        .sub(0.35)
        .mul(3)
        .clamp(0.02, 1)
    )
    assert 0.02 < float((ground < 0.1).float().mean()) < 0.3
    posed = replace(
        problem(ground, (2.25, 2.25), (13.25, 12.25)),
        immobile=Immobile(below=0.1, for_s=0.2),
        distribution=factories.certain(ground),
    )
    levels = time_to_go(NearOptimal(), posed)
    entry = time_to_go(NearOptimal(NearOptimalConfig(levels=0)), posed)
    assert float(levels.max()) < 200
    torch.testing.assert_close(levels, entry, rtol=0.02, atol=0)


def test_the_hazard_of_a_metre_is_that_of_its_cells() -> None:
    """Along a corridor of the same hazard V = (T + 1/h) (1 − exp(−h x)), which solves
    V' = 1 + h (T − V).
    """
    lost, budget_s = 0.01, 200.0
    ground = torch.ones(1, 64, 64)
    posed = problem(ground, (3.25, 16.0), (28.25, 16.0), time_budget_s=budget_s)
    weights = torch.tensor([lost, 1 - lost])[None, :, None, None].expand(1, 2, 64, 64)
    means = torch.tensor([0.05, 1.0])[None, :, None, None].expand_as(weights)
    posed = replace(
        posed,
        immobile=Immobile(below=0.1, for_s=2.0),
        distribution=TraversabilityMixture(weights, means, torch.zeros_like(means)),
    )
    found = float(time_to_go(Optimal(OptimalConfig(hazard=True)), posed))
    hazard = -math.log(1 - lost) / 0.5
    assert found == pytest.approx(
        (budget_s + 1 / hazard) * (1 - math.exp(-hazard * 24)), rel=0.02
    )
    sure = float(time_to_go(Optimal(), posed))
    assert sure == pytest.approx(24, rel=0.02)


def test_with_hazard_it_uses_the_distribution_alone() -> None:
    generator_ = generator(5)
    ground = 0.2 + 0.8 * torch.rand(4, 20, 20, generator=generator_)
    posed = replace(
        problem(ground, (1.25, 1.25), (8.25, 7.75)),
        immobile=Immobile(below=0.1, for_s=2.0),
        distribution=factories.normal(ground, torch.full_like(ground, 0.2)),
    )
    other = replace(posed, risk_map=1 - posed.risk_map, free=~posed.free)
    planner = Optimal(OptimalConfig(hazard=True))
    assert planner.uses(posed.task) == {"distribution"}
    states = [planner.init(one, generator()) for one in (posed, other)]
    turns = 0
    for heading in torch.linspace(-3, 3, 25):
        state = posed.start.clone()
        state[:, 2] = heading
        step = Step(state=state, traversability=torch.full((4,), 0.5), time_s=0.0)
        actions = [planner.plan(step, plan_state)[0] for plan_state in states]
        assert torch.equal(*actions)
        turns += int((actions[0][:, 1].abs() < 1).sum())
    assert turns  # that end within the step, where λ decides the rate


@pytest.mark.parametrize("hazard", [True, False])
def test_where_it_has_arrived_nothing_holds_it(hazard: bool) -> None:
    """Two maps that differ within the goal's disc alone."""
    ground = torch.full((2, 16, 24), 0.9)
    posed = problem(ground, (7.75, 4.25), (9.25, 4.25), time_budget_s=60.0)
    row, column = torch.meshgrid(torch.arange(16), torch.arange(24), indexing="ij")
    away = torch.hypot(0.5 * column + 0.25 - 9.25, 0.5 * row + 0.25 - 4.25)
    ground[1, (away > 0.1) & (away <= 1.0)] = 0.05
    posed = replace(posed, immobile=Immobile(below=0.1, for_s=0.3))
    predicted = factories.normal(
        ground, torch.full_like(ground, 0.2 if hazard else 0.0)
    )
    planner = Optimal(OptimalConfig(hazard=True)) if hazard else NearOptimal()
    found = time_to_go(planner, replace(posed, distribution=predicted, risk_map=ground))
    assert float(found[1]) == pytest.approx(float(found[0]), rel=0.03)


def test_with_hazard_it_goes_around_ground_that_is_quick_and_may_hold() -> None:
    ground = torch.full((1, 40, 40), 0.7)
    ground[:, 15:25, 10:30] = 1.0
    posed = problem(ground, (2.25, 10.25), (17.25, 10.25), time_budget_s=90.0)
    chance = torch.where(ground == 1, 0.1, 1e-9)
    weights = torch.stack((chance, 1 - chance), 1)
    means = torch.stack((torch.full_like(ground, 0.02), ground), 1)
    posed = replace(
        posed,
        immobile=Immobile(below=0.1, for_s=2.0),
        distribution=TraversabilityMixture(weights, means, torch.zeros_like(means)),
    )
    for hazard in (False, True):
        planner = Optimal(OptimalConfig(hazard=hazard))
        path = path_of(planner.init(posed, generator()), posed.start, torch.zeros(1))[0]
        path = path[~path.isnan().any(1)]
        assert float((path[-1] - posed.goal_m[0]).norm()) < 1.0
        row, column = posed.grid.cell_of(path[:, 0], path[:, 1])
        assert bool((chance[0, row, column] > 0.05).any()) is not hazard


def test_an_episode_alone_does_as_it_does_in_a_batch() -> None:
    ground = 0.2 + 0.8 * torch.rand(11, 20, 20, generator=generator(3))
    posed = problem(ground, (1.25, 1.25), (8.25, 7.75))
    # One beside it has a far longer way, for which more sweeps are made.
    posed.free[8, 4:16:6, :16] = posed.free[8, 7:16:6, 4:] = False
    planner, member = Optimal(), torch.tensor([9])
    whole = planner.init(posed, generator())
    alone = planner.init(posed.select(member), generator(1))
    assert torch.equal(planner.select(whole, member).to_go.value, alone.to_go.value)
    step = first(posed)
    action, _, plan = planner.plan(step, whole)
    found = planner.plan(first(posed.select(member)), planner.select(whole, member))[0]
    assert torch.equal(found, action[9:10])
    assert plan.status.tolist() == [PlanStatus.OK] * 11


def test_where_there_is_no_way_the_world_ends_the_episode() -> None:
    ground = torch.full((3, 24, 24), 0.9)
    ground[0, :, 10:13] = 0.02
    ground[2] = 0.0
    posed = replace(
        problem(ground, (2.25, 6.25), (9.25, 6.25), time_budget_s=12.0),
        immobile=Immobile(),
        distribution=factories.certain(ground),
    )
    solved = Solved(NearOptimal(), posed)
    # On its drive, and off it.
    for turned in (0.0, 0.1):
        step = step_at(posed.start + torch.tensor([0.0, 0.0, turned]))
        action, _, plan = solved.plan(step, solved.state)
        assert plan.status.tolist() == [
            PlanStatus.PARTIAL,
            PlanStatus.OK,
            PlanStatus.PARTIAL,
        ]
        assert torch.equal(action[[0, 2]], Straight().plan(step, posed)[0][[0, 2]])
    done = drive(solved, posed, world=known_world(posed))
    assert done.outcome[1:].tolist() == [Outcome.SUCCESS, Outcome.IMMOBILISED]
    assert done.outcome[0] != Outcome.SUCCESS
    assert 0.1 * int(done.steps[2]) == pytest.approx(Immobile().for_s)


@pytest.mark.parametrize("kind", [Optimal, NearOptimal])
def test_other_robots_and_maps_that_change_are_refused(kind: type[Optimal]) -> None:
    ground = torch.full((1, 16, 16), 0.9)
    for robot in (Bicycle(), DifferentialDrive()):
        with pytest.raises(
            ConfigError,
            match=f"Unicycle for planner '{kind.name}', got {type(robot).__name__}",
        ):
            kind().init(factories.problem(ground, robot=robot), generator())
    uneven = Unicycle(turn_rate_radps=(-1.0, 0.5))
    with pytest.raises(
        ConfigError, match=f"left and right turns with planner '{kind.name}'"
    ):
        kind().init(factories.problem(ground, robot=uneven), generator())
    backward = Unicycle(speed_mps=(-1.0, 1.0))
    with pytest.raises(
        ConfigError,
        match=f"`speed_mps` with minimum 0 for planner '{kind.name}', got minimum -1",
    ):
        kind().init(factories.problem(ground, robot=backward), generator())
    posed = factories.problem(ground, rules=replace(RULES, goal_radius_m=0.35))
    with pytest.raises(
        ConfigError,
        match=r"`goal_radius_m` ≥ 0\.35 m .half a cell's diagonal",
    ):
        kind().init(posed, generator())
    posed = factories.problem(ground)
    with pytest.raises(ConfigError, match="plans only once"):
        kind().revise(kind().init(posed, generator()), posed)


def test_what_cannot_be_known_is_refused() -> None:
    ground = torch.full((1, 16, 16), 0.9)
    posed = factories.problem(ground)
    unsure = replace(
        posed, distribution=factories.normal(ground, torch.full_like(ground, 0.1))
    )
    with pytest.raises(
        ConfigError, match="model 'clairvoyant' for planner 'near_optimal'"
    ):
        NearOptimal().init(unsure, generator())
    with pytest.raises(ConfigError, match="only in a world that immobilises"):
        Optimal(OptimalConfig(hazard=True)).init(posed, generator())


@pytest.mark.parametrize(
    ("kind", "changes", "words"),
    [
        (OptimalConfig, {"headings": 4}, "`headings` from 8 to 256 for optimal"),
        (OptimalConfig, {"refine": 0}, "`refine` from 1 to 4 for optimal"),
        (NearOptimalConfig, {"levels": 6}, "`levels` from 0 to 5 for near_optimal"),
        (
            NearOptimalConfig,
            {"headings": 300},
            "`headings` from 8 to 256 for near_optimal",
        ),
    ],
)
def test_settings_that_are_none_are_refused(
    kind: Any, changes: dict[str, int], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        kind(**changes)
