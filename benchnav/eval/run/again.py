"""Running episodes of a run again: for playback of what was not recorded."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchnav.core.device import device_of_run
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.folder import EPISODES, open_run, read_table
from benchnav.eval.report.recorded.recording import Recording
from benchnav.eval.run.recorder import Recorder
from benchnav.eval.run.rows import path_length_m
from benchnav.eval.run.unit import Settings, build, one_thread, read_block, simulate


def find_recording(folder: Path, unit: Unit, member: int, out: Path | None = None) -> Recording:
    """Gives the recording of an episode, running its unit again where it was not recorded.

    Args:
        folder: a finished run.
        unit: the episode's.
        member: which of the unit's episodes.
        out: folder that the recording of an episode that is run again is written to; the run's when not given.

    Raises:
        ConfigError: the run has no row of the episode, or the device that it was computed on is not there.
        BenchnavError: the unit did not repeat what the run holds.
    """
    out = out or folder
    for place in (folder, out):
        stored = place / unit.recording_path(member)
        if stored.exists():
            return Recording.load(stored)
    row = _row(folder, unit, unit.maps[member])
    with one_thread():
        device = device_of_run(open_run(folder).about)
        # Without a time limit of planners, which changes no action.
        settings = Settings(device=device.type)
        origin = settings.origins().of(unit)
        problem, simulation = build(unit, origin, device)
        recorder = Recorder(unit, problem, simulation, read_block(unit, origin, device).terrain, [member])
        episodes, _ = simulate(unit, problem, simulation, settings, recorder.watch, recorder.every)
    recording = recorder.recording(episodes, member)
    if not _repeats(row, recording):
        raise BenchnavError(
            f"The episode did not repeat: {folder} was made with other versions or on another machine type. "
            "Run the suite again here to replay it."
        )
    recording.save(out / unit.recording_path(member))
    return recording


def _row(folder: Path, unit: Unit, map_index: int) -> dict[str, Any]:
    """What a finished run holds of an episode."""
    rows = read_table(folder, EPISODES)
    own = (rows["condition"] == unit.condition.id) & (rows["seed"] == unit.seed)
    own &= (rows["realisation"] == unit.realisation) & (rows["map"] == map_index)
    if not own.any():
        raise ConfigError(
            f"Expected a finished run, got {folder} without that episode. Run the same command again to finish it."
        )
    return rows[own].to_dict("records")[0]


def _repeats(row: Mapping[str, Any], recording: Recording) -> bool:
    """Whether an episode that was run again came out as its row says."""
    ended = np.isclose(row["end_time_s"], recording.end_s, atol=1e-6)
    if row["outcome"] != recording.about["outcome"] or not ended:
        return False
    if not len(recording.traversability):
        return True
    length_m = path_length_m(recording.states[:, :2].astype(np.float64))
    met = recording.traversability.astype(np.float64).mean()
    return bool(row["path_length_m"] == length_m and row["traversability"] == met)
