"""The guide and the recovery, with local planners that do as little as can be."""

from dataclasses import dataclass, field, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import ConfigError
from benchnav.planning.objective import GoalDistance, Objective, TravelTime
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.astar.guided import GuideConfig, Guided
from benchnav.planning.planners.astar.waypoint import choose_waypoint, ground_costs
from benchnav.planning.planners.planner import LocalPlanner, Plan
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Bicycle, Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.outcome import Outcome
from tests import factories
from tests.planning.planners.driving import (
    drive,
    fake_cuda,
    first,
    generator,
    on_cuda,
    step_at,
    with_start,
)


@dataclass
class Constant(LocalPlanner[tuple[Tensor, ...]]):
    """Commands the same whatever it is told; keeps what it was told."""

    action: tuple[float, float]
    targets: list[Tensor] = field(default_factory=list)
    name: str = "constant"

    def init(self, problem: Problem, generator: torch.Generator) -> tuple[Tensor, ...]:
        return ()

    def plan_toward(
        self, step: Step, plan_state: tuple[Tensor, ...], target_m: Tensor
    ) -> tuple[Tensor, tuple[Tensor, ...], Plan]:
        self.targets.append(target_m)
        action = step.state.new_tensor(self.action).expand(len(step.state), 2)
        return action, plan_state, Plan.empty(len(action), action.device)

    def commit_action(
        self, plan_state: tuple[Tensor, ...], action: Tensor
    ) -> tuple[Tensor, ...]:
        return (*plan_state, action)

    def select(
        self, plan_state: tuple[Tensor, ...], members: Tensor
    ) -> tuple[Tensor, ...]:
        raise AssertionError("nobody leaves")


def test_under_travel_time_a_way_point_within_the_goals_radius_still_draws_the_local_planner() -> (
    None
):
    seen: list[Problem] = []

    class Noting(Constant):
        def init(
            self, problem: Problem, generator: torch.Generator
        ) -> tuple[Tensor, ...]:
            seen.append(problem)
            return ()

    problem = factories.problem(
        torch.full((1, 16, 16), 0.8), objective=TravelTime(Unicycle(), 1.0)
    )
    Guided(GuideConfig(), Noting((0.0, 0.0))).init(problem, generator())
    near = torch.tensor([[2.0, 2.0, 0.0]])
    cost = seen[0].objective.stage(
        near, torch.zeros(1, 2), torch.ones(1), torch.tensor([[2.5, 2.0]])
    )
    assert cost.item() == pytest.approx(0.1)


class Standing(Constant):
    """Stands; some of its episodes may leave."""

    def __init__(self) -> None:
        super().__init__((0.0, 0.0))

    def select(
        self, plan_state: tuple[Tensor, ...], members: Tensor
    ) -> tuple[Tensor, ...]:
        return tuple(action[members] for action in plan_state)


# --- With the recovery.


def test_a_local_planner_that_does_nothing_arrives_by_recovery_alone() -> None:
    walled = torch.full((2, 16, 24), 0.85)
    walled[1, 7:9, :12] = 0.1
    problem = factories.problem(walled, start=(2.0, 2.0), goal=(4.0, 6.5))
    driven = drive(
        Guided(GuideConfig(), Constant((0.0, 0.0))), problem, time_budget_s=100
    )
    assert driven.outcome.tolist() == [Outcome.SUCCESS] * 2
    assert problem.free_at(driven.states).float().mean() > 0.98


def recovered(problem: Problem, steps: int) -> list[list[float]]:
    """The points to which a robot that is held is steered, one after another."""
    planner = Guided(GuideConfig(), Constant((0.0, 0.0)))
    plan_state, state, targets = planner.init(problem, generator()), problem.start, []
    for _ in range(steps):
        action, plan_state, _ = planner.plan(step_at(state), plan_state)
        state = problem.robot(state, action, problem.traversability_at(state))
        target = plan_state.recovery.target_m[0].tolist()
        if plan_state.recovery.active and (not targets or targets[-1] != target):
            targets.append(target)
    return targets


def test_a_recovery_leads_through_the_corner_that_two_cells_share() -> None:
    ground = torch.full((1, 16, 20), 0.8)
    ground[0, 4:9, 5] = 0.0
    problem = with_start(factories.problem(ground, goal=(8.25, 1.75)), 2.45, 2.4, 0.0)
    # From cell (4, 4) to (3, 5): a line to its centre would cut cell (4, 5).
    assert astar.path_cells(astar.search(problem), torch.tensor([84]), 2).tolist() == [
        [84, 65]
    ]
    assert recovered(problem, 45) == [[2.5, 2.0], [2.75, 1.75]]
    free = factories.problem(torch.full((1, 16, 20), 0.8), goal=(8.25, 1.75))
    (first,) = astar.path_cells(astar.search(free), torch.tensor([84]), 2)[
        :, 1
    ].tolist()
    assert recovered(with_start(free, 2.45, 2.4, 0.0), 12) == [
        [first % 20 / 2 + 0.25, first // 20 / 2 + 0.25]
    ]


def test_one_that_drives_is_left_alone_on_ground_that_holds_it() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.85))
    driven = drive(
        Guided(GuideConfig(), Constant((0.9, 0.1))), problem, 0 * problem.risk_map, 5.0
    )
    assert (driven.actions == torch.tensor([0.9, 0.1])).all()


def test_the_local_planner_is_told_what_was_taken_instead() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.85))
    planner = Guided(GuideConfig(), Constant((0.0, 0.2)))
    state = planner.init(problem, generator())
    actions = []
    for _ in range(12):
        action, state, _ = planner.plan(first(problem), state)
        actions.append(action)
    assert torch.equal(torch.stack(state.local), torch.stack(actions))
    assert actions[9].tolist() == [[0.0, pytest.approx(0.2)]]
    assert actions[10][0, 0] > 0.5


def test_the_recovery_of_an_episode_stays_its_own_when_others_leave_the_batch() -> None:
    """Of four robots two are being led away, to two places; those that stay are led as
    they were among all.
    """
    ground = torch.full((4, 16, 20), 0.8)
    problem = factories.problem(ground, goal=(8.25, 6.75))
    starts = torch.tensor(
        [[1.6, 1.2, 0.0], [6.1, 2.3, 1.0], [2.2, 6.4, -1.0], [4.1, 4.4, 0.5]]
    )
    problem = replace(problem, start=starts)
    planner = Guided(GuideConfig(), Standing())
    plan_state, state = planner.init(problem, generator()), problem.start
    for _ in range(14):
        action, plan_state, _ = planner.plan(step_at(state), plan_state)
        # The first and third are carried on by the ground, so that they are not held.
        state = problem.robot(
            state, action, torch.full((4,), 0.5)
        ) + 0.1 * torch.tensor(
            [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 0.0]]
        )
    assert plan_state.recovery.active.tolist() == [False, True, False, True]
    whole, _, _ = planner.plan(step_at(state), plan_state)
    for kept in ([3], [2, 3], [3, 1], [0, 1, 3], [1, 0, 2]):
        members = torch.tensor(kept)
        some = planner.select(plan_state, members)
        action, following, _ = planner.plan(step_at(state[members]), some)
        torch.testing.assert_close(action, whole[members], rtol=0, atol=1e-6)
        assert (
            following.recovery.active.tolist()
            == plan_state.recovery.active[members].tolist()
        )
        for name in ("anchor_m", "steps", "driven_m", "target_m", "cell"):
            expected = getattr(plan_state.recovery, name)[members]
            torch.testing.assert_close(
                getattr(some.recovery, name), expected, rtol=0, atol=0
            )


# --- The guide.


def test_a_local_planner_alone_selects_what_it_carries() -> None:
    @dataclass(frozen=True)
    class Carried(Batch):
        of_episodes: Tensor
        shared: Tensor  # the same for all, so that no index of an episode fits it

    class Carrying(Constant):
        def select(self, plan_state: Any, members: Tensor) -> Any:
            return replace(plan_state, of_episodes=plan_state.of_episodes[members])

    problem = factories.problem(torch.full((4, 8, 8), 0.85))
    planner = Guided(GuideConfig(), Carrying((0.0, 0.0)))
    begun = planner.init(problem, generator())
    carried = Carried(torch.arange(4.0), torch.zeros(2))
    left = planner.select(replace(begun, local=carried), torch.tensor([1, 3]))
    assert left.local.of_episodes.tolist() == [1, 3]
    assert left.local.shared is carried.shared
    assert len(left.problem) == 2


def test_it_gives_the_way_points_of_the_rule_under_its_settings() -> None:
    slow = torch.full((2, 12, 24), 1.0)
    slow[0, 3:9, 5:8] = 0.31
    slow[1, :9, 6] = 0.1
    given = []
    for config, objective in (
        (GuideConfig(), GoalDistance()),
        (GuideConfig(lookahead_m=2.0), GoalDistance()),
        (GuideConfig(), TravelTime(Unicycle(), 1.0)),
    ):
        problem = factories.problem(
            slow, (1.75, 3.25), (10.25, 3.25), objective=objective
        )
        local = Constant((0.5, 0.0))
        planner = Guided(config, local)
        planner.plan(first(problem), planner.init(problem, generator()))
        points = astar.path_points(problem, astar.search(problem), problem.start, 30)
        expected, _ = choose_waypoint(ground_costs(problem), points, config.lookahead_m)
        torch.testing.assert_close(local.targets[0], expected)
        given.append(expected[0])
    assert not any(torch.equal(given[0], other) for other in given[1:])


def test_the_whole_reference_is_drawn_only_when_asked_for() -> None:
    problem = factories.problem(
        torch.full((2, 16, 24), 0.9), start=(1.1, 6.6), goal=(10.3, 2.2)
    )
    planner = Guided(GuideConfig(lookahead_m=1.0), Constant((0.5, 0.0)))
    state = planner.init(problem, generator())
    action, _, plan = planner.plan(first(problem), state)
    assert plan.reference.numel() == 0
    again, _, plan = planner.plan(first(problem, draw=True), state)
    assert torch.equal(action, again)
    torch.testing.assert_close(plan.reference[:, 0], problem.start[:, :2])
    torch.testing.assert_close(plan.reference[:, -1], problem.goal_m)


def test_it_says_where_the_path_is_the_shortest_and_not_the_cheapest_by_the_objective() -> (
    None
):
    class Own(Objective):
        """A J that says nothing of paths."""

        stage, terminal = GoalDistance.stage, GoalDistance.terminal

    class OwnPath(Own):
        def path_cost(self, traversability: Tensor, grade: Tensor) -> Tensor:
            return 1 / traversability

    planner = Guided(GuideConfig(), Constant((0, 0)))
    for objective in (GoalDistance(), Own()):
        follows = planner.follows(factories.task(objective=objective))
        assert follows == "3D path length (A*), J (constant)"
    for objective in (TravelTime(Unicycle(), 1.0), OwnPath()):
        assert planner.follows(factories.task(objective=objective)) == ""


def test_a_look_ahead_that_looks_nowhere_is_refused() -> None:
    with pytest.raises(ConfigError, match="lookahead_m"):
        GuideConfig(lookahead_m=0)


@pytest.mark.parametrize("objective", [GoalDistance(), TravelTime(Bicycle(), 1.0)])
def test_no_tensor_is_made_on_another_device_but_by_the_search(
    monkeypatch: pytest.MonkeyPatch, objective: Objective
) -> None:
    real = factories.problem(
        torch.full((2, 16, 24), 0.9), robot=Bicycle(), objective=objective
    )
    searched, costs = astar.search(real), astar.edge_costs(real)
    with fake_cuda(real) as problem:
        costs = costs.to("cuda")
        monkeypatch.setattr(astar, "edge_costs", lambda _: costs)
        moved = astar.CostToGo(searched.cost.to("cuda"), searched.following.to("cuda"))
        monkeypatch.setattr(astar, "search", lambda *_: moved)
        planner = Guided(GuideConfig(), Constant((0.5, 0.0)))
        state = planner.init(problem, generator())
        action, following, plan = planner.plan(first(problem, draw=True), state)
        recovery = following.recovery
        assert on_cuda(action, plan.reference, planner.local.targets[0])
        assert on_cuda(
            recovery.anchor_m, recovery.steps, recovery.driven_m, recovery.active
        )
