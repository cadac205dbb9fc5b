"""A picture of maps: one row a map, with colour, classes, elevation, slope and traversability."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from benchnav.datagen.appearance import light_direction, shade
from benchnav.datagen.store import TerrainDataset

_TITLES = ("colour", "class", "elevation [m]", "slope [°]", "traversability λ")


def save_preview(dataset: TerrainDataset, split: str, indices: Sequence[int], path: Path, kind: str) -> None:
    """Draws maps of a split to an image file.

    Args:
        dataset: where the maps are.
        split: name of a split.
        indices: which maps, ascending.
        path: file to write.
        kind: format of the picture, such as png.
    """
    maps = dataset.read(split, indices)
    rows = len(indices)
    figure = Figure(figsize=(13.2, 2.15 * rows + 0.45), layout="constrained")
    panels = figure.subplots(rows, 5, squeeze=False)
    for row, index in enumerate(indices):
        entry = {name: values[row] for name, values in maps.items()}
        _draw_row(figure, panels[row], dataset, entry)
        panels[row, 0].set_ylabel(f"{split} · map {index}\ny [m]")
        for panel in panels[row]:
            panel.set_xlabel("x [m]" if row == rows - 1 else "")
    for panel, title in zip(panels[0], _TITLES, strict=True):
        panel.set_title(title, fontsize=10)
    figure.savefig(path, dpi=130, format=kind)


def _draw_row(
    figure: Figure, panels: Sequence[Axes], dataset: TerrainDataset, entry: dict[str, np.ndarray]
) -> None:
    width, height = dataset.grid.extent_m
    extent = (0, width, 0, height)
    classes = dataset.recipe.classes
    steep = dataset.recipe.resolution_m
    z = entry["elevation_m"].astype(np.float64)

    panels[0].imshow(np.moveaxis(entry["rgb"], 0, -1), origin="lower", extent=extent)

    shown = np.unique(entry["class_id"])
    palette = ListedColormap(matplotlib.colormaps["tab10"](shown % 10))
    image = panels[1].imshow(
        np.searchsorted(shown, entry["class_id"]), origin="lower", extent=extent, cmap=palette,
        vmin=-0.5, vmax=len(shown) - 0.5,
    )  # fmt: skip
    bar = figure.colorbar(image, ax=panels[1], ticks=range(len(shown)), fraction=0.046)
    bar.ax.set_yticklabels([classes[c].name.replace("_", " ") for c in shown], fontsize=7)

    light = light_direction(np.array([0.75 * np.pi]), np.array([0.7]))
    hill = shade(3 * z[None], steep, light, 0.2)[0]
    image = panels[2].imshow(z, origin="lower", extent=extent, cmap="terrain")
    panels[2].imshow(hill, origin="lower", extent=extent, cmap="gray", alpha=0.35)
    y, x = ((np.arange(n) + 0.5) * steep for n in z.shape)
    panels[2].contour(x, y, z, levels=8, colors="k", linewidths=0.35)
    figure.colorbar(image, ax=panels[2], fraction=0.046)

    image = panels[3].imshow(entry["slope_deg"], origin="lower", extent=extent, cmap="magma", vmin=0, vmax=30)
    figure.colorbar(image, ax=panels[3], fraction=0.046, extend="max")
    image = panels[4].imshow(
        entry["traversability"], origin="lower", extent=extent, cmap="RdYlGn", vmin=0, vmax=1
    )
    figure.colorbar(image, ax=panels[4], fraction=0.046)
    for panel in panels:
        panel.plot(*entry["start_m"], "o", color="red", mec="white", ms=6)
        panel.plot(*entry["goal_m"], "X", color="magenta", mec="white", ms=8)
        panel.tick_params(labelsize=7)
