"""The path follower in closed loop with F, on ground of uniform traversability."""

import math

import pytest
import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.planning.planners.cl_rrt.pursuit import (
    SPACING_M,
    FollowerConfig,
    PathFollower,
    Reference,
    Tracking,
)
from benchnav.planning.robots import Bicycle, DifferentialDrive, Robot, Unicycle


def line(length_m: float) -> Reference:
    """Along x from the origin."""
    x = torch.arange(round(length_m / SPACING_M) + 1) * SPACING_M
    poses = torch.stack((x, torch.zeros_like(x), torch.zeros_like(x)), dim=-1)
    return Reference.along(poses[None], torch.tensor([length_m]))


def circle(radius_m: float, turns: float) -> Reference:
    """To the left about (0, radius), from the origin."""
    arc = torch.arange(round(turns * math.tau * radius_m / SPACING_M) + 1) * SPACING_M
    angle = arc / radius_m
    poses = torch.stack(
        (radius_m * angle.sin(), radius_m * (1 - angle.cos()), angle), dim=-1
    )
    return Reference.along(poses[None], arc[-1:])


def drive(
    reference: Reference,
    start: tuple[float, float, float],
    traversability: float,
    steps: int,
    config: FollowerConfig | None = None,
    robot: Robot | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """States [N + 1, S], actions [N, 2] and progress [N] of one robot."""
    robot = robot or Unicycle()
    follower = PathFollower(config or FollowerConfig(), robot)
    state = robot.initial_state(torch.tensor([start], dtype=torch.float32))
    tracking, ground = Tracking.standing(state), torch.tensor([traversability])
    progress = torch.zeros_like(state[:, 0])
    states, actions, progresses = [state], [], []
    for _ in range(steps):
        progress = follower.advance(reference, state, progress)
        action, tracking = follower.act(reference, state, tracking, progress)
        state = robot(state, action, ground)
        states.append(state)
        actions.append(action)
        progresses.append(progress)
    return torch.cat(states), torch.cat(actions), torch.cat(progresses)


@pytest.mark.parametrize("traversability", [1.0, 0.5])
def test_line_is_joined_and_kept(traversability: float) -> None:
    states, actions, progress = drive(
        line(12), (0, 0.5, 0.3), traversability, round(100 / traversability)
    )
    driven = states[:-1]
    assert driven[-1, 0] > 9
    assert driven[driven[:, 0] > 3, 1].abs().max() < 0.02
    assert actions[:, 0].min() >= 0
    assert actions[:, 0].max() <= 1
    assert actions[:, 1].abs().max() <= 1
    torch.testing.assert_close(progress[-1], driven[-1, 0], rtol=0, atol=0.01)


@pytest.mark.parametrize("traversability", [1.0, 0.5])
@pytest.mark.parametrize("radius_m", [1.0, 3.0])
def test_circle_is_kept(radius_m: float, traversability: float) -> None:
    states, _, progress = drive(
        circle(radius_m, 2), (0, 0, 0), traversability, round(100 / traversability)
    )
    radii = torch.hypot(states[:, 0], states[:, 1] - radius_m)
    assert (radii - radius_m).abs().max() < 0.05
    assert progress[-1] > 8
    # though the circle passes its beginning again
    assert (progress[1:] >= progress[:-1]).all()


def test_circle_tighter_than_the_bounds_at_full_speed_is_kept_by_slowing_down() -> None:
    states, actions, _ = drive(
        circle(0.5, 2), (0, 0, 0), 1.0, 100, FollowerConfig(lookahead_m=0.3)
    )
    radii = torch.hypot(states[:, 0], states[:, 1] - 0.5)
    assert (radii - 0.5).abs().max() < 0.05
    assert actions[:, 1].abs().max() <= 1
    assert actions[10:, 0].mean().item() == pytest.approx(0.5, abs=0.05)


def test_ground_changes_when_the_robot_is_somewhere_but_hardly_where() -> None:
    slow, _, _ = drive(circle(2, 1), (0, 0.4, 0), 0.4, 200)
    fast, _, _ = drive(circle(2, 1), (0, 0.4, 0), 1.0, 80)
    apart = torch.linalg.vector_norm(slow[:180, None, :2] - fast[:, :2], dim=-1).amin(
        dim=1
    )
    assert apart.max() < 0.1


@pytest.mark.parametrize(("gain", "speed"), [(0.5, 0.4), (0.0, 0.2)])
def test_integral_makes_up_for_the_ground(gain: float, speed: float) -> None:
    config = FollowerConfig(speed_mps=0.4, speed_kp=gain, speed_ki=gain)
    states, _, _ = drive(line(12), (0, 0, 0), 0.5, 200, config)
    moved = (states[1:, 0] - states[:-1, 0]) / 0.1
    assert moved[-20:].mean().item() == pytest.approx(speed, rel=0.02)


def test_derivative_damps_a_change_of_speed() -> None:
    error = torch.tensor([0.5])
    state = torch.tensor([[0.05, 0.0, 0.0]])
    tracking = Tracking(torch.zeros(1, 2), torch.zeros(1), error)
    speeds = []
    for gain in (0.0, 0.1):
        config = FollowerConfig(
            speed_mps=0.6, speed_kp=0.0, speed_ki=0.0, speed_kd=gain
        )
        action, _ = PathFollower(config, Unicycle()).act(
            line(5), state, tracking, torch.zeros(1)
        )
        speeds.append(action[0, 0].item())
    # Moved 0.05 m in 0.1 s: the error fell from 0.5 to 0.1 m/s, so the command falls by
    # 0.1·0.4/0.1.
    assert speeds[0] - speeds[1] == pytest.approx(0.4, abs=1e-5)


def test_reference_runs_straight_on_past_its_end() -> None:
    poses = torch.tensor(
        [[[0.0, 0.0, 0.0], [0.1, 0.0, math.pi / 6], [0.1, 0.0, math.pi / 6]]]
    )
    reference = Reference.along(poses, torch.tensor([0.1]))
    expected = torch.tensor(
        [0.1 + 0.1 * math.cos(math.pi / 6), 0.1 * math.sin(math.pi / 6)]
    )
    torch.testing.assert_close(reference.at(torch.tensor([0.2]))[0, :2], expected)


def test_robot_with_acceleration_limits_joins_and_keeps_a_line() -> None:
    states, actions, _ = drive(
        line(12), (0, 0.5, 0.3), 1.0, 120, robot=DifferentialDrive()
    )
    assert states[-1, 0] > 9
    assert states[states[:, 0] > 4, 1].abs().max() < 0.02
    assert (
        actions[0, 0] - states[1, 3]
    ).abs() > 0.5  # it cannot do what it is told at first


def test_a_fast_robot_looks_as_far_ahead_as_keeps_it_on_a_line() -> None:
    robot = Unicycle(speed_mps=(0.0, 6.0), turn_rate_radps=(-6.0, 6.0))
    states, actions, _ = drive(line(40), (0, 0.5, 0.1), 1.0, 60, robot=robot)
    assert actions[20:, 0].min().item() == pytest.approx(6.0)
    assert states[30:, 1].abs().max() < 0.01
    # Of what it would drive in a tenth of that time it weaves.
    weaving, _, _ = drive(
        line(40), (0, 0.5, 0.1), 1.0, 60, FollowerConfig(lookahead_s=0.06), robot
    )
    assert weaving[30:, 1].abs().max() > 0.05


@pytest.mark.parametrize(
    ("config", "robot", "wanted_mps", "lookahead_m"),
    [
        (FollowerConfig(), Unicycle(speed_mps=(-4.0, 3.0)), 3.0, 1.8),
        (
            FollowerConfig(speed_mps=2.0, lookahead_s=0.5),
            Unicycle(speed_mps=(0.0, 3.0)),
            2.0,
            1.0,
        ),
        (FollowerConfig(speed_mps=9.0), Unicycle(), 1.0, 0.6),
        (FollowerConfig(lookahead_m=0.7), Unicycle(speed_mps=(0.0, 0.3)), 0.3, 0.7),
    ],
)
def test_speed_and_look_ahead_are_those_of_the_robot_unless_set(
    config: FollowerConfig, robot: Robot, wanted_mps: float, lookahead_m: float
) -> None:
    follower = PathFollower(config, robot)
    assert follower.wanted_mps == wanted_mps
    assert follower.lookahead_m == pytest.approx(lookahead_m)


@pytest.mark.parametrize(
    "robot",
    [
        Bicycle(),
        Unicycle(turn_rate_radps=(0.1, 1.0)),
        Unicycle(turn_rate_radps=(-1.0, 0.0)),
        Unicycle(speed_mps=(-1.0, 0.0)),
    ],
)
def test_robots_that_cannot_follow_a_path_are_refused(robot: Robot) -> None:
    with pytest.raises(ConfigError, match="speed_mps, turn_rate_radps"):
        PathFollower(FollowerConfig(), robot)


@pytest.mark.parametrize(
    "field",
    ["lookahead_m", "lookahead_s", "speed_mps", "speed_kp", "speed_ki", "speed_kd"],
)
def test_settings_are_checked(field: str) -> None:
    with pytest.raises(ConfigError, match=field):
        FollowerConfig(**{field: -1.0})
