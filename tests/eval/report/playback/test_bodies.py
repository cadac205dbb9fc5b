"""Robots with a footprint in viewer files and videos."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.video import Frames
from benchnav.eval.report.playback.viewer_file import arrange, drivers_of, write_rerun
from benchnav.viz.bodies import rut_colours
from tests.eval.report import made
from tests.eval.report.playback.rrd import chunks, column, static, verify

STEPS = 23


def written(folder: Path, *recordings: Recording) -> Path:
    path = folder / "a.rrd"
    write_rerun(recordings, path)
    return path


def rgb(colours: object) -> np.ndarray:
    """Red, green and blue of stored colours."""
    packed = np.array(colours, np.uint32)
    return np.stack([(packed >> shift) & 255 for shift in (24, 16, 8)], axis=-1)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = written(tmp_path_factory.mktemp("a"), made.body_recording(STEPS))
    verify(file)
    return file


def test_wheels_are_spheres_in_the_colours_of_their_ruts(path: Path) -> None:
    body = made.body_recording(STEPS).body
    times, positions = column(path, "/world/wheels", "positions")
    np.testing.assert_allclose(times, 0.1 * np.arange(STEPS + 1), atol=1e-6)
    np.testing.assert_array_equal(np.array(positions, np.float32), body["wheels_m"])
    np.testing.assert_allclose(static(path, "/world/wheels", "radii"), 0.165)
    for entity in ("/world/wheels", "/map/overlay/contacts"):
        _, colours = column(path, entity, "colors")
        np.testing.assert_array_equal(rgb(colours), rut_colours(body["ruts_m"]))
    shown = rgb(colours).sum(axis=-1)
    assert (shown[:, [0, 3]] == 3 * 255).all()
    assert (shown[-1, 1:3] < shown[STEPS // 2, 1:3]).all()
    assert shown[-1, 1] == 0


def test_the_chassis_tilts_with_the_wheels(path: Path) -> None:
    body = made.body_recording(STEPS).body
    _, places = column(path, "/world/chassis", "translation")
    _, turns = column(path, "/world/chassis", "quaternion")
    rotation = Rotation.from_quat(np.array(turns)[:, 0])
    centre = static(path, "/world/chassis", "centers")[0]
    half = static(path, "/world/chassis", "half_sizes")[0]
    below = np.array(places)[:, 0] + rotation.apply(centre - (0, 0, half[2]))
    # The lower side of the box lies between the centres of the wheels.
    np.testing.assert_allclose(below, body["wheels_m"].mean(axis=1), atol=1e-5)
    corner = np.array(places)[:, 0] + rotation.apply(centre + half * (1, 1, -1))
    np.testing.assert_allclose(corner, body["wheels_m"][:, 0], atol=1e-5)


@pytest.mark.parametrize("rigid", [False, True])
def test_the_footprint_joins_the_contacts(rigid: bool, tmp_path: Path) -> None:
    recording = made.body_recording(STEPS, ruts=False, rigid=rigid)
    file = written(tmp_path, recording)
    contacts_m = recording.body["contacts_m"]
    flat = contacts_m / 0.5 * (1, -1) + (0, 40)
    _, strips = column(file, "/map/overlay/footprint", "strips")
    for strip, corners in zip(strips, flat, strict=True):
        (line,) = strip  # type: ignore[misc]
        away = np.linalg.norm(np.array(line)[:, None] - corners, axis=-1)
        np.testing.assert_allclose(away.min(axis=0), 0, atol=1e-4)
        np.testing.assert_allclose(away.min(axis=1), 0, atol=1e-4)
    names = chunks(file)
    assert ("/world/chassis" in names) == ("/world/wheels" in names) == rigid
    assert ("/world/footprint" in names) == ("/world/contacts" in names) != rigid
    assert not [name for name in names if name.startswith("/series/ruts")]


def test_depths_of_ruts_are_a_time_series(path: Path, tmp_path: Path) -> None:
    recording = made.body_recording(STEPS)
    ruts_m = recording.body["ruts_m"]
    for wheel in range(4):
        _, depths = column(path, f"/series/ruts/wheel_{wheel + 1}", "scalars")
        np.testing.assert_allclose(np.ravel(depths), 100 * ruts_m[:, wheel], atol=1e-5)
    about = recording.about | {"risk": "mean"}
    pair = [recording, replace(recording, about=about)]
    file = written(tmp_path, *pair)
    for name in ("CVaR", "mean"):
        entity = f"/series/ruts/conditions/{name}/deepest"
        _, depths = column(file, entity, "scalars")
        np.testing.assert_allclose(np.ravel(depths), 100 * ruts_m.max(1), atol=1e-5)


def views(*recordings: Recording) -> list[str]:
    names, queue = [], [arrange(drivers_of(recordings)).root_container]
    while queue:
        part = queue.pop(0)
        names.append(str(part.name))
        queue += [item for item in part.contents if not isinstance(item, str)]
    return names


def test_a_point_has_neither_a_body_nor_views_of_it(tmp_path: Path) -> None:
    names = chunks(written(tmp_path, made.held_recording(STEPS)))
    leaves = {name.split("/")[-1] for name in names}
    assert not leaves & {"contacts", "footprint", "wheels", "chassis", "wheel_1"}
    assert "Depth of ruts [cm]" in views(made.body_recording(STEPS))
    assert "Depth of ruts [cm]" not in views(made.held_recording(STEPS))
    assert "Depth of ruts [cm]" not in views(made.body_recording(STEPS, ruts=False))


def test_a_video_has_a_close_up_that_follows_a_robot_with_a_footprint() -> None:
    body = made.body_recording(STEPS, plans=())
    point = replace(made.held_recording(STEPS, plans=()), predicted=body.predicted)
    frames = Frames([point, body])
    assert list(frames.close_ups) == [1]
    panel = frames.close_ups[1]
    shown = []
    for time_s in (0.0, 2.0):
        shown.append(frames.draw(time_s))
        x, y = body.track[round(10 * time_s)]
        assert np.mean(panel.get_xlim()) == pytest.approx(x)
        assert np.mean(panel.get_ylim()) == pytest.approx(y)
    box = panel.get_window_extent()
    rows = slice(720 - int(box.y1), 720 - int(box.y0))
    columns = slice(int(box.x0), int(box.x1))
    assert (shown[0][rows, columns] != shown[1][rows, columns]).any(
        axis=-1
    ).mean() > 0.2
    assert not Frames([point]).close_ups
