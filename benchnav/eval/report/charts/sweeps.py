"""Sweeps of a run: conditions that are equal in all but one number, which takes three values or more, as curves."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.core import registry
from benchnav.core.figures import (
    BLIND,
    LINE_COLOURS,
    MARKERS,
    ONE_COLUMN_IN,
    TWO_COLUMNS_IN,
    condition_colours,
    legend_outside,
    planner_name,
    risk_name,
    stack_panels,
    styled,
)
from benchnav.datagen.recipe.scenario import find_series
from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.report.words import joined
from benchnav.planning.free_space import Rules

SEVERITY = "severity"
LEAST_VALUES = 3

_LEVEL = "risk.options.level"
_NAMES = {_LEVEL: "level α", SEVERITY: "severity of the scenario"}
# Of each measure its columns of the summary, and what they are multiplied by.
_MEASURES = {
    "success [%]": ("success_rate", "success_low", "success_high", 100.0),
    "T_total [s]": ("total_time_mean_s", "total_time_low_s", "total_time_high_s", 1.0),
}
_MOST_LINES, _MOST_ACROSS = 7, 4
_SAME = ("data", "scenario", "world", "robot", "objective")

Labels = Mapping[Any, Any]

# What panels are named by, in order.
_LABELS = ("scenario", "data", "world", "model", *KNOWLEDGE, "who", "risk", "robot", "objective")


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


def find_sweeps(conditions: Mapping[str, Mapping[str, Any]]) -> dict[str, list[Line]]:
    """Finds the sweeps of a run.

    A number that others follow, such as two that were changed together, makes no sweep.

    Args:
        conditions: by id, with `value`, as `run.json` holds them.

    Returns:
        Lines in the order of the run, by the name of their number with dots, such as `risk.options.level`;
        `severity` is that of scenarios.
    """
    values = {
        name: _with_defaults(about["value"])
        for name, about in conditions.items()
        if "split" in about["value"]
    }
    flat = [pd.json_normalize(value).to_dict("records")[0] for value in values.values()]
    known = pd.DataFrame(flat, index=list(values), dtype=object)
    tables = [(number, known) for number in sorted(known)]
    for scenario, pairs in find_series(dict.fromkeys(known.get("split", ()))).items():
        severities = {split: severity for severity, split in pairs}
        own = known[known["split"].isin(list(severities))]
        tables.append((SEVERITY, own.assign(severity=own["split"].map(severities), split=scenario)))
    sweeps: dict[str, list[Line]] = {}
    for number, table in tables:
        table = table[table[number].map(_is_number)]
        rest = table.drop(columns=number)
        for _, alike in table.groupby(rest.astype(str).apply(tuple, axis=1), sort=False):
            if alike[number].nunique() >= LEAST_VALUES:
                ordered = alike[number].astype(float).sort_values(kind="stable")
                line = Line(
                    values=tuple(ordered),
                    conditions=tuple(ordered.index),
                    rest=rest.loc[ordered.index[0]].dropna().to_dict(),
                )
                sweeps.setdefault(number, []).append(line)
    return sweeps


def _with_defaults(value: Mapping[str, Any]) -> dict[str, Any]:
    """A condition's value with rules and options of shipped planners that stand in it only where they differ."""
    planner = value["planner"]
    later = {}
    if planner["part"] in registry.names("planner"):
        later = registry.later_options("planner", planner["part"])
    options = {**later, **planner["options"]}
    return {
        **value,
        "rules": {**asdict(Rules()), **value.get("rules", {})},
        "planner": {**planner, "options": options},
    }


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and pd.notna(value)


def sweep_name(number: str) -> str:
    """What a figure and its file call a number: its last word, such as `level`."""
    return number.rpartition(".")[2]


@styled()
def curve_figure(number: str, lines: Sequence[Line], summary: pd.DataFrame) -> Figure:
    """Draws a sweep: success above with Wilson's band, T_total below with the bootstrap's.

    A panel a scenario, world, model and what else there is of that kind; where lines are many, a panel a planner
    too. Over a number of a risk setting, the other settings of the same planner are horizontal lines.

    Args:
        number: a name from `find_sweeps`.
        lines: those of the number.
        summary: of the run.
    """
    rows = summary.set_index("condition", drop=False)
    labels = _label_lines(number, lines, rows)
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
    values = sorted({value for line in lines for value in line.values})
    swept = [condition for line in lines for condition in line.conditions]
    others = rows.drop(swept).to_dict("records") if number.startswith("risk.") else []
    references: dict[str, dict[str, Any]] = {}
    for place, ((above, below), (title, shown)) in enumerate(zip(stacks, groups, strict=True)):
        for panel, (measure, (*names, scale)) in zip((above, below), _MEASURES.items(), strict=True):
            for line_place in shown:
                line, name = lines[line_place], labels["name"][line_place]
                own = rows.loc[list(line.conditions)]
                for label, row in _references(own.iloc[0], others):
                    blind = row["model"] == NOT_USED
                    # A pattern of dashes for each setting, with more and more dots between.
                    dashes = (0, (6, 2, *(1, 1.5) * len(references)))
                    colour = BLIND if blind else colours[name]
                    look = references.setdefault(label, {"color": colour, "ls": dashes})
                    if look["color"] != colour:  # of several planners
                        look["color"] = "0.2"
                    panel.axhline(scale * row[names[0]], color=colour, ls=look["ls"], lw=1, zorder=1)
                rate, low, high = (scale * own[column] for column in names)
                marker = MARKERS[list(colours).index(name) % len(MARKERS)]
                places = _places(number, line.values)
                panel.fill_between(places, low, high, color=colours[name], alpha=0.15, lw=0)
                panel.plot(places, rate, color=colours[name], marker=marker, ms=3.5, lw=1.2, label=name)
            panel.grid(axis="y", color="0.9")
            panel.tick_params(labelleft=place % across == 0)
            panel.set_ylabel("" if place % across else measure)
        above.set_title(title)
        below.tick_params(labelbottom=True)
        below.set_xlabel(_NAMES.get(number, sweep_name(number)))
        below.set_xticks(_places(number, values), [f"{value:g}" for value in values])
    handles = [Line2D([], [], lw=1, label=label, **look) for label, look in references.items()]
    legend_outside(figure, handles, 2 if across == 1 else 4)
    return figure


def _label_lines(number: str, lines: Sequence[Line], rows: pd.DataFrame) -> pd.DataFrame:
    """What names lines and their panels: a row a line, with the `planner` and the `name` of the line beside `_LABELS`.

    Of the part that is swept it is the name alone, since its label holds the number.
    """
    labelled = rows.loc[[line.conditions[0] for line in lines]].reset_index(drop=True)
    labelled["scenario"] = [str(line.rest["split"]).removeprefix("test/") for line in lines]
    labelled["who"] = labelled["planner"]
    if number.startswith(("world.", "rules.")):
        labelled["world"] = labelled["world"].str.partition(" ")[0]
    part = number.partition(".")[0]
    column = "who" if part == "planner" else part
    if f"{part}.part" in lines[0].rest:
        parts = np.array([line.rest.get(f"{part}.part") for line in lines])
        labelled[column] = labelled[column].where(labelled[column] == NOT_USED, parts)
    labelled["who"] = labelled["who"].map(planner_name)
    labelled["risk"] = labelled["risk"].map(risk_name)
    names = {}
    for _, alike in labelled.groupby(list(_LABELS), sort=False):
        rests = [lines[place].rest for place in alike.index]
        for place, rest in zip(alike.index, rests, strict=True):
            # What labels do not say is said where that is needed.
            differing = [key for key in rest if len({repr(other.get(key)) for other in rests}) > 1]
            more = (f"{sweep_name(key)} {rest[key]}" for key in differing)
            names[place] = joined([alike["who"][place], alike["risk"][place], *more])
    return labelled.assign(name=pd.Series(names))


def _panels(labels: pd.DataFrame) -> list[tuple[str, list[int]]]:
    """Titles and lines of the panels: split until no panel holds more lines than a reader can distinguish.

    What is blind stands in the panels of the models, and of what robots know, that it stands beside.
    """
    unused = ["model", *KNOWLEDGE]
    numbered = labels.assign(line=labels.index)
    blind = numbered["model"] == NOT_USED
    for left_out in ({"who", "risk"}, {"risk"}, set()):
        columns = [name for name in _LABELS if name not in left_out]
        panels = numbered.loc[~blind, columns].drop_duplicates()
        shared = [name for name in columns if name not in unused]
        beside = numbered[blind].drop(columns=unused).merge(panels, "left", shared)
        every = pd.concat([numbered[~blind], beside.fillna(dict.fromkeys(unused, NOT_USED))])
        groups = every.groupby(columns, sort=False)["line"].agg(list).reset_index()
        if groups["line"].map(len).max() <= _MOST_LINES:
            break
    differing = [name for name in columns if groups[name].nunique() > 1]
    return [(joined(own[differing]) or own["scenario"], own["line"]) for _, own in groups.iterrows()]


def _references(first: Labels, others: Iterable[Labels]) -> Iterator[tuple[str, Labels]]:
    """Settings that have no such number and stand beside a line: of its planner, and blind ones."""
    for row in others:
        blind = row["model"] == NOT_USED
        shared = _SAME if blind else (*_SAME, "model", "planner")
        if all(row[name] == first[name] for name in shared):
            yield planner_name(row["planner"]) if blind else risk_name(row["risk"]), row


def _places(number: str, values: Sequence[float]) -> np.ndarray:
    """Where values stand: levels by the logarithm of the tail's share, since they crowd toward 1."""
    numbers = np.asarray(values)
    return -np.log(1 - numbers) if number == _LEVEL and numbers.max() < 1 else numbers
