"""Draw the picture and the animation of docs/how-to/playback.md: an episode in worlds.

    benchnav-eval run --data stakes-v1 --model stakes-v1 --robots '[skid_steer]' \\
      --world '[stakes, {preset: stakes, backend: tracks}, {preset: stakes, backend: physics}]' \\
      --objectives '[travel_time]' --scenarios '[std]' --planners '[astar_dwa]' \\
      --risks '[mean]' --maps 10 --record all --out runs/worlds
    python -m tools.worlds runs/worlds --map 9

This writes docs/figures/worlds.png and docs/figures/worlds.gif. Without `--map`, the map
is the first of those on which outcomes differ most.
"""

import argparse
from pathlib import Path

import numpy as np

from benchnav.eval.figures.same_episode import draw_same_episode, same_episodes
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.recording import Recording, read_recordings
from benchnav.viz.style import save, styled
from tools.hero import FIGURES, frames, write_gif

TICK_MS = 160  # so that the file has less than 1 MB
NEAR_M = 0.2  # a robot this close to its last position moves no more


def find_episode(folder: Path, map_index: int | None) -> list[Recording]:
    """Return the recordings of the episode, one per world."""
    recordings = read_recordings(folder)
    if map_index is not None:
        name = str(map_index)
        recordings = [item for item in recordings if item.about["map"] == name]
    return same_episodes(recordings, list(open_run(folder).conditions))


def moves_until_s(recording: Recording) -> float:
    """Return the time at which a robot is near its last position, to stay there."""
    away_m = np.linalg.norm(recording.track - recording.track[-1], axis=1)
    return float(np.flatnonzero(away_m > NEAR_M)[-1] + 1) * recording.dt_s


def main() -> None:
    """Draw the picture and the animation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--map", type=int)
    parser.add_argument("--out", type=Path, default=FIGURES)
    arguments = parser.parse_args()
    recordings = find_episode(arguments.run, arguments.map)
    print(f"map {recordings[0].about['map']}")
    with styled():
        picture = draw_same_episode(recordings)
        save(picture, arguments.out / "worlds.png", "png", dpi=170, trim=True)
    until_s = max(map(moves_until_s, recordings)) + 2
    images = list(frames(recordings, until_s, TICK_MS))
    write_gif(images, arguments.out / "worlds.gif", TICK_MS)


if __name__ == "__main__":
    main()
