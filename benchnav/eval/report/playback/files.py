"""Where recordings lie in a run folder, and how one is written."""

import re
from pathlib import Path

from benchnav.eval.report.recorded.recording import Recording


def playback_path(folder: Path, stem: str, suffix: str = ".rrd") -> Path:
    """Where an episode's recording lies in a run folder.

    The viewer names what it opens by the file, and takes letters, digits, `_` and `-` without a warning;
    all else in the stem becomes `-`.

    Args:
        folder: the run folder.
        stem: names the episode, unlike any other of the run.
        suffix: `.rrd` for the viewer, `.npz` of the recording that all else is made of.
    """
    return folder / "playback" / f"{plain_name(stem)}{suffix}"


def plain_name(text: str) -> str:
    """A name that the viewer takes."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text).strip("-") or "episode"


def write_playback(folder: Path, stem: str, recording: Recording) -> Path:
    """Writes a recording into a run folder, and the viewer's file of it.

    Args:
        folder: the run folder.
        stem: names the episode, unlike any other of the run.
        recording: what to write.

    Returns:
        The path of the viewer's file, that of `playback_path`.
    """
    from benchnav.eval.report.playback.rerun_file import write_rerun  # most units record nothing

    path = playback_path(folder, stem)
    recording.save(playback_path(folder, stem, ".npz"))
    write_rerun([recording], path)
    return path
