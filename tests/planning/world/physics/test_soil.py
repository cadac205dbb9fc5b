"""Laws of soil: compiled code against NumPy, and settings."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.settings import read
from benchnav.planning.robots import SkidSteer
from benchnav.planning.world.physics.body import drive_of
from benchnav.planning.world.physics.maps import check_physics_maps
from benchnav.planning.world.physics.settings import Entrapment, Physics
from benchnav.planning.world.physics.soil import (
    Calibrated,
    CustomSoil,
    Isotropic,
    Janosi,
    Soil,
    Wheel,
    measured_wheels,
    plain_soil,
    read_soil,
)
from benchnav.planning.world.physics.workspace import Workspace
from benchnav.planning.world.world import World, read_world
from tests import factories


def workspace(soil: Soil) -> Workspace:
    physics = Physics(soil=soil, entrapment=None)
    return Workspace(physics, drive_of(SkidSteer()))


def random_wheels(count: int) -> np.ndarray:
    """Fields of `Wheel`, shape [9, count]; a tenth of the wheels stand still."""
    generator = np.random.default_rng(0)
    low = np.array([-1.5, -1.5, -1.0, 0.0, 0.0, -0.5, 0.0, -0.7, -0.7])
    high = np.array([1.5, 1.5, 1.0, 300.0, 1.0, 1.0, 0.7, 0.7, 0.7])
    wheels = generator.uniform(low[:, None], high[:, None], (9, count))
    wheels[:3, ::10] = 0
    wheels[4, ::7] = np.round(wheels[4, ::7])
    return wheels


@pytest.mark.parametrize(
    "soil",
    [
        Calibrated(),
        Calibrated(friction=0.5, slip_speed_mps=0.3, least_grip=0.4),
        Calibrated(is_directional=False),
        Isotropic(),
        Janosi(),
        Janosi(wheel="smooth", reserve=1.5),
    ],
)
def test_the_compiled_law_is_that_of_numpy(soil: Soil) -> None:
    wheels = random_wheels(2000)
    forces = workspace(soil).soil_forces(np.ascontiguousarray(wheels.T))
    names = [field.name for field in fields(Wheel)]
    state = Wheel(**dict(zip(names, wheels, strict=True)))
    expected = np.stack(soil.force(state), axis=1)
    np.testing.assert_allclose(forces, expected, rtol=1e-9, atol=1e-9)


def wheel(**changes: float) -> Wheel:
    values: dict[str, float] = {
        "rim_speed_mps": 1.0,
        "along_mps": 0.0,
        "across_mps": 0.0,
        "load_n": 100.0,
        "traversability": 0.5,
        "slope_gain": 0.0,
        "slope": 0.0,
        "climb": 0.0,
        "tilt": 0.0,
    }
    arrays = {name: np.array(value) for name, value in (values | changes).items()}
    return Wheel(**arrays)


def test_a_calibrated_wheel_pulls_until_it_moves_at_lambda() -> None:
    soil = Calibrated()
    assert soil.force(wheel(along_mps=0.5))[0] == pytest.approx(0)
    assert soil.force(wheel(along_mps=0.4))[0] > 0 > soil.force(wheel(along_mps=0.6))[0]
    # The slope law adds to λ; the control ignores it.
    uphill = wheel(along_mps=0.7, slope_gain=0.2)
    assert soil.force(uphill)[0] == pytest.approx(0)
    assert Isotropic().force(uphill)[0] < 0


def test_the_grip_falls_with_lambda_except_for_the_control() -> None:
    strongest = {
        (type(soil), value): soil.force(wheel(traversability=value, rim_speed_mps=99))[
            0
        ]
        for soil in (Calibrated(), Isotropic())
        for value in (1.0, 0.4, 0.02)
    }
    assert strongest == pytest.approx(
        {
            (Calibrated, 1.0): 80.0,
            (Calibrated, 0.4): 32.0,
            (Calibrated, 0.02): 8.0,
            (Isotropic, 1.0): 80.0,
            (Isotropic, 0.4): 80.0,
            (Isotropic, 0.02): 80.0,
        },
        rel=1e-6,
    )


def test_friction_bounds_the_force_with_gravity() -> None:
    steep = wheel(climb=2.0, tilt=-1.0, rim_speed_mps=0.0)
    assert np.hypot(*Calibrated().force(steep)) == pytest.approx(80.0)
    carried = wheel(climb=0.3, tilt=-0.2, rim_speed_mps=0.0)
    assert Calibrated().force(carried) == pytest.approx((30.0, -20.0))


@pytest.mark.parametrize("name", ["grouser", "smooth"])
@pytest.mark.parametrize("slope", [0.0, 0.1, 0.3])
def test_a_shearing_wheel_climbs_its_slope_at_lambda(name: str, slope: float) -> None:
    # Driving straight uphill at λ, the drawbar pull per load is tan ψ.
    state = wheel(along_mps=0.5, slope=slope)
    along, across = Janosi(wheel=name).force(state)
    assert along == pytest.approx(100.0 * slope, abs=1e-6)
    assert across == 0


def test_measured_wheels_have_their_slip_where_lambda_is_theirs() -> None:
    # On level soil, the fitted curve m (1 − exp(−s/k)) − r is 0 at s = 1 − λ: then the
    # displacement of the cell is that of the table.
    for name, numbers in measured_wheels().items():
        m, k, r = numbers["traction"], numbers["shear_slip"], numbers["resistance"]
        value = 1 + k * np.log(1 - r / m)
        for speed in (0.2, 0.5, 0.8):
            slip = 1 - speed
            state = wheel(along_mps=speed, traversability=value)
            pull = m * (1 - np.exp(-slip / k)) - r
            force = Janosi(wheel=name).force(state)[0]
            assert force == pytest.approx(100 * pull, abs=0.1)


def test_a_custom_law_is_one_file(tmp_path: Path) -> None:
    file = tmp_path / "viscous.c"
    file.write_text(
        '#include "wheel.h"\n'
        "void soil_force(const wheel_t *w, const double *p, double force[2]) {\n"
        "  force[0] = p[0] * w->load * (w->lambda * w->rim_speed - w->along);\n"
        "  force[1] = -p[1] * w->across;\n"
        "}\n"
    )
    soil = CustomSoil(file=str(file), numbers=(2.0, 3.0))
    wheels = random_wheels(50)
    forces = workspace(soil).soil_forces(np.ascontiguousarray(wheels.T))
    expected = 2 * wheels[3] * (wheels[4] * wheels[0] - wheels[1])
    np.testing.assert_allclose(forces[:, 0], expected)
    np.testing.assert_allclose(forces[:, 1], -3 * wheels[2])
    assert read_soil(plain_soil(soil)) == soil


def test_a_custom_law_that_does_not_compile_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "wrong.c"
    file.write_text("void soil_force(void) { nonsense }\n")
    with pytest.raises(ConfigError, match=r"Expected a soil law that cc compiles") as e:
        workspace(CustomSoil(file=str(file)))
    assert "\n" not in str(e.value)
    with pytest.raises(ConfigError, match="which cannot be read"):
        CustomSoil(file=str(tmp_path / "missing.c"))


def test_a_custom_law_that_has_changed_is_rejected(tmp_path: Path) -> None:
    file = tmp_path / "law.c"
    file.write_text("one")
    stored = plain_soil(CustomSoil(file=str(file)))
    assert read_soil(stored) == CustomSoil(file=str(file))
    file.write_text("two")
    with pytest.raises(ConfigError, match="Restore the file, or remove `digest`"):
        read_soil(stored)


@pytest.mark.parametrize("soil", [Calibrated(friction=0.6), Isotropic(), Janosi()])
def test_soils_are_plain_data(soil: Soil) -> None:
    physics = Physics(soil=plain_soil(soil), entrapment=None)
    assert physics.soil == soil
    assert read(Physics, physics.to_dict(), "`{}`".format) == physics
    assert hash(physics) == hash(Physics(soil=soil, entrapment=None))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"soil": "sand"}, "`soil` among calibrated, isotropic, janosi, custom"),
        ({"soil": {"name": "janosi", "wheel": "oak"}}, "among grouser, smooth"),
        ({"soil": {"friction": -1}}, "`friction` of a soil > 0 and finite, got -1"),
        ({"soil": {"least_grip": 0.0}}, r"`least_grip` of a soil in \(0, 1\]"),
        ({"soil": {"name": "janosi", "reserve": 1.0}}, "`reserve` of a soil > 1"),
        ({"soil": 3}, "`soil` as a name or a mapping with `name`, got 3"),
        ({"soil": "custom"}, "`soil.file` as text, got none"),
        ({"substep_s": 0.1}, r"`substep_s` in \(0, 0.02\], got 0.1"),
    ],
)
def test_settings_say_what_they_cannot_be(
    settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        Physics(**settings)


def test_entrapment_says_what_it_cannot_be() -> None:
    with pytest.raises(ConfigError, match="`sinkage` of entrapment > 0"):
        Entrapment(sinkage=0.0)


def test_a_world_stores_its_physics_only_for_that_backend() -> None:
    changes = {"soil": {"name": "janosi", "wheel": "smooth"}, "entrapment": None}
    settings = {"preset": "stakes", "backend": "physics", "physics": changes}
    world, _, label = read_world(settings)
    assert world.physics == Physics(soil=Janosi(wheel="smooth"), entrapment=None)
    assert label == (
        "stakes backend=physics soil=janosi wheel=smooth reserve=1.15 entrapment=none"
    )
    assert read_world(world.spec)[0] == world
    assert world.to_dict()["physics"]["soil"] == plain_soil(Janosi(wheel="smooth"))
    with pytest.raises(ConfigError, match="`backend` 'physics' with `physics`"):
        replace(world, backend="tracks")
    tracks = replace(world, backend="tracks", physics=None)
    assert "physics" not in tracks.to_dict()
    # All constants are part of the ids of the backend, though none is set.
    assert World.stakes(backend="physics").to_dict()["physics"] == Physics().to_dict()


def test_a_dataset_without_slope_laws_is_named() -> None:
    terrain = factories.terrain(torch.full((1, 8, 8), 0.5))
    assert terrain.slope_law is None
    (warning,) = check_physics_maps(terrain, Physics(), "plains")
    assert warning.startswith("maps of plains have no slope laws of classes")
    for soil in (Isotropic(), Calibrated(is_directional=False), Janosi()):
        assert check_physics_maps(terrain, Physics(soil=soil), "plains") == []
    with_laws = replace(terrain, slope_law=lambda slopes_deg: slopes_deg)
    assert check_physics_maps(with_laws, Physics(), "plains") == []


def test_a_world_names_the_setting_that_is_wrong() -> None:
    settings = {"backend": "physics", "physics": {"body": {"mass_kg": -1}}}
    with pytest.raises(ConfigError, match="`mass_kg` of a body > 0 and finite"):
        read_world(settings)
    settings = {"backend": "physics", "physics": {"entrapment": {"depth": 1}}}
    with pytest.raises(ConfigError, match=r"world\.physics\.entrapment.*'depth'"):
        read_world(settings)
