"""Settings of the backend `physics`: soil, entrapment, body and sub-step."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from benchnav.core.errors import expect
from benchnav.core.settings import plain
from benchnav.planning.world.physics.library import file_digest
from benchnav.planning.world.physics.soil import (
    Calibrated,
    Soil,
    plain_soil,
    read_soil,
)

_MAY_BE_ZERO = ("lag_s", "reverse_after_s")


@dataclass(frozen=True, kw_only=True)
class Entrapment:
    """Ruts that a slipping wheel digs, and that then hold it.

    A wheel on a cell of λ < `firm` sinks by `sinkage` (1 − λ/`firm`) metres per metre
    of slip, and leaves its rut within the distance `healing_m`. The rut resists motion
    in all directions with the force (depth/`hold_m`)² per load, at most
    `max_resistance`. The form follows slip sinkage: Ding et al. (2010), "Wheel
    slip-sinkage and its prediction model of lunar rover"; Lyasko (2010), "Slip sinkage effect in
    soil–vehicle mechanics". The constants are choices, to be varied.

    Args:
        sinkage: depth per slipped distance at λ = 0, both in metres.
        firm: λ from which on a wheel does not sink.
        healing_m: distance in metres.
        hold_m: depth in metres at which the resistance equals the load.
        max_depth_m: largest depth of a rut in metres.
        max_resistance: largest resistance per load. Up to 0.8, the other wheels can
            drag one wheel out.
    """

    sinkage: float = 0.035
    firm: float = 0.2
    healing_m: float = 0.2
    hold_m: float = 0.04
    max_depth_m: float = 0.1
    max_resistance: float = 0.8

    def __post_init__(self) -> None:
        """Validate the numbers."""
        for name, value in vars(self).items():
            expect(
                0 < value < float("inf"),
                f"`{name}` of entrapment > 0 and finite, got {value}.",
            )


@dataclass(frozen=True, kw_only=True)
class Body:
    """Body of a robot with wheels, and its low-level controller.

    By default, the body is a box on four wheels that stand where the robot's footprint
    has its contacts.

    Args:
        mjcf: MJCF file of another body; empty for the shipped one. It has one body with
            a free joint, at the robot's reference point, and wheels as spheres whose
            names begin with `wheel`. Wheels face the x axis of their bodies.
        digest: first digits of the SHA-256 of `mjcf`, which tie results to the body;
            if empty, those of the present file. Files that it includes do not count.
        mass_kg: mass with wheels.
        wheel_radius_m: radius of the wheels.
        wheel_width_m: width of the wheels, which cells must exceed.
        lag_s: time constant with which wheels follow the command; 0 for none.
        yaw_rate_loop: whether the controller corrects the difference of the sides, or
            the steering, so that the robot keeps the commanded curvature.
        loop_gain: correction of ω in rad/s per second and rad/s of error.
        max_rim_speed: largest speed of a rim as a multiple of the robot's top speed.
        reverse_after_s: time of standing under a command after which the controller
            drives straight back, and then tries again; 0 for never.
        reverse_for_s: time of driving back.
    """

    mjcf: str = ""
    digest: str = ""
    mass_kg: float = 46.0
    wheel_radius_m: float = 0.165
    wheel_width_m: float = 0.1
    lag_s: float = 0.1
    yaw_rate_loop: bool = True
    loop_gain: float = 10.0
    max_rim_speed: float = 1.5
    reverse_after_s: float = 0.0
    reverse_for_s: float = 1.0

    def __post_init__(self) -> None:
        """Compute or check the digest, and validate the numbers.

        Raises:
            ConfigError: If the file cannot be read or has changed, or a number is out
                of range.
        """
        if self.mjcf:
            digest = file_digest("a body", self.mjcf, self.digest)
            object.__setattr__(self, "digest", digest)
        for name, value in vars(self).items():
            if isinstance(value, str | bool):
                continue
            if name in _MAY_BE_ZERO:
                is_valid = 0 <= value < float("inf")
                expect(is_valid, f"`{name}` of a body ≥ 0 and finite, got {value}.")
                continue
            is_valid = 0 < value < float("inf")
            expect(is_valid, f"`{name}` of a body > 0 and finite, got {value}.")


@dataclass(frozen=True, kw_only=True)
class Physics:
    """Settings of the backend `physics`.

    Args:
        soil: law of the force on a wheel: a `Soil`, its name, or a mapping.
        entrapment: ruts that hold wheels; None for none.
        body: body of the robot.
        substep_s: step of the integration in seconds.
    """

    soil: Any = field(default_factory=Calibrated)
    entrapment: Entrapment | None = field(default_factory=Entrapment)
    body: Body = field(default_factory=Body)
    substep_s: float = 0.004

    def __post_init__(self) -> None:
        """Read the soil, and validate the sub-step."""
        object.__setattr__(self, "soil", read_soil(self.soil))
        expect(
            0 < self.substep_s <= 0.02,
            f"`substep_s` in (0, 0.02], got {self.substep_s}.",
        )

    @property
    def law(self) -> Soil:
        """Soil, with its type."""
        assert isinstance(self.soil, Soil)
        return self.soil

    def to_dict(self) -> dict[str, Any]:
        """Return all settings as plain data, for `settings.read`."""
        entrapment = None if self.entrapment is None else plain(self.entrapment)
        return {
            "soil": plain_soil(self.law),
            "entrapment": entrapment,
            "body": plain(self.body),
            "substep_s": self.substep_s,
        }


def sub_steps(dt_s: float, substep_s: float) -> int:
    """Return the number of sub-steps of a step.

    Raises:
        ConfigError: If a step has no whole number of sub-steps.
    """
    count = round(dt_s / substep_s)
    expect(
        count >= 1 and abs(count * substep_s - dt_s) <= 1e-9 * dt_s,
        f"`physics.substep_s` as a fraction of the robot's time step {dt_s:g} s, got "
        f"{substep_s:g} s. Use {dt_s / max(count, 1):g}.",
    )
    return count


def differences(base: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """Return the settings that differ, as `name=value` for tables."""
    changed = []
    for name, value in settings.items():
        before = base.get(name)
        if before == value:
            continue
        if name == "soil":
            changed.append(f"soil={value['name']}")
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            rest = {key: item for key, item in value.items() if key != "name"}
            changed += differences(before, rest)
        elif name != "soil":
            changed.append(f"{name}={_short(value)}")
    return changed


def _short(value: Any) -> str:
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else str(value)
