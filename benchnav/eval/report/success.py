"""The figure of success rates: a row a trial, so that any number of planners and risk settings fit."""

from collections.abc import Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.eval.report.figures import trial_name
from benchnav.eval.report.tables import NOT_USED

_PANEL = ("data", "scenario", "world", "robot", "objective")
_ROW_IN = 0.21
_PANELS_A_LINE = 4


def success_figure(summary: pd.DataFrame) -> Figure:
    """Draws the success rate of every trial with its 95 % interval, a panel a scenario (and world, robot …).

    A planner that looks at nothing predicted is drawn as a line through its panel, the floor that others are
    seen against.

    Args:
        summary: from `summary.summarise`.
    """
    keys = [name for name in _PANEL if name == "scenario" or summary[name].nunique() > 1]
    panels = [(key, rows) for key, rows in summary.groupby(keys, sort=False)]
    planners = list(summary["planner"].unique())
    models = summary.loc[summary["model"] != NOT_USED, "model"].nunique()
    settings = _settings(summary, planners)
    across = min(len(panels), _PANELS_A_LINE)
    down = -(-len(panels) // across)
    height = _ROW_IN * (len(settings) + 0.6 * len(planners)) + 0.9
    figure = Figure(figsize=(2.3 * across + 2.2, height * down), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
    for panel, (key, rows) in zip(axes, panels, strict=False):
        _draw(panel, rows, settings, planners)
        panel.set_title(", ".join(map(str, key)), fontsize=10)
    for panel in axes[len(panels) :]:
        panel.set_visible(False)
    for panel in axes[max(len(panels) - across, 0) : len(panels)]:
        panel.tick_params(labelbottom=True)
    places = list(settings.values())
    several = ["model"] if models > 1 else []
    names = [
        trial_name(dict(zip(("planner", "model", "risk"), setting, strict=True)), several)
        for setting in settings
    ]
    axes[0].set_yticks(places, names)
    axes[0].set_ylim(max(places) + 0.7, min(places) - 0.7)
    axes[0].set_xlim(-3, 103)
    figure.supxlabel("success rate [%] with its 95 % interval", fontsize=10)
    return figure


def _settings(summary: pd.DataFrame, planners: Sequence[str]) -> dict[tuple[str, str, str], float]:
    """Height of each row in the figure by planner, model and risk, planners a little apart."""
    rows = summary[["planner", "model", "risk"]].drop_duplicates().itertuples(index=False, name=None)
    ordered = sorted(rows, key=lambda setting: planners.index(setting[0]))
    return {setting: place + 0.6 * planners.index(setting[0]) for place, setting in enumerate(ordered)}


def _draw(
    panel: Axes, rows: pd.DataFrame, settings: dict[tuple[str, str, str], float], planners: Sequence[str]
) -> None:
    palette = matplotlib.colormaps["tab10"]
    for row in rows.to_dict("records"):
        setting = (row["planner"], row["model"], row["risk"])
        rate, low, high = (100 * row[f"success_{name}"] for name in ("rate", "low", "high"))
        blind = row["model"] == NOT_USED  # The clairvoyant has a model, and no risk.
        colour = "0.45" if blind else palette(planners.index(row["planner"]) % 10)
        place = settings[setting]
        panel.plot([low, high], [place, place], color=colour, lw=1.4, solid_capstyle="butt")
        panel.plot(rate, place, "o", color=colour, ms=5)
        if blind:
            panel.axvline(rate, color=colour, lw=1, ls="--", zorder=0)
            panel.axvspan(low, high, color=colour, alpha=0.12, lw=0, zorder=0)
    panel.grid(axis="x", alpha=0.3)
    panel.set_axisbelow(True)
    panel.set_xticks(np.arange(0, 101, 25))
    panel.tick_params(axis="y", length=0, labelsize=8)
