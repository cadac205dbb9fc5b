"""One style for the figures of datasets, models, runs and pages: sizes, colours, names,
layout, and saving.

Sizes are in inches and points as printed. Colours are distinct to every kind of colour
vision. Source: Okabe and Ito (2008), "Color universal design".
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

# Widths of a journal's column and of a page.
ONE_COLUMN_IN, TWO_COLUMNS_IN = 88 / 25.4, 180 / 25.4
TEXT, TITLE = 7.0, 8.0
_STRIP_IN = 0.2
_MIN_WIDTH_IN = 4.4  # of a figure with a legend of several columns
DPI = 200

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
# Type 42 embeds whole fonts, as publishers ask; composed images would be sampled anew
# in a PDF.
_SAVED: dict[Any, Any] = {"pdf.fonttype": 42, "image.composite_image": False}

BLUE, ORANGE, GREEN, PINK, AMBER, SKY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
)
# Yellow, the last, is lost on white: lines on white have the others alone.
COLOURS = (BLUE, ORANGE, GREEN, PINK, AMBER, SKY, "#000000", "#F0E442")
LINE_COLOURS = COLOURS[:-1]
BLIND = "0.45"

MARKERS = "osD^vP*X<"
# Of paths and curves that lie over each other, which grey tells apart by these.
LINE_STYLES: tuple[Any, ...] = (
    "-",
    (0, (3.2, 1.2)),
    (0, (1, 1.1)),
    (0, (5, 1.2, 1, 1.2)),
    (0, (5, 1.2, 1, 1.2, 1, 1.2)),
)
_PLANNERS = {
    "astar_dwa": ("A*+DWA", BLUE),
    "astar_mppi": ("A*+MPPI", PINK),
    "cl_rrt": ("CL-RRT", ORANGE),
    "mppi": ("MPPI", GREEN),
    "optimal": ("optimal", AMBER),
    "near_optimal": ("near-optimal", SKY),
    "straight": ("straight", BLIND),
}

# Of each shipped risk measure its name without a number, and with one.
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
    """The style of all figures, as a context or as the decorator of a function that
    draws one.
    """
    return matplotlib.rc_context(_STYLE)


def planner_name(planner: str) -> str:
    """What figures call a planner, from its label: the name, and its options as they
    are.
    """
    name = re.split("[ :]", planner)[0]
    return _PLANNERS[name][0] + planner[len(name) :] if name in _PLANNERS else planner


def risk_name(risk: str) -> str:
    """What tables, figures and videos call a risk setting, from its label: `cvar:0.95`
    is CVaR₀.₉₅.

    Args:
        risk: a label. One that is not of a shipped measure with at most a number stays
            as it is.
    """
    measure, colon, number = risk.partition(":")
    if colon and not _NUMBER.fullmatch(number):
        return risk
    named, with_number = _RISKS.get(measure, (measure, f"{measure}:{{}}"))
    return (
        with_number.format(number, lowered=number.translate(_LOWERED))
        if colon
        else named
    )


def planner_colours(planners: Sequence[str]) -> dict[str, str]:
    """Colours of planners by their labels: a shipped planner has the same one in every
    figure.

    Args:
        planners: labels; others than the shipped take colours that are left.
    """
    own = {
        planner: _PLANNERS[planner][1] for planner in planners if planner in _PLANNERS
    }
    left = [colour for colour in LINE_COLOURS if colour not in own.values()]
    others = [planner for planner in dict.fromkeys(planners) if planner not in own]
    return own | {
        planner: left[place % len(left)] for place, planner in enumerate(others)
    }


def condition_colours(
    planners: Sequence[str], palette: Sequence[str] = COLOURS
) -> list[str]:
    """Colours of conditions that are shown together.

    Args:
        planners: of each condition; where no two are alike, each has its planner's
            colour. Else the conditions take those of the palette in turn, but for the
            blind baseline, which is grey.
        palette: begun anew where it is used up.
    """
    own, turn = planner_colours(planners), itertools.cycle(palette)
    alike = len(own) < len(planners)
    return [
        own[planner] if not alike or own[planner] == BLIND else next(turn)
        for planner in planners
    ]


def bytes_of(colour: Any) -> tuple[int, ...]:
    """Red, green, blue and opacity of a colour, in [0, 255]."""
    return tuple(round(255 * value) for value in to_rgba(colour))


def line_style(place: int) -> Any:
    """The style of the line that is drawn in this place among others."""
    return LINE_STYLES[place % len(LINE_STYLES)]


def stack_panels(
    figure: Figure, count: int, across: int, layers: int = 1, **shared: Any
) -> list[Any]:
    """Divides a figure into places, row by row, each with panels under each other; what
    is left over is removed.

    Args:
        figure: empty.
        count: number of places.
        across: places side by side, at most `count`.
        layers: panels of a place.
        **shared: as in `Figure.subplots`.

    Returns:
        Of each place its panels, downward.
    """
    down = -(-count // across)
    panels = figure.subplots(layers * down, across, squeeze=False, **shared)
    stacks = [list(stack) for row in np.split(panels, down) for stack in row.T]
    for place in range(count, len(stacks)):
        for panel in stacks[place]:
            panel.remove()
        stacks[place - across][-1].tick_params(labelbottom=True)
    return stacks[:count]


def legend_outside(
    figure: Figure,
    handles: Sequence[Artist] = (),
    columns: int = 4,
    side: Any = "lower center",
) -> Legend:
    """Lay a legend next to the panels: what has a label in them, once each, then the
    handles.

    A figure that has a label of all its x-axes has its legend over the panels, as both
    would be in one place.

    Args:
        figure: with all its panels.
        handles: further entries.
        columns: of the legend of a figure that is as wide as a page; a narrower one has
            half of them.
        side: of the figure.
    """
    labelled: dict[str, Artist] = {}
    for panel in figure.axes:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            labelled.setdefault(label, handle)
    if figure.get_figwidth() < TWO_COLUMNS_IN:
        columns = -(-columns // 2)
    return figure.legend(
        handles=[*labelled.values(), *handles], loc="outside " + side, ncols=columns
    )


def page_width(count: int, across: int) -> float:
    """Return the width in inches of a figure with some places, of which so many fill
    both columns of a page.
    """
    return max(TWO_COLUMNS_IN * (min(count, across) / across), _MIN_WIDTH_IN)


def save(
    figure: Figure,
    path: Path,
    kind: str,
    dpi: float | str = "figure",
    trim: bool = False,
    strip_in: float = 0.0,
) -> None:
    """Writes a figure with its fonts embedded.

    Args:
        figure: what was drawn.
        path: file to write.
        kind: png, pdf, svg or jpg.
        dpi: dots an inch; those of the figure where not given.
        trim: cut white borders away.
        strip_in: height of a strip over the figure that is written too.
    """
    box: Any = "tight" if trim else None
    if strip_in and not trim:
        box = Bbox.from_extents(
            0, 0, figure.get_figwidth(), figure.get_figheight() + strip_in
        )
    with matplotlib.rc_context(_SAVED):
        figure.savefig(
            path, format=kind, dpi=dpi, bbox_inches=box, pad_inches=0.05 if trim else 0
        )


def save_twice(
    figure: Figure, path: Path, trim: bool = False, dpi: float = DPI, mark: str = ""
) -> None:
    """Writes a figure as PNG and, beside it, as PDF; each whole or not at all.

    Args:
        figure: what was drawn.
        path: of the PNG; its folder is made.
        trim: cut white borders away; a figure made for a column keeps its width
            without.
        dpi: dots an inch.
        mark: a line that is drawn in a strip over the figure; none where empty.
    """
    # Laid out for good, so that both files are drawn alike and no layout is made twice.
    figure.set_dpi(dpi)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    if mark:
        over = figure.dpi_scale_trans + ScaledTranslation(
            0, figure.get_figheight(), figure.dpi_scale_trans
        )
        figure.text(
            0.05,
            0.04,
            mark,
            transform=over,
            fontsize=TITLE,
            color=ORANGE,
            weight="bold",
            va="bottom",
        )
    for suffix in (".png", ".pdf"):
        with replacing(path.with_suffix(suffix)) as partial:
            save(figure, partial, suffix[1:], dpi, trim, _STRIP_IN if mark else 0.0)
