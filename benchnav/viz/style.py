"""Common style of all figures: sizes, colours, names, layout, and saving.

Lengths are in inches and text sizes in points, as printed. Colours can be distinguished
with any kind of colour vision. Source: Okabe and Ito (2008), "Color universal design".
"""

import itertools
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.transforms import Bbox, ScaledTranslation

from benchnav.core.store import replacing

# Widths of one column and of both columns of a journal's page.
ONE_COLUMN_IN = 88 / 25.4
TWO_COLUMNS_IN = 180 / 25.4
TEXT, TITLE = 7.0, 8.0  # text sizes
_STRIP_IN = 0.2  # height of the strip with a mark above a figure
_MIN_WIDTH_IN = 4.4  # minimum width of a figure with a legend of several columns
DPI = 200  # default resolution of saved figures, in dots per inch

_STYLE: dict[Any, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "figure.titlesize"), TITLE),
    **dict.fromkeys(("axes.labelsize", "figure.labelsize"), TITLE),
    **dict.fromkeys(("xtick.labelsize", "ytick.labelsize", "legend.fontsize"), TEXT),
    **dict.fromkeys(
        ("axes.linewidth", "xtick.major.width", "ytick.major.width", "grid.linewidth"),
        0.5,
    ),
    **dict.fromkeys(("xtick.major.size", "ytick.major.size"), 2.0),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(
        ("figure.constrained_layout.h_pad", "figure.constrained_layout.w_pad"), 0.03
    ),
    "hatch.linewidth": 0.7,
    "legend.handlelength": 2.2,
    "legend.columnspacing": 1.4,
}
# Settings for saving. Type 42 embeds complete fonts, which publishers require. Images
# that are composed into one would be resampled in a PDF.
_SAVE_STYLE: dict[Any, Any] = {"pdf.fonttype": 42, "image.composite_image": False}

BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
PINK = "#CC79A7"
AMBER = "#E69F00"
SKY = "#56B4E9"
COLOURS = (BLUE, ORANGE, GREEN, PINK, AMBER, SKY, "#000000", "#F0E442")
LINE_COLOURS = COLOURS[:-1]  # without yellow, which is invisible as a line on white
BLIND = "0.45"  # grey of the blind baseline

MARKERS = "osD^vP*X<"
# Dashes distinguish overlapping paths and curves in greyscale.
LINE_STYLES: tuple[Any, ...] = (
    "-",
    (0, (3.2, 1.2)),
    (0, (1, 1.1)),
    (0, (5, 1.2, 1, 1.2)),
    (0, (5, 1.2, 1, 1.2, 1, 1.2)),
)
# Name and colour of each shipped planner.
_PLANNERS = {
    "astar_dwa": ("A*+DWA", BLUE),
    "astar_mppi": ("A*+MPPI", PINK),
    "cl_rrt": ("CL-RRT", ORANGE),
    "mppi": ("MPPI", GREEN),
    "optimal": ("optimal", AMBER),
    "near_optimal": ("near-optimal", SKY),
    "straight": ("straight", BLIND),
}

# Displayed name of each shipped risk measure without and with a number.
_RISKS = {
    "mean": ("mean", "mean:{}"),
    "cvar": ("CVaR", "CVaR{lowered}"),
    "var": ("VaR", "VaR{lowered}"),
    "expected-time": ("expected time", "expected time (floor {})"),
    "time-cvar": ("time CVaR", "time CVaR{lowered}"),
    "chance": ("P(λ ≥ bound)", "P(λ ≥ {})"),
    "single-class": ("single class", "single-class CVaR{lowered}"),
}
_NUMBER = re.compile(r"\d+(\.\d+)?")
_LOWERED = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def styled() -> Any:
    """Return the common style, as a context manager or a function decorator."""
    return matplotlib.rc_context(_STYLE)


def planner_name(planner: str) -> str:
    """Return a planner's displayed name for its label; options are unchanged."""
    name = re.split("[ :]", planner)[0]
    if name not in _PLANNERS:
        return planner
    return _PLANNERS[name][0] + planner[len(name) :]


def risk_name(risk: str) -> str:
    """Return the displayed name of a risk setting: `cvar:0.95` becomes CVaR₀.₉₅.

    Args:
        risk: label of a risk setting. A label other than a shipped risk measure with at
            most one number is returned unchanged.
    """
    measure, colon, number = risk.partition(":")
    if colon and not _NUMBER.fullmatch(number):
        return risk
    plain, with_number = _RISKS.get(measure, (measure, f"{measure}:{{}}"))
    if not colon:
        return plain
    return with_number.format(number, lowered=number.translate(_LOWERED))


def planner_colours(planners: Sequence[str]) -> dict[str, str]:
    """Return colours of planners by label; shipped planners have fixed colours.

    Args:
        planners: labels of planners. Custom planners have the remaining colours in
            turn.
    """
    colours = {
        planner: _PLANNERS[planner][1] for planner in planners if planner in _PLANNERS
    }
    unused = [colour for colour in LINE_COLOURS if colour not in colours.values()]
    custom = [planner for planner in dict.fromkeys(planners) if planner not in colours]
    return colours | dict(zip(custom, itertools.cycle(unused), strict=False))


def condition_colours(
    planners: Sequence[str], palette: Sequence[str] = COLOURS
) -> list[str]:
    """Return the colour of each condition of a figure.

    Args:
        planners: label of each condition's planner. If all planners differ, each
            condition has the colour of its planner. Otherwise conditions have colours
            of the palette in turn, except for the blind baseline, which is grey.
        palette: colours; they repeat if there are more conditions.
    """
    by_planner = planner_colours(planners)
    planner_colour = [by_planner[planner] for planner in planners]
    if len(by_planner) == len(planners):
        return planner_colour
    cycle = itertools.cycle(palette)
    return [BLIND if colour == BLIND else next(cycle) for colour in planner_colour]


def bytes_of(colour: Any) -> tuple[int, ...]:
    """Return red, green, blue and opacity of a colour, in [0, 255]."""
    return tuple(round(255 * value) for value in to_rgba(colour))


def line_style(index: int) -> Any:
    """Return the dashes of a line from its index in a figure; dashes repeat."""
    return LINE_STYLES[index % len(LINE_STYLES)]


def stack_panels(
    figure: Figure, count: int, across: int, layers: int = 1, **shared: Any
) -> list[Any]:
    """Divide a figure into stacks of panels, row by row, without surplus panels.

    Args:
        figure: empty figure.
        count: number of stacks.
        across: number of stacks next to each other, at most `count`.
        layers: number of panels in a stack.
        **shared: keywords of Matplotlib's `Figure.subplots`, such as `sharex`.

    Returns:
        The panels of each stack, from top to bottom.
    """
    n_rows = -(-count // across)
    panels = figure.subplots(layers * n_rows, across, squeeze=False, **shared)
    stacks = [list(stack) for row in np.split(panels, n_rows) for stack in row.T]
    for index in range(count, len(stacks)):
        for panel in stacks[index]:
            panel.remove()
        stacks[index - across][-1].tick_params(labelbottom=True)
    return stacks[:count]


def legend_outside(
    figure: Figure,
    handles: Sequence[Artist] = (),
    columns: int = 4,
    side: Any = "lower center",
) -> Legend:
    """Add a legend outside the panels: each label of the panels once, then `handles`.

    If the figure has a common label for all x-axes, choose a side above the panels.
    Below the panels, the legend and the label would overlap.

    Args:
        figure: figure with all its panels.
        handles: further entries of the legend.
        columns: number of the legend's columns in a figure as wide as a page; a
            narrower figure has half as many.
        side: side of the figure, as in Matplotlib's `loc`.
    """
    labelled: dict[str, Artist] = {}
    for panel in figure.axes:
        panel_handles, labels = panel.get_legend_handles_labels()
        for handle, label in zip(panel_handles, labels, strict=True):
            labelled.setdefault(label, handle)
    if figure.get_figwidth() < TWO_COLUMNS_IN:
        columns = -(-columns // 2)
    all_handles = [*labelled.values(), *handles]
    return figure.legend(handles=all_handles, loc="outside " + side, ncols=columns)


def page_width(count: int, across: int) -> float:
    """Return a figure's width in inches for some panels.

    Args:
        count: number of panels.
        across: number of panels that are as wide as a page.
    """
    fraction = min(count, across) / across
    return max(TWO_COLUMNS_IN * fraction, _MIN_WIDTH_IN)


def save(
    figure: Figure,
    path: Path,
    kind: str,
    dpi: float | str = "figure",
    trim: bool = False,
    strip_in: float = 0.0,
) -> None:
    """Write a figure with embedded fonts.

    Args:
        figure: figure to write.
        path: path of the file.
        kind: file format: png, pdf, svg or jpg.
        dpi: dots per inch; by default, the figure's own.
        trim: whether to cut white borders.
        strip_in: height in inches of a strip above the figure that the file includes.
    """
    area: dict[str, Any] = {"bbox_inches": None, "pad_inches": 0}
    if trim:
        area = {"bbox_inches": "tight", "pad_inches": 0.05}
    elif strip_in:
        width_in = figure.get_figwidth()
        height_in = figure.get_figheight() + strip_in
        area["bbox_inches"] = Bbox.from_extents(0, 0, width_in, height_in)
    with matplotlib.rc_context(_SAVE_STYLE):
        figure.savefig(path, format=kind, dpi=dpi, **area)


def save_twice(
    figure: Figure, path: Path, trim: bool = False, dpi: float = DPI, mark: str = ""
) -> None:
    """Write a figure as PNG and as PDF next to it, each atomically.

    Args:
        figure: figure to write.
        path: path of the PNG; its folder is created.
        trim: whether to cut white borders; if false, the figure keeps its width.
        dpi: dots per inch.
        mark: line of text in a strip above the figure; if empty, there is no strip.
    """
    # Compute the layout only once, so that both files have the same layout.
    figure.set_dpi(dpi)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    strip_in = 0.0
    if mark:
        strip_in = _STRIP_IN
        scale = figure.dpi_scale_trans
        above = scale + ScaledTranslation(0, figure.get_figheight(), scale)
        style: dict[str, Any] = {"fontsize": TITLE, "color": ORANGE, "weight": "bold"}
        figure.text(0.05, 0.04, mark, transform=above, va="bottom", **style)
    for kind in ("png", "pdf"):
        with replacing(path.with_suffix(f".{kind}")) as partial:
            save(figure, partial, kind, dpi, trim, strip_in)
