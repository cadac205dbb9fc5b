"""Figures of sweeps: success and time over a number, a line for each combination of all else."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.charts.sweeps import SEVERITY, Line, Sweep
from benchnav.eval.report.figure_style import OKABE_ITO, ONE_COLUMN_IN, TWO_COLUMNS_IN, display_name

_MEASURES = {
    "success [%]": ("success_rate", "success_low", "success_high", 100.0),
    "T_total [s]": ("total_time_mean_s", "total_time_low_s", "total_time_high_s", 1.0),
}
_MARKERS = "osD^vP*X"
_STYLES: tuple[Any, ...] = ("--", ":", "-.", (0, (7, 2, 1, 2, 1, 2)), (0, (1, 3)), (0, (9, 2)))
_MOST_LINES, _MOST_ACROSS = 7, 4
_LEVEL = "risk.options.level"
_NAMES = {_LEVEL: "level α", SEVERITY: "severity of the scenario"}

Labels = Mapping[Any, Any]
Groups = dict[tuple[str, ...], list[Line]]

_MODEL = 3  # its place in what names a panel


def sweep_name(number: str) -> str:
    """What a figure and its file call a number: its last word, such as `level`."""
    return number.rpartition(".")[2]


def curve_figure(sweep: Sweep, summary: pd.DataFrame) -> Figure:
    """Draws a sweep: success above with Wilson's band, T_total below with the bootstrap's.

    A panel a scenario, world, model and what else there is of that kind; where lines are many, a panel a planner
    too. Over a number of a risk setting, the other settings of the same planner are horizontal lines.

    Args:
        sweep: from `find_sweeps`.
        summary: of the run.
    """
    rows = {row["condition"]: row for row in summary.to_dict("records")}
    groups = _panels(sweep, rows)
    across = min(len(groups), _MOST_ACROSS)
    down = -(-len(groups) // across)
    width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    colours = _colours(sweep, rows)
    figure = Figure(figsize=(width, 3.3 * down + 0.5), layout="constrained")
    axes = figure.subplots(2 * down, across, squeeze=False, sharex=True, sharey=False)
    for panel in axes.flat:
        panel.set_visible(False)
    handles: dict[str, Line2D] = {}
    for place, (title, lines) in enumerate(groups):
        pair = axes[2 * (place // across) : 2 * (place // across) + 2, place % across]
        for panel, (label, columns) in zip(pair, _MEASURES.items(), strict=True):
            panel.set_visible(True)
            _draw_references(panel, sweep, lines, rows, columns, colours, handles)
            for line in lines:
                _draw_line(panel, sweep.number, line, rows, columns, colours[_name(sweep, line, rows)])
            panel.grid(axis="y", color="0.9")
            if place % across == 0:
                panel.set_ylabel(label)
        pair[0].set_title(title)
        pair[0].tick_params(labelbottom=False)
        pair[1].tick_params(labelbottom=True)
        pair[1].set_xlabel(_NAMES.get(sweep.number, sweep_name(sweep.number)))
        _label_values(pair[1], sweep.number, sweep.lines)
    for first in range(2):
        _share_heights([axes[2 * line + first, column] for line in range(down) for column in range(across)])
    named = {
        name: Line2D([], [], color=colour, marker=marker, ms=3.5, lw=1.2, label=name)
        for name, (colour, marker) in colours.items()
    }
    columns_of_legend = 2 if across == 1 else 4
    figure.legend(
        handles=[*named.values(), *handles.values()], loc="outside lower center", ncols=columns_of_legend
    )
    return figure


def _panels(sweep: Sweep, rows: Mapping[str, Labels]) -> list[tuple[str, list[Line]]]:
    """Titles and lines of the panels: split until no panel holds more lines than a reader can distinguish."""
    for split in (("model",), ("model", "planner"), ("model", "planner", "risk")):
        groups: Groups = {}
        for line in sweep.lines:
            groups.setdefault(_place(sweep, line, rows, split), []).append(line)
        groups = _with_blind(groups) if split == ("model",) else groups
        if max(map(len, groups.values())) <= _MOST_LINES:
            break
    differing = [i for i in range(len(next(iter(groups)))) if len({key[i] for key in groups}) > 1]
    return [
        (", ".join(key[i] for i in differing if key[i] != NOT_USED) or key[0], lines)
        for key, lines in groups.items()
    ]


def _with_blind(groups: Groups) -> Groups:
    """Puts what is blind into the panels of the models that it stands beside."""
    found: Groups = {}
    for key, lines in groups.items():
        beside = [other for other in groups if other != key and _without_model(other) == _without_model(key)]
        if key[_MODEL] != NOT_USED or not beside:
            found[key] = [*found.get(key, []), *lines]
            continue
        for other in beside:
            found[other] = [*lines, *found.get(other, [])]
    return found


def _without_model(key: tuple[str, ...]) -> tuple[str, ...]:
    return key[:_MODEL] + key[_MODEL + 1 :]


def _place(sweep: Sweep, line: Line, rows: Mapping[str, Labels], split: Sequence[str]) -> tuple[str, ...]:
    row = rows[line.conditions[0]]
    scenario = str(line.rest["split"]).removeprefix("test/")
    world = row["world"].split(" ")[0] if sweep.number.startswith(("world.", "rules.")) else row["world"]
    parts = [_label(sweep, line, row, name) for name in (*split, "robot", "objective")]
    return (scenario, str(line.rest.get("data", row["data"])), world, *parts)


def _label(sweep: Sweep, line: Line, row: Labels, name: str) -> str:
    """A label of a line; of the part that is swept its name alone, since its label holds the number."""
    swept = sweep.number.startswith(f"{name}.")
    label = str(line.rest[f"{name}.part"]) if swept and row[name] != NOT_USED else row[name]
    return display_name(label) if name == "planner" else label


def _name(sweep: Sweep, line: Line, rows: Mapping[str, Labels]) -> str:
    """What a line is called: planner and risk setting, and what its labels do not say where that is needed."""
    name = _words(sweep, line, rows)
    place = _place(sweep, line, rows, ("model",))
    look_alikes = [
        other
        for other in sweep.lines
        if _words(sweep, other, rows) == name and _place(sweep, other, rows, ("model",)) == place
    ]
    differing = [key for key in line.rest if len({repr(other.rest.get(key)) for other in look_alikes}) > 1]
    return ", ".join([name, *(f"{sweep_name(key)} {line.rest[key]}" for key in differing)])


def _words(sweep: Sweep, line: Line, rows: Mapping[str, Labels]) -> str:
    row = rows[line.conditions[0]]
    words = [_label(sweep, line, row, name) for name in ("planner", "risk")]
    return ", ".join(word for word in words if word != NOT_USED)


def _colours(sweep: Sweep, rows: Mapping[str, Labels]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each line by its name."""
    names = list(dict.fromkeys(_name(sweep, line, rows) for line in sweep.lines))
    return {
        name: (OKABE_ITO[place % len(OKABE_ITO)], _MARKERS[place // len(OKABE_ITO) % len(_MARKERS)])
        for place, name in enumerate(names)
    }


def _draw_line(
    panel: Axes,
    number: str,
    line: Line,
    rows: Mapping[str, Any],
    columns: tuple[str, str, str, float],
    look: tuple[str, str],
) -> None:
    rate, low, high = (
        [columns[3] * float(rows[condition][name]) for condition in line.conditions] for name in columns[:3]
    )
    places = _places(number, line.values)
    panel.fill_between(places, low, high, color=look[0], alpha=0.15, lw=0)
    panel.plot(places, rate, color=look[0], marker=look[1], ms=3.5, lw=1.2)


def _draw_references(
    panel: Axes,
    sweep: Sweep,
    lines: Sequence[Line],
    rows: Mapping[str, Any],
    columns: tuple[str, str, str, float],
    colours: Mapping[str, tuple[str, str]],
    handles: dict[str, Line2D],
) -> None:
    """Draws the settings that have no such number, each in the colour of its planner's line."""
    if not sweep.number.startswith("risk."):
        return
    swept = {condition for line in sweep.lines for condition in line.conditions}
    same = ("data", "scenario", "world", "robot", "objective")
    for line in lines:
        first = rows[line.conditions[0]]
        for condition, row in rows.items():
            blind = row["model"] == NOT_USED
            alike = all(row[name] == first[name] for name in same)
            mine = all(row[name] == first[name] for name in ("model", "planner")) or blind
            if condition in swept or not alike or not mine:
                continue
            colour = "0.5" if blind else colours[_name(sweep, line, rows)][0]
            label = display_name(row["planner"]) if blind else row["risk"]
            if label not in handles:
                handles[label] = Line2D([], [], color="0.5" if blind else "0.2", lw=1, label=label)
            # Matplotlib names every pattern of dashes "--", so that a style cannot be read back from a line.
            style = _style(list(handles).index(label))
            handles[label].set_linestyle(style)
            panel.axhline(columns[3] * row[columns[0]], color=colour, ls=style, lw=1, zorder=1)


def _style(place: int) -> Any:
    """A pattern of dashes for each setting: those of `_STYLES`, then dashes with more and more dots between."""
    more = place - len(_STYLES) + 3
    return _STYLES[place] if place < len(_STYLES) else (0, (8, 2, *(1, 1.5) * more))


def _places(number: str, values: Sequence[float]) -> np.ndarray:
    """Where values stand: levels by the logarithm of the tail's share, since they crowd toward 1."""
    values_ = np.asarray(values)
    return -np.log(1 - values_) if number == _LEVEL and values_.max() < 1 else values_


def _label_values(panel: Axes, number: str, lines: Sequence[Line]) -> None:
    values = sorted({value for line in lines for value in line.values})
    panel.set_xticks(_places(number, values), [f"{value:g}" for value in values])


def _share_heights(panels: Sequence[Axes]) -> None:
    """Gives panels of one measure the same range, and numbers at the left alone."""
    shown = [panel for panel in panels if panel.get_visible()]
    ends = np.array([panel.get_ylim() for panel in shown])
    for panel in shown:
        panel.set_ylim(ends[:, 0].min(), ends[:, 1].max())
        panel.tick_params(labelleft=bool(panel.get_ylabel()))
