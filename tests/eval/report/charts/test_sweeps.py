from typing import Any

import pytest

from benchnav.eval.report.charts.sweeps import find_sweeps, flatten


def condition(split: str = "test/std", level: float | None = None, **options: Any) -> dict[str, Any]:
    risk = {"part": "mean", "options": {}} if level is None else {"part": "cvar", "options": {"level": level}}
    planner = {"part": "mppi", "options": {"samples": 64, "by_time": True, "window": [1, 2], **options}}
    return {"value": {"split": split, "risk": risk, "planner": planner, "world": {"correlation_m": 1.5}}}


def found(*conditions: dict[str, Any]) -> dict[str, list[tuple[tuple[float, ...], tuple[str, ...]]]]:
    sweeps = find_sweeps({str(place): about for place, about in enumerate(conditions)})
    return {sweep.number: [(line.values, line.conditions) for line in sweep.lines] for sweep in sweeps}


def test_flatten() -> None:
    assert flatten({"a": {"b": {"c": 1}, "d": [1, 2]}, "e": None}) == {"a.b.c": 1, "a.d": [1, 2], "e": None}


def test_three_values_of_one_number_make_a_line_and_are_put_in_order() -> None:
    assert found(condition(level=0.9), condition(level=0.5), condition(), condition(level=0.8)) == {
        "risk.options.level": [((0.5, 0.8, 0.9), ("1", "3", "0"))]
    }
    assert found(condition(level=0.9), condition(level=0.5), condition()) == {}


def test_conditions_that_differ_in_anything_else_are_lines_of_their_own() -> None:
    levels = (0.5, 0.8, 0.9)
    both = [condition(split, level) for split in ("test/std", "test/hg") for level in levels]
    assert found(*both)["risk.options.level"] == [(levels, ("0", "1", "2")), (levels, ("3", "4", "5"))]
    # Where a second number follows the first, neither is the reason.
    assert found(*(condition(level=level, samples=int(10 * level)) for level in levels)) == {}


def test_switches_and_lists_are_no_numbers() -> None:
    assert found(*(condition(by_time=value) for value in (True, False, True))) == {}
    assert found(*(condition(window=[1, value]) for value in (2, 3, 4))) == {}
    assert list(found(*(condition(samples=value) for value in (2, 3, 4)))) == ["planner.options.samples"]


def test_scenarios_of_a_series_make_a_line_over_severity_that_std_begins() -> None:
    lines = found(
        condition("test/hg-050"), condition("test/std"), condition("test/hg-100"), condition("test/hs")
    )
    assert lines == {"severity": [((0.0, 0.5, 1.0), ("1", "0", "2"))]}
    two = found(*(condition(f"test/{name}") for name in ("std", "hg@0.5", "hg@1", "hs@0.5", "hs@1")))
    assert [conditions for _, conditions in two["severity"]] == [("0", "1", "2"), ("0", "3", "4")]


@pytest.mark.parametrize("value", [{"world": {"time_budget_s": 100.0}}])
def test_conditions_that_say_too_little_of_themselves_make_none(value: dict[str, Any]) -> None:
    assert find_sweeps({str(i): {"value": value} for i in range(4)}) == []
