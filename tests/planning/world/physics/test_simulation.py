"""Bodies on soil: closed forms of mechanics, calibration, patches and purity."""

import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import Immobile
from benchnav.planning.robots import Ackermann, DifferentialDrive, SkidSteer, Unicycle
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.physics.body import drive_of, mjcf_of
from benchnav.planning.world.physics.settings import Body, Entrapment, Physics
from benchnav.planning.world.physics.soil import measured_wheels
from tests.planning.world.physics.worlds import (
    CENTRE,
    ENTRAPMENT,
    FIRM,
    ROBOT,
    SIZE,
    drive,
    simulation,
    slope_law,
    uniform,
)

GRAVITY = 9.81
LAMBDAS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9)
HEADINGS = (0.0, 45.0, 90.0, 180.0)  # from uphill


def test_a_body_falls_as_a_stone() -> None:
    sim = simulation(uniform([1.0]))
    now = sim.init(torch.tensor([[CENTRE, CENTRE, 0.4]]))
    body = now.body.clone()
    body[0, 3] += 5.0  # after the time: x, y, z
    begin_m = body[0, 3].item()
    step_s = FIRM.substep_s
    for step in range(1, 6):
        after, _ = sim.step(replace(now, body=body), torch.zeros(1, 2))
        body = after.body  # type: ignore[attr-defined]
        n = step * round(ROBOT.dt_s / step_s)
        # The integrator is semi-implicit: v first, then z.
        fallen_m = GRAVITY * step_s**2 * n * (n + 1) / 2
        assert begin_m - body[0, 3].item() == pytest.approx(fallen_m, abs=1e-9)


@pytest.mark.parametrize("heading", [0.0, 60.0, 180.0])
def test_friction_holds_a_robot_that_stands(heading: float) -> None:
    # Friction 0.8 holds up to 38.7°.
    slope_deg = 37.0
    driven = drive(
        simulation(uniform([0.5]), slope_deg=slope_deg), [heading], (0.0, 0.0)
    )
    moved = (driven.track[-1] - driven.track[0]).abs()
    assert float(moved.max()) < 1e-3


def test_above_the_friction_angle_a_robot_slides_as_a_block() -> None:
    slope = math.radians(42.0)
    sim = simulation(uniform([0.5]), slope_deg=42.0)
    driven = drive(sim, [90.0], (0.0, 0.0), steps=15)
    fallen_m = -(driven.track[:, 0, 0] - CENTRE) / math.cos(slope)
    time_s = torch.arange(16) * ROBOT.dt_s
    acceleration = GRAVITY * (math.sin(slope) - 0.8 * math.cos(slope))
    expected_m = acceleration * time_s.square() / 2
    torch.testing.assert_close(fallen_m, expected_m, atol=0.01, rtol=0.05)


@pytest.mark.parametrize("slope_deg", [0.0, 8.0, 15.0])
@pytest.mark.parametrize("robot", [ROBOT, Ackermann()])
def test_lambda_is_that_of_the_law_in_each_direction(
    robot: Any, slope_deg: float
) -> None:
    traversability = [value for value in LAMBDAS for _ in HEADINGS]
    headings = list(HEADINGS) * len(LAMBDAS)
    sim = simulation(uniform(traversability), robot=robot, slope_deg=slope_deg)
    driven = drive(sim, headings, (1.0, 0.0))
    cosine = torch.tensor(headings).deg2rad().cos().clamp(min=0)
    law = slope_law(slope_deg * cosine)[0] - slope_law(torch.tensor([slope_deg]))[0]
    expected = (torch.tensor(traversability) + law).clamp(0, 1)
    torch.testing.assert_close(driven.along_mps, expected, atol=2e-3, rtol=0)
    torch.testing.assert_close(driven.observed, expected, atol=2e-3, rtol=0)
    assert float(driven.across_mps.abs().max()) < 2e-3
    assert float(driven.turn_radps.abs().max()) < 2e-3


@pytest.mark.parametrize("robot_type", [SkidSteer, Ackermann])
def test_a_robot_in_reverse_has_the_lambda_of_its_motion(robot_type: Any) -> None:
    robot = robot_type(speed_mps=(-1.0, 1.0))
    sim = simulation(uniform([0.3, 0.3]), robot=robot, slope_deg=12.0)
    driven = drive(sim, [0.0, 180.0], (-1.0, 0.0))  # downhill and uphill
    gain = float(slope_law(torch.zeros(1)) - slope_law(torch.tensor([12.0])))
    expected = torch.tensor([-0.3 - gain, -0.3])
    torch.testing.assert_close(driven.along_mps, expected, atol=2e-3, rtol=0)
    torch.testing.assert_close(driven.observed, -expected, atol=2e-3, rtol=0)


def test_the_control_has_the_same_lambda_in_all_directions() -> None:
    physics = Physics(soil="isotropic", entrapment=None)
    sim = simulation(uniform([0.3] * 4), physics, slope_deg=15.0)
    driven = drive(sim, HEADINGS, (1.0, 0.0))
    torch.testing.assert_close(
        driven.along_mps, torch.full((4,), 0.3), atol=2e-3, rtol=0
    )


def test_soil_that_shears_is_calibrated_uphill_alone() -> None:
    physics = Physics(soil="janosi", entrapment=None)
    sim = simulation(uniform([0.3] * 4), physics, slope_deg=10.0)
    driven = drive(sim, HEADINGS, (1.0, 0.0), steps=60, skipped=40)
    uphill, _, across, downhill = driven.along_mps.tolist()
    assert uphill == pytest.approx(0.3, abs=0.02)
    assert uphill + 0.2 < across < 1 < downhill  # gravity drives it
    assert driven.observed.tolist()[3] == 1


@pytest.mark.parametrize("slope_deg", [0.0, 2.0, 5.0, 8.0])
def test_a_body_climbs_as_the_measured_wheel_does(slope_deg: float) -> None:
    # λ = 1 − s at which the drawbar pull per load, m (1 − exp(−s/k)) − r, is tan ψ. The
    # cells have λ of level soil and claim to be level, so that only gravity acts.
    numbers = measured_wheels()["grouser"]
    m, k, r = (numbers[name] for name in ("traction", "shear_slip", "resistance"))
    level, expected = (
        1 + k * math.log(1 - (r + math.tan(math.radians(angle))) / m)
        for angle in (0.0, slope_deg)
    )
    physics = Physics(soil="janosi", entrapment=None)
    sim = simulation(uniform([level]), physics, slope_deg=slope_deg)
    sim._slope_deg.zero_()
    driven = drive(sim, [0.0], (1.0, 0.0), steps=60, skipped=40)
    assert float(driven.along_mps) == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize("traversability", LAMBDAS)
@pytest.mark.parametrize("action", [(0.0, 1.0), (0.6, 0.5), (0.8, -0.3)])
def test_turns_have_the_lambda_of_the_terrain(
    traversability: float, action: tuple[float, float]
) -> None:
    driven = drive(simulation(uniform([traversability])), [30.0], action)
    speed, turn_rate = action
    assert float(driven.along_mps) == pytest.approx(traversability * speed, abs=0.01)
    # The loop holds at least a tenth of the commanded ω while the robot drives.
    least = max(traversability, 0.1) if speed else traversability
    tolerance = 0.01 if traversability >= 0.1 else 0.04
    assert float(driven.turn_radps) == pytest.approx(least * turn_rate, abs=tolerance)


def test_a_steered_robot_follows_its_curve() -> None:
    robot = Ackermann()
    sim = simulation(uniform([0.2, 0.9]), robot=robot)
    driven = drive(sim, [0.0, 0.0], (0.8, 0.4))
    curvature = math.tan(0.4) / robot.wheelbase_m
    expected = curvature * driven.along_mps
    torch.testing.assert_close(driven.turn_radps, expected, atol=0.01, rtol=0.01)


@pytest.mark.parametrize("lag_s", [0.0, 0.1, 0.5])
def test_wheels_follow_with_a_first_order_lag(lag_s: float) -> None:
    physics = Physics(entrapment=None, body=Body(lag_s=lag_s))
    sim = simulation(uniform([0.7]), physics)
    now: Any = sim.init(torch.tensor([[CENTRE, CENTRE, 0.0]]))
    before = 0.0
    for step in range(1, 5):
        now, _ = sim.step(now, torch.tensor([[0.8, 0.4]]))
        time_s = torch.arange(1, 26) * physics.substep_s + (step - 1) * ROBOT.dt_s
        speeds = 0.8 * (1 - (-time_s / lag_s).exp()) if lag_s else 0.8 + 0 * time_s
        speed, turn = now.memory[0, :2].tolist()
        assert speed == pytest.approx(speeds[-1].item(), abs=1e-4)
        assert turn == pytest.approx(speed / 2, abs=1e-4)
        assert now.memory[0, 4].item() == pytest.approx(speeds.mean().item(), abs=1e-4)
        assert speed > before or lag_s == 0
        before = speed


@pytest.mark.parametrize("robot_type", [SkidSteer, Ackermann])
@pytest.mark.parametrize("speed", [0.6, -0.6])
def test_the_loop_keeps_a_robot_straight_where_one_side_is_soft(
    robot_type: Any, speed: float
) -> None:
    field = uniform([0.8])
    field[:, SIZE // 2 :] = 0.2  # to the left of a robot that drives along x
    robot = robot_type(speed_mps=(-1.0, 1.0))
    turned = {}
    for has_loop in (True, False):
        physics = Physics(entrapment=None, body=Body(yaw_rate_loop=has_loop))
        sim = simulation(field, physics, robot)
        driven = drive(sim, [0.0], (speed, 0.0), steps=20)
        turned[has_loop] = float(driven.track[-1, 0, 2]) * speed
    # Without the loop, it turns towards the soft side, as with `tracks`.
    assert 0 < abs(turned[True]) < turned[False] / 1.5


def test_soft_cells_keep_lambda_downhill() -> None:
    field = uniform([0.05])
    firm = simulation(field, slope_deg=12.0)
    truth = firm._realisation.truth
    two = replace(
        truth,
        weights=torch.cat((0.9 * truth.weights, 0.1 * truth.weights), dim=1),
        means=torch.cat((truth.means + 0.6, truth.means), dim=1),
        stds=torch.cat((truth.stds, truth.stds), dim=1),
        group=(0, 0),
    )
    soft = simulation(field, slope_deg=12.0, truth=two)
    speeds = [float(drive(sim, [180.0], (1.0, 0.0)).along_mps) for sim in (firm, soft)]
    gain = float(slope_law(torch.zeros(1)) - slope_law(torch.tensor([12.0])))
    assert speeds == pytest.approx([0.05 + gain, 0.05], abs=0.01)


def test_without_a_slope_law_all_directions_are_alike() -> None:
    sim = simulation(uniform([0.3] * 4), slope_deg=12.0, slope_law=None)
    driven = drive(sim, HEADINGS, (1.0, 0.0))
    torch.testing.assert_close(
        driven.along_mps, torch.full((4,), 0.3), atol=2e-3, rtol=0
    )


def crossings(physics: Physics, soft: float) -> dict[tuple[int, bool], bool]:
    """Whether a robot crosses n × n soft cells, centred or half a track off."""
    cases = [(n, is_centred) for n in (1, 2, 3) for is_centred in (True, False)]
    field = uniform([0.8] * len(cases))
    poses = []
    for index, (n, is_centred) in enumerate(cases):
        row = SIZE // 2 - (n // 2 if is_centred else 0)
        field[index, row : row + n, 36 : 36 + n] = soft
        y = (row + n / 2) * 0.5 if is_centred else CENTRE
        poses.append((17.0, y, 0.0))
    sim = simulation(field, physics)
    now: Any = sim.init(torch.tensor(poses))
    has_crossed = torch.zeros(len(cases), dtype=torch.bool)
    for _ in range(100):
        now, _ = sim.step(now, torch.tensor([[1.0, 0.0]]).expand(len(cases), 2))
        beyond = torch.tensor([18.5 + 0.5 * n for n, _ in cases])
        has_crossed |= now.state[:, 0] > beyond
    return dict(zip(cases, has_crossed.tolist(), strict=True))


def test_ruts_hold_a_robot_on_two_by_two_soft_cells() -> None:
    # All four wheels sink in the middle of a patch; of two, the others drag them out.
    held = crossings(ENTRAPMENT, soft=0.03)
    assert held == {
        (1, True): True,
        (1, False): True,
        (2, True): False,
        (2, False): True,
        (3, True): False,
        (3, False): True,
    }
    firm = crossings(ENTRAPMENT, soft=0.2)
    assert all(firm.values())


def test_ruts_of_half_and_twice_the_depth() -> None:
    for factor in (0.5, 2.0):
        physics = Physics(entrapment=Entrapment(sinkage=0.035 * factor))
        held = crossings(physics, soft=0.03)
        assert held[1, True]
        assert not held[2, True]


def test_a_robot_that_stands_reverses_and_tries_again() -> None:
    # Without ruts: λ 0.06 counts as standing. It stands 1 s and drives back 1.5 s.
    body = Body(reverse_after_s=1.0, reverse_for_s=1.5, lag_s=0.0)
    sim = simulation(uniform([0.06]), Physics(entrapment=None, body=body))
    x_m = drive(sim, [0.0], (1.0, 0.0), steps=60).track[:, 0, 0] - CENTRE
    turns = [10, 25, 35, 50, 60]
    expected_m = torch.tensor([0.06, -0.03, 0.03, -0.06, 0.0])
    torch.testing.assert_close(x_m[turns], expected_m, atol=0.015, rtol=0)
    never = simulation(uniform([0.06]), FIRM)
    assert float(drive(never, [0.0], (1.0, 0.0), steps=60).track[-1, 0, 0]) > CENTRE


def pose_of(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    pose = 8 + 16 * torch.rand(count, 3, generator=generator)
    pose[:, 2] -= 16
    return pose


def rough(count: int) -> dict[str, Any]:
    """Rough terrain with random λ."""
    generator = torch.Generator().manual_seed(0)
    field = torch.rand(count, SIZE, SIZE, generator=generator)
    height = 0.4 * torch.rand(count, SIZE, SIZE, generator=generator)
    slope_deg = 20 * torch.rand(count, SIZE, SIZE, generator=generator)
    return {"field": field, "elevation_m": height, "slope_deg": slope_deg}


def test_a_batch_is_its_episodes_bit_for_bit_in_any_order() -> None:
    maps = rough(5)
    pose = pose_of(5)
    generator = torch.Generator().manual_seed(2)
    actions = torch.rand(25, 5, 2, generator=generator)
    sim = simulation(**maps, physics=ENTRAPMENT)
    states = []
    now: Any = sim.init(pose)
    for action in actions:
        states.append(now)
        now, observed = sim.step(now, action)
    for order in ([2], [4, 0, 3]):
        index = torch.tensor(order)
        part_maps = {name: values[index] for name, values in maps.items()}
        part = simulation(**part_maps, physics=ENTRAPMENT)
        then: Any = part.init(pose[index])
        for action in actions:
            then, seen = part.step(then, action[index])
        for name in ("state", "body", "memory", "contacts_m", "outcome"):
            assert torch.equal(getattr(then, name), getattr(now, name)[index]), name
        assert torch.equal(seen, observed[index])
    # A stored state gives the same step, whatever the workspace has computed since.
    again, _ = sim.step(states[10], actions[10])
    assert torch.equal(again.body, states[11].body)  # type: ignore[attr-defined]
    assert torch.equal(again.state, states[11].state)


def test_a_step_changes_no_argument_and_ended_episodes_stand_still() -> None:
    sim = simulation(uniform([0.5, 0.5]))
    now = sim.init(pose_of(2))
    now = replace(now, outcome=torch.tensor([Outcome.RUNNING, Outcome.TIMEOUT]))
    before = pickle.loads(pickle.dumps(now))
    after: Any
    after, _ = sim.step(now, torch.ones(2, 2))
    for name in ("state", "body", "memory", "contacts_m"):
        assert torch.equal(getattr(before, name), getattr(now, name))
        assert torch.equal(getattr(after, name)[1], getattr(now, name)[1])
        assert not torch.equal(getattr(after, name)[0], getattr(now, name)[0])


def test_exchanged_and_pickled_simulations_are_the_same() -> None:
    maps = rough(3)
    pose = pose_of(3)
    one = simulation(**{name: values[[0, 1]] for name, values in maps.items()})
    other = simulation(**{name: values[[2]] for name, values in maps.items()})
    one.exchange_(torch.tensor([1]), other)
    expected = simulation(**{name: values[[0, 2]] for name, values in maps.items()})
    ends = []
    for sim in (one, expected, pickle.loads(pickle.dumps(expected))):
        now: Any = sim.init(pose[[0, 2]])
        for _ in range(5):
            now, _ = sim.step(now, torch.tensor([[1.0, 0.5]]).expand(2, 2))
        ends.append(now.body)
    assert torch.equal(ends[0], ends[1])
    assert torch.equal(ends[0], ends[2])


def test_resampled_lambda_differs_by_seed_only() -> None:
    sim = simulation(uniform([0.5, 0.5]), world={"noise": "resampled"})
    driven = drive(sim, [0.0, 0.0], (1.0, 0.0), steps=20)
    again = drive(sim, [0.0, 0.0], (1.0, 0.0), steps=20)
    assert torch.equal(driven.track, again.track)
    assert not torch.equal(driven.track[:, 0], driven.track[:, 1])


def test_a_start_stays_where_it_is() -> None:
    maps = rough(4)
    sim = simulation(**maps)
    pose = pose_of(4)
    now = sim.init(pose)
    assert torch.equal(now.state, pose)
    after, _ = sim.step(now, torch.zeros(4, 2))
    torch.testing.assert_close(after.state, pose, atol=0.03, rtol=0)


def test_planes_under_wheels_agree_with_a_height_field() -> None:
    # MuJoCo's own collision with the height map, whose cells are two triangles each.
    mujoco = pytest.importorskip("mujoco")
    generator = torch.Generator().manual_seed(3)
    noise = torch.rand(1, 1, 10, 10, generator=generator)
    smooth = torch.nn.functional.interpolate(noise, size=(SIZE, SIZE), mode="bicubic")
    height = 2.0 * smooth[0]
    sim = simulation(uniform([1.0]), elevation_m=height)
    text = mjcf_of(FIRM.body, drive_of(ROBOT))
    spec = mujoco.MjSpec.from_string(text)
    low, high = float(height.min()), float(height.max())
    half = (SIZE - 1) * 0.25
    spec.add_hfield(
        name="map",
        size=[half, half, high - low, 1.0],
        nrow=SIZE,
        ncol=SIZE,
        userdata=((height[0] - low) / (high - low)).flatten().tolist(),
    )
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD,
        hfieldname="map",
        pos=[0.25 + half, 0.25 + half, low],
        friction=[2, 0, 0],
    )
    for geom in spec.geoms:
        geom.priority = 1 if geom.type == mujoco.mjtGeom.mjGEOM_HFIELD else 0
    model = spec.compile()
    data = mujoco.MjData(model)
    differences_m = []
    for pose in pose_of(9):
        now = sim.init(pose[None])
        settled = now.body[0, 1:8].numpy()
        data.qpos[:] = settled
        data.qpos[2] += 0.01
        data.qvel[:] = 0
        for _ in range(500):
            mujoco.mj_step(model, data)
        up = np.zeros(9), np.zeros(9)
        mujoco.mju_quat2Mat(up[0], np.array(settled[3:7]))
        mujoco.mju_quat2Mat(up[1], np.array(data.qpos[3:7]))
        differences_m.append(abs(data.qpos[2] - settled[2]))
        assert up[0][8] == pytest.approx(up[1][8], abs=0.02)
    assert np.median(differences_m) < 0.004


def test_a_robot_that_drives_off_a_ledge_rolls_over() -> None:
    height = torch.zeros(1, SIZE, SIZE)
    height[:, : SIZE // 2] = -3.0
    sim = simulation(uniform([0.9]), elevation_m=height)
    driven = drive(sim, [0.0], (0.5, 0.0), start=(CENTRE, CENTRE + 0.1), steps=30)
    assert driven.last.outcome.tolist() == [Outcome.ROLLOVER]


def test_who_tips_over_at_the_goal_has_reached_it() -> None:
    sim = simulation(uniform([0.9, 0.9]))
    now = sim.init(pose_of(2))
    body = now.body.clone()
    body[:, 3] += 0.5  # height
    body[:, 4:8] = torch.tensor([0.0, 1.0, 0.0, 0.0]).double()  # upside down
    sim._goal_m = torch.stack((now.state[0, :2], now.state[1, :2] + 9))
    after, _ = sim.step(replace(now, body=body), torch.zeros(2, 2))
    assert after.outcome.tolist() == [Outcome.SUCCESS, Outcome.ROLLOVER]


def test_physics_that_diverges_ends_the_episode_and_says_so() -> None:
    sim = simulation(uniform([0.9, 0.9]))
    now = sim.init(pose_of(2))
    body = now.body.clone()
    body[0, 8] = 1e4  # the first velocity
    after: Any
    after, observed = sim.step(replace(now, body=body), torch.ones(2, 2))
    assert after.outcome.tolist() == [Outcome.MODEL_ERROR, Outcome.RUNNING]
    assert bool(after.state.isfinite().all() & observed.isfinite().all())
    first, second = sim.faults(after)
    assert "map 0, got one that diverged in step 1 with noise key" in first
    assert second == ""
    later, _ = sim.step(after, torch.ones(2, 2))
    assert sim.faults(later) == [first, ""]


def test_held_robots_are_immobilised_by_what_they_observe() -> None:
    world = {"immobile": Immobile(by="observed")}
    sim = simulation(uniform([0.03]), ENTRAPMENT, world=world)
    driven = drive(sim, [0.0], (1.0, 0.0), steps=30)
    assert driven.last.outcome.tolist() == [Outcome.IMMOBILISED]
    assert float(driven.last.ruts_m.min()) > 0.05


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (Unicycle(), "a robot with a footprint, such as skid_steer"),
        (DifferentialDrive(), "got DifferentialDrive, which is a point"),
        (SkidSteer(track_m=2.5), "a footprint within the goal's disc of 1 m"),
        (SkidSteer(track_m=0.2), "cells of at most twice the track, 0.4 m"),
        (SkidSteer(dt_s=0.05, track_m=0.6), "as a fraction of the robot's time step"),
    ],
)
def test_robots_that_do_not_fit_are_rejected(robot: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        simulation(uniform([0.5]), robot=robot)


def test_maps_that_do_not_fit_are_rejected() -> None:
    height = torch.zeros(2, SIZE, SIZE)
    height[1, 3, 4] = torch.nan
    with pytest.raises(ConfigError, match=r"a height in each cell .* on 1 of 2 maps"):
        simulation(uniform([0.5, 0.5]), elevation_m=height)
    wide = Physics(body=Body(wheel_width_m=0.6))
    with pytest.raises(ConfigError, match=r"as wide as a wheel, 0\.6 m"):
        simulation(uniform([0.5]), wide)
