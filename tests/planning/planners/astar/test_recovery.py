import torch
from torch import Tensor

from benchnav.planning.planners.astar.recovery import Recovery, watch
from benchnav.planning.robots import Unicycle

ROBOT = Unicycle()
STAND, DRIVE = torch.tensor([[0.0, 0.5]]), torch.tensor([[1.0, 0.0]])


def watched(
    moves_m: list[float], action: Tensor, robot: Unicycle = ROBOT
) -> list[bool]:
    """Whether a robot that moves so far along x in each step is being steered away."""
    state = torch.zeros(1, 3)
    recovery = Recovery.none(state)
    active = []
    for move in moves_m:
        recovery = watch(recovery, state, action, robot)
        active.append(bool(recovery.active))
        state = state + torch.tensor([[move, 0.0, 0.1]])
    return active


def test_a_robot_that_is_held_for_a_second_is_steered_away() -> None:
    assert watched([0.0] * 13, STAND) == [False] * 10 + [True] * 3
    assert watched([0.0] * 8, STAND, Unicycle(dt_s=0.2)) == [False] * 5 + [True] * 3
    # 4 mm a step are 4 cm a second; 6 mm are more than 5 cm.
    assert any(watched([0.004] * 20, STAND))
    assert not any(watched([0.006] * 40, STAND))


def test_a_robot_that_drives_and_is_held_by_the_ground_is_not() -> None:
    assert not any(watched([0.0] * 200, DRIVE))
    assert any(watched([0.0] * 20, 0.1 * DRIVE))
    assert not any(watched([0.0] * 20, 0.3 * DRIVE))
    assert any(watched([0.0] * 20, 0.3 * DRIVE, Unicycle(speed_mps=(0, 2))))


def test_it_is_steered_until_it_has_left_the_place() -> None:
    active = watched([0.0] * 10 + [0.1] * 8, STAND)
    # At the sixteenth look it is 0.5 m away.
    assert active == [False] * 10 + [True] * 5 + [False] * 3


def test_it_is_steered_for_twenty_seconds_at_most() -> None:
    active = watched([0.0] * 225, STAND)
    assert active == [False] * 10 + [True] * 200 + [False] * 10 + [True] * 5


def test_each_robot_of_a_batch_is_watched_by_itself() -> None:
    state = torch.tensor([[1.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    recovery = Recovery.none(state)
    for _ in range(12):
        recovery = watch(recovery, state, torch.cat((STAND, STAND)), ROBOT)
        state = state + torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.05, 0.0]])
    assert recovery.active.tolist() == [True, False]
