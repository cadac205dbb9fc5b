"""Waterfall of a contrast of two settings along a series of worlds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.patches import Patch

from benchnav.core.errors import expect
from benchnav.core.settings import check_known
from benchnav.eval.figures.data import RunData
from benchnav.eval.stats.between import contrast_by_world
from benchnav.eval.stats.world_blocks import (
    BLOCK_LABELS,
    SETTING_LABELS,
    Block,
    Setting,
    find_blocks,
)
from benchnav.eval.words import contender_names, joined, world_names
from benchnav.metrics.shipped import SUCCESS
from benchnav.stats.tables import signed, signed_interval
from benchnav.viz.figure import Figure
from benchnav.viz.panels import GRID, draw_interval, panel_grid
from benchnav.viz.style import BLUE, ORANGE, TEXT, TWO_COLUMNS_IN, legend_outside

_ROW_IN = 0.24  # height of a row in inches
_GREY = "0.75"  # colour of the first and the last bar
_BAR: dict[str, Any] = {"height": 0.7, "lw": 0}
_MAX_CONTRASTS = 6
_MIN_WORLDS = 3  # minimum number of worlds for the contrasts of hypotheses


@dataclass(frozen=True, kw_only=True, eq=False)
class _Contrast:
    """A contrast in one block: title, and differences by world."""

    title: str
    table: pd.DataFrame


class Waterfall(Figure):
    """The difference in success of two settings, from world to world.

    Without `one` and `other`, the contrasts are the hypotheses of the run on success,
    if it has three or more worlds.

    Args:
        one: labels that select the first setting of each block, such as {"planner":
            "astar_dwa", "risk": "cvar:0.95"}.
        other: labels that select the setting that is subtracted.
        worlds: labels of the worlds, in the order of the series; if empty, all worlds
            in the order of the run.
        name: name of the figure's files; several waterfalls of a run need several names.
    """

    def __init__(
        self,
        one: dict[str, str] | None = None,
        other: dict[str, str] | None = None,
        worlds: tuple[str, ...] = (),
        name: str = "waterfall",
    ) -> None:
        """Store the contrast.

        Raises:
            ConfigError: If only one of `one` and `other` is given, or a column does not
                exist.
        """
        expect(
            (one is None) == (other is None),
            f"both `one` and `other`, or neither of them, got {one} and {other}.",
        )
        for labels in (one or {}, other or {}):
            for column in labels:
                check_known("labels", column, SETTING_LABELS)
        self.one = one
        self.other = other
        self.worlds = tuple(worlds)
        self.name = name

    def is_available(self, data: RunData) -> bool:
        """Return whether the run has the contrast in several worlds."""
        return bool(self._contrasts(data))

    def caption(self, data: RunData) -> str:
        """Return a caption that explains bars and lines."""
        n_contrasts = len(self._contrasts(data))
        words = (
            "Difference in success of two settings along a series of worlds: in the "
            "first world, its change from each world to the next, and in the last "
            "world, over the same episodes. Black lines are 95 % intervals, of a "
            "change over its paired differences per map. Changes are not causes: "
            "another order of worlds would give other values."
        )
        if n_contrasts > _MAX_CONTRASTS:
            words += (
                f" The first {_MAX_CONTRASTS} of {n_contrasts} contrasts are shown."
            )
        return words

    def draw(self, data: RunData) -> Drawing:
        """Draw a panel for each contrast, with the first world on top."""
        contrasts = self._contrasts(data)[:_MAX_CONTRASTS]
        n_rows = 2 + max(len(contrast.table) for contrast in contrasts)
        figure, grid = panel_grid(
            [contrast.title for contrast in contrasts],
            1,
            _ROW_IN * n_rows + 0.35,
            0.5,
            TWO_COLUMNS_IN,
            sharex=True,
        )
        for (panel,), contrast in zip(grid, contrasts, strict=True):
            _draw_contrast(panel, contrast.table)
        panel.set_xlabel("Δ success [points]")
        handles = [
            Patch(color=_GREY, label="difference in the first and the last world"),
            Patch(color=BLUE, label="the difference rises"),
            Patch(color=ORANGE, label="it falls"),
        ]
        legend_outside(figure, handles, 4)
        return figure

    def _contrasts(self, data: RunData) -> list[_Contrast]:
        """Return the contrasts that were run in all worlds of the series."""
        if data.between.settings.empty:
            return []
        rows = dict(list(data.episodes.groupby("condition", sort=False)))
        chosen = []
        for block in find_blocks(data.about["conditions"]):
            worlds = self.worlds or block.worlds
            candidates = block.settings_in(worlds)
            for pair in self._settings(data, candidates, worlds):
                table = contrast_by_world(pair, worlds, rows)
                if not table.empty:
                    chosen.append((block, pair, table))
        titles = _titles([(block, pair) for block, pair, _ in chosen])
        return [
            _Contrast(title=title, table=table)
            for title, (_, _, table) in zip(titles, chosen, strict=True)
        ]

    def _settings(
        self, data: RunData, candidates: Sequence[Setting], worlds: Sequence[str]
    ) -> list[tuple[Setting, Setting]]:
        """Return the pairs of settings of a block, the first of each pair first."""
        if self.one is not None and self.other is not None:
            first = _matching(candidates, self.one)
            second = _matching(candidates, self.other)
            return [(a, b) for a in first for b in second if a is not b]
        hypotheses = data.between.hypotheses
        if hypotheses.empty or len(worlds) < _MIN_WORLDS:
            return []
        of_success = hypotheses[hypotheses["metric"] == SUCCESS.quantity.name]
        by_id = {s.ids[worlds[0]]: s for s in candidates}
        pairs = {}
        for row in of_success.to_dict("records"):
            if row["one"] in by_id and row["other"] in by_id:
                pair = (by_id[row["one"]], by_id[row["other"]])
                pairs[pair[0].key, pair[1].key] = pair
        return list(pairs.values())


def _matching(settings: Sequence[Setting], labels: Mapping[str, str]) -> list[Setting]:
    return [s for s in settings if labels.items() <= s.labels.items()]


def _titles(contrasts: Sequence[tuple[Block, tuple[Setting, Setting]]]) -> list[str]:
    """Return names of contrasts: the block if it differs, and both settings."""
    blocks = pd.DataFrame([block.labels for block, _ in contrasts])
    differing = [name for name in blocks if blocks[name].nunique() > 1]
    sides = [setting.labels for _, pair in contrasts for setting in pair]
    names = contender_names(sides)
    titles = []
    for index, (block, _) in enumerate(contrasts):
        first, second = names[2 * index : 2 * index + 2]
        place = joined(block.labels[name] for name in BLOCK_LABELS if name in differing)
        titles.append(
            f"{place}: {first} − {second}" if place else f"{first} − {second}"
        )
    return titles


def _draw_contrast(panel: Axes, table: pd.DataFrame) -> None:
    """Draw the first difference, each change, and the last difference as bars."""
    differences = 100 * table["difference"].to_numpy()
    last = len(table)
    for height, row in ((0, table.iloc[0]), (last, table.iloc[-1])):
        low, high = 100 * row["difference_low"], 100 * row["difference_high"]
        value = 100 * row["difference"]
        panel.barh(height, value, color=_GREY, **_BAR)
        _draw_value(panel, height, (value, low, high), 0.0)
    for height, row in enumerate(table.iloc[1:].to_dict("records"), start=1):
        start = differences[height - 1]
        change, low, high = (100 * row[f"change{end}"] for end in ("", "_low", "_high"))
        colour = BLUE if change >= 0 else ORANGE
        panel.barh(height, change, left=start, color=colour, **_BAR)
        _draw_value(panel, height, (change, low, high), start)
    for height, value in enumerate(differences):
        panel.plot([value, value], [height - 0.35, height + 1.35], color="0.5", lw=0.5)
    names = list(world_names(list(table["world"])).values())
    steps = [f"→ {name}" for name in names[1:]]
    panel.set_yticks(range(last + 1), [names[0], *steps, names[-1]])
    panel.set_ylim(last + 0.6, -0.6)
    panel.axvline(0, color="0.4", lw=0.6, zorder=1)
    panel.grid(axis="x", color=GRID)
    panel.set_axisbelow(True)
    panel.tick_params(axis="y", length=0)


def _draw_value(
    panel: Axes, height: float, interval: tuple[float, float, float], start: float
) -> None:
    """Draw the interval of a bar that begins at `start`, and write its value."""
    value, low, high = interval
    words = signed(value)
    if not np.isnan(low):
        draw_interval(panel, start + low, start + high, height, "black", 0.9)
        words += f" ({signed_interval(low, high)})"
    side = panel.get_yaxis_transform()
    text = words.replace("-", "−")
    panel.text(1.01, height, text, transform=side, va="center", size=TEXT)
