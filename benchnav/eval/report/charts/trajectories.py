"""The figure of trajectories, after the paper's Fig. 2."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.figure_style import TRAVERSABILITY_COLOURS, condition_name
from benchnav.eval.report.recorded.drawn_plan import STYLES, LayerStyle
from benchnav.eval.report.recorded.ground import (
    IMMOBILISING,
    SOFT,
    field_colours,
    hatching,
    immobilised_at,
    outline,
)
from benchnav.eval.report.recorded.snapshot import Snapshot

MOST_PANELS = 8
_PANELS_A_LINE = 4
_LINE_WIDTH = 0.6
_CLOSED = "0.25"
_MARKS = {"start": ("o", "red", 8.0), "goal": ("X", "magenta", 10.0), "robot": ("o", "black", 7.0)}
_IMMOBILISED: dict[str, Any] = {"marker": "X", "color": "black", "mec": "white", "ms": 13.0, "ls": "none"}
_SOFT_WIDTH = 0.5
_MAP = ("data", "scenario", "map", "seed", "realisation")


def choose(snapshots: Sequence[Snapshot], conditions: Sequence[str]) -> list[Snapshot]:
    """Chooses one snapshot a condition, all of one map where there are such, at most `MOST_PANELS`.

    Of the maps that the first condition was recorded on it is the first on which outcomes differ, if there is one;
    else the first on which an episode failed.

    Args:
        snapshots: all there are.
        conditions: ids in the order wanted.
    """
    order = {condition: place for place, condition in enumerate(conditions)}
    known = [snapshot for snapshot in snapshots if snapshot.about["condition"] in order]
    known.sort(key=lambda s: (order[s.about["condition"]], int(s.about["map"])))
    outcomes: dict[tuple[str, ...], set[str]] = {}
    for snapshot in known:
        outcomes.setdefault(_map(snapshot), set()).add(snapshot.about["outcome"])
    maps = [
        _map(snapshot) for snapshot in known if snapshot.about["condition"] == known[0].about["condition"]
    ]
    differ = [place for place in maps if len(outcomes[place]) > 1]
    failed = [place for place in maps if outcomes[place] != {"success"}]
    shown = next(iter([*differ, *failed, *maps]), ())
    known.sort(key=lambda s: _map(s) != shown)
    first: dict[str, Snapshot] = {}
    for snapshot in known:
        first.setdefault(snapshot.about["condition"], snapshot)
    return sorted(first.values(), key=lambda s: order[s.about["condition"]])[:MOST_PANELS]


def _map(snapshot: Snapshot) -> tuple[str, ...]:
    return tuple(snapshot.about[name] for name in _MAP)


def trajectory_figure(snapshots: Sequence[Snapshot]) -> Figure:
    """Draws snapshots side by side: the terrain above with what was planned, the map planned on below.

    Where λ stayed what it was through an episode, a third row shows it, with the whole driven path.

    Args:
        snapshots: at least one.
    """
    across = min(len(snapshots), _PANELS_A_LINE)
    layers = 2 if all(snapshot.field is None for snapshot in snapshots) else 3
    down = layers * -(-len(snapshots) // across)
    tallest = max(float(snapshot.extent_m[1] / snapshot.extent_m[0]) for snapshot in snapshots)
    size = (3.5 * across + 1.0, (3.2 * min(max(tallest, 0.3), 3.0) + 0.7) * down + 0.7)
    figure = Figure(figsize=size, layout="compressed")
    panels = figure.subplots(down, across, squeeze=False)
    for panel in panels.flat:
        panel.set_visible(False)
    for place, snapshot in enumerate(snapshots):
        first = layers * (place // across)
        above, below, *last = panels[first : first + layers, place % across]
        _draw_terrain(above, snapshot)
        lines = _draw_driven(above, snapshot)
        _draw_predicted(below, snapshot)
        _draw_black(below, snapshot.track[: snapshot.now + 1])
        for panel in (above, below):
            _draw_plan(panel, snapshot)
            _draw_marks(panel, snapshot, snapshot.track[snapshot.now])
        if snapshot.field is not None:
            _draw_field(last[0], snapshot, snapshot.field)
        above.set_title(_title(snapshot, _several(snapshots)), fontsize=9)
    figure.legend(
        handles=_legend(snapshots), loc="outside lower center", ncols=4 if across > 1 else 2, frameon=False
    )
    figure.colorbar(lines, ax=panels, fraction=0.03, aspect=40, label="traversability λ")
    return figure


def _title(snapshot: Snapshot, several: Sequence[str]) -> str:
    about = snapshot.about
    heading = f"{condition_name(about, several)}, {about['scenario']} {about['map']}"
    return f"{heading}\nt = {snapshot.time_s:g} s; outcome: {about['outcome'].replace('_', ' ')}"


def _several(snapshots: Sequence[Snapshot]) -> list[str]:
    """Labels beside planner and risk that differ among snapshots."""
    values = {name: {snapshot.about[name] for snapshot in snapshots} for name in ("model", "world")}
    return [name for name, labels in values.items() if len(labels - {NOT_USED}) > 1]


def _draw_terrain(panel: Axes, snapshot: Snapshot) -> None:
    panel.imshow(np.moveaxis(snapshot.rgb, 0, -1), origin="lower", extent=_extent(snapshot))
    if snapshot.field is not None:
        resolution_m = float(snapshot.extent_m[0]) / snapshot.soft.shape[1]
        for lines in (outline, hatching):
            drawn = list(lines(snapshot.soft, resolution_m))
            panel.add_collection(LineCollection(drawn, colors=[_unit(SOFT)], linewidths=_SOFT_WIDTH))


def _draw_predicted(panel: Axes, snapshot: Snapshot) -> None:
    extent = _extent(snapshot)
    panel.imshow(
        snapshot.predicted, origin="lower", extent=extent, cmap=TRAVERSABILITY_COLOURS, vmin=0, vmax=1
    )
    blind = snapshot.about["model"] == NOT_USED
    panel.set_title(
        "E[λ] in truth; the planner is given nothing" if blind else "λ̂ given to the planner", fontsize=9
    )
    if not snapshot.free.all():
        closed = np.where(snapshot.free, np.nan, 1.0)
        panel.imshow(closed, origin="lower", extent=extent, cmap=ListedColormap([_CLOSED]))


def _extent(snapshot: Snapshot) -> tuple[float, float, float, float]:
    return 0, float(snapshot.extent_m[0]), 0, float(snapshot.extent_m[1])


def _draw_plan(panel: Axes, snapshot: Snapshot) -> None:
    for name, style in STYLES.items():
        panel.add_collection(LineCollection(list(snapshot.plan.lines.get(name, ())), **_looks(style)))


def _draw_driven(panel: Axes, snapshot: Snapshot) -> LineCollection:
    """Draws the path driven by that moment over the terrain, coloured by the observed λ."""
    driven = snapshot.track[: snapshot.now + 1]
    segments = np.stack((driven[:-1], driven[1:]), axis=1)
    lines = LineCollection(list(segments), cmap=TRAVERSABILITY_COLOURS, linewidths=3, capstyle="round")
    lines.set_array(snapshot.traversability[: snapshot.now])
    lines.set_clim(0, 1)
    panel.plot(*driven.T, color="white", lw=4.6, solid_capstyle="round")
    panel.add_collection(lines)
    lines.set_zorder(2.5)
    return lines


def _draw_black(panel: Axes, track: np.ndarray) -> None:
    """Draws a driven path over a map of λ, whose colours those of the observed λ would be lost on."""
    for colour, width in (("white", 4.0), ("black", 2.2)):
        panel.plot(*track.T, color=colour, lw=width, solid_capstyle="round")


def _draw_field(panel: Axes, snapshot: Snapshot, field: np.ndarray) -> None:
    """Draws λ as it was, and the whole driven path over it."""
    panel.imshow(field_colours(field, snapshot.immobilising), origin="lower", extent=_extent(snapshot))
    _draw_black(panel, snapshot.track)
    _draw_marks(panel, snapshot, snapshot.track[-1])
    held = immobilised_at(snapshot.about, snapshot.track)
    if held is not None:
        panel.plot(*held, **_IMMOBILISED, zorder=3.5)
    end_s = len(snapshot.traversability) * snapshot.dt_s
    panel.set_title(f"driven to the end ({end_s:g} s), on λ as it was", fontsize=9)


def _draw_marks(panel: Axes, snapshot: Snapshot, robot: np.ndarray) -> None:
    """Draws start, goal and robot, and the axes of the map."""
    panel.set_visible(True)
    places = (snapshot.track[0], snapshot.goal_m, robot)
    for (marker, colour, size), place in zip(_MARKS.values(), places, strict=True):
        panel.plot(*place, marker, color=colour, mec="white", ms=size, zorder=3)
    panel.set(xlim=(0, snapshot.extent_m[0]), ylim=(0, snapshot.extent_m[1]), aspect="equal")
    panel.tick_params(labelsize=8)
    panel.set_xlabel("x [m]", fontsize=8)
    panel.set_ylabel("y [m]", fontsize=8)


def _looks(style: LayerStyle) -> dict[str, Any]:
    red, green, blue, alpha = (value / 255 for value in style.colour)
    return {
        "colors": (red, green, blue, alpha),
        "linewidths": _LINE_WIDTH * style.width,
        "linestyles": "dashed" if style.dashed else "solid",
    }


def _legend(snapshots: Sequence[Snapshot]) -> list[Artist]:
    drawn = {name for snapshot in snapshots for name, lines in snapshot.plan.lines.items() if len(lines)}
    marks: list[Artist] = [
        Line2D([], [], marker=marker, color=colour, mec="white", ms=size, ls="none", label=name)
        for name, (marker, colour, size) in _MARKS.items()
    ]
    marks.append(Line2D([], [], color="black", lw=2.2, label="driven; above in the colour of the observed λ"))
    lines: list[Artist] = [
        Line2D(
            [], [], color=_looks(style)["colors"], lw=max(_LINE_WIDTH * style.width, 1), label=style.label,
            ls="--" if style.dashed else "-",
        )
        for name, style in STYLES.items()
        if name in drawn
    ]  # fmt: skip
    return [*marks, *_ground_legend(snapshots), *lines]


def _ground_legend(snapshots: Sequence[Snapshot]) -> list[Artist]:
    """Names what is drawn of the ground."""
    known = [snapshot for snapshot in snapshots if snapshot.field is not None]
    entries: list[Artist] = []
    if not all(snapshot.free.all() for snapshot in snapshots):
        entries.append(Patch(color=_CLOSED, label="not free"))
    if any(snapshot.soft.any() for snapshot in known):
        entries.append(
            Patch(fc="0.45", ec=_unit(SOFT), hatch="////", label="soft ground, which does not show")
        )
    if any(snapshot.immobilising.any() for snapshot in known):
        entries.append(Patch(color=_unit(IMMOBILISING), label="immobilises a robot"))
    if any(immobilised_at(snapshot.about, snapshot.track) is not None for snapshot in known):
        entries.append(Line2D([], [], **_IMMOBILISED, label="immobilised"))
    return entries


def _unit(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    red, green, blue = colour
    return red / 255, green / 255, blue / 255
