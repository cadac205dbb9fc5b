import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from benchnav.eval.report.playback import playback_path, read_path, write_playback, write_recording
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
