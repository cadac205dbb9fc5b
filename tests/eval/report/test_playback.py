import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from benchnav.eval.report.drawn_plan import DrawnPlan
from benchnav.eval.report.ground import HOLDING, field_colours, hatching, outline
from benchnav.eval.report.playback import (
    arrange,
    playback_path,
    read_path,
    write_playback,
    write_recording,
)
from benchnav.eval.report.recording import Recording
from benchnav.eval.report.snapshot import Snapshot
from tests.eval.report import made


def verify(path: Path) -> None:
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(
        ["rerun", "rrd", "verify", str(path)],
        check=True,
        capture_output=True,
        env={**os.environ, "PATH": programs},
    )


def column(path: Path, entity: str, name: str) -> tuple[np.ndarray, list[object]]:
    """Times in seconds and values of a component, in order of time."""
    batches: list[pa.RecordBatch] = [
        chunk.to_record_batch()
        for chunk in RrdReader(path).stream()
        if chunk.entity_path == entity and "time" in chunk.timeline_names
    ]
    found = []
    for batch in batches:
        times = batch.column("time").to_numpy(zero_copy_only=False).astype("timedelta64[ns]").astype(np.int64)
        values = batch.column(next(n for n in batch.schema.names if n.endswith(name))).to_pylist()
        found += list(zip(times * 1e-9, values, strict=True))
    found.sort(key=lambda pair: pair[0])
    return np.array([time for time, _ in found]), [value for _, value in found]


def test_a_recording_verifies_and_holds_the_driven_path(tmp_path: Path) -> None:
    recording = made.recording(40, dt_s=0.2)
    path = write_playback(tmp_path, "one", recording)
    verify(path)
    times, positions = read_path(path)
    np.testing.assert_allclose(times, 0.2 * np.arange(41), atol=1e-6)
    np.testing.assert_array_equal(positions[:, :2], recording.states[:, :2])
    snapshot = Snapshot.load(playback_path(tmp_path, "one", ".npz"))
    np.testing.assert_array_equal(snapshot.track, recording.states[:, :2])
    assert sorted(p.name for p in path.parent.iterdir()) == ["one.npz", "one.rrd"]


def test_commands_are_called_what_the_robot_calls_them(tmp_path: Path) -> None:
    recording = made.recording(12, action_names=("speed_mps", "arm [rad]"))
    write_recording(recording, tmp_path / "a.rrd")
    for index, entity in enumerate(("/series/command/speed_mps", "/series/command/arm\\ \\[rad\\]")):
        _, values = column(tmp_path / "a.rrd", entity, "scalars")
        np.testing.assert_allclose(np.ravel(values), recording.actions[:, index], rtol=1e-6)
    _, met = column(tmp_path / "a.rrd", "/series/traversability/met", "scalars")
    np.testing.assert_allclose(np.ravel(met), recording.traversability, rtol=1e-6)


def test_plans_are_shown_when_they_were_made(tmp_path: Path) -> None:
    recording = made.recording(40)
    write_recording(recording, tmp_path / "a.rrd")
    times, strips = column(tmp_path / "a.rrd", "/world/plan/samples", "strips")
    np.testing.assert_allclose(times, [plan.step * 0.1 for plan in recording.plans], atol=1e-6)
    for plan, shown in zip(recording.plans, strips, strict=True):
        assert len(shown) == 3  # type: ignore[arg-type]
        np.testing.assert_allclose(np.array(shown)[..., :2], np.array(plan.lines["samples"]), rtol=1e-6)


def chunks(path: Path) -> dict[str, list[pa.RecordBatch]]:
    """What is logged, by entity."""
    found: dict[str, list[pa.RecordBatch]] = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def static(path: Path, entity: str, name: str) -> np.ndarray:
    """The value of a component that is logged once for all times."""
    (batch,) = chunks(path)[entity]
    assert "time" not in batch.schema.names
    (value,) = batch.column(next(n for n in batch.schema.names if n.endswith(name))).to_pylist()
    return np.array(value)


def image(path: Path, entity: str) -> np.ndarray:
    """An image as the map has it: its first row is at the bottom."""
    return static(path, entity, "buffer").astype(np.uint8).reshape(40, 60, 3)[::-1]


def test_λ_as_it_was_is_shown_where_it_stayed(tmp_path: Path) -> None:
    recording = made.held_recording()
    write_recording(recording, tmp_path / "a.rrd")
    verify(tmp_path / "a.rrd")
    assert recording.field is not None
    shown = image(tmp_path / "a.rrd", "/map/field")
    np.testing.assert_array_equal(shown, field_colours(recording.field, recording.holding))
    np.testing.assert_array_equal((shown == HOLDING).all(axis=-1), recording.holding)
    write_recording(made.recording(10), tmp_path / "b.rrd")
    assert not [e for e in chunks(tmp_path / "b.rrd") if e.startswith(("/map/field", "/map/soft"))]


def views(recording: Recording) -> list[tuple[str, list[str]]]:
    """Names and contents of the flat views."""
    found = []
    queue: list[object] = [arrange(recording).root_container]
    while queue:
        part = queue.pop(0)
        queue += getattr(part, "contents", []) if hasattr(part, "row_shares") else []
        if type(part).__name__ == "Spatial2DView":
            found.append((part.name, part.contents))  # type: ignore[attr-defined]
    return found


def test_each_flat_view_shows_its_own_layer_under_what_is_driven_and_planned() -> None:
    colour = ("Colour", ["/map/colour", "/map/soft/**", "/map/overlay/**"])
    given = ("Traversability the planner is given", ["/map/risk", "/map/overlay/**"])
    as_it_is = ("Traversability as it is", ["/map/field", "/map/overlay/**"])
    assert views(made.recording(10)) == [colour, given]
    assert views(made.held_recording()) == [colour, given, as_it_is]


def test_soft_ground_is_marked_where_it_is(tmp_path: Path) -> None:
    recording = made.held_recording(field=None)
    write_recording(recording, tmp_path / "a.rrd")
    for name, lines in (("outline", outline), ("hatching", hatching)):
        shown = static(tmp_path / "a.rrd", f"/map/soft/{name}", "strips")
        expected = lines(recording.soft, 0.5)
        np.testing.assert_allclose(shown[..., 0] * 0.5, expected[..., 0], atol=1e-5)
        np.testing.assert_allclose((40 - shown[..., 1]) * 0.5, expected[..., 1], atol=1e-5)


def test_an_immobilised_robot_is_marked_from_that_moment_on(tmp_path: Path) -> None:
    recording = made.held_recording(43)
    write_recording(recording, tmp_path / "a.rrd")
    x, y = recording.states[-1, :2]
    flat = (x / 0.5, 40 - y / 0.5)
    for entity, place, size in (
        ("/world/immobilised", (x, y), 2),
        ("/map/overlay/immobilised/cross", flat, 4),
    ):
        times, ((cross,),) = column(tmp_path / "a.rrd", entity, "strips")  # type: ignore[misc]
        np.testing.assert_allclose(times, [4.3], atol=1e-6)
        np.testing.assert_allclose(np.mean(np.array(cross)[:, :2], axis=0), place, atol=1e-4)
        np.testing.assert_allclose(np.ptp(np.array(cross)[:, :2], axis=0), size, atol=1e-4)
        assert column(tmp_path / "a.rrd", entity, "labels")[1] == [["immobilised"]]
    write_recording(made.held_recording(43, about=made.recording().about), tmp_path / "b.rrd")
    assert not [entity for entity in chunks(tmp_path / "b.rrd") if "immobilised" in entity]


def test_the_driven_path_grows_to_the_end_and_stays(tmp_path: Path) -> None:
    recording = made.recording(237)
    write_recording(recording, tmp_path / "a.rrd")
    pieces = sorted(entity for entity in chunks(tmp_path / "a.rrd") if "/overlay/driven/" in entity)
    assert len(pieces) > 1
    for time_s in (0.4, 0.5, 9.99, 10.0, 10.5, 23.7):
        shown: list[object] = []
        for entity in pieces:
            times, strips = column(tmp_path / "a.rrd", entity, "strips")
            known = [strip for when, strip in zip(times, strips, strict=True) if when < time_s + 1e-6]
            shown += known[-1] if known else []  # type: ignore[arg-type]
        # A plan is drawn twice a second, and with it what was driven by then.
        steps = 237 if time_s == 23.7 else 5 * int(time_s / 0.5 + 1e-6)
        assert len(shown) == steps
        if steps:
            ends = np.array(shown)[:, 1]
            np.testing.assert_allclose(ends[:, 0] * 0.5, recording.states[1 : steps + 1, 0], rtol=1e-5)


def test_a_long_recording_of_a_crowded_planner_is_small(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    plans = [
        DrawnPlan(step=step, lines={"samples": list(generator.random((100, 51, 2), np.float32))})
        for step in range(0, 1200, 5)
    ]
    write_recording(made.held_recording(1200, plans=plans), tmp_path / "a.rrd")
    assert (tmp_path / "a.rrd").stat().st_size < 3e6
    _, strips = column(tmp_path / "a.rrd", "/map/overlay/plan/samples", "strips")
    for line, shown in zip(plans[0].lines["samples"], strips[0], strict=True):  # type: ignore[call-overload]
        ends = np.array(shown)[[0, -1]]
        np.testing.assert_allclose(ends[:, 0] * 0.5, line[[0, -1], 0], rtol=1e-5)


def test_an_episode_that_ended_at_once_can_be_played(tmp_path: Path) -> None:
    path = write_playback(tmp_path, "one", made.recording(0))
    verify(path)
    _, positions = read_path(path)
    assert len(positions) == 1


@pytest.mark.parametrize("stem", ["mppi+cvar:0.5+std+00004", "λ̂/a b.c", "λ", "plain_name-1"])
def test_names_are_such_that_the_viewer_takes_them(stem: str, tmp_path: Path) -> None:
    path = write_playback(tmp_path, stem, made.recording(3))
    assert path == playback_path(tmp_path, stem)
    assert path.parent == tmp_path / "playback"
    assert re.fullmatch(r"[A-Za-z0-9_-]+\.rrd", path.name)
    (recording,) = RrdReader(path).recordings()
    for name in (recording.application_id, recording.recording_id):
        assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", name)
    assert recording.recording_id == path.stem


def test_plain_names_stay_as_they_are(tmp_path: Path) -> None:
    assert playback_path(tmp_path, "mppi_cvar-1").name == "mppi_cvar-1.rrd"
