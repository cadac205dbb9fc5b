import re
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from benchnav.eval.report.playback.files import playback_path, write_playback
from benchnav.eval.report.recorded.recording import Recording
from tests.eval.report import made


def test_a_recording_and_the_viewers_file_of_it_lie_side_by_side(tmp_path: Path) -> None:
    recording = made.recording(40, dt_s=0.2)
    path = write_playback(tmp_path, "one", recording)
    assert sorted(p.name for p in path.parent.iterdir()) == ["one.npz", "one.rrd"]
    again = Recording.load(playback_path(tmp_path, "one", ".npz"))
    np.testing.assert_array_equal(again.states, recording.states)


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
