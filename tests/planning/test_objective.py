from dataclasses import dataclass

import pytest
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.objective import (
    GoalDistance,
    Objective,
    TravelTime,
    distance,
    has_path_cost,
    toward_waypoints,
)
from benchnav.planning.robots import Bicycle, Unicycle

STATE = torch.tensor([[0.0, 0.0, 0.0], [3.0, 4.0, 1.0], [0.0, 0.5, 2.0]])
ACTION = torch.tensor([[1.0, 0.0]]).expand(3, 2)
GROUND = torch.tensor([0.31, 0.3, 0.0])
TARGET = torch.tensor([[3.0, 4.0]]).expand(3, 2)


def test_the_papers_objective_is_the_distance_and_knows_no_penalty() -> None:
    expected = [5.0, 0.0, (9 + 3.5**2) ** 0.5]
    assert GoalDistance().stage(
        STATE, ACTION, GROUND, TARGET
    ).tolist() == pytest.approx(expected)
    assert GoalDistance().terminal(STATE, GROUND, TARGET).tolist() == pytest.approx(
        expected
    )


def test_travel_time_counts_the_steps_before_arrival() -> None:
    robot = Unicycle(dt_s=0.2)
    cost = TravelTime(robot, 4.7).stage(STATE, ACTION, GROUND, TARGET)
    assert cost.tolist() == pytest.approx([0.2, 0.0, 0.0])


def test_what_is_left_costs_the_time_at_top_speed() -> None:
    left = TravelTime(Bicycle(speed_mps=(0.0, 2.0)), 1.0).terminal(
        STATE, GROUND, TARGET
    )
    assert left.tolist() == pytest.approx([2.0, 0.0, 0.5 * ((9 + 3.5**2) ** 0.5 - 1)])


def test_travel_time_along_a_straight_line_is_the_time_it_takes() -> None:
    """Whatever the horizon ends at, on ground of λ = 1 the sum is what is left of the
    way over the speed.
    """
    robot = Unicycle()
    objective = TravelTime(robot, 0.5)
    for steps in (0, 10, 35, 55):
        state, total = torch.tensor([[0.0, 0.0, 0.0]]), torch.zeros(1)
        for _ in range(steps):
            total = total + objective.stage(
                state, ACTION[:1], torch.ones(1), torch.tensor([[5.25, 0.0]])
            )
            state = robot(state, ACTION[:1], torch.ones(1))
        total = total + objective.terminal(
            state, torch.ones(1), torch.tensor([[5.25, 0.0]])
        )
        assert total.item() == pytest.approx((5.25 - 0.5) / 1.0, abs=0.1)


@pytest.mark.parametrize("goal_radius_m", [0.0, -1.0, float("nan")])
def test_a_distance_at_which_nothing_arrives_is_refused(goal_radius_m: float) -> None:
    with pytest.raises(ConfigError, match="goal_radius_m"):
        TravelTime(Unicycle(), goal_radius_m)


def test_the_registry_gives_an_objective_the_tasks_robot_and_goal_radius() -> None:
    robot = Unicycle(dt_s=0.25)
    made = registry.make("objective", "travel_time", robot=robot, goal_radius_m=2.0)
    assert made == TravelTime(robot, 2.0)
    with pytest.raises(ConfigError, match=r"travel_time.*goal_radius_m"):
        registry.make(
            "objective",
            {"part": "travel_time", "options": {"goal_radius_m": 1.0}},
            robot=robot,
        )


def test_a_way_point_nearer_than_the_goals_radius_is_still_to_be_reached() -> None:
    objective = TravelTime(Unicycle(), 1.0)
    near, target = torch.tensor([[0.7, 0.0, 0.0], [0.1, 0.0, 0.0]]), torch.zeros(2, 2)
    assert objective.stage(near, ACTION[:2], torch.ones(2), target).tolist() == [
        0.0,
        0.0,
    ]
    local = toward_waypoints(objective)
    assert local.stage(
        near, ACTION[:2], torch.ones(2), target
    ).tolist() == pytest.approx([0.1, 0.0])
    assert toward_waypoints(TravelTime(Unicycle(), 0.1)) == TravelTime(Unicycle(), 0.1)
    paper = GoalDistance()
    assert toward_waypoints(paper) is paper


def test_an_objective_of_ones_own_with_a_radius_is_remade_for_way_points() -> None:
    @dataclass(frozen=True)
    class Own(GoalDistance):
        weight: float
        goal_radius_m: float

    assert toward_waypoints(Own(2.0, 1.0)) == Own(2.0, 0.2)
    assert toward_waypoints(Own(2.0, 0.1)) == Own(2.0, 0.1)


def test_a_metre_of_path_costs_its_time_or_its_length() -> None:
    ground, grade = torch.tensor([1.0, 0.5, 0.05]), torch.tensor([0.0, 0.75, -0.75])
    robot = Unicycle(speed_mps=(0.0, 2.0))
    seconds, metres = [0.5, 1.0, 10.0], [1.0, 1.25, 1.25]
    assert TravelTime(robot, 1.0).path_cost(ground, grade).tolist() == pytest.approx(
        seconds
    )
    assert GoalDistance().path_cost(ground, grade).tolist() == pytest.approx(metres)
    assert has_path_cost(TravelTime(robot, 1.0))
    assert has_path_cost(GoalDistance())


def test_an_objective_that_says_nothing_of_paths_has_their_length() -> None:
    class Own(Objective):
        def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
            return traversability

        def terminal(self, state, traversability, target):  # type: ignore[no-untyped-def]
            return traversability

    grade = torch.tensor([0.0, 0.75, -0.75])
    assert not has_path_cost(Own())
    assert Own().path_cost(torch.rand(3), grade).tolist() == pytest.approx(
        [1.0, 1.25, 1.25]
    )


def test_what_lacks_a_member_cannot_be_made() -> None:
    class Half(Objective):
        def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
            return traversability

    with pytest.raises(TypeError, match="terminal"):
        Half()  # type: ignore[abstract]


def test_distances_broadcast_and_agree_with_the_norm() -> None:
    states, targets = torch.rand(4, 7, 5), torch.rand(4, 1, 2)
    expected = torch.linalg.vector_norm(states[..., :2] - targets, dim=-1)
    torch.testing.assert_close(distance(states, targets), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", registry.names("objective"))
def test_an_objective_keeps_shape_and_dtype_for_any_leading_dimensions(
    name: str, dtype: torch.dtype
) -> None:
    objective = registry.make("objective", name, robot=Unicycle(), goal_radius_m=1.0)
    for leading in ((3,), (3, 4), (3, 4, 2)):
        target = torch.rand(3, *[1] * (len(leading) - 1), 2, dtype=dtype)
        given = (
            torch.rand(*leading, 3, dtype=dtype),
            torch.rand(*leading, 2, dtype=dtype),
        )
        ground = torch.rand(leading, dtype=dtype)
        for cost in (
            objective.stage(*given, ground, target),
            objective.terminal(given[0], ground, target),
        ):
            assert (cost.shape, cost.dtype) == (leading, dtype)
            assert cost.isfinite().all()
