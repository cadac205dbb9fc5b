"""Robots against closed forms."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.robots import Bicycle, DifferentialDrive, Robot, Unicycle

SHIPPED = [registry.make("robot", name) for name in registry.names("robot")]
EACH = pytest.mark.parametrize("robot", SHIPPED, ids=lambda robot: type(robot).__name__)


def run(
    robot: Robot, action: list[float], steps: int, traversability: float = 1.0
) -> Tensor:
    """States of a robot that repeats an action, shape [steps + 1, S], in float64."""
    state = robot.initial_state(torch.tensor([[1.0, 2.0, 0.5]], dtype=torch.float64))
    states = [state[0]]
    for _ in range(steps):
        state = robot(
            state, state.new_tensor([action]), state.new_tensor([traversability])
        )
        states.append(state[0])
    return torch.stack(states)


def test_the_unicycle_is_the_papers_equation() -> None:
    state, action = torch.tensor([[1.0, 2.0, 0.5]]), torch.tensor([[0.8, -0.4]])
    moved = Unicycle()(state, action, torch.tensor([0.5]))
    expected = [
        1 + 0.1 * 0.5 * 0.8 * 0.87758256,
        2 + 0.1 * 0.5 * 0.8 * 0.47942554,
        0.5 - 0.1 * 0.5 * 0.4,
    ]
    assert moved[0].tolist() == pytest.approx(expected)


def test_the_unicycle_drives_the_circle_of_radius_speed_over_turn_rate() -> None:
    states = run(Unicycle(dt_s=0.001), [0.8, 0.4], 7854, traversability=0.5)
    # A quarter of a turn: λ slows both motions and leaves the circle as it is.
    assert states[-1, 2].item() == pytest.approx(0.5 + math.pi / 2, abs=1e-3)
    centre = torch.tensor(
        [1 - 2 * math.sin(0.5), 2 + 2 * math.cos(0.5)], dtype=torch.float64
    )
    radius = torch.linalg.vector_norm(states[:, :2] - centre, dim=1)
    torch.testing.assert_close(radius, torch.full_like(radius, 2.0), atol=1e-3, rtol=0)


def test_a_differential_drive_reaches_its_speed_in_speed_over_acceleration_seconds() -> (
    None
):
    robot = DifferentialDrive(
        dt_s=0.1, acceleration_mps2=0.4, turn_acceleration_radps2=0.8
    )
    states = run(robot, [1.0, -1.0], 40)
    speeds, rates = states[:, 3], states[:, 4]
    assert (speeds[24] < 1 - 1e-9, speeds[25].item()) == (True, pytest.approx(1.0))
    assert (rates[12] > -1 + 1e-9, rates[13].item()) == (True, pytest.approx(-1.0))
    # Half the way of a constant speed is lost on starting: v·t − v²/2a, to half a
    # step's.
    straight = run(robot, [1.0, 0.0], 100)
    driven = torch.linalg.vector_norm(straight[-1, :2] - straight[0, :2]).item()
    assert driven == pytest.approx(10 - 1 / (2 * 0.4), abs=0.06)


def test_a_differential_drive_never_changes_its_velocities_faster_than_it_can() -> None:
    robot = DifferentialDrive(acceleration_mps2=0.3, turn_acceleration_radps2=0.7)
    generator = torch.Generator().manual_seed(0)
    state = robot.initial_state(torch.zeros(50, 3))
    for _ in range(60):
        action = 4 * torch.rand(50, 2, generator=generator) - 2
        moved = robot(state, action, torch.rand(50, generator=generator))
        change = (moved[:, 3:] - state[:, 3:]).abs()
        assert change[:, 0].max() <= 0.03 + 1e-6
        assert change[:, 1].max() <= 0.07 + 1e-6
        # Never past what was commanded.
        assert ((moved[:, 3:] - action) * (state[:, 3:] - action) >= -1e-6).all()
        state = moved


def test_a_differential_drive_without_haste_is_the_unicycle() -> None:
    quick = DifferentialDrive(acceleration_mps2=1e9, turn_acceleration_radps2=1e9)
    for action in ([0.7, -0.3], [1.0, 1.0]):
        torch.testing.assert_close(
            run(quick, action, 30, 0.6)[:, :3], run(Unicycle(), action, 30, 0.6)
        )


def test_soft_ground_slows_a_differential_drive_but_not_its_wheels() -> None:
    firm, soft = (
        run(DifferentialDrive(), [1.0, 0.5], 30, value) for value in (1.0, 0.25)
    )
    assert torch.equal(firm[:, 3:], soft[:, 3:])
    turned, hindered = (states[-1, 2] - states[0, 2] for states in (firm, soft))
    assert hindered.item() == pytest.approx(0.25 * turned.item())


@pytest.mark.parametrize(("steering", "wheelbase"), [(0.3, 0.5), (-0.6, 0.9)])
def test_a_bicycle_drives_the_circle_of_radius_wheelbase_over_tangent(
    steering: float, wheelbase: float
) -> None:
    robot = Bicycle(dt_s=0.001, wheelbase_m=wheelbase)
    states = run(robot, [1.0, steering], 4000, traversability=0.5)
    radius = wheelbase / math.tan(steering)
    centre = torch.tensor(
        [1 - radius * math.sin(0.5), 2 + radius * math.cos(0.5)], dtype=torch.float64
    )
    away = torch.linalg.vector_norm(states[:, :2] - centre, dim=1)
    torch.testing.assert_close(
        away, torch.full_like(away, abs(radius)), atol=2e-3, rtol=0
    )
    assert (states[-1, 2] - states[0, 2]).item() == pytest.approx(
        2.0 / radius, rel=1e-6
    )


def test_a_bicycle_does_not_turn_while_it_stands() -> None:
    assert torch.equal(
        run(Bicycle(), [0.0, 0.6], 1)[1], run(Bicycle(), [0.0, 0.6], 1)[0]
    )


@EACH
def test_ground_of_no_traversability_immobilises_a_robot(robot: Any) -> None:
    states = run(robot, [1.0, 0.5], 20, traversability=0.0)
    assert torch.equal(states[-1, :3], states[0, :3])


@EACH
def test_a_robot_keeps_shape_and_dtype_for_any_leading_dimensions_and_changes_nothing(
    robot: Any,
) -> None:
    for dtype in (torch.float32, torch.float64):
        for leading in ((4,), (2, 3), (2, 3, 5)):
            pose = torch.rand(*leading, 3, dtype=dtype)
            state = robot.initial_state(pose.flatten(0, -2)).unflatten(0, leading)
            assert state.dtype == dtype
            assert torch.equal(state[..., :3], pose)
            action, ground = (
                torch.rand(*leading, 2, dtype=dtype),
                torch.rand(leading, dtype=dtype),
            )
            kept = [value.clone() for value in (state, action, ground)]
            moved = robot(state, action, ground)
            assert (moved.shape, moved.dtype) == (state.shape, dtype)
            assert all(
                torch.equal(*pair)
                for pair in zip(kept, (state, action, ground), strict=True)
            )
            # Each robot moves by itself.
            first = (0,) * len(leading)
            alone = robot(state[first][None], action[first][None], ground[first][None])[
                0
            ]
            torch.testing.assert_close(moved[first], alone)


@EACH
def test_an_action_for_all_samples_broadcasts(robot: Any) -> None:
    state = robot.initial_state(torch.rand(6, 3))[:, None].expand(-1, 4, -1)
    action = torch.rand(6, 4, 2)
    moved = robot(state, action, torch.rand(6, 4))
    assert moved.shape == state.shape


@EACH
def test_an_initial_state_is_a_copy_of_the_pose(robot: Any) -> None:
    pose = torch.rand(2, 3)
    robot.initial_state(pose).zero_()
    assert (pose != 0).all()


@EACH
def test_no_action_is_faster_than_the_top_speed(robot: Any) -> None:
    low, high = torch.tensor(robot.action_low), torch.tensor(robot.action_high)
    assert len(low) == len(high) == len(robot.action_names) == 2
    assert (low < high).all()
    state = robot.initial_state(torch.zeros(200, 3))
    action = low + (high - low) * torch.rand(200, 2)
    for _ in range(40):
        moved = robot(state, action, torch.ones(200))
        driven = torch.linalg.vector_norm(moved[:, :2] - state[:, :2], dim=1)
        assert driven.max() <= robot.dt_s * robot.top_speed_mps + 1e-5
        state = moved


def test_bounds_names_and_rates_say_what_was_set() -> None:
    unicycle = Unicycle(speed_mps=(-2.0, 1.5), turn_rate_radps=(-0.5, 0.7))
    assert (unicycle.action_low, unicycle.action_high) == ((-2.0, -0.5), (1.5, 0.7))
    assert unicycle.top_speed_mps == 2.0
    assert unicycle.action_names == ("speed_mps", "turn_rate_radps")
    bicycle = Bicycle(speed_mps=(-0.2, 1.5), steering_rad=0.4)
    assert (bicycle.action_low, bicycle.action_high) == ((-0.2, -0.4), (1.5, 0.4))
    assert bicycle.top_speed_mps == 1.5
    assert bicycle.action_names == ("speed_mps", "steering_rad")
    drive = DifferentialDrive(acceleration_mps2=0.3, turn_acceleration_radps2=0.6)
    assert drive.action_rates == (0.3, 0.6)
    assert unicycle.action_rates is None
    assert bicycle.action_rates is None


@pytest.mark.parametrize("dt_s", [0.05, 0.2])
@pytest.mark.parametrize("kind", [Unicycle, DifferentialDrive, Bicycle])
def test_the_time_step_scales_the_motion(kind: Any, dt_s: float) -> None:
    robot = kind(dt_s=dt_s)
    state = torch.zeros(1, len(run(robot, [0.0, 0.0], 0)[0]))
    state[:, 3:] = torch.tensor([0.8, 0.0])[: state.shape[1] - 3]
    moved = robot(state, torch.tensor([[0.8, 0.0]]), torch.ones(1))
    assert moved[0, 0].item() == pytest.approx(0.8 * dt_s)


@pytest.mark.parametrize(
    ("kind", "settings", "expected"),
    [
        (Unicycle, {"dt_s": 0.0}, "dt_s"),
        (Unicycle, {"speed_mps": (1.0, 1.0)}, "speed_mps"),
        (Unicycle, {"turn_rate_radps": (1.0, -1.0)}, "turn_rate_radps"),
        (DifferentialDrive, {"dt_s": -0.1}, "dt_s"),
        (DifferentialDrive, {"acceleration_mps2": 0.0}, "acceleration_mps2"),
        (
            DifferentialDrive,
            {"turn_acceleration_radps2": -1.0},
            "turn_acceleration_radps2",
        ),
        (Bicycle, {"dt_s": 0.0}, "dt_s"),
        (Bicycle, {"speed_mps": (1.0, 0.0)}, "speed_mps"),
        (Bicycle, {"steering_rad": 1.6}, "steering_rad"),
        (Bicycle, {"steering_rad": 0.0}, "steering_rad"),
        (Bicycle, {"wheelbase_m": 0.0}, "wheelbase_m"),
    ],
)
def test_a_robot_that_cannot_move_is_refused(
    kind: Any, settings: dict[str, Any], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        kind(**settings)
