"""Figures of the series: examples of maps, distributions of their cells, and curves over severity."""

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.viz.style import styled
from studies.scenarios.statistics import SHARE_EDGES, SLOPE_EDGES, Maps, estimate, first, histogram, rms

EXAMPLE = 13
COLOURS = {"std": "#222222", "hg": "#D55E00", "hs": "#0072B2"}  # of Okabe and Ito, distinct for everyone
NOTE: dict[str, Any] = {"fontsize": 7, "color": "0.35"}


@styled()
def draw_examples(pairs: Mapping[str, Maps], extent_m: tuple[float, float]) -> Figure:
    """One map in hg, std and hs: its picture, its slope, and the error of its predicted E[λ]."""
    titles = ("hg, severity 1", "hg, severity 0.5", "std (severity 0)", "hs, severity 0.5", "hs, severity 1")
    names = ("hg-100", "hg-050", "std", "hs-050", "hs-100")
    looks = {"slope_deg": ("cividis", 0.0, 25.0, "slope [°]", "max")}
    looks["error predicted"] = ("PuOr", -0.4, 0.4, "error of E[λ]", "both")
    figure = Figure(figsize=(7.2, 4.25), layout="compressed")
    panels = figure.subplots(3, len(names), sharex=True, sharey=True)
    where: dict[str, Any] = {"extent": (0, extent_m[0], 0, extent_m[1]), "origin": "lower"}
    for panel, name, title in zip(panels[0], names, titles, strict=True):
        panel.imshow(np.moveaxis(pairs[name]["rgb"][EXAMPLE], 0, -1), **where)
        panel.set(title=title, xticks=(0, 16, 32), yticks=(0, 16, 32))
    for row, (layer, (colours, low, high, label, extend)) in zip(panels[1:], looks.items(), strict=True):
        for panel, name in zip(row, names, strict=True):
            image = panel.imshow(pairs[name][layer][EXAMPLE], cmap=colours, vmin=low, vmax=high, **where)
        figure.colorbar(image, ax=row, label=label, extend=extend, pad=0.015, aspect=14, extendfrac=0.06)
    for panel in panels[:, 0]:
        panel.set_ylabel("y [m]")
    for panel in panels[-1]:
        panel.set_xlabel("x [m]")
    return figure


@styled()
def draw_distributions(series: Mapping[str, Maps], steepest: float) -> Figure:
    """Slope, λ and brightness of all cells in std, hg and hs."""
    figure, panels = _three_panels(2.5)
    for name, dashes in (("std", "-"), ("hg-100", "-"), ("hs-100", (0, (4, 1.5)))):
        maps: Maps = series[name]
        look: dict[str, Any] = {"color": COLOURS[name.split("-")[0]], "ls": dashes, "lw": 1.3, "label": name}
        counts = [maps["slope"], maps["lambda"], histogram(maps["brightness"], SHARE_EDGES)]
        slope, traversability, light = (np.r_[0, c.sum(0).cumsum()] / c.sum() for c in counts)
        panels[0].plot(SLOPE_EDGES[slope < 1], 1 - slope[slope < 1], **look)
        panels[1].plot(SHARE_EDGES, traversability, **look)
        panels[2].plot(SHARE_EDGES, light, **look)
    panels[0].axvline(steepest, color="0.5", lw=0.8, ls=":")
    panels[0].text(steepest - 0.4, 0.6, "steepest in training", rotation=90, ha="right", va="top", **NOTE)
    panels[0].set(xlabel="slope ψ [°]", ylabel="share of cells steeper than ψ", yscale="log")
    panels[0].set(xlim=(0, 38), ylim=(1e-5, 1))
    panels[1].set(xlabel="realised traversability λ", ylabel="share of cells at or under λ")
    panels[2].set(xlabel="brightness [share of full light]", ylabel="share of cells at or under it")
    for panel, start in zip(panels[1:], (0, 0.2), strict=True):
        panel.set(xlim=(start, 1), ylim=(0, 1))
    panels[1].legend(frameon=False, loc="upper left")
    return figure


@styled()
def draw_series(series: Mapping[str, Maps]) -> Figure:
    """Accuracy and error over severity, and the accuracy of each map in low light over its brightness."""
    figure, panels = _three_panels(2.6)
    sources = {"none": ("no class known", "", ":"), "predicted": ("classes predicted", "o", "-")}
    sources["true"] = ("true classes", "s", "--")
    for preset, colour in list(COLOURS.items())[1:]:
        pairs = {0.0: series["std"]} | {_severity(n): m for n, m in series.items() if n.startswith(preset)}
        curves = [(panels[0], [estimate([100 * m["right"]], first) for m in pairs.values()], "o", "-")]
        for source, (_, marker, dashes) in sources.items():
            values = [estimate([m[f"square {source}"]], rms) for m in pairs.values()]
            curves.append((panels[1], values, marker, dashes))
        for panel, values, marker, dashes in curves:
            look = {"color": colour, "marker": marker, "ls": dashes, "label": preset, "mfc": "white"}
            panel.errorbar(list(pairs), *zip(*values, strict=True), lw=1.2, ms=3.5, capsize=2, **look)
    keys = [
        Line2D([], [], color="0.3", mfc="white", ms=3.5, label=n, marker=m, ls=d)
        for n, m, d in sources.values()
    ]
    panels[0].legend(frameon=False, loc="lower left")
    panels[1].legend(handles=keys, frameon=False, loc="upper left", handlelength=2.6)
    dark = [name for name in series if name.startswith("hs")]
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.1, 1, len(dark)))
    for name, shade in zip(dark, shades, strict=True):
        light, right = (
            np.median(series[name]["brightness"], axis=(1, 2)),
            series[name]["right"].mean(axis=(1, 2)),
        )
        panels[2].plot(light, 100 * right, "o", ms=2.4, mew=0, color=shade, label=f"{_severity(name):g}")
    lit = np.median(series["std"]["brightness"], axis=(1, 2))
    panels[2].axvspan(lit.min(), lit.max(), color="0.88", lw=0)
    panels[2].text(lit.mean(), 4, "light\nof std", ha="center", **NOTE)
    panels[2].legend(frameon=False, loc="upper left", title="severity of hs", title_fontsize=7)
    for panel in panels[:2]:
        panel.set(xlabel="severity", xticks=(0, 0.5, 1, 1.5))
    panels[0].set(ylabel="pixel accuracy [%]", ylim=(0, 100))
    panels[1].set(ylabel="RMS error of E[λ]", ylim=(0, 0.15))
    panels[2].set(xlabel="median brightness of a map", ylabel="pixel accuracy of a map [%]")
    panels[2].set(xlim=(0, 1), ylim=(-2, 100))
    return figure


def _three_panels(height_in: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(7.2, height_in), layout="constrained")
    panels = figure.subplots(1, 3)
    for panel, letter in zip(panels, "abc", strict=True):
        panel.set_title(f"({letter})", loc="left")
        panel.grid(alpha=0.25, lw=0.5)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, panels


def _severity(name: str) -> float:
    return int(name[-3:]) / 100
