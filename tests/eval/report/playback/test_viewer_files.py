import re
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.viewer_file import write_viewer_files
from tests.eval.report import made


def test_a_recording_gets_the_viewers_file_beside_it_once(tmp_path: Path) -> None:
    recording = made.recording(40, dt_s=0.2)
    stored = tmp_path / "playback" / "mppi_cvar-1.npz"
    recording.save(stored)
    write_viewer_files(tmp_path)
    path = stored.with_suffix(".rrd")
    assert sorted(p.name for p in path.parent.iterdir()) == [stored.name, path.name]
    np.testing.assert_array_equal(Recording.load(stored).states, recording.states)
    (known,) = RrdReader(path).recordings()
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", known.application_id)
    assert known.recording_id == path.stem
    path.write_text("kept")
    write_viewer_files(tmp_path)
    assert path.read_text() == "kept"


def test_names_of_recordings_are_such_that_the_viewer_takes_them() -> None:
    suite = Suite(model="oracle", planners=("mppi",), risks=("cvar:0.5",))
    (condition,) = conditions_of(suite, lambda data: ["std"])
    path = Unit(condition=condition, seed=0, realisation=0, maps=(3, 4)).recording_path(
        1, ".rrd"
    )
    assert re.fullmatch(
        r"playback/mppi-cvar-0-5-std-[0-9a-f]{8}-0-0-00004\.rrd", str(path)
    )
