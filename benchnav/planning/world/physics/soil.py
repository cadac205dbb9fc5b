"""Soils: laws of the force on a wheel.

A soil is a value that names a C file with the law, and the law's parameters. The file
is compiled together with the simulation; wheel.h states what it must define. `force`
computes the shipped laws with NumPy, as an oracle. Letters in shapes: *K any dimensions
of wheels.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from benchnav.core.errors import expect
from benchnav.core.settings import check_known, plain, read
from benchnav.planning.world.physics.library import FOLDER, file_digest


@dataclass(frozen=True, kw_only=True)
class Wheel:
    """Motion and terrain of wheels, each of shape [*K]; fields of `wheel_t` in wheel.h.

    Args:
        rim_speed_mps: speed of the rim along the wheel's heading.
        along_mps: velocity of the contact along the heading.
        across_mps: velocity of the contact to the left.
        load_n: normal force.
        traversability: λ of the cell.
        slope_gain: what the class's slope law adds to λ in this direction.
        slope: tangent of the inclination of the cell.
        climb: tangent of the terrain's inclination along the heading.
        tilt: tangent of the terrain's inclination to the left.
    """

    rim_speed_mps: np.ndarray
    along_mps: np.ndarray
    across_mps: np.ndarray
    load_n: np.ndarray
    traversability: np.ndarray
    slope_gain: np.ndarray
    slope: np.ndarray
    climb: np.ndarray
    tilt: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Soil:
    """Base class of soils."""

    name: ClassVar[str]
    source: ClassVar[str]

    @property
    def path(self) -> Path:
        """C file that defines the law."""
        return FOLDER / self.source

    @property
    def parameters(self) -> tuple[float, ...]:
        """Parameters of the law, in the order that the C file states."""
        raise NotImplementedError

    def force(self, wheel: Wheel) -> tuple[np.ndarray, np.ndarray]:
        """Return the force along the heading and to the left in N, each [*K]."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class _Slipping(Soil):
    """Soil on which a wheel moves at λ times the speed of its rim; see calibrated.c."""

    source: ClassVar[str] = "calibrated.c"

    friction: float = 0.8
    slip_speed_mps: float = 0.1

    def __post_init__(self) -> None:
        """Validate the numbers."""
        for name in ("friction", "slip_speed_mps"):
            value = getattr(self, name)
            expect(
                0 < value < float("inf"),
                f"`{name}` of a soil > 0 and finite, got {value}.",
            )

    @property
    def _least_grip(self) -> float:
        """λ below which the grip does not fall; 1 for a constant grip."""
        return 1.0

    @property
    def _is_directional(self) -> bool:
        return False

    @property
    def parameters(self) -> tuple[float, ...]:
        """Parameters of calibrated.c."""
        return (
            self.friction,
            self.slip_speed_mps,
            self._least_grip,
            float(self._is_directional),
        )

    def force(self, wheel: Wheel) -> tuple[np.ndarray, np.ndarray]:
        """Return the force along the heading and to the left in N, each [*K]."""
        traversability = wheel.traversability
        if self._is_directional:
            traversability = traversability + wheel.slope_gain
        traversability = np.clip(traversability, 0, 1)
        error_along = traversability * wheel.rim_speed_mps - wheel.along_mps
        error_across = -wheel.across_mps
        error = np.hypot(error_along, error_across)
        grip = self.friction * np.maximum(traversability, self._least_grip)
        gain = grip / self.slip_speed_mps * _tanh_ratio(error / self.slip_speed_mps)
        along = gain * error_along + wheel.climb
        across = gain * error_across + wheel.tilt
        total = np.hypot(along, across)
        scale = wheel.load_n * np.minimum(1, self.friction / np.maximum(total, 1e-12))
        return scale * along, scale * across


@dataclass(frozen=True, kw_only=True)
class Calibrated(_Slipping):
    """Soil on which a robot moves at the λ of its cells, in each direction.

    With heading θ from uphill, a plane of slope ψ gives λ + f(ψ max(0, cos θ)) − f(ψ),
    clipped to [0, 1], where f is the slope law of the cell's class. Soft cells give λ.
    The grip is in proportion to λ.

    Args:
        friction: largest force per load.
        slip_speed_mps: difference to the speed at which the wheel would move that the
            soil answers with 76 % of the grip.
        least_grip: λ below which the grip does not fall. A wheel on softer cells still
            brakes.
        is_directional: whether the slope law applies; otherwise, λ of a cell is the
            same in all directions.
    """

    name: ClassVar[str] = "calibrated"

    least_grip: float = 0.1
    is_directional: bool = True

    def __post_init__(self) -> None:
        """Validate the numbers."""
        super().__post_init__()
        expect(
            0 < self.least_grip <= 1,
            f"`least_grip` of a soil in (0, 1], got {self.least_grip}.",
        )

    @property
    def _least_grip(self) -> float:
        return self.least_grip

    @property
    def _is_directional(self) -> bool:
        return self.is_directional


@dataclass(frozen=True, kw_only=True)
class Isotropic(_Slipping):
    """Soil with λ of the cell in all directions, and with a constant grip: the control.

    Args:
        friction: largest force per load.
        slip_speed_mps: difference to the speed at which the wheel would move that the
            soil answers with 76 % of the grip.
    """

    name: ClassVar[str] = "isotropic"


@dataclass(frozen=True, kw_only=True)
class Janosi(Soil):
    """Soil that shears under the wheel; gravity acts, so that the slope matters.

    Traction per load is m (1 − exp(−s/k)), less the resistance r, with slip s. A wheel
    that drives straight up the slope of its cell moves at λ; in other directions, the
    law itself says how fast. Where the measured soil cannot carry the slope, its
    traction is raised. Source: Janosi and Hanamoto (1961), "The analytical
    determination of drawbar pull as a function of slip for tracked vehicles in
    deformable soils".

    Args:
        wheel: name in the table of measured wheels, soils.csv, which has m and r.
        reserve: least traction as a multiple of what the cell's slope needs, > 1.
    """

    name: ClassVar[str] = "janosi"
    source: ClassVar[str] = "janosi.c"
    # Speeds at which the resistance and the slip are regularised, in m/s.
    _RESISTANCE_MPS: ClassVar[float] = 0.05
    _LEAST_MPS: ClassVar[float] = 0.1

    wheel: str = "grouser"
    reserve: float = 1.15

    def __post_init__(self) -> None:
        """Validate the name and the reserve."""
        check_known("`wheel` of the soil 'janosi'", self.wheel, measured_wheels())
        expect(
            1 < self.reserve < float("inf"),
            f"`reserve` of a soil > 1 and finite, got {self.reserve}.",
        )

    @property
    def parameters(self) -> tuple[float, ...]:
        """Parameters of janosi.c."""
        measured = measured_wheels()[self.wheel]
        return (
            measured["traction"],
            measured["resistance"],
            self.reserve,
            self._RESISTANCE_MPS,
            self._LEAST_MPS,
        )

    def force(self, wheel: Wheel) -> tuple[np.ndarray, np.ndarray]:
        """Return the force along the heading and to the left in N, each [*K]."""
        strongest, resistance, reserve, resistance_mps, least_mps = self.parameters
        needed = np.maximum(wheel.slope, 0) + resistance
        traction = np.maximum(strongest, reserve * needed)
        slip_uphill = np.maximum(1 - wheel.traversability, 0.02)
        displacement = slip_uphill / -np.log1p(-needed / traction)
        speed = np.maximum(np.abs(wheel.rim_speed_mps), np.abs(wheel.along_mps))
        speed = np.maximum(speed, least_mps)
        slip_along = (wheel.rim_speed_mps - wheel.along_mps) / speed
        slip_across = -wheel.across_mps / speed
        slip = np.maximum(np.hypot(slip_along, slip_across), 1e-12)
        gain = traction * -np.expm1(-slip / displacement) / slip
        drag = resistance * np.tanh(wheel.along_mps / resistance_mps)
        along = wheel.load_n * (gain * slip_along - drag)
        return along, wheel.load_n * gain * slip_across


@dataclass(frozen=True, kw_only=True)
class CustomSoil(Soil):
    """Soil whose law is a C file of the user; see wheel.h.

    Args:
        file: path of the C file.
        numbers: parameters that the law is given.
        digest: first digits of the file's SHA-256, which tie results to the law; if
            empty, those of the present file.
    """

    name: ClassVar[str] = "custom"

    file: str
    numbers: tuple[float, ...] = ()
    digest: str = ""

    def __post_init__(self) -> None:
        """Compute or check the digest.

        Raises:
            ConfigError: If the file cannot be read, or has changed.
        """
        digest = file_digest("a soil law", self.file, self.digest)
        object.__setattr__(self, "digest", digest)

    @property
    def path(self) -> Path:
        """C file that defines the law."""
        return Path(self.file)

    @property
    def parameters(self) -> tuple[float, ...]:
        """Parameters of the law."""
        return self.numbers


SOILS = {kind.name: kind for kind in (Calibrated, Isotropic, Janosi, CustomSoil)}


def read_soil(soil: Any) -> Soil:
    """Return a soil from its name, or from a mapping with `name` and settings.

    Raises:
        ConfigError: If the name or a setting does not exist, or a value is invalid.
    """
    if isinstance(soil, Soil):
        return soil
    expect(
        isinstance(soil, str | Mapping),
        f"`soil` as a name or a mapping with `name`, got {soil!r}.",
    )
    settings = {"name": soil} if isinstance(soil, str) else dict(soil)
    name = settings.pop("name", Calibrated.name)
    check_known("`soil`", name, SOILS)
    result = read(SOILS[name], settings, "`{}`".format, "soil")
    assert isinstance(result, Soil)
    return result


def plain_soil(soil: Soil) -> dict[str, Any]:
    """Return a soil as plain data, for `read_soil`."""
    return {"name": soil.name, **plain(soil)}


@cache
def measured_wheels() -> dict[str, dict[str, float]]:
    """Return traction m, slip k and resistance r of measured wheels, by name.

    They are fitted to drawbar/load = m (1 − exp(−s/k)) − r of single wheels on dry
    sand; the table soils.csv states source and licence of the measurements.
    """
    numbers = ("traction", "shear_slip", "resistance")
    text = (FOLDER / "soils.csv").read_text(encoding="utf-8")
    rows = csv.DictReader(text.splitlines())
    return {row["name"]: {key: float(row[key]) for key in numbers} for row in rows}


def _tanh_ratio(value: np.ndarray) -> np.ndarray:
    """Return tanh(x) / x, and 1 at 0."""
    safe = np.maximum(value, 1e-9)
    return np.tanh(safe) / safe
