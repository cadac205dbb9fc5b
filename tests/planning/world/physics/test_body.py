"""Bodies and the compiled library."""

import os
import sys
from pathlib import Path

import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.planning.robots import Ackermann, SkidSteer
from benchnav.planning.world.physics import library
from benchnav.planning.world.physics.body import drive_of
from benchnav.planning.world.physics.settings import Body, Physics
from benchnav.planning.world.physics.workspace import Workspace, workspace
from tests.planning.world.physics.worlds import CENTRE, FIRM, drive, simulation, uniform

WHEEL = '<geom name="wheel_{0}" type="sphere" size="0.1" pos="{1} {2} -0.1" mass="1"/>'


def six_wheels(path: Path) -> str:
    """A rover whose front wheels hang on a hinged rocker."""
    middle = "".join(
        WHEEL.format(f"{x}{y}", x, y) for x in (0.0, -0.3) for y in (0.25, -0.25)
    )
    front = "".join(WHEEL.format(f"front{y}", 0.0, y) for y in (0.25, -0.25))
    path.write_text(
        '<mujoco><worldbody><body name="hull"><freejoint/>'
        f'<geom type="box" size="0.3 0.15 0.05" mass="10"/>{middle}'
        '<body name="rocker" pos="0.35 0 0"><joint type="hinge" axis="1 0 0" '
        'range="-20 20" damping="1"/>'
        f"{front}</body></body></worldbody></mujoco>"
    )
    return str(path)


def test_wheels_stand_on_the_contacts_of_the_robot() -> None:
    robot = SkidSteer(track_m=0.6, wheelbase_m=0.4)
    assert robot.footprint is not None
    sim = simulation(uniform([0.8]), robot=robot)
    now = sim.init(torch.tensor([[CENTRE, CENTRE, 0.3]]))
    contacts = now.contacts_m[0].view(4, 2)
    expected = robot.footprint.contacts(now.state)[0]  # side, then front and rear
    expected = expected.transpose(0, 1).reshape(4, 2).double()
    torch.testing.assert_close(contacts, expected, atol=1e-5, rtol=0)
    space = workspace(FIRM, drive_of(robot))
    assert space.contact_radius_m == pytest.approx(robot.footprint.radius_m)
    assert float(space.model.body_mass.sum()) == pytest.approx(FIRM.body.mass_kg)
    assert float(now.body[0, 3]) == pytest.approx(FIRM.body.wheel_radius_m, abs=1e-3)
    # The loads carry the weight.
    assert float(now.memory[0, -4:].sum()) == pytest.approx(46 * 9.81, rel=1e-3)


def test_a_steered_robot_has_its_rear_axle_at_its_position() -> None:
    robot = Ackermann(wheelbase_m=0.6)
    sim = simulation(uniform([0.8]), robot=robot)
    now = sim.init(torch.tensor([[CENTRE, CENTRE, 0.0]]))
    x, y = now.contacts_m[0].view(4, 2).sub(CENTRE).T
    assert x.tolist() == pytest.approx([0.6, 0.6, 0.0, 0.0], abs=1e-5)
    assert y.tolist() == pytest.approx([0.2, -0.2, 0.2, -0.2], abs=1e-5)


def test_a_body_of_the_user_drives(tmp_path: Path) -> None:
    body = Body(mjcf=six_wheels(tmp_path / "rover.xml"))
    physics = Physics(entrapment=None, body=body)
    robot = SkidSteer(track_m=0.5, wheelbase_m=0.7)
    sim = simulation(uniform([0.3, 0.8]), physics, robot=robot)
    driven = drive(sim, [0.0, 1.0], (0.8, 0.0))
    assert driven.along_mps.tolist() == pytest.approx([0.24, 0.64], abs=0.01)
    assert driven.last.contacts_m.shape == (2, 12)
    # Planners would keep less clear than the wheels need.
    with pytest.raises(ConfigError, match="wheels are within the robot's footprint"):
        simulation(uniform([0.8]), physics)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco>", "Expected a body that MuJoCo compiles, got body.xml"),
        (
            f"<mujoco><worldbody><body>{WHEEL.format(1, 0, 0)}"
            "</body></worldbody></mujoco>",
            "3 to 16 spheres whose names begin with `wheel`, got 1",
        ),
        (
            "<mujoco><worldbody><body>"
            + "".join(WHEEL.format(i, i % 2, i // 2) for i in range(4))
            + "</body></worldbody></mujoco>",
            "with a free joint on its first body",
        ),
        (
            '<mujoco><worldbody><body><freejoint/><geom size="0.1" pos="3 0 0"/>'
            + "".join(WHEEL.format(i, i % 2, i // 2) for i in range(4))
            + "</body></worldbody></mujoco>",
            "a body that stands still on level terrain",
        ),
    ],
)
def test_bodies_that_do_not_stand_are_rejected(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "body.xml"
    path.write_text(text)
    physics = Physics(body=Body(mjcf=str(path)))
    with pytest.raises(ConfigError, match=message) as error:
        Workspace(physics, drive_of(SkidSteer()))
    assert "\n" not in str(error.value)


def test_a_body_that_is_missing_or_has_changed_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"got missing\.xml, which cannot be read"):
        Body(mjcf="missing.xml")
    path = tmp_path / "body.xml"
    path.write_text("<mujoco/>")
    stored = Body(mjcf=str(path))
    path.write_text("<mujoco></mujoco>")
    with pytest.raises(ConfigError, match=r"Restore the file, or remove `digest`"):
        Body(mjcf=str(path), digest=stored.digest)


def test_a_missing_mujoco_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match=r"pip install 'benchnav\[physics\]'"):
        library.import_mujoco()


def test_a_missing_compiler_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler -O1")
    law = library.FOLDER / "calibrated.c"
    with pytest.raises(ConfigError, match=r"got 'no-such-compiler'.*apt install gcc"):
        library.load_library.__wrapped__(law)


def test_code_is_compiled_once_and_again_for_other_compilers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("BENCHNAV_CACHE", str(tmp_path))
    law = library.FOLDER / "calibrated.c"
    load = library.load_library.__wrapped__
    load(law)
    (path,) = (tmp_path / "physics").iterdir()
    written = path.stat().st_mtime_ns
    load(law)
    assert path.stat().st_mtime_ns == written
    monkeypatch.setenv("CC", f"{os.environ.get('CC', 'cc')} -O1")
    load(law)
    assert len(list((tmp_path / "physics").iterdir())) == 2
    # Headers of another MuJoCo may differ.
    monkeypatch.setattr(library.import_mujoco(), "__version__", "4.9.9")
    load(law)
    names = {file.suffix for file in (tmp_path / "physics").iterdir()}
    assert len(list((tmp_path / "physics").iterdir())) == 3
    assert names == {".so"}


def test_a_cache_that_cannot_be_written_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("BENCHNAV_CACHE", str(blocked))
    with pytest.raises(ConfigError, match="Set BENCHNAV_CACHE to another folder"):
        library.load_library.__wrapped__(library.FOLDER / "calibrated.c")
