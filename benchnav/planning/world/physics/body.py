"""Bodies: the shipped one in MJCF, and the model in MuJoCo of any body.

Each wheel is a sphere that touches only a plane of its own, which the compiled code
lays under it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError, expect
from benchnav.planning.robots import SPEED, STEERING, TURN_RATE, Robot
from benchnav.planning.world.physics.settings import Body, Physics

MAX_WHEELS = 16
PLANE = "_plane_"  # prefix of the name of a wheel's plane

_WHEEL_MASS_FRACTION = 1.5 / 46  # of one of four wheels (choice)


@dataclass(frozen=True)
class Drive:
    """Dimensions and bounds of a robot that the model needs.

    Args:
        is_steered: whether the second action is a steering angle.
        top_speed_mps: largest |v| in m/s.
        track_m: distance between left and right wheels.
        front_m: distance of the front wheels ahead of the robot's position.
        rear_m: distance of the rear wheels ahead of it, ≤ 0 if they are behind.
        max_steering_rad: largest steering angle; 0 for none.
    """

    is_steered: bool
    top_speed_mps: float
    track_m: float
    front_m: float
    rear_m: float
    max_steering_rad: float

    @property
    def wheelbase_m(self) -> float:
        """Distance between front and rear wheels."""
        return self.front_m - self.rear_m


def drive_of(robot: Robot) -> Drive:
    """Return the dimensions and bounds of a robot with a footprint.

    Raises:
        ConfigError: If the robot's actions are not (v, ω) or (v, δ), or a steered robot
            does not have its position on the rear axle.
    """
    names = robot.action_names
    expect(
        names in ((SPEED, TURN_RATE), (SPEED, STEERING)),
        f"a robot with the actions ({SPEED}, {TURN_RATE}) or ({SPEED}, {STEERING}) for "
        f"`world.backend` 'physics', got ({', '.join(names)}).",
    )
    footprint = robot.footprint
    assert footprint is not None
    is_steered = names[1] == STEERING
    rear_m = footprint.ahead_m - footprint.wheelbase_m / 2
    expect(
        not is_steered or abs(rear_m) < 1e-6,
        "a steered robot whose position is the middle of its rear axle for "
        f"`world.backend` 'physics', got rear contacts {rear_m:g} m ahead of it.",
    )
    return Drive(
        is_steered=is_steered,
        top_speed_mps=robot.top_speed_mps,
        track_m=footprint.track_m,
        front_m=footprint.ahead_m + footprint.wheelbase_m / 2,
        rear_m=rear_m,
        max_steering_rad=robot.action_high[1] if is_steered else 0.0,
    )


def mjcf_of(body: Body, drive: Drive) -> str:
    """Return the MJCF of the shipped body: a box on four wheels."""
    radius_m = body.wheel_radius_m
    half_track_m = drive.track_m / 2
    middle_m = (drive.front_m + drive.rear_m) / 2
    wheel_kg = _WHEEL_MASS_FRACTION * body.mass_kg
    wheels = []
    for row, x_m in (("front", drive.front_m), ("rear", drive.rear_m)):
        for side, y_m in (("left", half_track_m), ("right", -half_track_m)):
            wheels.append(
                f'<geom name="wheel_{row}_{side}" type="sphere" size="{radius_m}" '
                f'pos="{x_m} {y_m} 0" mass="{wheel_kg}"/>'
            )
    size_m = drive.wheelbase_m / 2 + 0.05, max(half_track_m - 0.025, 0.05), 0.08
    size = " ".join(map(str, size_m))
    box = f'<geom type="box" size="{size}" pos="{middle_m} 0 0.08" '
    box += f'mass="{body.mass_kg - 4 * wheel_kg}"/>'
    return (
        '<mujoco model="rover"><worldbody><body name="chassis"><freejoint/>'
        f"{box}{''.join(wheels)}</body></worldbody></mujoco>"
    )


def build_model(mujoco: Any, physics: Physics, drive: Drive) -> tuple[Any, list[str]]:
    """Return the model with a plane per wheel, and the names of the wheels.

    Raises:
        ConfigError: If the body does not compile, or lacks wheels or a free joint.
    """
    body = physics.body
    try:
        spec = _spec(mujoco, body, drive)
        wheels = _add_planes(mujoco, spec)
        option = spec.option
        option.timestep = physics.substep_s
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = 10.0  # friction of ruts holds instead of creeping
        disabled = mujoco.mjtDisableBit
        option.disableflags |= int(disabled.mjDSBL_AUTORESET)
        option.disableflags |= int(disabled.mjDSBL_ISLAND)
        model = spec.compile()
    except (ValueError, OSError, mujoco.FatalError) as error:
        name = Path(body.mjcf).name if body.mjcf else "the shipped body"
        raise ConfigError(
            f"Expected a body that MuJoCo compiles, got {name}: "
            f"{' '.join(str(error).split())}"
        ) from error
    is_free = model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    expect(
        is_free and model.jnt_qposadr[0] == 0,
        f"`mjcf` of a body with a free joint on its first body, got {body.mjcf}. Add "
        "<freejoint/>.",
    )
    return model, wheels


def _spec(mujoco: Any, body: Body, drive: Drive) -> Any:
    if body.mjcf:
        return mujoco.MjSpec.from_file(body.mjcf)
    return mujoco.MjSpec.from_string(mjcf_of(body, drive))


def _add_planes(mujoco: Any, spec: Any) -> list[str]:
    """Add a plane per wheel, and let wheels touch only their planes."""
    names = []
    for geom in spec.geoms:
        geom.contype = 0
        geom.conaffinity = 0
        is_sphere = geom.type == mujoco.mjtGeom.mjGEOM_SPHERE
        if geom.name.startswith("wheel") and is_sphere:
            names.append(geom.name)
    expect(
        3 <= len(names) <= MAX_WHEELS,
        f"`mjcf` of a body with 3 to {MAX_WHEELS} spheres whose names begin with "
        f"`wheel`, got {len(names)}.",
    )
    for index, name in enumerate(names):
        bit = 1 << index
        wheel = next(geom for geom in spec.geoms if geom.name == name)
        wheel.contype = bit
        wheel.condim = 1
        wheel.friction = [1e-5, 1e-5, 1e-5]
        plane = spec.worldbody.add_body(name=f"_mocap_{name}", mocap=True)
        plane.add_geom(
            name=PLANE + name,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[2, 2, 1],
            condim=1,
            contype=0,
            conaffinity=bit,
            friction=[1e-5, 1e-5, 1e-5],
        )
    return names
