"""Sweeps of a run: conditions that are equal in all but one number, which takes three values or more, as curves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.core.figures import (
    BLIND,
    LINE_COLOURS,
    MARKERS,
    ONE_COLUMN_IN,
    TWO_COLUMNS_IN,
    condition_colours,
    legend_outside,
    planner_name,
    stack_panels,
    styled,
)
from benchnav.datagen.recipe.scenario import find_series
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.words import joined

SEVERITY = "severity"
LEAST_VALUES = 3

_LEVEL = "risk.options.level"
_NAMES = {_LEVEL: "level α", SEVERITY: "severity of the scenario"}
# Of each measure its columns of the summary, and what they are multiplied by.
_MEASURES = {
    "success [%]": ("success_rate", "success_low", "success_high", 100.0),
    "T_total [s]": ("total_time_mean_s", "total_time_low_s", "total_time_high_s", 1.0),
}
_STYLES: tuple[Any, ...] = ("--", ":", "-.", (0, (7, 2, 1, 2, 1, 2)), (0, (1, 3)), (0, (9, 2)))
_MOST_LINES, _MOST_ACROSS = 7, 4
_SAME = ("data", "scenario", "world", "robot", "objective")

Labels = Mapping[Any, Any]
Columns = tuple[str, str, str, float]


@dataclass(frozen=True, kw_only=True)
class Line:
    """Conditions of one sweep that differ in its number alone.

    Args:
        values: of the number, ascending.
        conditions: ids, one a value.
        rest: all else that the conditions are, by name with dots.
    """

    values: tuple[float, ...]
    conditions: tuple[str, ...]
    rest: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """All lines over one number.

    Args:
        number: its name with dots, such as `risk.options.level`; `severity` for that of scenarios.
        lines: in the order of the run.
    """

    number: str
    lines: tuple[Line, ...]


def find_sweeps(conditions: Mapping[str, Mapping[str, Any]]) -> list[Sweep]:
    """Finds the sweeps of a run.

    A number that others follow, such as two that were changed together, makes no sweep.

    Args:
        conditions: by id, with `value`, as `run.json` holds them.

    Returns:
        By name of the number.
    """
    points = []
    flat = {
        condition: pd.json_normalize(dict(about["value"])).to_dict("records")[0]
        for condition, about in conditions.items()
        if "split" in about["value"]
    }
    for condition, value in flat.items():
        for name, number in value.items():
            if isinstance(number, int | float) and not isinstance(number, bool):
                rest = {key: other for key, other in value.items() if key != name}
                points.append((name, condition, float(number), rest))
    points.sort(key=lambda point: point[0])
    for scenario, pairs in find_series(dict.fromkeys(value["split"] for value in flat.values())).items():
        severities = {split: severity for severity, split in pairs}
        for condition, value in flat.items():
            if value["split"] in severities:
                rest = {**value, "split": scenario}
                points.append((SEVERITY, condition, severities[value["split"]], rest))
    lines: dict[str, list[Line]] = {}
    table = pd.DataFrame(points, columns=["number", "condition", "value", "rest"])
    table["key"] = [repr(sorted(rest.items())) for rest in table["rest"]]
    for (number, _), group in table.groupby(["number", "key"], sort=False):
        if group["value"].nunique() >= LEAST_VALUES:
            ordered = group.sort_values("value", kind="stable")
            line = Line(
                values=tuple(ordered["value"]),
                conditions=tuple(ordered["condition"]),
                rest=group["rest"].iloc[0],
            )
            lines.setdefault(number, []).append(line)
    return [Sweep(number=number, lines=tuple(own)) for number, own in lines.items()]


def sweep_name(number: str) -> str:
    """What a figure and its file call a number: its last word, such as `level`."""
    return number.rpartition(".")[2]


@styled()
def curve_figure(sweep: Sweep, summary: pd.DataFrame) -> Figure:
    """Draws a sweep: success above with Wilson's band, T_total below with the bootstrap's.

    A panel a scenario, world, model and what else there is of that kind; where lines are many, a panel a planner
    too. Over a number of a risk setting, the other settings of the same planner are horizontal lines.

    Args:
        sweep: from `find_sweeps`.
        summary: of the run.
    """
    return _Curves(sweep, summary).draw()


class _Curves:
    """What the lines of one sweep are called and look like, and where they stand."""

    def __init__(self, sweep: Sweep, summary: pd.DataFrame) -> None:
        self.sweep = sweep
        self.rows: dict[str, Labels] = {row["condition"]: row for row in summary.to_dict("records")}
        names = {self.name(line): self.first(line)["planner"] for line in sweep.lines}
        colours = condition_colours(list(names.values()), LINE_COLOURS)
        markers = [MARKERS[place // len(LINE_COLOURS) % len(MARKERS)] for place in range(len(names))]
        self.looks = dict(zip(names, zip(colours, markers, strict=True), strict=True))
        self.references: dict[str, Line2D] = {}

    def draw(self) -> Figure:
        groups = self.panels()
        across = min(len(groups), _MOST_ACROSS)
        down = -(-len(groups) // across)
        width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
        figure = Figure(figsize=(width, 3.3 * down + 0.5), layout="constrained")
        stacks = stack_panels(figure, len(groups), across, layers=2, sharex=True)
        for place, ((above, below), (title, lines)) in enumerate(zip(stacks, groups, strict=True)):
            for panel, (label, columns) in zip((above, below), _MEASURES.items(), strict=True):
                self.draw_references(panel, lines, columns)
                for line in lines:
                    self.draw_line(panel, line, columns)
                panel.grid(axis="y", color="0.9")
                if place % across == 0:
                    panel.set_ylabel(label)
            above.set_title(title)
            below.tick_params(labelbottom=True)
            below.set_xlabel(_NAMES.get(self.sweep.number, sweep_name(self.sweep.number)))
            values = sorted({value for line in self.sweep.lines for value in line.values})
            below.set_xticks(self.places(values), [f"{value:g}" for value in values])
        for panels in zip(*stacks, strict=True):
            _share_heights(panels)
        legend_outside(figure, list(self.references.values()), 2 if across == 1 else 4)
        return figure

    def panels(self) -> list[tuple[str, list[Line]]]:
        """Titles and lines of the panels: split until no panel holds more lines than a reader can distinguish."""
        for split in (("model",), ("model", "planner"), ("model", "planner", "risk")):
            groups: dict[tuple[str, ...], list[Line]] = {}
            for line in self.sweep.lines:
                groups.setdefault(self.place(line, split), []).append(line)
            if split == ("model",):
                groups = _with_blind(groups)
            if max(map(len, groups.values())) <= _MOST_LINES:
                break
        differing = [place for place, labels in enumerate(zip(*groups, strict=True)) if len(set(labels)) > 1]
        return [(joined(key[place] for place in differing) or key[0], lines) for key, lines in groups.items()]

    def first(self, line: Line) -> Labels:
        """The labels of a line, of which all conditions have the same but for the number."""
        return self.rows[line.conditions[0]]

    def place(self, line: Line, split: Sequence[str] = ("model",)) -> tuple[str, ...]:
        """What names the panel of a line: scenario, data, world, model, and what else it is split by."""
        row = self.first(line)
        world = (
            row["world"].split(" ")[0] if self.sweep.number.startswith(("world.", "rules.")) else row["world"]
        )
        scenario = str(line.rest["split"]).removeprefix("test/")
        labels = (self.label(line, name) for name in (*split, "robot", "objective"))
        return (scenario, str(line.rest.get("data", row["data"])), world, *labels)

    def label(self, line: Line, name: str) -> str:
        """A label of a line; of the part that is swept its name alone, since its label holds the number."""
        label = self.first(line)[name]
        if self.sweep.number.startswith(f"{name}.") and label != NOT_USED:
            label = str(line.rest[f"{name}.part"])
        return planner_name(label) if name == "planner" else label

    def name(self, line: Line) -> str:
        """What a line is called: planner and risk setting, and what its labels do not say where that is needed."""
        alike = [other for other in self.sweep.lines if self._said(other) == self._said(line)]
        differing = [key for key in line.rest if len({repr(other.rest.get(key)) for other in alike}) > 1]
        return joined([*self._said(line)[0], *(f"{sweep_name(key)} {line.rest[key]}" for key in differing)])

    def _said(self, line: Line) -> tuple[tuple[str, str], tuple[str, ...]]:
        return (self.label(line, "planner"), self.label(line, "risk")), self.place(line)

    def draw_line(self, panel: Axes, line: Line, columns: Columns) -> None:
        rate, low, high = (
            [columns[3] * self.rows[condition][name] for condition in line.conditions] for name in columns[:3]
        )
        name, places = self.name(line), self.places(line.values)
        colour, marker = self.looks[name]
        panel.fill_between(places, low, high, color=colour, alpha=0.15, lw=0)
        panel.plot(places, rate, color=colour, marker=marker, ms=3.5, lw=1.2, label=name)

    def draw_references(self, panel: Axes, lines: Sequence[Line], columns: Columns) -> None:
        """Draws the settings that have no such number, each in the colour of its planner's line."""
        if not self.sweep.number.startswith("risk."):
            return
        swept = {condition for line in self.sweep.lines for condition in line.conditions}
        others = [row for condition, row in self.rows.items() if condition not in swept]
        for line in lines:
            first = self.first(line)
            for row in others:
                blind = row["model"] == NOT_USED
                shared = _SAME if blind else (*_SAME, "model", "planner")
                if any(row[name] != first[name] for name in shared):
                    continue
                label = planner_name(row["planner"]) if blind else row["risk"]
                if label not in self.references:
                    style = _style(len(self.references))
                    self.references[label] = Line2D(
                        [], [], color=BLIND if blind else "0.2", lw=1, ls=style, label=label
                    )
                # Matplotlib names every pattern of dashes "--", so that a style cannot be read back from a line.
                style = _style(list(self.references).index(label))
                colour = BLIND if blind else self.looks[self.name(line)][0]
                panel.axhline(columns[3] * row[columns[0]], color=colour, ls=style, lw=1, zorder=1)

    def places(self, values: Sequence[float]) -> np.ndarray:
        """Where values stand: levels by the logarithm of the tail's share, since they crowd toward 1."""
        numbers = np.asarray(values)
        return -np.log(1 - numbers) if self.sweep.number == _LEVEL and numbers.max() < 1 else numbers


def _with_blind(groups: dict[tuple[str, ...], list[Line]]) -> dict[tuple[str, ...], list[Line]]:
    """Puts what is blind into the panels of the models that it stands beside."""
    merged: dict[tuple[str, ...], list[Line]] = {}
    for key, lines in groups.items():
        scenario, data, world, model, *rest = key
        beside = [k for k in groups if k != key and (*k[:3], *k[4:]) == (scenario, data, world, *rest)]
        if model != NOT_USED or not beside:
            merged[key] = [*merged.get(key, []), *lines]
            continue
        for other in beside:
            merged[other] = [*lines, *merged.get(other, [])]
    return merged


def _style(place: int) -> Any:
    """A pattern of dashes for each setting: those of `_STYLES`, then dashes with more and more dots between."""
    more = place - len(_STYLES) + 3
    return _STYLES[place] if place < len(_STYLES) else (0, (8, 2, *(1, 1.5) * more))


def _share_heights(panels: Sequence[Axes]) -> None:
    """Gives panels of one measure the same range, and numbers at the left alone."""
    ends = np.array([panel.get_ylim() for panel in panels])
    for panel in panels:
        panel.set_ylim(ends[:, 0].min(), ends[:, 1].max())
        panel.tick_params(labelleft=bool(panel.get_ylabel()))
