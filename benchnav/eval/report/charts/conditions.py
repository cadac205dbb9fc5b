"""Charts of the conditions of a run: success, outcomes, distributions, and the forest plot of its hypotheses.

All but the last have a panel a block and a row a setting. Any number of planners, models and risk settings fits,
since their names stand on the left.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.core.figures import (
    AMBER,
    BLIND,
    BLUE,
    GREEN,
    ONE_COLUMN_IN,
    ORANGE,
    PINK,
    SKY,
    TWO_COLUMNS_IN,
    legend_outside,
    planner_colours,
    stack_panels,
    styled,
)
from benchnav.core.quantity import Quantity
from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.report.words import (
    NOT_YET,
    blocks,
    outcome_in_words,
    p_in_words,
    reading_names,
    with_names,
)
from benchnav.metrics.shipped import QUANTITIES

# From what the ground did to what the code did; success is light, each failure has a colour of its own.
OUTCOME_COLOURS = {
    "immobilised": ORANGE,
    "stuck": AMBER,
    "timeout": BLUE,
    "stalled": SKY,
    "out_of_bounds": PINK,
    "planner_failure": GREEN,
    "planner_error": "#000000",
    "model_error": "#7F7F7F",
    "sensor_error": "#4D4D4D",
    "belief_error": "#A6A6A6",
}
SUCCESS_COLOUR = "#E4E4E4"
# In white, so that outcomes of one lightness differ in grey.
OUTCOME_HATCHES = {
    "immobilised": "",
    "stuck": "/////",
    "timeout": "....",
    "stalled": "|||||",
    "out_of_bounds": "xxxx",
    "planner_failure": "-----",
    "planner_error": "",
    "model_error": "\\\\\\\\\\",
    "sensor_error": "ooo",
    "belief_error": "+++++",
}

_ROW_IN, _GAP_ROWS = 0.145, 0.6
_PANELS_A_LINE = 4
_QUANTITIES = {"total_time_s": "T_total [s], a failure counts as T", "traversability": "λ̄, mean observed λ"}
_ENDS = {"success": (BLUE, "o"), "failure": (ORANGE, "x")}  # colour and marker of a dot
_SPREAD = 0.32  # of a row's height, to either side
_TEST_IN, _METRIC_IN = 0.3, 0.55
_MARGIN = "0.88"

_SETTING = ["planner", "model", *KNOWLEDGE, "risk"]


def lay_out(
    summary: pd.DataFrame, measures: Sequence[str], legend_in: float = 0.0
) -> tuple[Figure, list[tuple[Axes, pd.DataFrame]]]:
    """Makes the panels, with the names of settings at the left of each line of panels.

    Args:
        summary: from `summary.summarise`.
        measures: what is drawn of each block, a panel each and side by side; the panels then list each block as
            often.
        legend_in: height kept for a legend.

    Returns:
        The figure; of each block its panel, and its rows of the summary with the `height` that each is drawn at.
    """
    settings = with_names(summary[_SETTING].drop_duplicates())
    # Planners are a little apart.
    planner = settings["planner"].factorize()[0]
    settings = settings.assign(gap=_GAP_ROWS * planner).sort_values("gap", kind="stable")
    settings["height"] = np.arange(len(settings)) + settings.pop("gap")
    lowest, columns = settings["height"].max(), len(measures)
    known = blocks(summary.merge(settings, on=_SETTING, how="left"))
    every = [block for block in known for _ in measures]
    across = columns if columns > 1 else min(len(every), _PANELS_A_LINE)
    tall = _ROW_IN * (lowest + 1.4) + 0.5
    width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    high = tall * -(-len(every) // across) + 0.2 + legend_in
    figure = Figure(figsize=(width, high), layout="constrained")
    shared = "all" if columns == 1 else "col"
    stacks = stack_panels(figure, len(every), across, sharex=shared, sharey=True)
    panels = []
    for place, ((panel,), (title, rows)) in enumerate(zip(stacks, every, strict=True)):
        panels.append((panel, rows))
        panel.set(title=title, axisbelow=True)
        panel.tick_params(axis="y", length=0)
        panel.grid(axis="x", color="0.9")
        if place >= len(every) - across:
            panel.set_xlabel(measures[place % columns])
        for height in sorted(set(settings["height"]) - set(rows["height"])):
            looks: dict[str, Any] = {"transform": panel.get_yaxis_transform(), "ha": "center", "va": "center"}
            panel.text(0.5, height, "not run", color="0.5", size=6, **looks)
    first, _ = panels[0]
    first.set_yticks(settings["height"].tolist(), settings["name"].tolist())
    first.set_ylim(lowest + 0.7, -0.7)
    return figure, panels


@styled()
def success_figure(summary: pd.DataFrame) -> Figure:
    """Draws the success rate of every condition with its 95 % interval, a panel a block of the run.

    A planner that is blind is drawn as a line through its panel, the baseline that others are seen against.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`, whose `best_marked` fills points.
    """
    (figure, panels), colours = lay_out(summary, ["success [%]"]), planner_colours(list(summary["planner"]))
    for panel, rows in panels:
        for row in rows.to_dict("records"):
            # The clairvoyant has a model, and no risk.
            blind = row["model"] == NOT_USED
            colour = BLIND if blind else colours[row["planner"]]
            face = colour if row.get("best_marked") else "white"
            rate, low, high = (100 * row[f"success_{name}"] for name in ("rate", "low", "high"))
            panel.plot([low, high], [row["height"]] * 2, color=colour, lw=1.2, solid_capstyle="butt")
            panel.plot(rate, row["height"], "o", color=colour, ms=4, mfc=face)
            if blind:
                panel.axvline(rate, color=colour, lw=0.8, ls="--", zorder=0)
                panel.axvspan(low, high, color=colour, alpha=0.12, lw=0, zorder=0)
    panel.set(xticks=np.arange(0, 101, 25), xlim=(-4, 104))
    return figure


@styled()
def outcome_figure(summary: pd.DataFrame) -> Figure:
    """Draws the shares of outcomes, a bar a condition, in one order for all: failures first, then success.

    Args:
        summary: from `summary.summarise`.
    """
    ended = [name for name in OUTCOME_COLOURS if summary[f"{name}_count"].sum()]
    figure, panels = lay_out(summary, ["share of episodes [%]"], legend_in=0.15 + 0.15 * (len(ended) // 3))
    for panel, rows in panels:
        left = np.zeros(len(rows))
        for name in ended:
            share = 100 * rows[f"{name}_count"] / rows["n_episodes"]
            colour, label = OUTCOME_COLOURS[name], outcome_in_words(name)
            hatched: dict[str, Any] = {"hatch": OUTCOME_HATCHES[name], "ec": "white"}
            panel.barh(rows["height"], share, 0.78, left, fc=colour, lw=0, label=label, **hatched)
            left = left + share
        panel.barh(rows["height"], 100 - left, 0.78, left, color=SUCCESS_COLOUR, lw=0, label="success")
    panel.set_xlim(0, 100)
    legend_outside(figure, columns=3 if figure.get_figwidth() < TWO_COLUMNS_IN else 6)
    return figure


@styled()
def distribution_figure(summary: pd.DataFrame, episodes: pd.DataFrame) -> Figure:
    """Draws a dot an episode, with median and quartiles: T_total on the left, λ̄ on the right, a line a block.

    Args:
        summary: from `summary.summarise`.
        episodes: the rows it was made of.
    """
    figure, panels = lay_out(summary, list(_QUANTITIES.values()), legend_in=0.15)
    for place, (panel, rows) in enumerate(panels):
        _draw_dots(panel, rows, episodes, list(_QUANTITIES)[place % len(_QUANTITIES)])
    panels[0][0].set_xlim(left=0)
    panels[1][0].set_xlim(0, 1)
    handles = [
        Line2D([], [], ls="none", ms=3, color=colour, marker=marker, label=label)
        for label, (colour, marker) in _ENDS.items()
    ]
    words = "median and quartiles of all"
    handles.append(Line2D([], [], color="black", marker="|", ms=6, lw=1.2, label=words))
    legend_outside(figure, handles)
    return figure


def _draw_dots(panel: Axes, rows: pd.DataFrame, episodes: pd.DataFrame, name: str) -> None:
    """Draws a quantity of the episodes of several conditions, each condition at its height; all dots at once."""
    dots = rows[["condition", "height"]].merge(episodes, on="condition")
    turn = dots.groupby("condition").cumcount()
    dots["up"] = dots["height"] + np.random.default_rng(0).uniform(-_SPREAD, _SPREAD, len(dots))[turn]
    dots = dots[dots[name].notna()]
    if dots.empty:
        return
    for (colour, marker), own in zip(
        _ENDS.values(), (dots[dots["success"]], dots[~dots["success"]]), strict=True
    ):
        looks: dict[str, Any] = {"color": colour, "marker": marker, "alpha": 0.45, "rasterized": True}
        panel.scatter(
            own[name], own["up"], s=5 if marker == "x" else 3, lw=0.5 if marker == "x" else 0, **looks
        )
    middles = dots.groupby("height")[name].quantile([0.25, 0.5, 0.75]).unstack()
    heights = middles.index.to_numpy()
    panel.plot(
        [middles[0.25], middles[0.75]], [heights, heights], color="black", lw=1.2, solid_capstyle="butt"
    )
    panel.plot(middles[0.5], heights, "|", color="black", ms=6, mew=1.4)


@styled()
def forest_figure(tests: pd.DataFrame, known: Mapping[str, Quantity] = QUANTITIES) -> Figure:
    """Draws each hypothesis as its difference, with the 95 % interval thin and the 90 % interval thick.

    Filled points are of hypotheses that are supported; the band is where a margin wants the difference to lie.

    Args:
        tests: from `hypotheses.test_hypotheses`.
        known: what conditions are compared by, by name; panels are in this order.
    """
    numbered = tests.assign(number=range(1, len(tests) + 1))
    panels = {name: numbered[numbered["metric"] == name] for name in known if (tests["metric"] == name).any()}
    heights = [_METRIC_IN + _TEST_IN * len(rows) for rows in panels.values()]
    figure = Figure(figsize=(TWO_COLUMNS_IN, sum(heights) + 0.3), layout="constrained")
    axes = figure.subplots(len(panels), squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for panel, (name, rows) in zip(axes, panels.items(), strict=True):
        _draw_tests(panel, rows, known[name])
    point: dict[str, Any] = {"marker": "o", "ms": 4, "lw": 0}
    is_tested = tests["p_holm"].notna().all()
    looks: dict[str, Any] = {
        **({"supported": point} if is_tested else {}),
        "not supported" if is_tested else NOT_YET: {**point, "mfc": "white"},
        "90 % interval": {"lw": 2.6},
        "95 % interval": {"lw": 0.9},
    }
    handles: list[Artist] = [Line2D([], [], color=BLUE, label=label, **look) for label, look in looks.items()]
    if (tests["margin"] > 0).any():
        handles.append(Patch(color=_MARGIN, label="allowed by the margin"))
    legend_outside(figure, handles, 5)
    return figure


def _draw_tests(panel: Axes, rows: pd.DataFrame, quantity: Quantity) -> None:
    # Where no episode tells anything, a row has no numbers.
    ends = rows[["low", "high", "difference", "margin"]].astype(float).abs()
    reach = max(ends.max().max(), 1e-9) * 1.08
    panel.set(xlim=(-reach, reach), ylim=(len(rows) - 0.4, -0.6))
    panel.axvline(0, color="0.4", lw=0.6, zorder=1)
    names = []
    for height, row in enumerate(rows.to_dict("records")):
        if row["margin"] > 0:
            inner = -row["margin"] if row["kind"] == "superiority" else row["margin"]
            low = -reach if row["direction"] == "lower" else -inner
            high = reach if row["direction"] == "higher" else inner
            panel.fill_between([low, high], height - 0.36, height + 0.36, color=_MARGIN, lw=0, zorder=0)
        for suffix, width in (("", 0.9), ("_90", 2.6)):
            span = [row[f"low{suffix}"], row[f"high{suffix}"]]
            panel.plot(span, [height, height], color=BLUE, lw=width, solid_capstyle="butt", zorder=2)
        face = BLUE if row["supported"] else "white"
        panel.plot(row["difference"], height, "o", color=BLUE, ms=4.5, mfc=face, zorder=3)
        beside = panel.get_yaxis_transform()
        panel.text(1.01, height, p_in_words(row["p_holm"]), transform=beside, va="center")
        one, other = map(reading_names, row["names"])
        names.append(f"{row['number']}. {one}\n− {other}")
    panel.set_yticks(range(len(rows)), names)
    panel.tick_params(axis="y", length=0)
    panel.grid(axis="x", color="0.93", zorder=0)
    unit = f" [{quantity.unit}]" if quantity.unit else ""
    panel.set(xlabel=f"Δ {quantity.words}{unit}", axisbelow=True)
    # Which way is better, at the end of the axis where it lies.
    place, side, words = (1, "right", "better →") if quantity.better == "higher" else (0, "left", "← better")
    if quantity.better != "neither":
        panel.annotate(words, (place, 1), xycoords="axes fraction", va="bottom", ha=side, color="0.35")
