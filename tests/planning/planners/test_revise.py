"""Planners whose map changes on the way: what they keep, and what they do anew."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners import boundary
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.cl_rrt import cl_rrt
from benchnav.planning.planners.cl_rrt.cl_rrt import CLRRT
from benchnav.planning.planners.cl_rrt.config import CLRRTConfig
from benchnav.planning.planners.cl_rrt.pursuit import FollowerConfig
from benchnav.planning.planners.planner import PlanStatus
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from tests import factories
from tests.planning.planners.driving import first, generator, step_at
from tests.planning.planners.test_planners import NAMES as ALL
from tests.planning.planners.test_planners import make

START, GOAL = (2.0, 6.0), (13.0, 6.0)
NAMES = [name for name in ALL if not make(name).plans_once]
LEARNS = sorted(set(NAMES) - {"straight"})


def ground() -> Tensor:
    return torch.full((2, 24, 30), 0.85)


def wall() -> Tensor:
    """A wall across the straight way, which has its gap far from it; on the first of
    two maps alone.
    """
    changed = ground()
    changed[0, :20, 14:16] = 0.1
    return changed


def problem(predicted: Tensor, **changes: Any) -> Problem:
    return factories.problem(predicted, start=START, goal=GOAL, **changes)


def taken(planner: Any, plan_state: Any, state: Tensor, steps: int) -> list[Tensor]:
    """Actions of some steps from a standing robot's place."""
    actions = []
    for _ in range(steps):
        action, plan_state, _ = planner.plan(step_at(state), plan_state)
        actions.append(action)
    return actions


@pytest.mark.parametrize("name", NAMES)
def test_the_same_map_changes_no_action(name: str) -> None:
    planner, posed = make(name), problem(ground())
    plan_state = planner.init(posed, generator())
    state = first(posed)
    _, plan_state, _ = planner.plan(state, plan_state)
    again = planner.revise(plan_state, problem(ground()))
    for one, other in zip(
        taken(planner, plan_state, posed.start, 3),
        taken(planner, again, posed.start, 3),
        strict=True,
    ):
        assert torch.equal(one, other)


def drive(
    planner: Any, first: Problem, then: Problem, steps: int, at: int = 5
) -> Tensor:
    """Where robots are under the true ground of the second problem, which they learn of
    after some steps.
    """
    state, observed = first.start, torch.full_like(first.start[:, 0], torch.nan)
    plan_state, draws = boundary.begin(planner, first, generator()), generator(1)
    track = [state]
    for count in range(steps):
        if count == at:
            plan_state = boundary.revise(
                planner, plan_state, replace(then, start=state), draws
            )
        step = replace(step_at(state), traversability=observed, time_s=0.1 * count)
        answer = boundary.act(planner, step, plan_state, first)
        plan_state = answer.plan_state
        observed = then.traversability_at(state)
        state = first.robot(state, answer.action, observed)
        track.append(state)
    return torch.stack(track, 1)


@pytest.mark.parametrize("name", sorted(set(LEARNS) - {"mppi"}))
def test_a_wall_that_is_learnt_of_is_driven_around(name: str) -> None:
    planner = make(name)
    track = drive(planner, problem(ground()), problem(wall()), 350)
    free = problem(wall()).free_at(track)[0]
    assert bool(free.all()), "it drove into the wall"
    assert float((track[0, -1, :2] - torch.tensor(GOAL)).norm()) < 1.2
    assert float(track[0, :, 1].max()) > 9.5
    # The other map is as it was.
    assert float((track[1, :, 1] - 6).abs().max()) < 1.0


@pytest.mark.parametrize("name", LEARNS)
def test_a_state_is_not_changed_and_one_episode_is_not_the_others(name: str) -> None:
    planner = make(name)
    posed, then = problem(ground()), problem(wall())
    plan_state = planner.init(posed, generator())
    _, plan_state, _ = planner.plan(first(posed), plan_state)
    kept = planner.revise(plan_state, then)
    whole, own = taken(planner, kept, posed.start, 2), torch.tensor([1])
    alone = taken(planner, planner.select(plan_state, own), posed.start[1:], 2)
    # The second map did not change, so that its robot drives as before.
    for one, other in zip(whole, alone, strict=True):
        torch.testing.assert_close(one[1:], other, atol=1e-5, rtol=0)
    before = taken(planner, planner.init(posed, generator()), posed.start, 1)
    fresh = planner.init(posed, generator())
    planner.revise(fresh, then)
    assert torch.equal(taken(planner, fresh, posed.start, 1)[0], before[0])


@pytest.mark.parametrize("name", ["astar_dwa", "astar_mppi"])
def test_a_revised_search_is_the_whole_search_of_the_new_map(name: str) -> None:
    planner, then = make(name), problem(wall(), objective=GoalDistance())
    plan_state = planner.init(problem(ground(), objective=GoalDistance()), generator())
    revised, anew = planner.revise(plan_state, then), astar.search(then)
    assert torch.equal(revised.field.cost, anew.cost)
    assert torch.equal(revised.field.following, anew.following)
    assert torch.equal(
        revised.ground.penalty_per_m,
        planner.init(then, generator()).ground.penalty_per_m,
    )
    assert revised.local.problem.risk_map is not plan_state.local.problem.risk_map
    assert torch.equal(revised.local.problem.risk_map, then.risk_map)
    # Now a hill is seen on the second map.
    heights = torch.zeros(2, 24, 30).index_put(
        (torch.tensor(1), torch.tensor(12)), torch.tensor(4.0)
    )
    hill = replace(then, observation=replace(then.observation, elevation_m=heights))
    assert torch.equal(
        planner.revise(revised, hill).field.cost, astar.search(hill).cost
    )
    assert not torch.equal(astar.search(hill).cost, anew.cost)


def test_local_planners_keep_their_motion() -> None:
    then = problem(wall())
    for name, kept in (("astar_dwa", "velocity"), ("astar_mppi", "mean")):
        planner, posed = make(name), problem(ground())
        plan_state = planner.init(posed, generator())
        for _ in range(3):
            _, plan_state, _ = planner.plan(first(posed), plan_state)
        revised = planner.revise(plan_state, then)
        assert torch.equal(
            getattr(revised.local, kept), getattr(plan_state.local, kept)
        )
        assert float(getattr(revised.local, kept).abs().max()) > 0
    planner, posed = make("mppi"), problem(ground())
    plan_state = planner.plan(first(posed), planner.init(posed, generator()))[1]
    revised = planner.revise(plan_state, then)
    assert torch.equal(revised.mean, plan_state.mean)
    assert torch.equal(revised.problem.risk_map, then.risk_map)


def test_cl_rrt_keeps_a_path_that_is_free_and_leaves_one_that_is_no_longer() -> None:
    planner, posed = make("cl_rrt"), problem(ground())
    _, plan_state, _ = planner.plan(first(posed), planner.init(posed, generator()))
    revised = planner.revise(plan_state, problem(wall()))
    assert revised.edge.tolist() == [
        int(plan_state.route.depth[0]),
        int(plan_state.edge[1]),
    ]
    slow = ground()
    slow[:, :, 14:16] = 0.5
    assert torch.equal(planner.revise(plan_state, problem(slow)).edge, plan_state.edge)
    _, after, _ = planner.plan(step_at(posed.start), revised)
    assert not torch.equal(
        after.route.path[0].nan_to_num(), plan_state.route.path[0].nan_to_num()
    )
    assert torch.equal(
        after.route.path[1].nan_to_num(), plan_state.route.path[1].nan_to_num()
    )


def slow(traversability: float, rows: slice = slice(8, 16)) -> Tensor:
    """Free ground of little λ̂ across the straight path, 3 m thick, on the first of two
    maps only.
    """
    changed = ground()
    changed[0, rows, 13:19] = traversability
    return changed


def cl_rrt_on_its_path(monkeypatch: pytest.MonkeyPatch) -> tuple[CLRRT, Any, list[int]]:
    """CL-RRT with a path to the goal, and a list to which each search adds its number
    of episodes.
    """
    planner, posed, searched = make("cl_rrt"), problem(ground()), []
    _, plan_state, _ = planner.plan(first(posed), planner.init(posed, generator()))
    assert plan_state.route.status.tolist() == [PlanStatus.OK] * 2
    search = cl_rrt.search

    def count(loop: Any, root: Tensor, *rest: Any) -> Any:
        searched.append(len(root))
        return search(loop, root, *rest)

    monkeypatch.setattr(cl_rrt, "search", count)
    return planner, plan_state, searched


def test_cl_rrt_drives_around_ground_that_turns_slow_and_stays_free() -> None:
    planner = make("cl_rrt")
    track = drive(planner, problem(ground()), problem(slow(0.32)), 145)
    # Straight on it takes 10 m less 3 m at 0.85 m/s and 3 m at 0.32 m/s: 17.6 s.
    assert float((track[0, -1, :2] - torch.tensor(GOAL)).norm()) < 1.2
    unchanged = drive(planner, problem(ground()), problem(ground()), 145)
    assert torch.equal(track[1], unchanged[1])


@pytest.mark.parametrize(
    ("traversability", "searches"), [(0.85, []), (0.68, []), (0.6, [1]), (0.95, [])]
)
def test_cl_rrt_searches_where_its_path_costs_a_tenth_more(
    traversability: float, searches: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 10 m ahead 3 m turn slow: the path costs 1.1 times as much at λ̂ = 0.64."""
    planner, plan_state, searched = cl_rrt_on_its_path(monkeypatch)
    then = problem(slow(traversability, slice(None)))
    for _ in range(2):  # the second revision brings nothing new
        plan_state = planner.revise(plan_state, then)
        for _ in range(2):
            _, plan_state, _ = planner.plan(step_at(then.start), plan_state)
    assert searched == searches


def test_cl_rrt_keeps_a_dearer_path_that_no_new_one_undercuts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    planner, before, _ = cl_rrt_on_its_path(monkeypatch)
    # Slow ground from edge to edge, and a new path 3 m beside the old one.
    monkeypatch.setattr(cl_rrt, "search", lambda loop, root, *rest: detour)
    detour = before.route.select(torch.tensor([0]))
    detour = replace(detour, path=detour.path + torch.tensor([0.0, 3.0]))
    detour = replace(
        detour,
        path=torch.cat((before.problem.start[:1, None, :2], detour.path[:, :-1]), 1),
    )
    then = problem(slow(0.4, slice(None)))
    _, after, _ = planner.plan(step_at(then.start), planner.revise(before, then))
    assert torch.equal(after.route.path.nan_to_num(), before.route.path.nan_to_num())
    assert after.doubted.tolist() == [False, False]
    # Over quick ground the same path is taken.
    _, after, _ = planner.plan(
        step_at(then.start), planner.revise(before, problem(slow(0.4, slice(8, 14))))
    )
    assert torch.equal(after.route.path[0].nan_to_num(), detour.path[0].nan_to_num())
    assert torch.equal(
        after.route.path[1].nan_to_num(), before.route.path[1].nan_to_num()
    )


def test_cl_rrt_tries_a_few_times_for_a_path_in_place_of_a_dearer_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    planner, plan_state, _ = cl_rrt_on_its_path(monkeypatch)
    before, radii = plan_state.route, []

    def none(loop: Any, root: Tensor, *rest: Any) -> Any:
        radii.append(float(loop.radius_m[0]))
        assert not bool(loop.crossing.any())
        partial = torch.full_like(before.status[:1], int(PlanStatus.PARTIAL))
        return replace(before.select(torch.tensor([0])), status=partial)

    monkeypatch.setattr(cl_rrt, "search", none)
    then = problem(slow(0.4))
    plan_state = planner.revise(plan_state, then)
    alone = planner.select(plan_state, torch.tensor([0]))
    assert alone.doubted.tolist() == [True]
    for _ in range(8):
        _, plan_state, _ = planner.plan(step_at(then.start), plan_state)
    assert radii == pytest.approx([1.0, 0.5, 0.25, 0.125, 0.1])
    assert plan_state.failures.tolist() == [0, 0]
    assert torch.equal(plan_state.route.path.nan_to_num(), before.path.nan_to_num())
    # What is behind the robot is driven already.
    passed = replace(then, start=then.start + torch.tensor([8.0, 0.0, 0.0]))
    fresh = replace(alone, doubted=torch.tensor([False]))
    assert planner.revise(fresh, passed.select(torch.tensor([0]))).doubted.tolist() == [
        False
    ]


def test_cl_rrt_leaves_a_partial_path_that_costs_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    planner, plan_state, _ = cl_rrt_on_its_path(monkeypatch)
    partial = torch.full_like(plan_state.route.status, int(PlanStatus.PARTIAL))
    plan_state = replace(plan_state, route=replace(plan_state.route, status=partial))
    revised = planner.revise(plan_state, problem(slow(0.4)))
    assert revised.edge.tolist() == [
        int(plan_state.route.depth[0]),
        int(plan_state.edge[1]),
    ]
    assert revised.doubted.tolist() == [False, False]


def test_cl_rrt_costs_what_is_left_of_a_path_by_the_time_that_its_metres_take() -> None:
    """At the wanted 1 m/s on quick ground, at 0.4 · 2 m/s on slow ground."""
    planner = CLRRT(CLRRTConfig(expansions=25, follower=FollowerConfig(speed_mps=1.0)))
    posed = problem(ground(), robot=Unicycle(speed_mps=(0.0, 2.0)))
    _, plan_state, _ = planner.plan(first(posed), planner.init(posed, generator()))
    line = torch.full((2, 60, 2), torch.nan)
    line[:, :21, 0], line[:, :21, 1] = torch.linspace(2, 12, 21), 6.1
    route = replace(plan_state.route, path=line)
    state = torch.tensor([[2.0, 6.0, 0.0], [7.0, 6.3, 0.0]])
    then = problem(slow(0.4), robot=Unicycle(speed_mps=(0.0, 2.0)))
    then = replace(then, free=then.free.clone())
    then.free[1, :, 20:22] = False
    cost = planner._cost_ahead(replace(plan_state, problem=then), route, state)
    wanted = torch.tensor([7 + 3 / 0.8, 5 + PENALTY])
    torch.testing.assert_close(cost, wanted, rtol=1e-4, atol=0.01)


class Counts(registry.find("planner", "straight").target):  # type: ignore[misc]
    """One that cannot revise, and counts how often it begins."""

    begun = 0

    def init(self, problem: Problem, generator: torch.Generator) -> Problem:
        type(self).begun += 1
        self.start = problem.start.clone()
        problem.start.zero_()
        return problem

    def revise(self, plan_state: Any, problem: Problem) -> Any:
        return NotImplemented


def test_a_planner_that_cannot_revise_begins_anew_where_the_robots_are() -> None:
    planner, posed = Counts(), problem(ground())
    plan_state = boundary.begin(planner, posed, generator())
    moved = replace(problem(wall()), start=posed.start + 1)
    again = boundary.revise(planner, plan_state, moved, generator())
    assert planner.begun == 2
    assert torch.equal(planner.start, posed.start + 1)
    assert torch.equal(moved.start, posed.start + 1), (
        "it wrote into what is not its own"
    )
    assert torch.equal(again.risk_map, wall())


def test_of_a_batch_the_map_that_has_changed_is_searched_anew_and_no_other() -> None:
    maps = 0.4 + 0.5 * torch.rand(3, 16, 16, generator=generator())
    before = factories.problem(maps)
    changed = maps.clone()
    changed[1, 4:9, 4:9] = 0.1
    after = factories.problem(changed)
    planner = make("astar_dwa")
    found = planner.revise(planner.init(before, generator()), after)
    wanted = planner.init(after, generator())
    assert torch.equal(found.field.cost, wanted.field.cost)
    assert torch.equal(found.field.following, wanted.field.following)
    assert not torch.equal(
        found.field.cost, planner.init(before, generator()).field.cost
    )
