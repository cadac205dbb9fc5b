from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.eval.figures.over import Over, find_sweeps
from benchnav.viz.style import risk_name
from tests.eval.report import made


def condition(
    split: str = "test/std", level: float | None = None, **options: Any
) -> dict[str, Any]:
    risk = (
        {"part": "mean", "options": {}}
        if level is None
        else {"part": "cvar", "options": {"level": level}}
    )
    planner = {
        "part": "mppi",
        "options": {"samples": 64, "by_time": True, "window": [1, 2], **options},
    }
    return {
        "value": {
            "split": split,
            "risk": risk,
            "planner": planner,
            "world": {"correlation_m": 1.5},
        }
    }


def found(
    *conditions: dict[str, Any],
) -> dict[str, list[tuple[tuple[float, ...], tuple[str, ...]]]]:
    sweeps = find_sweeps({str(place): about for place, about in enumerate(conditions)})
    return {
        number: [(line.values, line.conditions) for line in lines]
        for number, lines in sweeps.items()
    }


def test_three_values_of_one_number_make_a_line_and_are_put_in_order() -> None:
    assert found(
        condition(level=0.9), condition(level=0.5), condition(), condition(level=0.8)
    ) == {"risk.options.level": [((0.5, 0.8, 0.9), ("1", "3", "0"))]}
    assert found(condition(level=0.9), condition(level=0.5), condition()) == {}


def test_conditions_that_differ_in_anything_else_are_lines_of_their_own() -> None:
    levels = (0.5, 0.8, 0.9)
    both = [
        condition(split, level) for split in ("test/std", "test/hg") for level in levels
    ]
    assert found(*both)["risk.options.level"] == [
        (levels, ("0", "1", "2")),
        (levels, ("3", "4", "5")),
    ]
    # Where a second number follows the first, neither is the reason.
    assert (
        found(*(condition(level=level, samples=int(10 * level)) for level in levels))
        == {}
    )


def test_switches_and_lists_are_no_numbers() -> None:
    assert found(*(condition(by_time=value) for value in (True, False, True))) == {}
    assert found(*(condition(window=[1, value]) for value in (2, 3, 4))) == {}
    assert list(found(*(condition(samples=value) for value in (2, 3, 4)))) == [
        "planner.options.samples"
    ]


def test_what_stands_in_no_value_at_its_default_is_a_number_too() -> None:
    def guided(**options: Any) -> dict[str, Any]:
        about = condition()
        return {
            "value": {
                **about["value"],
                "planner": {"part": "astar_dwa", "options": options},
            }
        }

    lines = found(guided(), guided(explore=1.0), guided(explore=0.5))
    assert lines == {"planner.options.explore": [((0.0, 0.5, 1.0), ("0", "2", "1"))]}
    every = [
        {"value": {**condition()["value"], "rules": rules}}
        for rules in ({}, {"replan_every_s": 2.0}, {"replan_every_s": 0.2})
    ]
    assert found(*every) == {
        "rules.replan_every_s": [((0.2, 0.5, 2.0), ("2", "0", "1"))]
    }


def test_scenarios_of_a_series_make_a_line_over_severity_that_std_begins() -> None:
    lines = found(
        condition("test/hg-050"),
        condition("test/std"),
        condition("test/hg-100"),
        condition("test/hs"),
    )
    assert lines == {"severity": [((0.0, 0.5, 1.0), ("1", "0", "2"))]}
    two = found(
        *(
            condition(f"test/{name}")
            for name in ("std", "hg@0.5", "hg@1", "hs@0.5", "hs@1")
        )
    )
    assert [conditions for _, conditions in two["severity"]] == [
        ("0", "1", "2"),
        ("0", "3", "4"),
    ]


@pytest.mark.parametrize("value", [{"world": {"time_budget_s": 100.0}}])
def test_conditions_that_say_too_little_of_themselves_make_none(
    value: dict[str, Any],
) -> None:
    assert find_sweeps({str(i): {"value": value} for i in range(4)}) == {}


LEVELS = (0.5, 0.8, 0.9)


def values(labels: dict[str, str], **changes: Any) -> dict[str, Any]:
    """What `run.json` says of a condition with these labels."""
    part, _, level = labels["risk"].partition(":")
    risk = {"part": part, "options": {"level": float(level)} if level else {}}
    world = {"name": labels["world"], **changes}
    parts = {
        name: {"part": labels[name].split(" ")[0], "options": {}}
        for name in ("model", "planner")
    }
    value = {
        "data": labels["data"],
        "split": f"test/{labels['scenario']}",
        "risk": risk,
        **parts,
        "world": world,
    }
    return {"value": value}


def drawn(*conditions: tuple[dict[str, str], int], **changes: Any) -> Figure:
    rows = made.rows(
        *(
            [made.row(labels, i, 20.0 if i < count else None) for i in range(10)]
            for labels, count in conditions
        )
    )
    known = {
        "+".join(made.row(labels)["condition"].split("+")): values(labels, **changes)
        for labels, _ in conditions
    }
    data = made.run_data(made.summarised(rows), about={"conditions": known})
    (figure,) = Over().variants(data)
    return figure.draw(data)


def shown(figure: Figure) -> list[Axes]:
    return [panel for panel in figure.axes if panel.get_visible()]


def curves(panel: Axes) -> list[list[float]]:
    return [
        list(line.get_ydata())
        for line in panel.lines
        if line.get_marker() not in ("None", None)
    ]


def test_success_and_time_stand_at_their_levels_with_their_bands() -> None:
    figure = drawn(
        *(
            (made.condition(risk=f"cvar:{level}"), n)
            for level, n in zip(LEVELS, (2, 6, 4), strict=True)
        )
    )
    above, below = shown(figure)
    assert curves(above) == [pytest.approx([20, 60, 40])]
    assert curves(below) == [pytest.approx([84, 52, 68])]
    (line,) = above.lines
    np.testing.assert_allclose(line.get_xdata(), -np.log(1 - np.array(LEVELS)))
    assert [label.get_text() for label in below.get_xticklabels()] == [
        "0.5",
        "0.8",
        "0.9",
    ]
    band = above.collections[0].get_paths()[0].vertices[:, 1]
    assert band.min() < 20 < 60 < band.max()


def test_other_settings_of_the_same_planner_are_lines_across_and_blind_ones_grey() -> (
    None
):
    levels = [(made.condition(risk=f"cvar:{level}"), 5) for level in LEVELS]
    figure = drawn(
        *levels,
        (made.condition(risk="mean"), 3),
        (made.condition("cl_rrt", "mean"), 9),  # no line of its planner is there
        (made.condition("straight", "–", model="–"), 1),
    )
    above, _ = shown(figure)
    across = {
        float(np.asarray(line.get_ydata())[0])
        for line in above.lines
        if line.get_marker() == "None"
    }
    assert across == {30, 10}
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["MPPI, CVaR", "mean", "straight"]


def test_each_setting_is_drawn_in_the_style_that_the_legend_gives_it() -> None:
    settings = ["mean", "var", "entropic", "chance", "worst", "own", "other", "last"]
    figure = drawn(
        *((made.condition(risk=f"cvar:{level}"), 9) for level in LEVELS),
        *((made.condition(risk=setting), n) for n, setting in enumerate(settings)),
        (made.condition("straight", "–", model="–"), 8),
    )
    names = {
        10.0 * n: risk_name(name) for n, name in enumerate([*settings, "straight"])
    }
    # Matplotlib tells a pattern of dashes by a private name alone: `get_linestyle`
    # gives "--" for each.
    legend = {
        line.get_label(): line._dash_pattern for line in figure.legends[0].get_lines()
    }
    above, _ = shown(figure)
    lines = {
        names[float(np.asarray(line.get_ydata())[0])]: line._dash_pattern
        for line in above.lines
        if line.get_marker() == "None"
    }
    assert lines == {name: legend[name] for name in names.values()}
    assert len(set(map(repr, lines.values()))) == len(names)


def test_lines_of_one_panel_differ_in_marker_as_well_as_in_colour() -> None:
    planners = ["astar_dwa", "mppi", "cl_rrt"]
    figure = drawn(
        *((made.condition(p, f"cvar:{level}"), 5) for p in planners for level in LEVELS)
    )
    above, _ = shown(figure)
    looks = [
        (line.get_marker(), line.get_color())
        for line in above.lines
        if line.get_marker() != "None"
    ]
    assert [len(set(each)) for each in zip(*looks, strict=True)] == [3, 3]
    legend = [
        (line.get_marker(), line.get_color()) for line in figure.legends[0].get_lines()
    ]
    assert legend == looks


def test_scenarios_worlds_and_models_have_panels_of_their_own() -> None:
    places: tuple[dict[str, str], ...] = (
        {"scenario": "hg"},
        {"world": "stakes"},
        {"model": "mdn"},
    )
    for other in places:
        figure = drawn(
            *((made.condition(risk=f"cvar:{level}"), 5) for level in LEVELS),
            *((made.condition(risk=f"cvar:{level}", **other), 7) for level in LEVELS),
        )
        panels = shown(figure)
        assert len(panels) == 4
        titles = [panel.get_title() for panel in panels if panel.get_title()]
        assert titles[1] == next(iter(other.values()))
        # One measure has one range, so that heights can be compared.
        ranges = {tuple(np.round(panel.get_ylim(), 6)) for panel in panels}
        assert len(ranges) == 2


def test_what_looks_at_nothing_stands_beside_every_model_over_all_severities() -> None:
    blind = {"planner": "straight", "risk": "–", "model": "–"}
    scenarios = ("std", "hg-050", "hg")
    models = [
        made.condition(scenario=name, model=model)
        for name in scenarios
        for model in ("a", "b")
    ]
    figure = drawn(
        *((made.condition(scenario=name, **blind), 2) for name in scenarios),
        *((one, 7) for one in models),
    )
    success = shown(figure)[:2]
    assert [panel.get_title() for panel in success] == ["a", "b"]
    for panel in success:
        lines = [line for line in panel.lines if len(line.get_xdata()) == 3]
        assert [list(line.get_xdata()) for line in lines] == [[0, 0.5, 1]] * 2
        assert sorted(line.get_ydata()[0] for line in lines) == [20, 70]


def test_many_lines_are_distinguished_by_panels() -> None:
    planners = [f"planner_{i}" for i in range(9)]
    figure = drawn(
        *((made.condition(p, f"cvar:{level}"), 5) for p in planners for level in LEVELS)
    )
    assert len(shown(figure)) == 18
    assert all(len(curves(panel)) == 1 for panel in shown(figure))
