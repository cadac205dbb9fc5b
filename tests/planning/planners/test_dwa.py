import torch

from benchnav.planning.dwa import DWAConfig, choose_velocity, velocity_window
from tests import factories

CONFIG = DWAConfig()


def test_the_window_is_what_the_accelerations_reach_within_the_bounds() -> None:
    problem = factories.problem(torch.full((2, 16, 16), 0.8))
    window = velocity_window(problem, torch.tensor([[0.5, 0.0], [0.98, -1.0]]), CONFIG)
    assert window.shape == (2, 100, 2)
    torch.testing.assert_close(window.amin(1), torch.tensor([[0.45, -0.05], [0.93, -1.0]]))
    torch.testing.assert_close(window.amax(1), torch.tensor([[0.55, 0.05], [1.0, -0.95]]))


def test_it_speeds_up_toward_a_far_waypoint_and_turns_to_one_aside() -> None:
    problem = factories.problem(torch.full((2, 16, 16), 0.8), start=(2.0, 2.0), goal=(6.0, 6.0))
    waypoint = torch.tensor([[6.0, 6.0], [2.0, 6.0]])
    velocity, _, _ = choose_velocity(problem, problem.start, torch.tensor([[0.5, 0.0]] * 2), waypoint, CONFIG)
    assert velocity[0, 0] > 0.54
    assert abs(velocity[0, 1]) < 0.01
    assert velocity[1, 1] > 0.04


def test_it_brakes_before_a_wall() -> None:
    walled = torch.full((1, 16, 16), 0.9)
    walled[:, :, 8:] = 0.1
    problem = factories.problem(walled, start=(3.4, 4.0), goal=(7.0, 4.0))
    velocity, _, _ = choose_velocity(
        problem, problem.start, torch.tensor([[0.3, 0.0]]), problem.goal_m, CONFIG
    )
    assert velocity[0, 0] < 0.26


def test_a_robot_that_spins_stops_spinning() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8), start=(4.0, 4.0), goal=(4.0, 7.0))
    state, velocity = problem.start.clone(), torch.tensor([[0.0, -1.0]])
    for _ in range(80):
        velocity, _, _ = choose_velocity(problem, state, velocity, problem.goal_m, CONFIG)
        state = problem.dynamics(state, velocity, problem.traversability_at(state))
    assert abs(velocity[0, 1]) < 0.6
    assert torch.linalg.vector_norm(state[0, :2] - problem.goal_m[0]) < 3.0


def test_it_turns_on_the_spot_toward_a_waypoint_behind_on_either_side() -> None:
    problem = factories.problem(torch.full((2, 16, 16), 0.8), start=(4.0, 4.0), goal=(4.0, 7.0))
    state = torch.tensor([[4.0, 4.0, -0.3], [4.0, 4.0, 3.4]])
    behind = torch.tensor([[1.0, 4.0], [7.0, 4.0]])
    velocity, _, _ = choose_velocity(problem, state, torch.zeros(2, 2), behind, CONFIG)
    # The shorter way round: from −0.3 to −π rightward, from 3.4 to 2π leftward.
    assert velocity[0, 1] < -0.04
    assert velocity[1, 1] > 0.04


def test_a_near_waypoint_does_not_slow_the_robot() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.9), start=(2.0, 4.0), goal=(7.0, 4.0))
    near = torch.tensor([[3.0, 4.0]])
    velocity, _, _ = choose_velocity(problem, problem.start, torch.tensor([[0.6, 0.0]]), near, CONFIG)
    assert velocity[0, 0] > 0.64
