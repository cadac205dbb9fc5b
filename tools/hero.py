"""Draw the picture and the animation of README.md: one map under two risk settings.

    benchnav-eval run --config demo --out runs/demo
    python tools/hero.py runs/demo

This writes docs/figures/hero.png and docs/figures/hero.gif. On the map, the robot under
the first setting is immobilised and that under the second reaches the goal. Among such
maps, it is the one whose driven paths are farthest apart.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import Axes3D
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from benchnav.eval.figures.moment import drive_at
from benchnav.eval.folder.results import read_results
from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.video import SPEED, Frames
from benchnav.eval.run.recordings import record_driven
from benchnav.viz import drives, maps
from benchnav.viz.style import BLUE, ORANGE, save, styled

FIGURES = Path(__file__).parents[1] / "docs/figures"
RISKS = {"mean": ("mean of λ", BLUE), "cvar:0.8": ("CVaR of λ at 0.8", ORANGE)}
TICK_MS, GIF_SIZE = 120, (800, 450)
CAUGHT = "immobilises a robot; no image shows it"
Pair = tuple[Recording, Recording]


def find_pair(folder: Path) -> Pair:
    """Return the recordings of both settings on the map of the module's docstring."""
    rows = read_results(folder, False).episodes
    first, second = (
        rows[(rows["risk"] == risk) & (rows["planner"] == "astar_dwa")]
        for risk in RISKS
    )
    keys = ["seed", "realisation", "map"]
    shared = first[first["outcome"] == "immobilised"].merge(
        second[second["success"]], on=keys
    )[keys]
    pairs = zip(
        *(driven(folder, ended.merge(shared, on=keys)) for ended in (first, second)),
        strict=True,
    )
    return max(pairs, key=lambda pair: apart(pair[0].track, pair[1].track))


def driven(folder: Path, rows: pd.DataFrame) -> list[Recording]:
    """Return the recordings of one condition's episodes, in order."""
    return list(record_driven(folder, rows.reset_index(drop=True)))


def apart(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest distance of a position of path `a` to path `b`, in metres."""
    return float(np.linalg.norm(a[:, None] - b[None], axis=-1).min(1).max())


def heights(recording: Recording, positions: np.ndarray) -> np.ndarray:
    """Return the smoothed elevation at positions (x, y), in metres."""
    column, row = (positions / recording.resolution_m - 0.5).T
    smooth = gaussian_filter(recording.elevation_m, 1.0)
    return map_coordinates(smooth, (row, column), order=1, mode="nearest")


def draw_terrain(panel: Axes3D, pair: Pair) -> None:
    """Draw the terrain in perspective with both paths and the immobilising cells."""
    first = pair[0]
    rows, columns = first.elevation_m.shape
    x, y = ((np.arange(size) + 0.5) * first.resolution_m for size in (columns, rows))
    # The image is shaded already. The exponent darkens it, since it is light.
    colours = (np.moveaxis(first.rgb, 0, -1) / 255) ** 1.4
    colours[first.immobilising] = to_rgb(maps.IMMOBILISING)
    panel.computed_zorder = False
    panel.plot_surface(
        *np.meshgrid(x, y),
        first.elevation_m,
        facecolors=colours,
        rstride=1,
        cstride=1,
        lw=0,
        antialiased=False,
        shade=False,
        zorder=1,
    )
    for recording, (name, colour) in zip(pair, RISKS.values(), strict=True):
        high = heights(recording, recording.track) + 0.3
        for edge, width in (("white", 4.2), (colour, 2.2)):
            label = f"planned on the {name}" if edge == colour else "_edge"
            panel.plot(
                *recording.track.T, high, color=edge, lw=width, label=label, zorder=3
            )
    end = first.track[-1]
    positions = {"start": first.track[0], "goal": first.goal_m, "immobilised": end}
    for (name, (x_m, y_m)), top in zip(
        positions.items(),
        heights(first, np.array(list(positions.values()))),
        strict=True,
    ):
        panel.plot(
            [x_m],
            [y_m],
            [top + 0.4],
            **drives.MARKS[name] | {"ms": 1.3 * drives.MARKS[name]["ms"]},
        )
    panel.set_box_aspect((1, rows / columns, 0.22), zoom=1.15)
    panel.view_init(elev=50, azim=-62)
    panel.set_axis_off()


@styled()
def draw_hero(pair: Pair) -> Figure:
    """Draw the terrain with both paths, and both maps of λ̂."""
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    places = figure.add_gridspec(1, 4, width_ratios=(1.45, 1, 1, 0.05))
    terrain = figure.add_subplot(places[0], projection="3d")
    draw_terrain(terrain, pair)
    handles, _ = terrain.get_legend_handles_labels()
    handles.append(Patch(color=maps.IMMOBILISING, label=CAUGHT))
    terrain.legend(
        handles=handles, loc="lower left", fontsize=8, bbox_to_anchor=(0, -0.08)
    )
    for index, recording in enumerate(pair):
        panel = figure.add_subplot(places[1 + index])
        name, colour = RISKS[recording.about["risk"]]
        extent_m = recording.grid.extent_m
        image = maps.show_map(panel, recording.predicted, extent_m, **maps.LAMBDA)
        maps.overlay(panel, recording.immobilising, extent_m, maps.IMMOBILISING)
        whole_drive = drive_at(recording, len(recording.actions))
        drives.draw_drive(panel, whole_drive, 2.2, 1.2, colour)
        panel.set(xticks=[], yticks=[])
        panel.set_title(
            f"λ̂ = {name}: {recording.outcome} after {recording.end_s:.0f} s", fontsize=9
        )
        maps.draw_scale(panel, extent_m, 8)
    figure.colorbar(
        image,
        cax=figure.add_subplot(places[3]),
        label="λ̂, fraction of the commanded speed",
    )
    return figure


def frames(
    recordings: Sequence[Recording], until_s: float, tick_ms: int = TICK_MS
) -> Iterator[Image.Image]:
    """Yield frames of the video of episodes up to a time, and at the end."""
    video = Frames(recordings)
    end_s = max(recording.end_s for recording in recordings)
    for time_s in [*np.arange(0, until_s, SPEED * tick_ms / 1000), end_s]:
        # This filter draws no rings around the edges of cells.
        yield Image.fromarray(video.draw(float(time_s))).resize(
            GIF_SIZE, Image.Resampling.HAMMING
        )


def write_gif(
    images: Sequence[Image.Image],
    path: Path,
    tick_ms: int = TICK_MS,
) -> None:
    """Write frames as a GIF with one palette.

    Maximum coverage keeps colours of few pixels, such as those of the marks.
    """
    palette = images[len(images) // 2].quantize(256, method=Image.Quantize.MAXCOVERAGE)
    first, *rest = (
        image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images
    )
    first.save(
        path,
        save_all=True,
        append_images=rest,
        duration=[tick_ms] * len(rest) + [2500],
        loop=0,
        optimize=True,
    )


def main() -> None:
    """Draw the picture and the animation."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=FIGURES)
    arguments = parser.parse_args()
    pair = find_pair(arguments.run)
    print(f"map {pair[0].about['map']}")
    save(draw_hero(pair), arguments.out / "hero.png", "png", dpi=170)
    end_s = max(recording.end_s for recording in pair)
    write_gif(list(frames(pair, end_s)), arguments.out / "hero.gif")


if __name__ == "__main__":
    main()
