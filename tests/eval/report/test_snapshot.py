from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from benchnav.errors import ConfigError
from benchnav.eval.report.recording import take_snapshot
from benchnav.eval.report.snapshot import Snapshot
from tests.eval.report import made


@pytest.mark.parametrize(
    "recording", [made.recording(200), made.recording(0), made.recording(0, plans=()), made.held_recording()]
)
def test_a_snapshot_comes_back_as_it_was(recording, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    snapshot = take_snapshot(recording)
    snapshot.save(tmp_path / "there" / "a.npz")
    again = Snapshot.load(tmp_path / "there" / "a.npz")
    for field in fields(Snapshot):
        before, after = getattr(snapshot, field.name), getattr(again, field.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(after, before)
        elif field.name != "plan":
            assert after == before
    assert again.plan.step == snapshot.plan.step
    assert list(again.plan.lines) == list(snapshot.plan.lines)
    for name, lines in snapshot.plan.lines.items():
        assert len(again.plan.lines[name]) == len(lines)
        for before, after in zip(lines, again.plan.lines[name], strict=True):
            np.testing.assert_array_equal(after, before)
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["a.npz"]


def test_what_earlier_versions_wrote_reads_as_no_ground(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    take_snapshot(made.held_recording()).save(path)
    with np.load(path) as stored:
        earlier = {name: stored[name] for name in stored if name not in ("field", "soft", "holding")}
        assert len(earlier) == len(stored.files) - 3
    np.savez_compressed(path, **earlier)
    snapshot = Snapshot.load(path)
    assert snapshot.field is None
    for region in (snapshot.soft, snapshot.holding):
        assert (region.dtype, region.shape) == (bool, (40, 60))
        assert not region.any()


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    take_snapshot(made.recording(20)).save(path)
    whole = path.read_bytes()
    for damage in (b"", b"no zip", whole[: len(whole) // 2], whole[:500] + bytes(400) + whole[900:]):
        path.write_bytes(damage)
        with pytest.raises(ConfigError, match=r"a\.npz is damaged"):
            Snapshot.load(path)
