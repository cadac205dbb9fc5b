"""Success of each setting in one world against its success in another."""

import textwrap
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D

from benchnav.eval.figures.data import RunData
from benchnav.eval.stats.world_blocks import BLOCK_LABELS, SETTING_LABELS
from benchnav.eval.words import contender_names, joined, world_names
from benchnav.viz.figure import Figure
from benchnav.viz.panels import GRID, panel_grid
from benchnav.viz.style import (
    LINE_COLOURS,
    MARKERS,
    condition_colours,
    legend_outside,
)

_PANEL_IN = 2.5  # height of a panel in inches
_MAX_ACROSS = 3  # panels next to each other
_LEGEND_LINE_IN = 0.16
_MAX_PAIRS = 12  # maximum number of pairs of worlds that are all shown
_MAX_LETTERS = 22  # in a line of an axis label
_MARGIN = 0.03  # distance from an interval to the frame, as a success rate


class WorldAgreement(Figure):
    """Success in two worlds, one panel per pair of worlds and block."""

    name = "between-worlds"

    def is_available(self, data: RunData) -> bool:
        """Return whether settings were run in two worlds."""
        return bool(_pairs(data))

    def caption(self, data: RunData) -> str:
        """Return a caption that explains points, lines and numbers."""
        settings = data.between.settings
        sentences = [
            "Success of each setting in two worlds, with 95 % intervals. On the dashed "
            "line, both are equal.",
            "r is Pearson's correlation. MMRV is the mean maximum rank violation by "
            "differences in the world on the horizontal axis.",
        ]
        if _has_robust(settings):
            sentences.append("Filled points are in the best set of all worlds.")
        if _is_cut(data):
            sentences.append("Only pairs with the first world are shown.")
        return " ".join(sentences)

    def draw(self, data: RunData) -> Drawing:
        """Draw a panel for each pair of worlds with common settings, block by block."""
        pairs = _pairs(data)
        settings = _named(data.between.settings)
        by_name = settings.drop_duplicates("name")
        names = list(by_name["name"])
        looks = _looks(names, list(by_name["planner"]))
        differing = [name for name in BLOCK_LABELS if settings[name].nunique() > 1]
        titles = [_title(pair, differing) for pair, _ in pairs]
        across = min(len(pairs), _MAX_ACROSS)
        columns = 4 if across > 1 else 2
        n_lines = -(-len(names) // columns) + 1
        figure, grid = panel_grid(titles, across, _PANEL_IN, _LEGEND_LINE_IN * n_lines)
        short_names = world_names(data.between.worlds)
        is_filled = _has_robust(settings)
        for (panel,), (pair, rows) in zip(grid, pairs, strict=True):
            _draw_pair(panel, rows, looks, is_filled)
            panel.set_xlabel(_axis_label(short_names[pair["world"]]))
            panel.set_ylabel(_axis_label(short_names[pair["other"]]))
        face: dict[str, Any] = {} if is_filled else {"mfc": "white"}
        handles = [
            Line2D([], [], ls="none", ms=4.5, label=name, **looks[name], **face)
            for name in names
        ]
        legend_outside(figure, handles, 4)
        return figure


def _looks(names: Sequence[str], planners: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return colour and marker of each setting."""
    colours = condition_colours(planners, LINE_COLOURS)
    looks = {}
    for index, (name, colour) in enumerate(zip(names, colours, strict=True)):
        marker = MARKERS[index % len(MARKERS)]
        looks[name] = {"color": colour, "marker": marker}
    return looks


def _named(settings: pd.DataFrame) -> pd.DataFrame:
    """Return the table of settings with a column `name`."""
    labels = settings[list(SETTING_LABELS)]
    return settings.assign(name=contender_names(labels.to_dict("records")))


def _pairs(data: RunData) -> list[tuple[dict[Any, Any], pd.DataFrame]]:
    """Return the shown rows of the table of agreement, each with its settings."""
    agreement = data.between.agreement
    if agreement.empty:
        return []
    if _is_cut(data):
        agreement = agreement[agreement["world"] == data.between.worlds[0]]
    settings = _named(data.between.settings).dropna(subset="success_rate")
    pairs = []
    for pair in agreement.to_dict("records"):
        rows = _in_both(settings, pair)
        if not rows.empty:
            pairs.append((pair, rows))
    return pairs


def _is_cut(data: RunData) -> bool:
    n_pairs = len(list(combinations(data.between.worlds, 2)))
    return n_pairs > _MAX_PAIRS


def _has_robust(settings: pd.DataFrame) -> bool:
    """Return whether some, but not all, competing settings are in the robust set."""
    robust = settings.loc[settings["competes"], "robust"]
    return bool(robust.any() and not robust.all())


def _in_both(settings: pd.DataFrame, pair: Mapping[Any, Any]) -> pd.DataFrame:
    """Return the settings of a block in both worlds, one row per setting.

    Columns of the other world end in `_other`.
    """
    block = settings
    for name in BLOCK_LABELS:
        block = block[block[name] == pair[name]]
    first = block[block["world"] == pair["world"]]
    second = block[block["world"] == pair["other"]]
    return first.merge(second, on=list(SETTING_LABELS), suffixes=("", "_other"))


def _draw_pair(
    panel: Axes,
    rows: pd.DataFrame,
    looks: Mapping[str, Mapping[str, Any]],
    is_filled: bool,
) -> None:
    lows = rows[["success_low", "success_low_other"]].to_numpy()
    highs = rows[["success_high", "success_high_other"]].to_numpy()
    limits = (100 * (lows.min() - _MARGIN), 100 * (highs.max() + _MARGIN))
    panel.plot(limits, limits, color="0.6", lw=0.7, ls="--", zorder=0)
    for row in rows.to_dict("records"):
        look = looks[row["name"]]
        x, low, high = _in_percent(row, "")
        y, low_other, high_other = _in_percent(row, "_other")
        line: dict[str, Any] = {"color": look["color"], "lw": 0.8, "zorder": 2}
        panel.hlines(y, low, high, **line)
        panel.vlines(x, low_other, high_other, **line)
        face = look["color"] if row["robust"] and is_filled else "white"
        panel.plot(x, y, ls="none", ms=4.5, mfc=face, zorder=3, **look)
    step = 10 if limits[1] - limits[0] < 50 else 20
    ticks = np.arange(step * np.ceil(limits[0] / step), limits[1], step)
    panel.set(xlim=limits, ylim=limits, aspect="equal", xticks=ticks, yticks=ticks)
    panel.grid(color=GRID)
    panel.set_axisbelow(True)


def _in_percent(row: Mapping[Any, Any], suffix: str) -> list[float]:
    return [100 * row[f"success_{name}{suffix}"] for name in ("rate", "low", "high")]


def _title(pair: Mapping[Any, Any], columns: Sequence[str]) -> str:
    """Return the block of a pair of worlds, its correlation and rank violation."""
    block = joined(str(pair[name]) for name in columns)
    words = [f"MMRV {100 * pair['mmrv']:.1f}"]
    if not np.isnan(pair["pearson"]):
        words.insert(0, f"r {pair['pearson']:.2f}")
    numbers = ", ".join(words)
    return f"{block}: {numbers}" if block else numbers


def _axis_label(world: str) -> str:
    """Return the label of an axis, broken into lines that fit a panel."""
    lines = textwrap.wrap(world, _MAX_LETTERS, break_long_words=False)
    return "\n".join(["success [%] in", *lines])
