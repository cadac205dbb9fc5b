"""Sweeps of a run: conditions that are equal in all but one number, which takes three values or more, as curves."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
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

# What panels are named by, in order.
_LABELS = ("scenario", "data", "world", "model", "who", "risk", "robot", "objective")


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
    rows = summary.set_index("condition", drop=False)
    labels = _label_lines(sweep, rows)
    planners = labels.drop_duplicates("name").set_index("name")["planner"]
    colours = dict(zip(planners.index, condition_colours(planners.tolist(), LINE_COLOURS), strict=True))
    groups = _panels(labels)
    across = min(len(groups), _MOST_ACROSS)
    down = -(-len(groups) // across)
    width = ONE_COLUMN_IN if across == 1 else TWO_COLUMNS_IN
    figure = Figure(figsize=(width, 3.3 * down + 0.5), layout="constrained")
    stacks = stack_panels(figure, len(groups), across, layers=2, sharex=True)
    for above, below in stacks[1:]:
        above.sharey(stacks[0][0])
        below.sharey(stacks[0][1])
    values = sorted({value for line in sweep.lines for value in line.values})
    swept = [condition for line in sweep.lines for condition in line.conditions]
    others = rows.drop(swept).to_dict("records") if sweep.number.startswith("risk.") else []
    references: dict[str, str] = {}
    for place, ((above, below), (title, lines)) in enumerate(zip(stacks, groups, strict=True)):
        for panel, (measure, (*names, scale)) in zip((above, below), _MEASURES.items(), strict=True):
            for number in lines:
                line, name = sweep.lines[number], labels["name"][number]
                own = rows.loc[list(line.conditions)]
                for label, row in _references(own.iloc[0], others):
                    blind = row["model"] == NOT_USED
                    references.setdefault(label, BLIND if blind else "0.2")
                    style = _style(list(references).index(label))
                    colour = BLIND if blind else colours[name]
                    panel.axhline(scale * row[names[0]], color=colour, ls=style, lw=1, zorder=1)
                rate, low, high = (scale * own[column] for column in names)
                marker = MARKERS[list(colours).index(name) // len(LINE_COLOURS) % len(MARKERS)]
                places = _places(sweep, line.values)
                panel.fill_between(places, low, high, color=colours[name], alpha=0.15, lw=0)
                panel.plot(places, rate, color=colours[name], marker=marker, ms=3.5, lw=1.2, label=name)
            panel.grid(axis="y", color="0.9")
            panel.tick_params(labelleft=place % across == 0)
            panel.set_ylabel("" if place % across else measure)
        above.set_title(title)
        below.tick_params(labelbottom=True)
        below.set_xlabel(_NAMES.get(sweep.number, sweep_name(sweep.number)))
        below.set_xticks(_places(sweep, values), [f"{value:g}" for value in values])
    # Matplotlib names every pattern of dashes "--", so that a style cannot be read back from a line.
    handles = [
        Line2D([], [], color=colour, lw=1, ls=_style(place), label=label)
        for place, (label, colour) in enumerate(references.items())
    ]
    legend_outside(figure, handles, 2 if across == 1 else 4)
    return figure


def _label_lines(sweep: Sweep, rows: pd.DataFrame) -> pd.DataFrame:
    """What names lines and their panels: a row a line, with the `planner` and the `name` of the line beside `_LABELS`.

    Of the part that is swept it is the name alone, since its label holds the number.
    """
    table = []
    for line in sweep.lines:
        first = rows.loc[line.conditions[0]]
        labels = {name: first[name] for name in ("model", "planner", "risk", "robot", "objective")}
        for name, label in labels.items():
            if sweep.number.startswith(f"{name}.") and label != NOT_USED:
                labels[name] = str(line.rest[f"{name}.part"])
        world = first["world"]
        table.append(
            {
                "scenario": str(line.rest["split"]).removeprefix("test/"),
                "data": str(line.rest.get("data", first["data"])),
                "world": world.split(" ")[0] if sweep.number.startswith(("world.", "rules.")) else world,
                **labels,
                "planner": first["planner"],
                "who": planner_name(labels["planner"]),
            }
        )
    labelled = pd.DataFrame(table)
    names = {}
    for _, alike in labelled.groupby(list(_LABELS), sort=False):
        rests = [sweep.lines[number].rest for number in alike.index]
        for number, rest in zip(alike.index, rests, strict=True):
            # What labels do not say is said where that is needed.
            differing = [key for key in rest if len({repr(other.get(key)) for other in rests}) > 1]
            more = (f"{sweep_name(key)} {rest[key]}" for key in differing)
            names[number] = joined([alike["who"][number], alike["risk"][number], *more])
    return labelled.assign(name=pd.Series(names))


def _panels(labels: pd.DataFrame) -> list[tuple[str, list[int]]]:
    """Titles and lines of the panels: split until no panel holds more lines than a reader can distinguish."""
    for left_out in (("who", "risk"), ("risk",), ()):
        columns = [name for name in _LABELS if name not in left_out]
        groups = {key: group.index.tolist() for key, group in labels.groupby(columns, sort=False)}
        if len(left_out) == 2:
            groups = _with_blind(groups)
        if max(map(len, groups.values())) <= _MOST_LINES:
            break
    differing = [place for place, own in enumerate(zip(*groups, strict=True)) if len(set(own)) > 1]
    return [(joined(key[place] for place in differing) or key[0], lines) for key, lines in groups.items()]


def _references(first: Labels, others: Iterable[Labels]) -> Iterator[tuple[str, Labels]]:
    """Settings that have no such number and stand beside a line: of its planner, and blind ones."""
    for row in others:
        blind = row["model"] == NOT_USED
        shared = _SAME if blind else (*_SAME, "model", "planner")
        if all(row[name] == first[name] for name in shared):
            yield planner_name(row["planner"]) if blind else row["risk"], row


def _places(sweep: Sweep, values: Sequence[float]) -> np.ndarray:
    """Where values stand: levels by the logarithm of the tail's share, since they crowd toward 1."""
    numbers = np.asarray(values)
    return -np.log(1 - numbers) if sweep.number == _LEVEL and numbers.max() < 1 else numbers


def _with_blind(groups: dict[Any, list[int]]) -> dict[Any, list[int]]:
    """Puts what is blind into the panels of the models that it stands beside."""
    merged: dict[Any, list[int]] = {}
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
