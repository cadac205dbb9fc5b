"""Sweeps of a run as curves: conditions that differ only in one number."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D

from benchnav.core import registry
from benchnav.datagen.recipe.scenario import find_series
from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.lines import MAX_ACROSS, divide_lines
from benchnav.eval.words import joined
from benchnav.planning.free_space import Rules
from benchnav.viz.figure import Figure
from benchnav.viz.panels import Curves, Looks, line_looks, ticks_of
from benchnav.viz.style import (
    BLIND,
    LINE_COLOURS,
    TWO_COLUMNS_IN,
    condition_colours,
    legend_outside,
    planner_name,
    risk_name,
)

SEVERITY = "severity"
MIN_VALUES = 3  # minimum number of values of a sweep

_LEVEL = "risk.options.level"
_NAMES = {_LEVEL: "level α", SEVERITY: "severity of the scenario"}
_LABEL_IN = 0.26  # width of the label of a tick and a gap, in inches
_SIDE_IN = 0.35  # distance between the axes of neighbouring panels, in inches
# Columns of the summary (mean, lower and upper limit) and their factor, by measure.
_MEASURES = {
    "success [%]": ("success_rate", "success_low", "success_high", 100.0),
    "T_total [s]": ("total_time_mean_s", "total_time_low_s", "total_time_high_s", 1.0),
}
_SAME = ("data", "scenario", "world", "robot", "objective")

# Columns in titles of panels. Planner (`who`) and risk setting are used only if there
# are many lines.
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
    """Conditions that differ only in the number of a sweep.

    Args:
        values: values of the number, ascending.
        conditions: ids of the conditions, one per value.
        rest: all other settings of the conditions, by dotted name.
    """

    values: tuple[float, ...]
    conditions: tuple[str, ...]
    rest: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A setting without the number of a sweep, drawn as a horizontal line.

    Args:
        condition: id of the condition.
        name: name of the setting in the legend.
        look: style of the line, as keywords of `Axes.axhline`.
    """

    condition: str
    name: str
    look: Mapping[str, Any]


def find_sweeps(conditions: Mapping[str, Mapping[str, Any]]) -> dict[str, list[Line]]:
    """Find the sweeps of a run.

    A sweep has at least `MIN_VALUES` values of one number, while all other settings are
    constant.

    Args:
        conditions: entries of `run.json` by id, with `value`.

    Returns:
        Lines in the order of the run, by the dotted name of the number, such as
        `risk.options.level`; for series of scenarios, the name is `severity`.
    """
    values = {
        name: _with_defaults(entry["value"])
        for name, entry in conditions.items()
        if "split" in entry["value"]
    }
    flat = [pd.json_normalize(value).to_dict("records")[0] for value in values.values()]
    table_of_values = pd.DataFrame(flat, index=list(values), dtype=object)
    tables = [(number, table_of_values) for number in sorted(table_of_values)]
    tables += [(SEVERITY, table) for table in _series_tables(table_of_values)]
    sweeps: dict[str, list[Line]] = {}
    for number, table in tables:
        numeric = table[table[number].map(_is_number)]
        fixed = numeric.drop(columns=number)
        keys = fixed.astype(str).apply(tuple, axis=1)
        for _, group in numeric.groupby(keys, sort=False):
            if group[number].nunique() < MIN_VALUES:
                continue
            ordered = group[number].astype(float).sort_values(kind="stable")
            ids = tuple(ordered.index)
            other_settings = fixed.loc[ids[0]].dropna().to_dict()
            line = Line(values=tuple(ordered), conditions=ids, rest=other_settings)
            sweeps.setdefault(number, []).append(line)
    return sweeps


def _series_tables(values: pd.DataFrame) -> list[pd.DataFrame]:
    """Return a table for each series of scenarios, with a column `severity`.

    In this table, `split` is the name of the series.
    """
    splits = dict.fromkeys(values.get("split", ()))
    tables = []
    for scenario, pairs in find_series(splits).items():
        severities = {split: severity for severity, split in pairs}
        in_series = values["split"].isin(list(severities))
        table = values[in_series]
        severity = table["split"].map(severities)
        tables.append(table.assign(severity=severity, split=scenario))
    return tables


def _with_defaults(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return a condition's value, completed by defaults of rules and planner options."""
    planner = value["planner"]
    later_options = {}
    if planner["part"] in registry.names("planner"):
        later_options = registry.later_options("planner", planner["part"])
    options = later_options | planner["options"]
    rules = asdict(Rules()) | value.get("rules", {})
    return {**value, "rules": rules, "planner": {**planner, "options": options}}


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and pd.notna(value)


def sweep_name(number: str) -> str:
    """Return the last word of a number's dotted name, such as `level`, for figures."""
    return number.rpartition(".")[2]


class Over(Figure):
    """Success and T_total over the number of a sweep.

    Attributes:
        number: dotted name of the number, from `find_sweeps`.
        lines: lines of the sweep.
    """

    name = "over"
    number = ""
    lines: Sequence[Line] = ()

    def variants(self, data: RunData) -> Sequence[Self]:
        """Return one figure per sweep."""
        sweeps = find_sweeps(data.about["conditions"])
        counts = Counter(map(sweep_name, sweeps))
        figures = []
        for number, lines in sweeps.items():
            short_name = sweep_name(number)
            if counts[short_name] > 1:
                short_name = number.replace(".", "-")
            name = f"over-{short_name}"
            figures.append(self.variant(number=number, lines=lines, name=name))
        return figures

    def caption(self, data: RunData) -> str:
        """Return a caption that names the number and explains bands, lines and axis."""
        sentences = [
            f"Success and T_total over {self.name.removeprefix('over-')}.",
            "Points are conditions, and bands are their 95 % intervals.",
        ]
        if self.number.startswith("risk."):
            sentences.append(
                "Horizontal broken lines are settings without this number, in the "
                "colour of their planner, or in grey for a blind planner."
            )
        if self.number == _LEVEL:
            sentences.append(
                "The axis is spaced by the logarithm of 1 − α, the fraction of the "
                "lower tail."
            )
        return " ".join(sentences)

    def draw(self, data: RunData) -> Drawing:
        """Draw success above and T_total below, with bands of 95 % intervals.

        There is a panel for each scenario, world, model and so on; if there are many
        lines, also for each planner. If the number belongs to a risk setting, other
        settings of the same planner are horizontal lines.
        """
        rows = data.summary.set_index("condition", drop=False)
        labels = _label_lines(self.number, self.lines, rows)
        looks = _looks_of_lines(labels)
        _, groups = divide_lines(labels, _PANEL_COLUMNS)
        groups = [
            (title or labels["scenario"][shown[0]], shown) for title, shown in groups
        ]
        measured = _measured(rows)
        points = []
        for title, shown in groups:
            for index in shown:
                line = self.lines[index]
                x = _positions(self.number, line.values)
                line_points = measured.loc[list(line.conditions)]
                name = labels["name"][index]
                points.append(line_points.assign(panel=title, line=name, x=x))
        curves = Curves(
            table=pd.concat(points),
            measures={name: name for name in _MEASURES},
            looks=looks,
            x_label=_NAMES.get(self.number, sweep_name(self.number)),
            across=min(len(groups), MAX_ACROSS),
        )
        figure, panels = curves.draw()
        self._label_ticks(list(panels.values()), curves.across)
        handles: list[Line2D] = []
        if self.number.startswith("risk."):
            by_panel = {
                title: self._references(rows, labels["name"], looks, shown)
                for title, shown in groups
            }
            for (title, measure), panel in panels.items():
                for reference in by_panel[title]:
                    value = measured.loc[reference.condition, measure]
                    panel.axhline(value, label="_reference", **reference.look)
            references = [line for lines in by_panel.values() for line in lines]
            handles = _reference_handles(references)
        legend_outside(figure, handles)
        return figure

    def _label_ticks(self, panels: Sequence[Axes], across: int) -> None:
        """Label the values of the number, except where labels would overlap."""
        ticks = sorted({value for line in self.lines for value in line.values})
        positions = _positions(self.number, ticks)
        width_in = TWO_COLUMNS_IN / max(across, 2) - _SIDE_IN
        min_gap = (positions[-1] - positions[0]) * _LABEL_IN / width_in
        labels = [""] * len(ticks)
        # The loop starts at the last value, since high levels matter most.
        next_position = np.inf
        for index in reversed(range(len(ticks))):
            if next_position - positions[index] >= min_gap:
                labels[index] = f"{ticks[index]:g}"
                next_position = positions[index]
        for panel in panels:
            panel.set_xticks(positions, labels)
            ticks_of(panel, "y", 5)

    def _references(
        self,
        rows: pd.DataFrame,
        names: pd.Series,
        looks: Looks,
        shown: Sequence[int],
    ) -> list[Reference]:
        """Return the horizontal lines of a panel, for settings without the number.

        A setting is shown if the panel has a line of its planner. A blind planner is
        shown in all panels of its block.

        Args:
            rows: rows of the summary, by condition.
            names: names of the lines of the sweep.
            looks: styles of lines by name.
            shown: indices of the lines in the panel.
        """
        swept = [condition for line in self.lines for condition in line.conditions]
        other_rows = rows.drop(swept)
        settings = [_setting_name(row) for row in other_rows.to_dict("records")]
        order = list(dict.fromkeys(settings))
        references = []
        for index in shown:
            first_row = rows.loc[self.lines[index].conditions[0]]
            line_colour = looks[names[index]]["color"]
            named_rows = zip(settings, other_rows.iterrows(), strict=True)
            for name, (condition, row) in named_rows:
                is_blind = row["model"] == NOT_USED
                shared = list(_SAME) if is_blind else [*_SAME, "model", "planner"]
                if (row[shared] != first_row[shared]).any():
                    continue
                colour = BLIND if is_blind else line_colour
                # The number of dots after a dash distinguishes settings.
                dashes = (0, (6, 2, *(1, 1.5) * order.index(name)))
                look = {"color": colour, "ls": dashes, "lw": 1, "zorder": 1}
                reference = Reference(condition=str(condition), name=name, look=look)
                references.append(reference)
        return references


def _looks_of_lines(labels: pd.DataFrame) -> dict[str, dict[str, Any]]:
    planners = labels.drop_duplicates("name").set_index("name")["planner"]
    colours = condition_colours(planners.tolist(), LINE_COLOURS)
    return line_looks(planners.index, colours)


def _measured(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the measures `_MEASURES` and their interval limits, by condition."""
    measured: dict[str, pd.Series] = {}
    for name, (*columns, scale) in _MEASURES.items():
        for end, column in zip(("", "_low", "_high"), columns, strict=True):
            measured[name + end] = scale * rows[column]
    return pd.DataFrame(measured)


def _setting_name(row: Mapping[Any, Any]) -> str:
    if row["model"] == NOT_USED:
        return planner_name(row["planner"])
    return risk_name(row["risk"])


def _reference_handles(references: Sequence[Reference]) -> list[Line2D]:
    """Return a legend entry for each setting.

    An entry is black if the lines of its setting have several colours.
    """
    handles = []
    for name in dict.fromkeys(reference.name for reference in references):
        line_looks_ = [line.look for line in references if line.name == name]
        look = dict(line_looks_[0])
        if len({line_look["color"] for line_look in line_looks_}) > 1:
            look["color"] = "black"
        handles.append(Line2D([], [], label=name, **look))
    return handles


def _label_lines(
    number: str, lines: Sequence[Line], rows: pd.DataFrame
) -> pd.DataFrame:
    """Return one row per line, with the columns `_LABELS`, `planner` and `name`.

    A part with a swept option has its name instead of its label, which contains the
    number.
    """
    first_conditions = [line.conditions[0] for line in lines]
    labelled = rows.loc[first_conditions].reset_index(drop=True)
    splits = [str(line.rest["split"]) for line in lines]
    labelled["scenario"] = [split.removeprefix("test/") for split in splits]
    labelled["who"] = labelled["planner"]
    if number.startswith(("world.", "rules.")):
        labelled["world"] = labelled["world"].str.partition(" ")[0]
    part = number.partition(".")[0]
    column = "who" if part == "planner" else part
    key = f"{part}.part"
    if key in lines[0].rest:
        parts = np.array([line.rest.get(key) for line in lines])
        is_unused = labelled[column] == NOT_USED
        labelled[column] = labelled[column].where(is_unused, parts)
    labelled["who"] = labelled["who"].map(planner_name)
    labelled["risk"] = labelled["risk"].map(risk_name)
    names: dict[Any, str] = {}
    for _, group in labelled.groupby(list(_LABELS), sort=False):
        rests = {index: lines[index].rest for index in group.index}
        for index, rest in rests.items():
            # Names that would be the same get the settings that differ.
            differing = [key for key in rest if _differs(key, rests.values())]
            extra = [f"{sweep_name(key)} {rest[key]}" for key in differing]
            words = [group["who"][index], group["risk"][index], *extra]
            names[index] = joined(words)
    return labelled.assign(name=pd.Series(names))


def _differs(key: str, settings: Iterable[Mapping[str, Any]]) -> bool:
    return len({repr(setting.get(key)) for setting in settings}) > 1


def _positions(number: str, values: Sequence[float]) -> np.ndarray:
    """Return positions of values on the axis: −log(1 − α) for levels α below 1."""
    numbers = np.asarray(values)
    is_level = number == _LEVEL and numbers.max() < 1
    return -np.log(1 - numbers) if is_level else numbers
