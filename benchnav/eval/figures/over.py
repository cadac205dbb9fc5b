"""Sweeps of a run as curves: conditions that differ in one number of three values."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchnav.core import registry
from benchnav.datagen.recipe.scenario import find_series
from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.lines import MAX_ACROSS, divide_lines
from benchnav.eval.words import joined
from benchnav.planning.free_space import Rules
from benchnav.viz.figure import Figure
from benchnav.viz.panels import Curves, line_looks
from benchnav.viz.style import (
    BLIND,
    LINE_COLOURS,
    condition_colours,
    legend_outside,
    planner_name,
    risk_name,
)

SEVERITY = "severity"
MIN_VALUES = 3

_LEVEL = "risk.options.level"
_NAMES = {_LEVEL: "level α", SEVERITY: "severity of the scenario"}
# Columns of the summary of each measure, and their factor.
_MEASURES = {
    "success [%]": ("success_rate", "success_low", "success_high", 100.0),
    "T_total [s]": ("total_time_mean_s", "total_time_low_s", "total_time_high_s", 1.0),
}
_SAME = ("data", "scenario", "world", "robot", "objective")

# Columns in titles of panels; planner and risk setting only if there are many lines.
_LABELS = (
    "scenario",
    "data",
    "world",
    "model",
    *KNOWLEDGE,
    "who",
    "risk",
    "robot",
    "objective",
)
_PANEL_COLUMNS = [
    [name for name in _LABELS if name not in left_out]
    for left_out in (("who", "risk"), ("risk",), ())
]


@dataclass(frozen=True, kw_only=True)
class Line:
    """Conditions of a sweep that differ only in its number.

    Args:
        values: values of the number, ascending.
        conditions: ids, one a value.
        rest: all other settings of the conditions, by dotted name.
    """

    values: tuple[float, ...]
    conditions: tuple[str, ...]
    rest: Mapping[str, Any]


def find_sweeps(conditions: Mapping[str, Mapping[str, Any]]) -> dict[str, list[Line]]:
    """Find the sweeps of a run.

    Numbers that change together are no sweep.

    Args:
        conditions: entries of `run.json` by id, with `value`.

    Returns:
        Lines in the order of the run, by the dotted name of their number, such as
        `risk.options.level`; `severity` is that of scenarios.
    """
    values = {
        name: _with_defaults(entry["value"])
        for name, entry in conditions.items()
        if "split" in entry["value"]
    }
    flat = [pd.json_normalize(value).to_dict("records")[0] for value in values.values()]
    table_of_values = pd.DataFrame(flat, index=list(values), dtype=object)
    tables = [(number, table_of_values) for number in sorted(table_of_values)]
    for scenario, pairs in find_series(
        dict.fromkeys(table_of_values.get("split", ()))
    ).items():
        severities = {split: severity for severity, split in pairs}
        of_series = table_of_values[table_of_values["split"].isin(list(severities))]
        tables.append(
            (
                SEVERITY,
                of_series.assign(
                    severity=of_series["split"].map(severities), split=scenario
                ),
            )
        )
    sweeps: dict[str, list[Line]] = {}
    for number, table in tables:
        table = table[table[number].map(_is_number)]
        fixed = table.drop(columns=number)
        for _, group in table.groupby(
            fixed.astype(str).apply(tuple, axis=1), sort=False
        ):
            if group[number].nunique() >= MIN_VALUES:
                ordered = group[number].astype(float).sort_values(kind="stable")
                line = Line(
                    values=tuple(ordered),
                    conditions=tuple(ordered.index),
                    rest=fixed.loc[ordered.index[0]].dropna().to_dict(),
                )
                sweeps.setdefault(number, []).append(line)
    return sweeps


def _with_defaults(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return a condition's value completed by default rules and planner options."""
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
    """Return the name of a number in figures and files: its last word, as `level`."""
    return number.rpartition(".")[2]


class Over(Figure):
    """Success and T_total over a number that otherwise equal conditions differ in.

    Attributes:
        number: a name from `find_sweeps`.
        lines: lines of that number.
    """

    name = "over"
    number = ""
    lines: Sequence[Line] = ()

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return a figure a sweep."""
        sweeps = find_sweeps(data.about["conditions"])
        counts = Counter(map(sweep_name, sweeps))
        short_names = {
            sweep: sweep_name(sweep)
            if counts[sweep_name(sweep)] == 1
            else sweep.replace(".", "-")
            for sweep in sweeps
        }
        return [
            self.variant(number=number, lines=lines, name=f"over-{short_names[number]}")
            for number, lines in sweeps.items()
        ]

    def caption(self, data: RunData) -> str:
        """Return which number it is."""
        return (
            f"Success and T_total over {self.name.removeprefix('over-')}. Bands are "
            "95 % intervals; horizontal lines are settings without this number."
        )

    def draw(self, data: RunData) -> Drawing:
        """Draw success above with Wilson's band, T_total below with the bootstrap's.

        There is a panel for each scenario, world, model and so on, and for each planner
        if there are many lines. Over a number of a risk setting, other settings of the
        same planner are horizontal lines.
        """
        rows = data.summary.set_index("condition", drop=False)
        labels = _label_lines(self.number, self.lines, rows)
        planners = labels.drop_duplicates("name").set_index("name")["planner"]
        looks = line_looks(
            planners.index, condition_colours(planners.tolist(), LINE_COLOURS)
        )
        _, groups = divide_lines(labels, _PANEL_COLUMNS)
        groups = [
            (title or labels["scenario"][shown[0]], shown) for title, shown in groups
        ]
        columns_of_measures: dict[str, pd.Series] = {}
        for name, (*columns, scale) in _MEASURES.items():
            for end, column in zip(("", "_low", "_high"), columns, strict=True):
                columns_of_measures[name + end] = scale * rows[column]
        measured = pd.DataFrame(columns_of_measures)
        points = []
        for title, shown in groups:
            for index in shown:
                line = self.lines[index]
                x = _positions(self.number, line.values)
                of_line = measured.loc[list(line.conditions)]
                name = labels["name"][index]
                points.append(of_line.assign(panel=title, line=name, x=x))
        across = min(len(groups), MAX_ACROSS)
        measures = {name: name for name in _MEASURES}
        label = _NAMES.get(self.number, sweep_name(self.number))
        curves = Curves(
            table=pd.concat(points),
            measures=measures,
            looks=looks,
            x_label=label,
            across=across,
        )
        figure, panels = curves.draw()
        ticks = sorted({value for line in self.lines for value in line.values})
        for panel in panels.values():
            panel.set_xticks(
                _positions(self.number, ticks), [f"{value:g}" for value in ticks]
            )
        if self.number.startswith("risk."):
            others = rows.drop(
                [condition for line in self.lines for condition in line.conditions]
            )
            for title, shown in groups:
                colours = {
                    index: looks[labels["name"][index]]["color"] for index in shown
                }
                firsts = {
                    index: rows.loc[self.lines[index].conditions[0]] for index in shown
                }
                for measure in _MEASURES:
                    _draw_references(
                        panels[title, measure],
                        others,
                        measured[measure],
                        firsts,
                        colours,
                    )
        legend_outside(figure)
        return figure


def _draw_references(
    panel: Axes,
    others: pd.DataFrame,
    values: pd.Series,
    firsts: Mapping[int, pd.Series],
    colours: Mapping[int, Any],
) -> None:
    """Draw settings without the number, of the same planner or blind, as lines."""
    settings = [
        risk_name(row["risk"])
        if row["model"] != NOT_USED
        else planner_name(row["planner"])
        for row in others.to_dict("records")
    ]
    order = list(dict.fromkeys(settings))
    for index, first_row in firsts.items():
        for name, (condition, row) in zip(settings, others.iterrows(), strict=True):
            is_blind = row["model"] == NOT_USED
            shared = list(_SAME) if is_blind else [*_SAME, "model", "planner"]
            if (row[shared] == first_row[shared]).all():
                colour = BLIND if is_blind else colours[index]
                # Dashes with an increasing number of dots distinguish settings.
                dashes = (0, (6, 2, *(1, 1.5) * order.index(name)))
                panel.axhline(
                    values[condition],
                    color=colour,
                    ls=dashes,
                    lw=1,
                    zorder=1,
                    label=name,
                )


def _label_lines(
    number: str, lines: Sequence[Line], rows: pd.DataFrame
) -> pd.DataFrame:
    """Return `_LABELS`, `planner` and `name` of each line, a row a line.

    A swept part is named without its label, which contains the number.
    """
    labelled = rows.loc[[line.conditions[0] for line in lines]].reset_index(drop=True)
    labelled["scenario"] = [
        str(line.rest["split"]).removeprefix("test/") for line in lines
    ]
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
    for _, group in labelled.groupby(list(_LABELS), sort=False):
        rests = [lines[index].rest for index in group.index]
        for index, rest in zip(group.index, rests, strict=True):
            # Settings that no label shows are appended if lines would coincide.
            differing = [
                key
                for key in rest
                if len({repr(fixed.get(key)) for fixed in rests}) > 1
            ]
            extra = (f"{sweep_name(key)} {rest[key]}" for key in differing)
            names[index] = joined([group["who"][index], group["risk"][index], *extra])
    return labelled.assign(name=pd.Series(names))


def _positions(number: str, values: Sequence[float]) -> np.ndarray:
    """Return positions of values; levels by the logarithm of the tail's weight."""
    numbers = np.asarray(values)
    return -np.log(1 - numbers) if number == _LEVEL and numbers.max() < 1 else numbers
