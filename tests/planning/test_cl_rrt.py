"""CL-RRT on small maps, driven through the same F that it predicts with unless said otherwise."""

import math
from dataclasses import fields

import pytest
import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.cl_rrt import CLRRT, CLRRTConfig, CLRRTState
from benchnav.planning.dynamics import Unicycle
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planner import Plan, PlanStatus, make_planner
from benchnav.planning.problem import Problem, heading_to
from benchnav.terrain import Grid

GRID = Grid(32, 32, 0.5)  # 16 m × 16 m
SMALL = CLRRTConfig(expansions=200)


def open_map(batch: int = 1) -> Tensor:
    return torch.full((batch, *GRID.shape), 0.8)


def walled_map(gap: slice | None = None) -> Tensor:
    """A wall 1 m thick at x = 8 m, between start and goal, with or without a gap along y."""
    maps = open_map()
    maps[:, :, 16:18] = 0.1
    if gap is not None:
        maps[:, gap, 16:18] = 0.8
    return maps


def make_problem(maps: Tensor, dynamics: Unicycle | None = None) -> Problem:
    batch = len(maps)
    start, goal = torch.tensor([[3.0, 8.0]]).expand(batch, -1), torch.tensor([[13.0, 8.0]]).expand(batch, -1)
    return Problem(
        grid=GRID,
        elevation_m=torch.zeros_like(maps),
        traversability=maps,
        dynamics=dynamics or Unicycle(),
        objective=GoalDistance(),
        start=heading_to(start, goal),
        goal_m=goal.clone(),
    )


def begin(problem: Problem, config: CLRRTConfig = SMALL, seed: int = 0) -> tuple[CLRRT, CLRRTState]:
    planner = CLRRT(config)
    return planner, planner.init(problem, torch.Generator().manual_seed(seed))


def drive(
    problem: Problem, steps: int, config: CLRRTConfig = SMALL, seed: int = 0, truth: Tensor | None = None
) -> tuple[Tensor, Tensor, list[Plan]]:
    """States [N + 1, B, S], actions [N, B, A] and plans, until all have arrived or failed."""
    planner, plan_state = begin(problem, config, seed)
    ground = GRID.pad(problem.traversability if truth is None else truth, outside=0.0)
    state = problem.start
    states, actions, plans = [state], [], []
    for _ in range(steps):
        action, plan_state, plan = planner.plan(state, plan_state)
        actions.append(action)
        plans.append(plan)
        state = problem.dynamics(state, action, GRID.lookup(ground, state[:, 0], state[:, 1]))
        states.append(state)
        if bool((arrived(problem, state) | (plan.status == PlanStatus.FAILED)).all()):
            break
    return torch.stack(states), torch.stack(actions), plans


def arrived(problem: Problem, state: Tensor) -> Tensor:
    return torch.linalg.vector_norm(state[..., :2] - problem.goal_m, dim=-1) < problem.goal_radius_m


def known(points: Tensor) -> Tensor:
    return points[~points[..., 0].isnan()]


def off_polyline(points: Tensor, polyline: Tensor) -> Tensor:
    """Distances of points [N, 2] to a polyline [M, 2]."""
    begin, along = polyline[:-1], polyline[1:] - polyline[:-1]
    share = ((points[:, None] - begin) * along).sum(-1) / (along * along).sum(-1).clamp(min=1e-9)
    nearest = begin + share.clamp(0, 1)[..., None] * along
    return torch.linalg.vector_norm(points[:, None] - nearest, dim=-1).amin(dim=1)


def all_free(problem: Problem, points: Tensor) -> bool:
    return bool((problem.traversability_at(points[None]) > problem.stuck_threshold).all())


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
    assert all(plan.path is first.path for plan in plans)  # followed to the end, without another plan
    assert off_polyline(states[:, 0, :2], path).max() < 0.05
    assert off_polyline(path, states[:, 0, :2]).max() < 0.05
    low, high = torch.tensor(problem.dynamics.action_low), torch.tensor(problem.dynamics.action_high)
    assert ((actions >= low) & (actions <= high)).all()


def test_best_path_of_an_open_map_is_nearly_straight() -> None:
    states, _, _ = drive(make_problem(open_map()), 300)
    straight_s = (10 - 1) / 0.8
    assert (len(states) - 1) * 0.1 < 1.1 * straight_s


def test_wall_is_passed_through_its_gap() -> None:
    problem = make_problem(walled_map(gap=slice(24, 28)))
    states, _, plans = drive(problem, 600)
    assert plans[0].status.tolist() == [PlanStatus.OK]
    assert all_free(problem, known(plans[0].path[0]))
    assert all_free(problem, known(plans[0].tree[0]))
    assert arrived(problem, states[-1]).all()
    assert all_free(problem, states[:, 0])
    within = states[(states[:, 0, 0] > 8) & (states[:, 0, 0] < 9), 0]
    assert len(within) > 0
    assert ((within[:, 1] >= 12) & (within[:, 1] <= 14)).all()


def test_quicker_way_is_preferred_to_the_shorter_one() -> None:
    maps = open_map()
    maps[:, 8:24, 12:20] = 0.32  # free, but slow: 4 m at 0.32 take as long as 10 m around
    states, _, _ = drive(make_problem(maps), 600, CLRRTConfig())
    straight_s = 5 / 0.8 + 4 / 0.32
    assert (len(states) - 1) * 0.1 < straight_s


def test_closed_wall_is_a_partial_plan_and_then_a_failure() -> None:
    problem = make_problem(walled_map())
    states, actions, plans = drive(problem, 1000)
    status = torch.stack([plan.status[0] for plan in plans])
    assert status[0] == PlanStatus.PARTIAL
    assert set(status[:-1].tolist()) == {PlanStatus.PARTIAL}
    assert status[-1] == PlanStatus.FAILED
    assert states[-1, 0, 0] > 5  # it went as far as it could
    assert all_free(problem, states[:, 0])
    assert actions.isfinite().all()
    torch.testing.assert_close(actions[-1], torch.zeros(1, 2))
    # Tried again at once, the first path kept; at its end tried as often before it gives up.
    assert all(torch.equal(plan.path.nan_to_num(), plans[0].path.nan_to_num()) for plan in plans[1:10])
    without = [bool(plan.path.isnan().all()) for plan in plans]
    assert without[-SMALL.most_failures - 1 :] == [False] + SMALL.most_failures * [True]


def test_closed_wall_is_not_breached_where_the_ground_is_other_than_predicted() -> None:
    problem = make_problem(walled_map().repeat(20, 1, 1))
    noise = torch.rand(problem.traversability.shape, generator=torch.Generator().manual_seed(0))
    truth = (problem.traversability + 0.4 * (noise - 0.5)).clamp(0.1, 1)
    states, _, plans = drive(problem, 600, truth=truth)
    assert (plans[-1].status == PlanStatus.FAILED).all()
    assert states[..., 0].max() < 8.0


def test_way_to_the_goal_takes_the_place_of_a_partial_path_at_once() -> None:
    problem = make_problem(walled_map(gap=slice(24, 26)))
    config = CLRRTConfig(expansions=75)
    for seed in range(10):
        states, _, plans = drive(problem, config.most_failures, config, seed)
        status = [int(plan.status[0]) for plan in plans]
        if status[0] == PlanStatus.PARTIAL and PlanStatus.OK in status:
            assert len(known(plans[0].path[0])) > 2
            assert not torch.equal(plans[-1].path.nan_to_num(), plans[0].path.nan_to_num())
            assert off_polyline(states[:, 0, :2], known(plans[0].path[0])).max() < 0.5
            return
    pytest.fail("Expected a seed at which a later plan finds what the first did not.")


def test_failure_is_final_and_leaves_the_other_episodes_alone() -> None:
    blocked = open_map()
    blocked[:] = 0.1
    blocked[:, 14:18, 4:9] = 0.8  # a cell about the start
    problem = make_problem(torch.cat((blocked, open_map())))
    planner, plan_state = begin(problem)
    state = problem.start
    statuses = []
    for _ in range(200):
        action, plan_state, plan = planner.plan(state, plan_state)
        state = problem.dynamics(state, action, problem.traversability_at(state))
        statuses.append(plan.status)
    failed = torch.stack(statuses)[:, 0] == PlanStatus.FAILED
    assert failed.any()
    assert failed[int(failed.to(torch.uint8).argmax()) :].all()
    assert (torch.stack(statuses)[:, 1] == PlanStatus.OK).all()
    assert arrived(problem, state).tolist() == [False, True]
    _, _, plan = planner.plan(torch.tensor([[3.0, 12.0, 0.0], [3.0, 12.0, 0.0]]), plan_state)
    assert plan.status.tolist() == [PlanStatus.FAILED, PlanStatus.OK]  # wherever it is put


def test_partial_path_is_not_changed_while_the_robot_stands_on_ground_that_is_not_free() -> None:
    # From there a way out may lead through the very wall that the path stops at.
    maps = open_map(8)
    maps[:, 15, 6:10] = 0.1  # from y = 7.5 m, beside the start
    problem = make_problem(maps)
    planner, plan_state = begin(problem, CLRRTConfig(expansions=25))
    _, plan_state, first = planner.plan(problem.start, plan_state)
    beside = problem.start + torch.tensor([0.3, -0.3, 0.0])
    assert (problem.traversability_at(beside) <= problem.stuck_threshold).all()
    assert (first.status == PlanStatus.PARTIAL).all()
    for _ in range(SMALL.most_failures - 2):
        _, plan_state, plan = planner.plan(beside, plan_state)
        assert plan.path is first.path
    _, later, plan = planner.plan(problem.start, plan_state)
    assert (later.failures != plan_state.failures).all()


@pytest.mark.parametrize("beneath", [0.2, 0.0])
def test_robot_on_ground_that_is_not_free_leaves_it_once(beneath: float) -> None:
    maps = open_map()
    maps[:, 14:18, 4:8] = beneath
    problem = make_problem(maps)
    truth = maps.clamp(min=0.3)  # in truth such ground slows the robot, no more
    states, _, plans = drive(problem, 400, truth=truth)
    assert plans[0].status.tolist() == [PlanStatus.OK]
    assert arrived(problem, states[-1]).all()
    free = problem.traversability_at(states[:, 0][None])[0] > problem.stuck_threshold
    assert not free[0]
    assert free[int(free.to(torch.uint8).argmax()) :].all()


def test_robot_that_leaves_ground_that_is_not_free_stays_on_the_map() -> None:
    off_border_m = torch.arange(1, 8) * 0.1
    maps = open_map(len(off_border_m))
    maps[:, :, :6] = 0.1
    problem = make_problem(maps)
    planner, plan_state = begin(problem)
    facing = torch.stack((off_border_m, torch.full((7,), 8.0), torch.full((7,), math.pi)), dim=1)
    _, _, plan = planner.plan(facing, plan_state)
    points = known(plan.tree.flatten(0, 2))
    assert len(points) > 0
    assert GRID.contains(points[:, 0], points[:, 1]).all()


def test_tree_grows_in_a_room_smaller_than_an_edge() -> None:
    maps = torch.full((1, *GRID.shape), 0.1)
    maps[:, 12:20, 4:12] = 0.8
    problem = make_problem(maps)
    planner, plan_state = begin(problem)
    _, _, plan = planner.plan(problem.start, plan_state)
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
    problem = make_problem(walled_map(gap=slice(24, 28)))
    noise = torch.rand(problem.traversability.shape, generator=torch.Generator().manual_seed(0))
    states, _, plans = drive(problem, 900, truth=(problem.traversability + noise - 0.5).clamp(0.1, 1))
    assert arrived(problem, states[-1]).all()
    assert off_polyline(states[:, 0, :2], known(plans[0].path[0])).max() < 0.3


def test_displaced_robots_plan_anew_and_only_they() -> None:
    problem = make_problem(open_map(3))
    planner, plan_state = begin(problem)
    _, plan_state, before = planner.plan(problem.start, plan_state)
    moved = problem.start + torch.tensor([[0.0, 0.6, 0.0], [0.0, 1.4, 0.0], [0.0, 0.0, 0.0]])
    _, _, after = planner.plan(moved, plan_state)
    changed = [
        not torch.equal(a, b) for a, b in zip(before.tree.nan_to_num(), after.tree.nan_to_num(), strict=True)
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
        action, plan_state, plan = planner.plan(state, plan_state)
        if step >= 90:
            driven.append(state[0, :2])
        state = problem.dynamics(state, action, problem.traversability_at(state))
    path = known(plan.path[0])
    torch.testing.assert_close(path[0], driven[0])
    assert off_polyline(torch.stack(driven), path).max() < 0.05
    assert arrived(problem, state).all()


def test_robot_that_makes_no_progress_plans_anew() -> None:
    problem = make_problem(open_map())
    planner, plan_state = begin(problem, CLRRTConfig(expansions=100, stall_s=2.0))
    paths = []
    for _ in range(45):  # 4.5 s on the spot
        _, plan_state, plan = planner.plan(problem.start, plan_state)
        paths.append(plan.path)
    fresh = [step for step in range(1, 45) if paths[step] is not paths[step - 1]]
    assert fresh == [21, 42]


def test_same_seed_same_actions() -> None:
    problem = make_problem(walled_map(gap=slice(24, 28)))
    states, actions, plans = drive(problem, 40, seed=3)
    again, same, _ = drive(problem, 40, seed=3)
    assert torch.equal(actions, same)
    assert torch.equal(states, again)
    _, _, others = drive(problem, 1, seed=4)
    assert not torch.equal(plans[0].tree.nan_to_num(), others[0].tree.nan_to_num())


def test_episode_is_planned_alike_alone_and_in_a_batch() -> None:
    maps = torch.cat((walled_map(gap=slice(24, 28)), open_map(), walled_map(gap=slice(4, 8))))
    together, _, _ = drive(make_problem(maps), 30)
    alone, _, _ = drive(make_problem(maps[2:]), 30)
    torch.testing.assert_close(together[:, 2], alone[:, 0])


def test_plan_is_pure() -> None:
    problem = make_problem(walled_map())
    planner, plan_state = begin(problem)
    _, plan_state, _ = planner.plan(problem.start, plan_state)
    state = problem.start + 1.5  # far enough to plan anew
    given = [problem.traversability, problem.start, problem.goal_m, problem.elevation_m, state]
    for part in (plan_state, plan_state.route, plan_state.tracking):
        given += [getattr(part, f.name) for f in fields(part) if isinstance(getattr(part, f.name), Tensor)]
    copies = [tensor.clone() for tensor in given]
    global_state = torch.random.get_rng_state()
    action, _, _ = planner.plan(state, plan_state)
    again, _, _ = planner.plan(state, plan_state)
    assert torch.equal(action, again)
    for tensor, copy in zip(given, copies, strict=True):
        torch.testing.assert_close(tensor, copy, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(torch.random.get_rng_state(), global_state)


def test_drawn_tree_is_one_of_edges_no_longer_than_the_step() -> None:
    problem = make_problem(open_map(2))
    planner, plan_state = begin(problem)
    _, _, plan = planner.plan(problem.start, plan_state)
    assert plan.tree.shape[:2] == (2, SMALL.expansions)
    assert plan.tree.shape[3] == 2
    assert plan.path.shape[2] == plan.reference.shape[2] == 2
    edges = [known(edge) for edge in plan.tree[0] if not edge.isnan().all()]
    assert len(edges) > SMALL.expansions / 2
    ends = torch.stack([edge[-1] for edge in edges] + [problem.start[0, :2]])
    for edge in edges:
        assert torch.linalg.vector_norm(edge[1:] - edge[:-1], dim=1).sum() < SMALL.step_m + 0.2
        assert torch.linalg.vector_norm(ends - edge[0], dim=1).min() < 1e-6  # begins where another ends
    assert known(plan.reference[0]).shape[0] > 10
    assert off_polyline(known(plan.path[0]), known(plan.reference[0])).max() < 0.5


@pytest.mark.parametrize(
    "dynamics", [Unicycle(), Unicycle(dt_s=0.2, speed_mps=(0.1, 0.6), turn_rate_radps=(-0.5, 0.4))]
)
def test_prediction_is_what_the_controller_then_does(dynamics: Unicycle) -> None:
    # With F as predicted the robot comes through each predicted state, over all edges of the path.
    problem = make_problem(walled_map(gap=slice(24, 28)), dynamics)
    config = CLRRTConfig(speed_mps=0.3, speed_kd=0.02, edge_time_s=18.0)
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
    action, _, plan = planner.plan(state, plan_state)
    assert action.abs().max() == 0
    assert plan.status[0] != PlanStatus.FAILED


@pytest.mark.parametrize(
    "options",
    [
        {"expansions": 0},
        {"expansions": 30},
        {"step_m": -1.0},
        {"goal_bias": 1.5},
        {"replan_distance_m": math.nan},
        {"lookahead_m": 0.0},
        {"most_failures": 0},
    ],
)
def test_settings_are_checked(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(options))):
        make_planner("cl_rrt", options)


def test_radius_below_the_tightest_turn_is_refused() -> None:
    problem = make_problem(open_map(), Unicycle(speed_mps=(0.8, 1.0), turn_rate_radps=(-0.5, 0.5)))
    with pytest.raises(ConfigError, match="turning_radius_m"):
        begin(problem)


@pytest.mark.parametrize("goal_bias", [0.0, 1.0])
def test_extreme_goal_biases_plan_too(goal_bias: float) -> None:
    _, _, plans = drive(make_problem(open_map()), 1, CLRRTConfig(expansions=200, goal_bias=goal_bias))
    assert plans[0].status[0] != PlanStatus.FAILED
