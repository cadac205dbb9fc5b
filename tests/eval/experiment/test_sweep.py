from typing import Any

import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.registry import complete, read_part
from benchnav.eval.experiment.condition import Condition, conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.sweep import each_mapping, each_part


def parts(kind: str, given: Any) -> list[tuple[str, dict[str, Any]]]:
    return [
        (part.label, dict(part.options))
        for part in each_part(kind, read_part(kind, given))
    ]


def conditions(**settings: Any) -> list[Condition]:
    return conditions_of(Suite(model="oracle", **settings), lambda data: ["std"])


def test_a_list_of_levels_is_a_part_each_labelled_as_on_the_command_line() -> None:
    given = {"part": "cvar", "options": {"level": [0.5, 0.9]}}
    assert parts("risk", given) == [
        ("cvar:0.5", {"level": 0.5}),
        ("cvar:0.9", {"level": 0.9}),
    ]
    assert parts("risk", "cvar:0.9") == [("cvar:0.9", {"level": 0.9})]
    assert parts("risk", "mean") == [("mean", {})]


def test_several_lists_are_a_product_with_labels_of_their_own() -> None:
    given = {
        "part": "astar_dwa",
        "label": "dwa",
        "options": {
            "lookahead_m": [2.0, 4.0],
            "dwa": {"horizon_s": [2.0, 5.0], "speeds": 5},
        },
    }
    assert parts("planner", given) == [
        (
            f"dwa lookahead_m={lookahead:g} dwa.horizon_s={horizon:g}",
            {"lookahead_m": lookahead, "dwa": {"horizon_s": horizon, "speeds": 5}},
        )
        for lookahead in (2.0, 4.0)
        for horizon in (2.0, 5.0)
    ]


def test_a_list_that_the_option_takes_is_one_value() -> None:
    given = {"part": "mppi", "options": {"noise": [0.3, 0.6], "samples": [8, 16]}}
    assert [label for label, _ in parts("planner", given)] == [
        "mppi samples=8",
        "mppi samples=16",
    ]
    pairs = {"part": "mppi", "options": {"noise": [[0.3, 0.6], [0.5, 0.5]]}}
    made = [
        complete("planner", part)
        for part in each_part("planner", read_part("planner", pairs))
    ]
    assert [list(part.options["noise"]) for part in made] == [[0.3, 0.6], [0.5, 0.5]]


def test_mappings_are_expanded_at_any_depth() -> None:
    given = {
        "preset": "stakes",
        "correlation_m": [1, 2],
        "immobile": {"below": [0.1, 0.2], "for_s": 3},
    }
    assert each_mapping(given) == [
        {
            "preset": "stakes",
            "correlation_m": ell,
            "immobile": {"below": below, "for_s": 3},
        }
        for ell in (1, 2)
        for below in (0.1, 0.2)
    ]
    assert each_mapping("stakes") == ["stakes"]
    assert each_mapping({"preset": "stakes"}) == [{"preset": "stakes"}]


def test_a_suite_sweeps_levels_planners_worlds_and_tasks() -> None:
    found = conditions(
        planners=[{"part": "mppi", "options": {"horizon_s": [1.0, 2.0]}}],
        risks=["mean", {"part": "cvar", "options": {"level": [0.5, 0.9]}}],
        world={"preset": "stakes", "correlation_m": [1.0, 2.0]},
        task={"min_traversability": [0.05, 0.1]},
    )
    assert len(found) == 2 * 3 * 2 * 2
    values = {
        (
            t.planner.options["horizon_s"],
            t.risk.label,
            t.world.correlation_m,
            t.rules.min_traversability,
        )
        for t in found
    }
    assert len(values) == len(found)
    assert {t.world_label for t in found} == {
        f"stakes correlation_m={ell}{rest}"
        for ell in (1, 2)
        for rest in ("", " min_traversability=0.1")
    }


def test_a_sweep_in_one_of_several_products_is_its_own() -> None:
    swept = {
        "planners": [{"part": "mppi", "options": {"samples": [8, 16]}}],
        "world": [{"preset": "stakes", "time_budget_ratio": [2, 3]}],
    }
    found = conditions(planners=["straight"], risks=["mean"], conditions=[{}, swept])
    assert [t.labels["planner"] for t in found] == ["straight"] + [
        "mppi samples=8",
        "mppi samples=16",
    ] * 2
    assert [t.world.time_budget_ratio for t in found[1:]] == [2, 2, 3, 3]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"risks": [{"part": "cvar", "options": {"level": []}}]},
            "one or more values of `level`",
        ),
        (
            {"world": {"preset": "stakes", "immobile": {"below": []}}},
            "one or more values of `immobile.below`",
        ),
        ({"risks": [{"part": "cvar", "options": {"level": [0.5, "high"]}}]}, "level"),
        ({"risks": [{"part": "cvar", "options": {"levels": [0.5]}}]}, "levels"),
        (
            {"risks": [{"part": "cvar", "options": {"level": [0.5, 0.5]}}]},
            "Expected settings that differ",
        ),
    ],
)
def test_bad_sweeps_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        conditions(**{"planners": ["mppi"], **settings})
