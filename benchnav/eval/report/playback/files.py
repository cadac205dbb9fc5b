"""The viewer's files of a run's recordings."""

from pathlib import Path

from benchnav.eval.report.playback.rerun_file import write_rerun
from benchnav.eval.report.recorded.recording import Recording


def write_viewer_files(folder: Path) -> None:
    """Writes the viewer's file of each recording in a run folder that has none.

    Args:
        folder: the run folder.
    """
    for path in sorted((folder / "playback").glob("*.npz")):
        if not path.with_suffix(".rrd").exists():
            write_rerun([Recording.load(path)], path.with_suffix(".rrd"))
