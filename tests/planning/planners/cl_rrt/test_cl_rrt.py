"""CL-RRT on small maps, driven through the same F that it predicts with unless said
otherwise.
"""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.eval.run.rollout import run_episodes
from benchnav.planning.free_space import Immobile
from benchnav.planning.objective import TravelTime, distance
from benchnav.planning.planners.cl_rrt import cl_rrt
from benchnav.planning.planners.cl_rrt.cl_rrt import CLRRT, CLRRTState
from benchnav.planning.planners.cl_rrt.config import CLRRTConfig
from benchnav.planning.planners.cl_rrt.edges import ClosedLoop
from benchnav.planning.planners.cl_rrt.pursuit import FollowerConfig
from benchnav.planning.planners.cl_rrt.tree import Route, search
from benchnav.planning.planners.planner import Plan, PlanStatus
from benchnav.planning.planners.straight import Straight
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Bicycle, DifferentialDrive, Robot, Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import World
from tests import factories
from tests.planning.planners.cl_rrt.maps import (
    GRID,
    known,
    make_problem,
    open_map,
    walled_map,
)
from tests.planning.planners.driving import drive as closed_loop

SMALL = CLRRTConfig(expansions=200)
GAP = slice(20, 28)  # from y = 10 m to 14 m, wide enough to be found by every seed


def at(state: Tensor, draw: bool = True) -> Step:
    return Step(
        state=state,
        traversability=torch.full_like(state[:, 0], math.nan),
        time_s=0.0,
        draw=draw,
    )


def begin(
    problem: Problem, config: CLRRTConfig = SMALL, seed: int = 0
) -> tuple[CLRRT, CLRRTState]:
    planner = CLRRT(config)
    return planner, planner.init(problem, torch.Generator().manual_seed(seed))


def first_plan(problem: Problem, config: CLRRTConfig = SMALL, seed: int = 0) -> Plan:
    planner, plan_state = begin(problem, config, seed)
    return planner.plan(at(problem.start), plan_state)[2]


def drive(
    problem: Problem,
    steps: int,
    config: CLRRTConfig = SMALL,
    seed: int = 0,
    truth: Tensor | None = None,
) -> tuple[Tensor, Tensor, list[Plan]]:
    """States [N + 1, B, S], actions [N, B, A] and plans, until all have arrived."""
    planner, plan_state = begin(problem, config, seed)
    ground = problem.grid.pad(
        problem.traversability if truth is None else truth, outside=0.0
    )
    state = problem.start
    states, actions, plans = [state], [], []
    for _ in range(steps):
        action, plan_state, plan = planner.plan(at(state), plan_state)
        actions.append(action)
        plans.append(plan)
        state = problem.robot(
            state, action, problem.grid.lookup(ground, state[:, 0], state[:, 1])
        )
        states.append(state)
        if bool(arrived(problem, state).all()):
            break
    return torch.stack(states), torch.stack(actions), plans


def arrived(problem: Problem, state: Tensor) -> Tensor:
    return distance(state, problem.goal_m) < problem.goal_radius_m


def off_polyline(points: Tensor, polyline: Tensor) -> Tensor:
    """Distances of points [N, 2] to a polyline [M, 2]."""
    begin, along = polyline[:-1], polyline[1:] - polyline[:-1]
    share = ((points[:, None] - begin) * along).sum(-1) / (along * along).sum(-1).clamp(
        min=1e-9
    )
    nearest = begin + share.clamp(0, 1)[..., None] * along
    return torch.linalg.vector_norm(points[:, None] - nearest, dim=-1).amin(dim=1)


def all_free(problem: Problem, points: Tensor) -> bool:
    return bool(problem.free_at(points[None]).all())


def test_open_map_is_crossed_as_predicted() -> None:
    problem = make_problem(open_map())
    states, actions, plans = drive(problem, 300)
    first = plans[0]
    path = known(first.path[0])
    assert first.status.tolist() == [PlanStatus.OK]
    assert all_free(problem, path)
    torch.testing.assert_close(path[0], problem.start[0, :2])
    assert arrived(problem, path[-1:]).all()
    assert arrived(problem, states[-1]).all()
    # followed to the end, without another plan
    assert all(plan.path is first.path for plan in plans)
    assert off_polyline(states[:, 0, :2], path).max() < 0.05
    assert off_polyline(path, states[:, 0, :2]).max() < 0.05
    low, high = problem.action_bounds
    assert ((actions >= low) & (actions <= high)).all()


def test_best_path_of_an_open_map_is_nearly_straight() -> None:
    states, _, _ = drive(make_problem(open_map()), 300)
    straight_s = (10 - 1) / 0.8
    assert (len(states) - 1) * 0.1 < 1.1 * straight_s


def test_wall_is_passed_through_its_gap() -> None:
    problem = make_problem(walled_map(gap=GAP))
    states, _, plans = drive(problem, 600)
    assert plans[0].status.tolist() == [PlanStatus.OK]
    assert all_free(problem, known(plans[0].path[0]))
    assert all_free(problem, known(plans[0].tree[0]))
    assert arrived(problem, states[-1]).all()
    assert all_free(problem, states[:, 0])
    within = states[(states[:, 0, 0] > 8) & (states[:, 0, 0] < 9), 0]
    assert len(within) > 0
    assert ((within[:, 1] >= 10) & (within[:, 1] <= 14)).all()


def test_quicker_way_is_preferred_to_the_shorter_one() -> None:
    maps = open_map()
    maps[:, 8:24, 12:20] = (
        0.32  # free, but slow: 4 m at 0.32 take as long as 10 m around
    )
    states, _, _ = drive(make_problem(maps), 600, CLRRTConfig())
    straight_s = 5 / 0.8 + 4 / 0.32
    assert (len(states) - 1) * 0.1 < straight_s


def test_closed_wall_is_tried_in_vain_and_then_crossed() -> None:
    problem = make_problem(walled_map())
    states, _, plans = drive(problem, 1000)
    status = torch.stack([plan.status[0] for plan in plans])
    assert status[0] == PlanStatus.PARTIAL
    assert PlanStatus.FAILED not in status
    assert arrived(problem, states[-1]).all()
    # Tried again at once, the first path kept; at its end tried as often before it
    # crosses.
    assert all(
        torch.equal(plan.path.nan_to_num(), plans[0].path.nan_to_num())
        for plan in plans[1:10]
    )
    without = torch.tensor([bool(plan.path.isnan().all()) for plan in plans])
    assert without.sum() == SMALL.most_failures
    last = int(without.nonzero()[-1])
    assert without[last - SMALL.most_failures + 1 : last + 1].all()
    assert states[last, 0, 0] > 5  # it went as far as it could before
    assert all_free(problem, states[: last + 1, 0])
    # Across by the cheapest way, which is the shortest; then a free way is looked for,
    # and found.
    blocked = ~problem.free_at(states[:, 0][None])[0]
    metres = distance(states[1:, 0], states[:-1, 0])[blocked[:-1]].sum()
    assert metres < 1.3
    assert status[last + 1] == PlanStatus.PARTIAL
    assert status[-1] == PlanStatus.OK


@pytest.mark.parametrize("most_failures", [1, 3])
def test_plans_in_vain_before_a_wall_is_crossed_and_tries_at_a_free_way_afterwards(
    most_failures: int,
) -> None:
    blocked = torch.full((1, *GRID.shape), 0.1)
    blocked[:, 15:17, 5:7] = 0.8  # too small for a partial path
    problem = make_problem(blocked)
    config = replace(
        SMALL, expansions=100, most_failures=most_failures, turning_radius_m=0.2
    )
    planner, plan_state = begin(problem, config)
    without, failures = [], []
    for _ in range(10):
        _, plan_state, plan = planner.plan(at(problem.start), plan_state)
        without.append(bool(plan.path.isnan().all()))
        failures.append(int(plan_state.failures))
    assert without == most_failures * [True] + (10 - most_failures) * [False]
    tries = list(range(1, most_failures + 1))
    assert failures == (tries + [0] + tries + 10 * [most_failures])[:10]


def test_of_two_episodes_one_may_cross_and_the_other_not() -> None:
    problem = make_problem(torch.cat((walled_map(), walled_map(gap=GAP))))
    states, _, plans = drive(problem, 1000, replace(SMALL, most_failures=2))
    assert arrived(problem, states[-1]).all()
    assert not all_free(problem.select(torch.tensor([0])), states[:, 0])
    assert all_free(problem.select(torch.tensor([1])), states[:, 1])
    assert all(plan.status[1] == PlanStatus.OK for plan in plans)


def test_goal_on_ground_that_is_not_free_is_reached() -> None:
    maps = open_map()
    maps[:, 10:22, 22:] = 0.1  # about the goal, but for its disc
    problem = make_problem(maps)
    assert problem.free_at(problem.goal_m[:, None]).all()
    states, _, _ = drive(problem, 1000, replace(SMALL, most_failures=2))
    assert arrived(problem, states[-1]).all()


def test_closed_wall_is_not_entered_by_chance_where_the_ground_is_other_than_predicted() -> (
    None
):
    problem = make_problem(walled_map().repeat(8, 1, 1))
    noise = torch.rand(
        problem.traversability.shape, generator=torch.Generator().manual_seed(0)
    )
    truth = (problem.risk_map + 0.4 * (noise - 0.5)).clamp(0.1, 1)
    states, _, plans = drive(problem, 100, truth=truth)
    # [N, B]
    without = torch.stack([plan.path[..., 0].isnan().all(dim=1) for plan in plans])
    assert without.any(dim=0).all()
    for member in range(8):
        before = states[: int(without[:, member].to(torch.uint8).argmax()) + 1, member]
        assert before[-1, 0] > 5
        assert before[:, 0].max() < 8.0


def test_way_to_the_goal_takes_the_place_of_a_partial_path_at_once() -> None:
    problem = make_problem(walled_map(gap=slice(24, 28)))
    config = CLRRTConfig(expansions=100)
    for seed in range(10):
        states, _, plans = drive(problem, config.most_failures, config, seed)
        status = [int(plan.status[0]) for plan in plans]
        if status[0] == PlanStatus.PARTIAL and PlanStatus.OK in status:
            assert len(known(plans[0].path[0])) > 2
            assert not torch.equal(
                plans[-1].path.nan_to_num(), plans[0].path.nan_to_num()
            )
            assert off_polyline(states[:, 0, :2], known(plans[0].path[0])).max() < 0.5
            return
    pytest.fail("Expected a seed at which a later plan finds what the first did not.")


def test_robot_off_the_map_is_left_alone() -> None:
    problem = make_problem(open_map(2))
    planner, plan_state = begin(problem)
    off = torch.tensor([[-1.0, 8.0, 0.0], [3.0, 8.0, 0.0]])
    for _ in range(2 * SMALL.most_failures):
        action, plan_state, plan = planner.plan(at(off), plan_state)
    assert plan_state.failures[0] == 0  # nothing was tried
    assert action[0].abs().max() == 0
    assert plan.status.tolist() == [PlanStatus.PARTIAL, PlanStatus.OK]


def test_goal_farther_than_a_plan_reaches_is_approached_along_partial_paths() -> None:
    maps = torch.full((1, 12, 96), 0.8)  # 48 m long
    problem = factories.problem(maps, (3.0, 3.0), (45.0, 3.0))
    config = CLRRTConfig(expansions=100, expansions_per_round=50, most_failures=1)
    assert config.rounds * config.step_m == 10
    states, _, plans = drive(problem, 900, config)
    assert plans[0].status.tolist() == [PlanStatus.PARTIAL]
    assert arrived(problem, states[-1]).all()
    assert len(states) * 0.1 < 1.2 * 41 / 0.8


def test_goal_as_far_as_the_rounds_reach_is_planned_to_at_once() -> None:
    maps = torch.full((1, 12, 96), 0.8)
    problem = factories.problem(maps, (3.0, 3.0), (45.0, 3.0))
    assert first_plan(problem, CLRRTConfig()).status.tolist() == [PlanStatus.OK]


def test_partial_path_is_not_changed_while_the_robot_stands_on_ground_that_is_not_free() -> (
    None
):
    # From there a way out may lead through the very wall that the path stops at.
    maps = open_map(8)
    maps[:, 15, 6:10] = 0.1  # from y = 7.5 m, beside the start
    problem = make_problem(maps)
    planner, plan_state = begin(problem, CLRRTConfig(expansions=25))
    _, plan_state, first = planner.plan(at(problem.start), plan_state)
    beside = problem.start + torch.tensor([0.3, -0.3, 0.0])
    assert not problem.free_at(beside).any()
    assert (first.status == PlanStatus.PARTIAL).all()
    for _ in range(SMALL.most_failures - 2):
        _, plan_state, plan = planner.plan(at(beside), plan_state)
        assert plan.path is first.path
    # once it is back on free ground it looks for a way again
    assert (plan_state.failures == 0).all()
    _, later, plan = planner.plan(at(problem.start), plan_state)
    assert ((later.failures == 1) | (plan.status == PlanStatus.OK)).all()


@pytest.mark.parametrize("beneath", [0.2, 0.0])
def test_robot_on_ground_that_is_not_free_leaves_it_once(beneath: float) -> None:
    maps = open_map()
    maps[:, 14:18, 4:8] = beneath
    problem = make_problem(maps)
    truth = maps.clamp(min=0.3)  # in truth such ground slows the robot, no more
    states, _, plans = drive(problem, 400, truth=truth)
    assert plans[0].status.tolist() == [PlanStatus.OK]
    assert arrived(problem, states[-1]).all()
    free = problem.free_at(states[:, 0][None])[0]
    assert not free[0]
    assert free[int(free.to(torch.uint8).argmax()) :].all()


def test_robot_that_leaves_ground_that_is_not_free_stays_on_the_map() -> None:
    off_border_m = torch.arange(1, 8) * 0.1
    maps = open_map(len(off_border_m))
    maps[:, :, :6] = 0.1
    problem = make_problem(maps)
    planner, plan_state = begin(problem)
    facing = torch.stack(
        (off_border_m, torch.full((7,), 8.0), torch.full((7,), math.pi)), dim=1
    )
    _, _, plan = planner.plan(at(facing), plan_state)
    points = known(plan.tree.flatten(0, 2))
    assert len(points) > 0
    assert GRID.contains(points[:, 0], points[:, 1]).all()


def test_tree_grows_in_a_room_smaller_than_an_edge() -> None:
    maps = torch.full((1, *GRID.shape), 0.1)
    maps[:, 12:20, 4:12] = 0.8
    problem = make_problem(maps)
    planner, plan_state = begin(problem)
    _, _, plan = planner.plan(at(problem.start), plan_state)
    edges = (~plan.tree[0, ..., 0].isnan()).any(dim=1).sum()
    assert edges > SMALL.expansions / 4
    assert all_free(problem, known(plan.tree[0]))


def test_robot_that_faces_a_wall_turns_tighter() -> None:
    maps = open_map()
    maps[:, 9:23, 8:10] = 0.1  # 1 m ahead of the start and 7 m wide
    maps[:, 9:11, 3:8] = 0.1
    maps[:, 21:23, 3:8] = 0.1
    maps[:, 14:18, 7] = 0.1
    problem = make_problem(maps)
    states, _, _ = drive(problem, 900, CLRRTConfig())
    assert arrived(problem, states[-1]).all()
    assert all_free(problem, states[:, 0])


def test_ground_other_than_predicted_changes_the_time_but_not_the_way() -> None:
    problem = make_problem(walled_map(gap=GAP))
    noise = torch.rand(
        problem.traversability.shape, generator=torch.Generator().manual_seed(0)
    )
    states, _, plans = drive(
        problem, 900, truth=(problem.risk_map + noise - 0.5).clamp(0.1, 1)
    )
    assert arrived(problem, states[-1]).all()
    assert off_polyline(states[:, 0, :2], known(plans[0].path[0])).max() < 0.3


def test_displaced_robots_plan_anew_and_only_they() -> None:
    problem = make_problem(open_map(3))
    planner, plan_state = begin(problem)
    _, plan_state, before = planner.plan(at(problem.start), plan_state)
    moved = problem.start + torch.tensor(
        [[0.0, 0.6, 0.0], [0.0, 1.4, 0.0], [0.0, 0.0, 0.0]]
    )
    _, _, after = planner.plan(at(moved), plan_state)
    changed = [
        not torch.equal(a, b)
        for a, b in zip(before.tree.nan_to_num(), after.tree.nan_to_num(), strict=True)
    ]
    assert changed == [False, True, False]
    torch.testing.assert_close(after.path[1, 0], moved[1, :2])
    torch.testing.assert_close(after.path[[0, 2]], before.path[[0, 2]], equal_nan=True)


def test_displaced_robot_follows_its_new_path_from_the_beginning() -> None:
    problem = make_problem(open_map())
    planner, plan_state = begin(problem)
    state, driven = problem.start, []
    for step in range(250):
        if step == 90:  # on the second edge by then
            state = state + torch.tensor([[-1.0, 2.5, 0.0]])
        action, plan_state, plan = planner.plan(at(state), plan_state)
        if step >= 90:
            driven.append(state[0, :2])
        state = problem.robot(state, action, problem.traversability_at(state))
    path = known(plan.path[0])
    torch.testing.assert_close(path[0], driven[0])
    assert off_polyline(torch.stack(driven), path).max() < 0.05
    assert arrived(problem, state).all()


def test_robot_that_makes_no_progress_plans_anew() -> None:
    problem = make_problem(open_map())
    planner, plan_state = begin(problem, CLRRTConfig(expansions=100, stall_s=2.0))
    paths = []
    for _ in range(45):  # 4.5 s on the spot
        _, plan_state, plan = planner.plan(at(problem.start), plan_state)
        paths.append(plan.path)
    fresh = [step for step in range(1, 45) if paths[step] is not paths[step - 1]]
    assert fresh == [21, 42]


def test_same_seed_same_actions() -> None:
    problem = make_problem(walled_map(gap=GAP))
    states, actions, plans = drive(problem, 40, seed=3)
    again, same, _ = drive(problem, 40, seed=3)
    assert torch.equal(actions, same)
    assert torch.equal(states, again)
    _, _, others = drive(problem, 1, seed=4)
    assert not torch.equal(plans[0].tree.nan_to_num(), others[0].tree.nan_to_num())


def test_episode_alone_is_what_it_is_in_a_batch() -> None:
    maps = torch.cat((walled_map(gap=GAP), walled_map(), open_map()))
    problem = make_problem(maps)
    together, _, _ = drive(problem, 600)
    for member in range(len(maps)):
        alone = problem.select(torch.tensor([member]))
        states, _, _ = drive(alone, 600)
        assert arrived(alone, states[-1]).all()
        # Rounding may put the step at which it goes on to the next edge off by one.
        assert off_polyline(states[:, 0, :2], together[:, member, :2]).max() < 0.05
        assert arrived(
            alone, together[min(len(states) + 3, len(together) - 1), member][None]
        ).all()


def test_samples_are_keyed_by_seed_and_step_whatever_is_in_the_batch() -> None:
    # The robots of one batch start at other steps than that of the other, but plan at
    # the same one.
    maps = torch.cat((open_map(), walled_map(gap=GAP)))
    together, alone = make_problem(maps), make_problem(maps[1:])
    plans = []
    for problem in (together, alone):
        planner, plan_state = begin(problem, seed=5)
        for _ in range(3):
            _, plan_state, _ = planner.plan(at(problem.start), plan_state)
        away = problem.start + torch.tensor([0.0, 2.0, 0.0])
        plans.append(planner.plan(at(away), plan_state)[2])
    torch.testing.assert_close(plans[0].tree[1], plans[1].tree[0], equal_nan=True)
    planner, plan_state = begin(alone, seed=5)
    earlier = planner.plan(at(away), plan_state)[2]
    assert not torch.equal(earlier.tree.nan_to_num(), plans[1].tree.nan_to_num())


def test_layers_are_drawn_when_asked_for_whenever_that_is() -> None:
    problem = make_problem(open_map(2))
    planner, plan_state = begin(problem)
    action, plan_state, plan = planner.plan(at(problem.start, draw=False), plan_state)
    assert plan.path.numel() == plan.reference.numel() == plan.tree.numel() == 0
    drawn, _, later = planner.plan(at(problem.start), begin(problem)[1])
    assert torch.equal(drawn, action)
    # of a route planned when none was asked for
    _, _, shown = planner.plan(at(problem.start), plan_state)
    torch.testing.assert_close(shown.tree, later.tree, equal_nan=True)


def test_drawn_tree_is_one_of_edges_no_longer_than_the_step() -> None:
    problem = make_problem(open_map(2))
    planner, plan_state = begin(problem)
    _, _, plan = planner.plan(at(problem.start), plan_state)
    assert plan.tree.shape[:2] == (2, SMALL.expansions)
    assert plan.tree.shape[3] == 2
    assert plan.path.shape[2] == plan.reference.shape[2] == 2
    edges = [known(edge) for edge in plan.tree[0] if not edge.isnan().all()]
    assert len(edges) > SMALL.expansions / 2
    ends = torch.stack([edge[-1] for edge in edges] + [problem.start[0, :2]])
    for edge in edges:
        assert (
            torch.linalg.vector_norm(edge[1:] - edge[:-1], dim=1).sum()
            < SMALL.step_m + 0.2
        )
        # begins where another ends
        assert torch.linalg.vector_norm(ends - edge[0], dim=1).min() < 1e-6
    assert known(plan.reference[0]).shape[0] > 10
    assert off_polyline(known(plan.path[0]), known(plan.reference[0])).max() < 0.5


@pytest.mark.parametrize(
    "robot",
    [
        Unicycle(),
        Unicycle(dt_s=0.2, speed_mps=(0.1, 0.6), turn_rate_radps=(-0.5, 0.4)),
        DifferentialDrive(),
    ],
)
def test_prediction_is_what_the_controller_then_does(robot: Robot) -> None:
    # With F as predicted the robot comes through each predicted state, over all edges
    # of the path.
    problem = make_problem(walled_map(gap=GAP), robot)
    config = CLRRTConfig(
        edge_time_s=18.0, follower=FollowerConfig(speed_mps=0.3, speed_kd=0.02)
    )
    states, _, plans = drive(problem, 900, config)
    path = known(plans[0].path[0])
    assert plans[0].status.tolist() == [PlanStatus.OK]
    assert len(path) > 20
    apart = torch.linalg.vector_norm(path[:, None] - states[:, 0, :2], dim=-1)
    assert apart.amin(dim=1).max() < 1e-4


def test_robot_at_its_goal_stands() -> None:
    problem = make_problem(open_map())
    planner, plan_state = begin(problem)
    state = torch.cat((problem.goal_m, torch.zeros(1, 1)), dim=1)
    action, _, plan = planner.plan(at(state), plan_state)
    assert action.abs().max() == 0
    assert plan.path.isnan().all()  # there is nothing to plan


@pytest.mark.parametrize(
    "options",
    [
        {"expansions": 0},
        {"expansions": 30},
        {"step_m": -1.0},
        {"goal_bias": 1.5},
        {"replan_distance_m": math.nan},
        {"follower": {"lookahead_m": 0.0}},
        {"most_failures": 0},
    ],
)
def test_settings_are_checked(options: dict[str, object]) -> None:
    with pytest.raises(
        ConfigError,
        match="lookahead_m" if "follower" in options else next(iter(options)),
    ):
        registry.make("planner", {"part": "cl_rrt", "options": options})


def test_settings_of_the_follower_are_given_beside_the_others() -> None:
    options = {"expansions": 75, "follower": {"lookahead_m": 0.9}}
    made = registry.make("planner", {"part": "cl_rrt", "options": options})
    assert made.config == CLRRTConfig(
        expansions=75, follower=FollowerConfig(lookahead_m=0.9)
    )


@pytest.mark.parametrize(
    ("robot", "match"),
    [
        (
            Unicycle(speed_mps=(0.8, 1.0), turn_rate_radps=(-0.5, 0.5)),
            "turning_radius_m",
        ),
        (Unicycle(turn_rate_radps=(0.0, 1.0)), "both sides"),
        (Bicycle(), "steering_rad"),
    ],
)
def test_robots_that_it_cannot_steer_are_refused_before_anything_runs(
    robot: Robot, match: str
) -> None:
    with pytest.raises(ConfigError, match=match):
        begin(make_problem(open_map(), robot))


def test_what_tables_say_of_it() -> None:
    planner = CLRRT()
    assert planner.steers == (("speed_mps", "turn_rate_radps"),)
    assert planner.follows(factories.task()) == "simulated time to the goal"
    assert planner.follows(factories.task(objective=TravelTime(Unicycle(), 1.0))) == ""
    assert planner.remarks(factories.task(Unicycle())) == ()
    assert planner.remarks(factories.task(Unicycle(speed_mps=(-1.0, 3.0)))) == ()
    (remark,) = planner.remarks(factories.task(DifferentialDrive()))
    assert "looks 1 m ahead" in remark
    slow = CLRRT(CLRRTConfig(follower=FollowerConfig(speed_mps=1.0)))
    said = ("CL-RRT drives at 1 m/s at most; the robot's top speed is 3 m/s",)
    assert slow.remarks(factories.task(Unicycle(speed_mps=(0.0, 3.0)))) == said
    assert slow.remarks(factories.task(Unicycle())) == ()
    # Backward it would be faster, but it is driven forward alone.
    assert (
        "at 2 m/s at most"
        in planner.remarks(factories.task(Unicycle(speed_mps=(-3.0, 2.0))))[0]
    )


@pytest.mark.parametrize("top_mps", [0.5, 3.0])
def test_on_open_ground_it_is_as_fast_as_the_straight_line(top_mps: float) -> None:
    problem = make_problem(open_map(), Unicycle(speed_mps=(0.0, top_mps)))
    steps = [
        closed_loop(planner, problem).steps.item()
        for planner in (CLRRT(CLRRTConfig(expansions=50)), Straight())
    ]
    assert steps[0] <= 1.05 * steps[1]


def test_a_fast_robot_finds_the_gap_in_less_time_than_a_slow_one() -> None:
    maps, steps = walled_map(gap=GAP), []
    for top in (1.0, 3.0):
        robot = Unicycle(speed_mps=(0.0, top), turn_rate_radps=(-top, top))
        problem = make_problem(maps, robot)
        states, _, _ = drive(problem, 400)
        assert arrived(problem, states[-1]).all()
        assert all_free(problem, states[:, 0])
        steps.append(len(states))
    assert steps[1] < 0.4 * steps[0]


def test_those_that_are_kept_go_on_as_they_would_in_the_batch() -> None:
    problem = make_problem(torch.cat((walled_map(gap=GAP), open_map(), walled_map())))
    planner, plan_state = begin(problem, CLRRTConfig(expansions=50))
    state, members = problem.start, torch.tensor([2, 0])
    for _ in range(3):
        action, plan_state, _ = planner.plan(at(state), plan_state)
        state = problem.robot(state, action, problem.traversability_at(state))
    few = planner.select(plan_state, members)
    for count in range(4):
        # aside, so that it plans anew
        state = state + torch.tensor([0.0, 1.5, 0.0]) * (count == 2)
        action, plan_state, plan = planner.plan(at(state), plan_state)
        few_action, few, few_plan = planner.plan(at(state[members]), few)
        torch.testing.assert_close(few_action, action[members])
        torch.testing.assert_close(few_plan.path, plan.path[members], equal_nan=True)
        assert torch.equal(few.failures, plan_state.failures[members])
        state = problem.robot(state, action, problem.traversability_at(state))


def test_trees_are_grown_for_running_robots_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grown: list[int] = []

    def counted(loop: ClosedLoop, root: Tensor, *rest: Any) -> Route:
        grown.append(len(root))
        return search(loop, root, *rest)

    monkeypatch.setattr(cl_rrt, "search", counted)
    problem = make_problem(open_map(3))
    # In truth two of three are held where they begin, which ends their episodes after a
    # second.
    truth = torch.cat((torch.zeros(2, *GRID.shape), open_map()))
    world = World(immobile=Immobile(below=0.1, for_s=1.0))
    places = factories.places(problem.goal_m, problem.start[:, :2])
    terrain = replace(factories.terrain(truth, 0.01), grid=problem.grid)
    simulation = Simulation(terrain, problem.task, world, places, 0, range(3))
    planner = CLRRT(replace(SMALL, expansions=50, stall_s=2.0))
    episodes = run_episodes(planner, problem, simulation, torch.Generator())
    assert episodes.outcome.tolist() == [Outcome.IMMOBILISED] * 2 + [Outcome.SUCCESS]
    assert episodes.steps[2] > 40
    assert grown[0] == 3
    assert set(grown[1:]) <= {1}


@pytest.mark.parametrize(("expansions", "per_round"), [(100, 25), (100, 50), (200, 25)])
def test_number_of_expansions_and_rounds(expansions: int, per_round: int) -> None:
    config = CLRRTConfig(expansions=expansions, expansions_per_round=per_round)
    planner, plan_state = begin(make_problem(open_map()), config)
    _, plan_state, plan = planner.plan(at(plan_state.problem.start), plan_state)
    assert plan.tree.shape[1] == expansions
    tried = (~plan.tree[0, ..., 0].isnan()).any(dim=1)
    assert tried.sum() > 0.8 * expansions
    assert plan_state.route.rows.shape[1] == expansions // per_round
    # A round's edges all begin where earlier rounds' end.
    begins, ends = (
        plan.tree[0, :, 0],
        torch.stack([edge[-1] for edge in map(known, plan.tree[0][tried])]),
    )
    first_round = tried.nonzero()[:, 0] < per_round
    from_root = (
        torch.linalg.vector_norm(begins[tried] - plan_state.problem.start[0, :2], dim=1)
        < 1e-4
    )
    assert from_root[first_round].all()
    assert not from_root.all()
    assert len(ends) == len(from_root)


@pytest.mark.parametrize(
    ("goal_bias", "edges"), [(0.0, 0), (0.04, 1), (0.25, 7), (1.0, 25)]
)
def test_share_of_the_edges_that_aim_at_the_goal(goal_bias: float, edges: int) -> None:
    # In the second round there are nodes enough. On open ground an edge that aims at
    # the goal ends on a line that leads there.
    config = CLRRTConfig(
        expansions=50, goal_bias=goal_bias, step_m=3.0, turning_radius_m=0.5
    )
    problem = make_problem(open_map())
    straight = 0
    for points in map(known, first_plan(problem, config).tree[0, 25:]):
        along, to_goal = points[-1] - points[-2], problem.goal_m[0] - points[-1]
        across = along[0] * to_goal[1] - along[1] * to_goal[0]
        straight += int(torch.atan2(across, (along * to_goal).sum()).abs() < 0.05)
    assert straight == edges


@pytest.mark.parametrize("turning_radius_m", [0.5, 1.0, 2.5])
def test_references_turn_no_tighter_than_the_radius(turning_radius_m: float) -> None:
    problem = make_problem(open_map())
    away = problem.start + torch.tensor([0.0, 0.0, math.pi / 2])
    planner, plan_state = begin(
        problem, CLRRTConfig(turning_radius_m=turning_radius_m, goal_bias=1.0)
    )
    _, plan_state, plan = planner.plan(at(away), plan_state)
    assert plan.status.tolist() == [PlanStatus.OK]
    rows = plan_state.route.rows[0, 0]
    headings = torch.atan2(rows[:, 3], rows[:, 2])
    turned = (headings[1:] - headings[:-1]).abs().max() / 0.1
    assert turned.item() == pytest.approx(1 / turning_radius_m, rel=1e-3)


@pytest.mark.parametrize("step_m", [1.0, 3.0])
def test_longest_edge(step_m: float) -> None:
    plan = first_plan(
        make_problem(open_map()), CLRRTConfig(expansions=100, step_m=step_m)
    )
    lengths = [
        distance(points[1:], points[:-1]).sum() for points in map(known, plan.tree[0])
    ]
    assert max(lengths).item() == pytest.approx(step_m, abs=0.2)


@pytest.mark.parametrize("edge_time_s", [2.0, 5.0])
def test_longest_edge_in_time(edge_time_s: float) -> None:
    plan = first_plan(
        make_problem(open_map() * 0.5),
        CLRRTConfig(expansions=100, edge_time_s=edge_time_s),
    )
    lengths = [
        distance(points[1:], points[:-1]).sum() for points in map(known, plan.tree[0])
    ]
    assert max(lengths).item() == pytest.approx(0.4 * edge_time_s, abs=0.2)


@pytest.mark.parametrize("replan_distance_m", [0.5, 2.0])
def test_distance_from_the_path_at_which_it_plans_anew(
    replan_distance_m: float,
) -> None:
    problem = make_problem(open_map(2))
    planner, plan_state = begin(
        problem, replace(SMALL, replan_distance_m=replan_distance_m)
    )
    _, plan_state, before = planner.plan(at(problem.start), plan_state)
    off = torch.tensor([[0.0, -0.9, 0.0], [0.0, -1.1, 0.0]]) * replan_distance_m
    _, _, after = planner.plan(at(problem.start + off), plan_state)
    changed = [
        not torch.equal(*pair)
        for pair in zip(before.tree.nan_to_num(), after.tree.nan_to_num(), strict=True)
    ]
    assert changed == [False, True]


@pytest.mark.parametrize(
    "follower",
    [
        FollowerConfig(),
        FollowerConfig(speed_mps=1.0, lookahead_m=1.2),
        FollowerConfig(speed_mps=1.0, lookahead_s=1.2),
        FollowerConfig(speed_mps=0.5),
        FollowerConfig(speed_mps=1.0, speed_kp=0.1),
        FollowerConfig(speed_mps=1.0, speed_ki=0.1),
        FollowerConfig(speed_mps=1.0, speed_kd=0.05),
    ],
)
def test_follower_drives_as_it_is_set(follower: FollowerConfig) -> None:
    # Ground that slows the robot, so that each gain tells; away from the goal, so that
    # it has to turn.
    maps = open_map() * 0.6
    problem = make_problem(
        maps, Unicycle(speed_mps=(0.0, 2.0), turn_rate_radps=(-2.0, 2.0))
    )
    turned = replace(problem, start=problem.start + torch.tensor([0.0, 0.0, 1.0]))
    _, usual, _ = drive(
        turned, 20, replace(SMALL, follower=FollowerConfig(speed_mps=1.0))
    )
    _, actions, _ = drive(turned, 20, replace(SMALL, follower=follower))
    assert (usual - actions).abs().max() > 0.02


def test_wanted_speed_is_the_speed_over_ground() -> None:
    problem = make_problem(open_map(), Unicycle(speed_mps=(0.0, 2.0)))
    states, _, _ = drive(
        problem, 400, replace(SMALL, follower=FollowerConfig(speed_mps=0.6))
    )
    moved = distance(states[1:, 0], states[:-1, 0]) / 0.1
    assert moved[30:].median().item() == pytest.approx(0.6, abs=0.03)


def test_robot_with_acceleration_limits_arrives() -> None:
    problem = make_problem(walled_map(gap=GAP), DifferentialDrive())
    states, _, _ = drive(problem, 600)
    assert arrived(problem, states[-1]).all()
    assert all_free(problem, states[:, 0])
