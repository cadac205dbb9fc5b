"""Draws the picture and the moving picture of README.md: one map, two risk settings, one robot that was immobilised.

    benchnav-eval run --config demo --record all --out runs/hero
    python benchmarks/hero.py runs/hero

writes docs/figures/hero.png and docs/figures/hero.gif, in a minute. The map is the one on which the first setting is
immobilised and the second arrives, and the driven paths lie farthest apart.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patheffects import Normal, Stroke
from mpl_toolkits.mplot3d import Axes3D
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from benchnav.eval.recording import Recording
from benchnav.viz.style import MARKS, mark, robot_marker, styled

FIGURES = Path(__file__).parents[1] / "docs/figures"
COLOURS, NAMES = ("#D55E00", "#0072B2"), ("mean of λ", "CVaR of λ at 0.8")
EDGE = [Stroke(linewidth=5, foreground="white"), Normal()]
RISKS = {"mean", "cvar:0.8"}
FRAMES, TICK_MS = 70, 90


def find_pair(folder: Path) -> tuple[Recording, Recording]:
    """Recordings of the two settings on the map where their paths lie farthest apart and their outcomes differ."""
    recordings = [Recording.load(path) for path in sorted((folder / "playback").glob("*.npz"))]
    by_map: dict[int, dict[str, Recording]] = {}
    for own in recordings:
        by_map.setdefault(int(own.about["map"]), {})[str(own.about["risk"])] = own
    pairs = [(both["mean"], both["cvar:0.8"]) for both in by_map.values() if set(both) >= RISKS]
    telling = [
        (one, other)
        for one, other in pairs
        if (one.about["outcome"], other.about["outcome"]) == ("immobilised", "success")
    ]
    return max(telling, key=lambda pair: apart(*(own.track for own in pair)))


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """The largest distance of a place on a path to another path, in metres."""
    return float(np.linalg.norm(one[:, None] - other[None], axis=-1).min(1).max())


def heights(recording: Recording, places: np.ndarray) -> np.ndarray:
    """Elevation at places (x, y), smooth from cell to cell."""
    column, row = (places / recording.resolution_m - 0.5).T
    return map_coordinates(
        gaussian_filter(recording.elevation_m, 1.0), (row, column), order=1, mode="nearest"
    )


def draw_ground(panel: Axes3D, pair: tuple[Recording, Recording]) -> None:
    """The terrain from the side, with both paths."""
    ground = pair[0]
    rows, columns = ground.elevation_m.shape
    x, y = ((np.arange(size) + 0.5) * ground.resolution_m for size in (columns, rows))
    colours = (np.moveaxis(ground.rgb, 0, -1) / 255) ** 1.4  # which are shaded, and light
    panel.computed_zorder = False
    panel.plot_surface(
        *np.meshgrid(x, y), ground.elevation_m, facecolors=colours, rstride=1, cstride=1, lw=0, antialiased=False,
        shade=False, zorder=1,
    )  # fmt: skip
    for own, colour, name in zip(pair, COLOURS, NAMES, strict=True):
        high = heights(own, own.track) + 0.3
        panel.plot(
            *own.track.T,
            high,
            color=colour,
            lw=2.2,
            label=f"planned on the {name}",
            zorder=3,
            path_effects=EDGE,
        )
    held = pair[0].track[-1]
    top = heights(ground, np.array([ground.track[0], ground.goal_m, held])) + 0.4
    places = {"start": ground.track[0], "goal": ground.goal_m, "immobilised": held}
    for (name, (x_m, y_m)), height in zip(places.items(), top, strict=True):
        panel.plot([x_m], [y_m], [height], **MARKS[name] | {"ms": 1.3 * MARKS[name]["ms"], "zorder": 4})
    panel.set_box_aspect((1, rows / columns, 0.22), zoom=1.18)
    panel.view_init(elev=42, azim=-62)
    panel.set_axis_off()


def draw_map(panel: Axes, own: Recording, place: int) -> AxesImage:
    """λ̂ under a risk setting, with the path that was driven on it; gives the image."""
    width, height = own.grid.extent_m
    image = panel.imshow(
        own.predicted, origin="lower", extent=(0, width, 0, height), cmap="viridis", vmin=0, vmax=1
    )
    panel.plot(*own.track.T, color=COLOURS[place], lw=2, path_effects=EDGE)
    mark(panel, "start", own.track[0], 1.2)
    mark(panel, "goal", own.goal_m, 1.2)
    arrived = own.about["outcome"] == "success"
    end = "arrived" if arrived else "immobilised"
    if not arrived:
        mark(panel, "immobilised", own.track[-1], 1.2)
    panel.set_title(f"λ̂ = {NAMES[place]}: {end} after {len(own.actions) * own.dt_s:.0f} s", fontsize=9)
    panel.set(xticks=[], yticks=[])
    return image


@styled()
def draw_hero(pair: tuple[Recording, Recording]) -> Figure:
    """The ground with both paths, and both maps of λ̂."""
    figure = Figure(figsize=(10.5, 3.2), layout="constrained")
    places = figure.add_gridspec(1, 4, width_ratios=(1.45, 1, 1, 0.05))
    ground = figure.add_subplot(places[0], projection="3d")
    draw_ground(ground, pair)
    ground.legend(loc="lower left", fontsize=8, frameon=False)
    images = [draw_map(figure.add_subplot(places[1 + place]), own, place) for place, own in enumerate(pair)]
    bar = figure.add_subplot(places[3])
    figure.colorbar(images[0], cax=bar, label="λ̂, share of the commanded speed")
    return figure


@styled()
def frames(pair: tuple[Recording, Recording]) -> Iterator[Image.Image]:
    """Both robots on the λ̂ that their planner was given, over time."""
    ground = pair[0]
    assert ground.field is not None
    width, height = ground.grid.extent_m
    longest = max(len(own.track) for own in pair)
    for now in np.linspace(0, longest - 1, FRAMES).round().astype(int):
        figure = Figure(figsize=(6.4, 3.6), dpi=110, layout="constrained")
        for place, (panel, own) in enumerate(zip(figure.subplots(1, 2), pair, strict=True)):
            panel.imshow(
                own.predicted,
                origin="lower",
                extent=(0, width, 0, height),
                cmap="viridis",
                vmin=0,
                vmax=1,
                alpha=0.8,
            )
            driven = own.track[: now + 1]
            panel.plot(*driven.T, color=COLOURS[place], lw=3, path_effects=EDGE)
            mark(panel, "start", own.track[0], 1.2)
            mark(panel, "goal", own.goal_m, 1.2)
            ended, arrived = now >= len(own.track) - 1, own.about["outcome"] == "success"
            state = ("arrived" if arrived else "immobilised") if ended else "driving"
            heading = robot_marker(own.states[min(now, len(own.track) - 1), 2])
            looks = {} if ended else {"marker": heading}
            mark(panel, state if ended else "robot", driven[-1], 1.4, **looks)
            panel.set_title(f"A*+DWA, {NAMES[place]}: {state}", fontsize=8)
            panel.set(xticks=[], yticks=[])
        figure.supxlabel(f"{now * ground.dt_s:4.1f} s", fontsize=9)
        yield rendered(figure)


def rendered(figure: Figure) -> Image.Image:
    """A figure as an image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=FIGURES)
    given = parser.parse_args()
    pair = find_pair(given.run)
    print(f"map {pair[0].about['map']}")
    draw_hero(pair).savefig(given.out / "hero.png", dpi=170)
    # One palette for all, by coverage, which keeps the colours of few pixels: those of the marks.
    images = list(frames(pair))
    palette = images[FRAMES // 2].quantize(256, method=Image.Quantize.MAXCOVERAGE)
    first, *rest = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    first.save(
        given.out / "hero.gif", save_all=True, append_images=rest, duration=[TICK_MS] * len(rest) + [2500],
        loop=0, optimize=True,
    )  # fmt: skip


if __name__ == "__main__":
    main()
