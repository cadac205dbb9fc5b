"""The command `replay`: episodes in the viewer, in a browser, or as a video.

This module imports nothing heavy, so that the command's help is quick.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.suite import Labels

if TYPE_CHECKING:
    from benchnav.eval.experiment.unit import Unit
    from benchnav.eval.recording import Recording

VIDEO = ".mp4"


def replay(
    labels: Labels,
    folder: str,
    seed: int | None = None,
    realisation: int = 0,
    map: int = 0,
    view: bool = True,
    web: bool = False,
    video: str = "",
    out: str = "",
) -> int:
    """Play back one or several episodes on a map; create missing recordings first.

    With several labels of a column, such as --risk mean,cvar:0.9, their conditions are
    shown together. For a column without a label, the first matching label of the run
    is taken.

    Args:
        labels: Labels of the conditions.
        folder: Run folder.
        seed: Root seed; by default, the run's first seed.
        realisation: Index of the draw of λ.
        map: Index of the map in the scenario.
        view: Open the viewer; if false, only create the recording.
        web: Serve the viewer to a browser on this machine until Ctrl-C.
        video: Write a video to this .mp4 file instead of opening the viewer, with
            conditions side by side.
        out: Folder for recordings of a read-only run; if empty, the run folder.
    """
    from benchnav.eval.find_episodes import find_episodes

    if video and Path(video).suffix != VIDEO:
        raise ConfigError(f"Expected `video` to be a {VIDEO} file, got {video!r}.")
    if video and web:
        raise ConfigError("Expected `video` or `web`, got both. Leave one out.")
    run = Path(folder)
    out_folder = other_folder(folder, out)
    episodes = find_episodes(run, labels.selected, seed, realisation, map)
    if video:
        from benchnav.core.progress import show_progress
        from benchnav.eval.report.playback.video import write_video

        recordings = _recordings(run, episodes, out_folder)
        show_progress(write_video(recordings, Path(video)), "frames")
        print(f"video:   {video}")
        return 0
    worlds = dict.fromkeys(unit.condition.labels["world"] for unit, _ in episodes)
    if len({repr(unit.condition.world) for unit, _ in episodes}) > 1:
        raise ConfigError(
            f"Expected conditions with the same world, got {', '.join(worlds)}. The "
            "viewer shows one map. Pass --video FILE.mp4 to show the worlds side by "
            "side."
        )
    path = _viewer_file(run, episodes, out_folder)
    print(f"recording: {path}")
    if web:
        from benchnav.eval.report.playback.web import serve

        serve(path)
        return 0
    has_display = (
        sys.platform != "linux"
        or "DISPLAY" in os.environ
        or "WAYLAND_DISPLAY" in os.environ
    )
    if view and has_display:
        command = [sys.executable, "-m", "rerun_cli", str(path)]
        completed = subprocess.run(command, check=False)
        return 1 if completed.returncode else 0
    reason = "no display was found; " if view else ""
    print(
        f"{reason}view the recording by `{program('rerun')} {path}`, in a browser by "
        f"--web, or as a video by --video FILE{VIDEO}"
    )
    return 0


def program(name: str) -> str:
    """Return the command for a program of this environment: its name or its path."""
    path = Path(sys.executable).parent / name
    search_path = os.environ.get("PATH", "").split(os.pathsep)
    if path.parent in map(Path, search_path):
        return name
    if path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    return str(path)


def other_folder(run: str, out: str) -> Path:
    """Return the folder for files derived from a run: `out`, or the run folder.

    Args:
        run: the run folder.
        out: folder for the files; if empty, the run folder.

    Raises:
        ConfigError: If `out` is the folder of another run.
    """
    out_folder = Path(out or run)
    is_run = (out_folder / "run.json").exists()
    if is_run and out_folder.resolve() != Path(run).resolve():
        raise ConfigError(
            f"Expected `out` to be a folder without another run, got {out}. Choose "
            "another folder."
        )
    return out_folder


def _recordings(
    folder: Path, episodes: "list[tuple[Unit, int]]", out: Path
) -> "list[Recording]":
    from benchnav.eval.run.recordings import find_recording

    return [find_recording(folder, unit, index, out) for unit, index in episodes]


def _viewer_file(folder: Path, episodes: "list[tuple[Unit, int]]", out: Path) -> Path:
    """Return the path of the episodes' viewer file; create the file if necessary."""
    from benchnav.eval.folder.checksums import matches_checksum, note_checksums
    from benchnav.eval.report.playback.viewer_file import write_rerun

    unit, index = episodes[0]
    path = out / unit.recording_path(index, ".rrd")
    if len(episodes) > 1:
        conditions = "".join(unit_.condition.id for unit_, _ in episodes)
        digest = hashlib.sha256(conditions.encode()).hexdigest()[:8]
        words = (
            unit.condition.scenario,
            digest,
            unit.seed,
            unit.realisation,
            f"{unit.maps[index]:05d}",
        )
        path = path.with_name(f"together-{'-'.join(map(str, words))}.rrd")
    if len(episodes) > 1 or not path.exists() or not matches_checksum(out, path):
        write_rerun(_recordings(folder, episodes, out), path)
        note_checksums(out, [path])
    return path
