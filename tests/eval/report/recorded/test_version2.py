"""Snapshots as version 2 of run folders held them."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchnav.errors import ConfigError
from benchnav.eval.report.recorded.recording import read_snapshots, take_snapshot
from benchnav.eval.report.recorded.snapshot import Snapshot
from benchnav.eval.report.recorded.version2 import is_snapshot, read_snapshot
from tests.eval.report import made


def save(snapshot: Snapshot, path: Path, *, ground: bool = True) -> None:
    """Writes what version 2 wrote; its first runs knew nothing of the ground."""
    names = ["rgb", "predicted", "free", "extent_m", "goal_m", "track", "traversability"]
    names += ["field", "soft", "holding"] if ground else []
    arrays = {name: getattr(snapshot, name) for name in names if getattr(snapshot, name) is not None}
    for name, lines in snapshot.plan.lines.items():
        arrays[f"points_{name}"] = np.concatenate([np.empty((0, 2), np.float32), *lines])
        arrays[f"sizes_{name}"] = np.array([len(line) for line in lines], dtype=np.int64)
    scalars = {"about": dict(snapshot.about), "dt_s": snapshot.dt_s, "step": snapshot.plan.step}
    text = json.dumps(scalars | {"layers": list(snapshot.plan.lines)})
    path.parent.mkdir(exist_ok=True)
    np.savez_compressed(path, scalars=np.array(text), **arrays)


@pytest.mark.parametrize(
    "recording", [made.recording(200), made.recording(0, plans=()), made.held_recording()]
)
def test_a_snapshot_is_read_as_it_was(recording, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    snapshot = take_snapshot(recording)
    save(snapshot, tmp_path / "playback" / "a.npz")
    recording.save(tmp_path / "playback" / "b.npz")
    for again in (read_snapshot(tmp_path / "playback" / "a.npz"), *read_snapshots(tmp_path)):
        for name in ("rgb", "field", "soft", "holding", "track", "traversability", "goal_m"):
            np.testing.assert_array_equal(getattr(again, name), getattr(snapshot, name))
        assert (again.about, again.time_s) == (snapshot.about, snapshot.time_s)
        for name, lines in snapshot.plan.lines.items():
            for before, after in zip(lines, again.plan.lines[name], strict=True):
                np.testing.assert_array_equal(after, before)
    assert [is_snapshot(tmp_path / "playback" / name) for name in ("a.npz", "b.npz")] == [True, False]


def test_what_told_nothing_of_the_ground_reads_as_no_ground(tmp_path: Path) -> None:
    save(take_snapshot(made.held_recording()), tmp_path / "a.npz", ground=False)
    snapshot = read_snapshot(tmp_path / "a.npz")
    assert snapshot.field is None
    for region in (snapshot.soft, snapshot.holding):
        assert (region.dtype, region.shape) == (bool, (40, 60))
        assert not region.any()


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save(take_snapshot(made.recording(20)), path)
    path.write_bytes(path.read_bytes()[:500] + bytes(400) + path.read_bytes()[900:])
    with pytest.raises(ConfigError, match=r"a\.npz is damaged"):
        read_snapshot(path)
