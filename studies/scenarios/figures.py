"""Figures of the series: maps, distributions over cells, curves over severity."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.datagen import generate, load_recipe, recipe_from_dict
from benchnav.viz import draw_estimates, legend_outside, panel_grid, show_map, styled
from benchnav.viz.maps import frame_map
from benchnav.viz.style import BLUE, ORANGE
from studies.scenarios.statistics import (
    SHARE_EDGES,
    SLOPE_EDGES,
    Maps,
    Statistic,
    estimate,
    first,
    histogram,
    rms,
)
from studies.study import Work

EXAMPLE = 13  # index of the map of test/std that all figures of the page show
COLOURS = {"std": "#222222", "hg": ORANGE, "hs": BLUE}
# Label, marker and line style of an error, by the classes that it is computed with.
SOURCES = {
    "none": ("no class known", "", ":"),
    "predicted": ("classes predicted", "o", "-"),
    "true": ("true classes", "s", "--"),
}
EXAMPLES = {
    "hg-100": "hg, severity 1",
    "hg-050": "hg, severity 0.5",
    "std": "std (severity 0)",
    "hs-050": "hs, severity 0.5",
    "hs-100": "hs, severity 1",
}
LAYERS: dict[str, tuple[str, dict[str, Any]]] = {
    "slope_deg": ("slope [°]", {"cmap": "cividis", "vmin": 0, "vmax": 25}),
    "error predicted": ("error of E[λ]", {"cmap": "PuOr", "vmin": -0.4, "vmax": 0.4}),
}
RAIN = {
    "classes": ["wet_clay", "packed_soil", "loose_soil", "fine_sand"],
    "colour": [36, 30, 26],
    "share": 0.5,
}
TINTS: dict[str, Any] = {
    "std": {"preset": "std"},
    "wet": {"preset": "wet"},
    "tint of soil and sand": {"preset": "std", "tints": [RAIN]},
    "snow, severity 0.5": {"preset": "snow", "severity": 0.5},
    "snow": {"preset": "snow"},
}


def _show_row(
    panels: Iterable[Axes], maps: Iterable[np.ndarray], extent_m: Any, **style: Any
) -> Any:
    """Draw maps in a row of panels; return the last image."""
    for panel, values in zip(panels, maps, strict=True):
        image = show_map(panel, values, extent_m, **style)
        frame_map(panel)
        panel.set(xticks=(0, 16, 32), yticks=(0, 16, 32))
    return image


def _picture(rgb: np.ndarray) -> np.ndarray:
    return np.moveaxis(rgb, 0, -1)


@styled()
def draw_examples(pairs: Mapping[str, Maps], extent_m: tuple[float, float]) -> Figure:
    """Draw one map in hg, std and hs: picture, slope and error of predicted E[λ]."""
    figure = Figure(figsize=(7.2, 4.25), layout="compressed")
    panels = figure.subplots(3, len(EXAMPLES), sharex=True, sharey=True)
    shown = [pairs[name] for name in EXAMPLES]
    _show_row(panels[0], (_picture(maps["rgb"][EXAMPLE]) for maps in shown), extent_m)
    for row, (layer, (label, style)) in zip(panels[1:], LAYERS.items(), strict=True):
        image = _show_row(
            row, (maps[layer][EXAMPLE] for maps in shown), extent_m, **style
        )
        figure.colorbar(image, ax=row, label=label, extend="both", pad=0.015, aspect=14)
    for panel, title in zip(panels[0], EXAMPLES.values(), strict=True):
        panel.set_title(title)
    figure.supxlabel("x [m]")
    figure.supylabel("y [m]")
    return figure


@styled()
def draw_tints(work: Work, folder: Path) -> dict[str, Figure]:
    """Draw the picture of one map under each tint of `TINTS`."""
    data = load_recipe("shift-v1").to_dict()
    splits = {"test/std": {"scenario": "one", "maps": EXAMPLE + 1}}
    pictures = []
    for title, entry in TINTS.items():
        changes = {"scenarios": {"one": entry}, "splits": splits}
        recipe = recipe_from_dict(data | changes, title)
        maps = generate(recipe, "test/std", np.array([EXAMPLE]))
        pictures.append(_picture(maps["rgb"][0]))
    figure, places = panel_grid(list(TINTS), len(TINTS), 1.5, 0.25, sharey=True)
    _show_row([panel for (panel,) in places], pictures, recipe.grid.extent_m)
    figure.supxlabel("x [m]")
    return {"tints": figure}


@styled()
def draw_distributions(series: Mapping[str, Maps], steepest: float) -> Figure:
    """Draw the fractions of cells in std, hg and hs above each slope, λ and brightness."""
    labels = ("(a) slope [°]", "(b) realised λ", "(c) brightness (1 is full light)")
    figure, places = panel_grid(labels, 3, 2.0)
    panels = [panel for (panel,) in places]
    for name, dashes in (("std", "-"), ("hg-100", "-"), ("hs-100", "--")):
        maps = series[name]
        counts = (
            (maps["slope"], SLOPE_EDGES),
            (maps["lambda"], SHARE_EDGES),
            (histogram(maps["brightness"], SHARE_EDGES), SHARE_EDGES),
        )
        for panel, (count, edges) in zip(panels, counts, strict=True):
            above = 1 - np.r_[0, count.sum(0).cumsum()] / count.sum()
            panel.plot(
                edges,
                above,
                color=COLOURS[name[:3].strip("-")],
                ls=dashes,
                lw=1.3,
                label=name,
            )
    panels[0].axvline(
        steepest, color="0.5", lw=0.8, ls=":", label="steepest in training"
    )
    panels[0].set(
        xlim=(0, 38), yscale="log", ylim=(1e-5, 1.1), ylabel="fraction of cells above"
    )
    panels[2].set_xlim(0.2, 1)
    legend_outside(figure)
    return figure


@styled()
def draw_series(series: Mapping[str, Maps]) -> Figure:
    """Draw accuracy and error over severity, and accuracy over brightness for hs.

    The third panel has one point per map.
    """
    figure, panels = panel_grid(["(a)", "(b)", "(c)"], 3, 2.2)
    accuracy, error, of_maps = (panel for (panel,) in panels)
    for preset in ("hg", "hs"):
        by_severity = _by_severity(series, (preset, "std"))
        style = {"color": COLOURS[preset], "ms": 3.5, "lw": 1.2}
        for source, (words, marker, dashes) in SOURCES.items():
            look = style | {"marker": marker, "ls": dashes}
            label = f"{preset}, {words}"
            _draw_estimates(error, by_severity, f"square {source}", rms, look, label)
        look = style | {"marker": "o"}
        _draw_estimates(accuracy, by_severity, "right", first, look)
    _draw_maps(figure, of_maps, _by_severity(series, ("hs",)))
    lit = np.median(series["std"]["brightness"], axis=(1, 2))
    of_maps.axvspan(
        lit.min(), lit.max(), color="0.88", lw=0, zorder=0, label="light of std"
    )
    accuracy.set(xlabel="severity", ylabel="pixel accuracy [%]", ylim=(0, 100))
    error.set(xlabel="severity", ylabel="RMS error of E[λ] [%]", ylim=(0, 15))
    of_maps.set(
        xlabel="median brightness of a map",
        ylabel="pixel accuracy of a map [%]",
        ylim=(-2, 102),
    )
    legend_outside(figure)
    return figure


def _draw_maps(figure: Figure, panel: Axes, dark: Mapping[float, Maps]) -> None:
    """Draw the accuracy of each map over its brightness, coloured by severity."""
    light, accuracy, severity = [], [], []
    for value, maps in dark.items():
        light.append(np.median(maps["brightness"], axis=(1, 2)))
        accuracy.append(100 * maps["right"].mean(axis=(1, 2)))
        severity.append(np.full(len(maps["right"]), value))
    points = panel.scatter(
        np.concatenate(light),
        np.concatenate(accuracy),
        c=np.concatenate(severity),
        cmap="viridis_r",
        s=4,
        lw=0,
    )
    figure.colorbar(points, ax=panel, label="severity of hs")


def _draw_estimates(
    panel: Axes,
    by_severity: Mapping[float, Maps],
    key: str,
    statistic: Statistic,
    look: Mapping[str, Any],
    label: str = "",
) -> None:
    """Draw a statistic in per cent over severity, with standard errors."""
    estimates = [estimate([maps[key]], statistic) for maps in by_severity.values()]
    value, error = 100 * np.array(estimates).T
    severities = list(by_severity)
    low, high = value - error, value + error
    draw_estimates(panel, severities, value, low, high, look, label, bars=True)


def _by_severity(
    series: Mapping[str, Maps], prefixes: tuple[str, ...]
) -> dict[float, Maps]:
    return {
        _severity(name): maps
        for name, maps in series.items()
        if name.startswith(prefixes)
    }


def _severity(name: str) -> float:
    return 0.0 if name == "std" else int(name[-3:]) / 100
