"""Conditions as values, and how a suite becomes a list of them."""

from dataclasses import replace
from itertools import pairwise

import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import Condition, condition_from, conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.world.world import PRESETS, Immobile, World

FAN = "tests.eval.parts:Faulty"


def conditions(**changes: object) -> list[Condition]:
    given = {"model": "oracle", "planners": (FAN,), "risks": ("mean",)} | changes
    return conditions_of(Suite(**given), lambda data: ["std", "hg"])  # type: ignore[arg-type]


def one(**changes: object) -> Condition:
    (condition,) = conditions(**({"scenarios": ("std",)} | changes))
    return condition


def test_travel_time_ends_where_the_tasks_goal_begins() -> None:
    for changes, radius_m in (({}, 1.0), ({"task": {"goal_radius_m": 0.3}}, 0.3)):
        task = one(objectives=("travel_time",), **changes).make_task()
        assert (task.objective.goal_radius_m, task.rules.goal_radius_m) == (radius_m, radius_m)


def test_the_id_is_that_of_the_value_and_not_of_the_label() -> None:
    condition = one()
    assert one().id == condition.id
    assert one(planners=({"part": FAN, "label": "other"},)).id == condition.id
    assert one(risks=("cvar:0.9",)).id == one(risks=("cvar",)).id
    changes = (
        {"scenarios": ("hg",)},
        {"data": "other"},
        {"model": "tests.eval.parts:Gaussian"},
        {"risks": ("cvar",)},
        {"risks": ("cvar:0.5",)},
        {"planners": ({"part": FAN, "options": {"after_s": 2.0}},)},
        {"robots": ("differential_drive",)},
        {"robots": ({"part": "unicycle", "options": {"dt_s": 0.2}},)},
        {"objectives": ("travel_time",)},
        {"world": {"noise": "stored"}},
        {"world": {"time_budget_s": 50.0}},
        {"world": {"noise": "stored", "time_budget_s": 50.0}},
        {"world": "stakes"},
        {"world": {"preset": "stakes", "correlation_m": 2.0}},
        {"world": {"preset": "stakes", "immobile": {"below": 0.2}}},
        {"world": {"preset": "stakes", "immobile": {"for_s": 3.0}}},
        {"world": {"preset": "stakes", "immobile": None}},
        {"world": {"preset": "stakes", "time_budget_ratio": 2.0}},
        {"world": {"preset": "stakes", "time_budget_s": 2.0}},
        {"task": {"min_traversability": 0.05}},
        {"task": {"goal_radius_m": 0.5}},
        {"task": {"free_space": {"by": "mean"}}},
        {"task": {"free_space": {"above": 0.1}}},
    )
    ids = [condition.id, *(one(**change).id for change in changes)]
    assert len(set(ids)) == len(ids)


def test_a_condition_is_read_back_from_what_a_run_holds() -> None:
    for condition in conditions(
        planners=({"part": FAN, "label": "late", "options": {"after_s": 2.0}}, "straight"),
        task={"free_space": {"by": "mean", "above": 0.1}},
        conditions=({"world": [{"noise": "stored"}, "stakes", {"preset": "stakes", "immobile": None}]},),
        robots=({"part": "unicycle", "options": {"speed_mps": [0.0, 2.0]}},),
    ):
        again = condition_from({"value": condition.value, "labels": condition.labels})
        assert again.id == condition.id
        assert again == condition


def test_every_setting_reaches_its_place() -> None:
    condition = one(
        task={"free_space": {"by": "mean", "above": 0.1}, "min_traversability": 0.05, "goal_radius_m": 2},
        world={"preset": "paper", "noise": "stored", "time_budget_s": 30.0},
        robots=({"part": "unicycle", "options": {"dt_s": 0.2}},),
        planners=({"part": FAN, "options": {"after_s": 3.0}},),
    )
    assert (condition.rules.free_space.by, condition.rules.free_space.above) == ("mean", 0.1)
    assert (condition.rules.min_traversability, condition.rules.goal_radius_m) == (0.05, 2.0)
    assert (condition.world.noise, condition.world.time_budget_s) == ("stored", 30.0)
    assert condition.make_task().robot.dt_s == 0.2
    assert condition.make_task().rules == condition.rules
    assert condition.make_planner().after_s == 3.0
    assert (
        condition.world_label
        == "paper noise=stored time_budget_s=30 by=mean above=0.1 min_traversability=0.05 goal_radius_m=2"
    )
    travel = one(objectives=("travel_time",), robots=({"part": "unicycle", "options": {"dt_s": 0.2}},))
    assert travel.make_task().objective.robot.dt_s == 0.2  # type: ignore[attr-defined]


def test_several_worlds_stand_at_the_top_of_a_suite() -> None:
    suite = Suite(
        model="oracle",
        planners=("straight",),
        world=("paper", {"preset": "stakes", "correlation_m": [1.0, 2.0]}),
    )
    worlds = [condition.world for condition in conditions_of(suite, lambda data: ["std"])]
    assert [(world.noise, world.correlation_m) for world in worlds] == [
        ("resampled", 1.5), ("frozen", 1.0), ("frozen", 2.0),
    ]  # fmt: skip


def test_a_product_has_every_combination_once_in_the_order_of_tables() -> None:
    made = conditions(
        planners=(FAN, "mppi"), risks=("mean", "cvar"), models=("oracle", "tests.eval.parts:Gaussian")
    )
    names = ("scenario", "model", "risk", "planner")
    keys = [tuple(condition.labels[name] for name in names) for condition in made]
    assert len(set(keys)) == len(keys) == 16
    assert keys[:3] == [
        ("std", "oracle", "mean", "Faulty"), ("std", "oracle", "mean", "mppi"), ("std", "oracle", "cvar", "Faulty"),
    ]  # fmt: skip


def test_products_side_by_side_take_what_they_leave_out_from_the_suite() -> None:
    made = conditions(
        risks=("mean",),
        conditions=(
            {"planners": ["mppi"], "risks": ["cvar", "var"], "scenario": "std"},
            {"planner": FAN, "world": ["paper", {"noise": "stored"}], "scenarios": "hg"},
        ),
    )
    seen = [(t.labels["planner"], t.labels["risk"], t.scenario, t.world.noise) for t in made]
    assert seen == [
        ("mppi", "cvar", "std", "resampled"), ("mppi", "var", "std", "resampled"),
        ("Faulty", "mean", "hg", "resampled"), ("Faulty", "mean", "hg", "stored"),
    ]  # fmt: skip


def test_a_blind_planner_is_one_condition_for_all_models_and_risks() -> None:
    made = conditions(
        planners=("straight", FAN), risks=("mean", "cvar"), models=("oracle", "tests.eval.parts:Gaussian")
    )
    blind = [condition for condition in made if condition.blind]
    assert [(t.scenario, t.labels["risk"], t.labels["model"]) for t in blind] == [
        ("std", "–", "–"),
        ("hg", "–", "–"),
    ]
    assert len(made) == 2 + 2 * 2 * 2
    alone = conditions(planners=("straight",), risks=("cvar",), model="tests.eval.parts:Gaussian")
    assert [t.id for t in alone] == [t.id for t in blind]


def test_two_settings_of_one_part_stand_side_by_side_with_labels() -> None:
    few, many = (
        {"part": "mppi", "label": name, "options": {"samples": n}} for name, n in (("few", 8), ("many", 9))
    )
    made = conditions(planners=(few, many), scenarios=("std",))
    assert [(t.labels["planner"], t.make_planner().config.samples) for t in made] == [("few", 8), ("many", 9)]
    for first, second in pairwise(made):
        assert first.id != second.id


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"risks": ("cvar", "cvar:0.9")}, "twice"),
        ({"risks": ("cvr",)}, "Did you mean 'cvar'"),
        ({"planners": ("mpi",)}, "Did you mean 'mppi'"),
        ({"planners": ("mppi", {"part": "mppi", "options": {"samples": 8}})}, "label"),
        ({"planners": ({"part": "mppi", "options": {"sample": 8}},)}, "Did you mean 'samples'"),
        ({"planners": ({"part": "mppi", "option": {}},)}, "options"),
        ({"model": "no-such-model"}, "no-such-model"),
        ({"model": "fused"}, "family"),
        ({"model": {"part": "paper-v1", "options": {"a": 1}}}, "no options"),
        ({"world": {"noise": "loud"}}, "loud"),
        ({"conditions": ({"noise": "stored"},)}, "It is now 'world.noise'"),
        ({"conditions": ({"planner_options": {}},)}, "It is now 'planners'"),
        ({"world": "papr"}, "Did you mean 'paper'"),
        ({"world": {"nois": "stored"}}, "Did you mean 'noise'"),
        ({"task": {"min_traversabilty": 0.1}}, "Did you mean 'min_traversability'"),
        ({"task": {"free_space": {"by": "noise"}}}, "noise"),
        ({"task": {"min_traversability": "much"}}, "min_traversability"),
        ({"conditions": ({"planer": "mppi"},)}, "Did you mean 'planner"),
    ],
)
def test_what_cannot_be_had_is_refused(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        conditions(**changes)


def test_a_suite_refuses_what_means_nothing() -> None:
    for bad in (
        {"planners": ()},
        {"realisations": 0},
        {"maps": -1},
        {"seeds": (1, 1)},
        {"record": "sometimes"},
    ):
        with pytest.raises(ConfigError):
            replace(Suite(), **bad)


def test_a_world_with_stakes_is_distinguished_by_what_is_changed() -> None:
    condition = one(world="stakes")
    assert condition.world == PRESETS["stakes"].world
    assert condition.rules == PRESETS["stakes"].rules
    assert condition.world_label == "stakes"
    changed = one(
        world={"preset": "stakes", "correlation_m": 2, "immobile": {"below": 0.2}, "time_budget_s": 50},
        task={"min_traversability": 0.1, "free_space": {"by": "risk"}},
    )
    assert changed.world == World(
        noise="frozen", correlation_m=2.0, immobile=Immobile(below=0.2, for_s=2.0), time_budget_s=50.0
    )
    assert changed.rules == Rules(free_space=FreeSpace(by="risk", above=0.1), min_traversability=0.1)
    assert changed.world_label == (
        "stakes correlation_m=2 immobile=0.2/2s time_budget_s=50 by=risk min_traversability=0.1"
    )
    assert one(world={"preset": "stakes", "immobile": None}).world_label == "stakes immobile=none"
    held = one(world={"immobile": {"for_s": 4}})
    assert held.world.immobile == Immobile(below=0.1, for_s=4.0)
    assert one(world={"preset": "stakes", "time_budget_s": 50.0}).world.time_budget_s == 50.0
    own = one(world={"time_budget_ratio": 2}).world
    assert (own.time_budget_s, own.time_budget_ratio) == (None, 2.0)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"world": {"correlation_m": 2.0}}, "with `world.noise` frozen, got it with 'resampled'"),
        ({"world": {"time_budget_s": 5.0, "time_budget_ratio": 2.0}}, "either"),
        ({"world": {"time_budget_s": None}}, "either"),
        ({"world": {"preset": "stakes", "correlation_m": False}}, "as a number, got False"),
        ({"world": {"immobile": 3}}, "`world.immobile` as a mapping or null, got 3"),
        ({"world": {"immobile": {"belw": 0.2}}}, "Did you mean 'below'"),
        ({"model": "clairvoyant"}, "with λ that stays for the model 'clairvoyant', got 'paper'"),
    ],
)
def test_worlds_that_contradict_themselves_are_refused(changes: dict[str, object], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        conditions(**changes)


def test_the_clairvoyant_is_one_condition_a_planner_for_all_risks() -> None:
    made = conditions(
        planners=("straight", FAN, "mppi"), risks=("mean", "cvar"), models=("oracle", "clairvoyant"),
        world="stakes", scenarios=("std",),
    )  # fmt: skip
    seen = [(t.labels["model"], t.labels["planner"], t.labels["risk"]) for t in made]
    assert sorted(seen) == sorted(
        [("–", "straight", "–"), ("clairvoyant", "Faulty", "–"), ("clairvoyant", "mppi", "–")]
        + [("oracle", planner, risk) for planner in ("Faulty", "mppi") for risk in ("mean", "cvar")]
    )
    for condition in made:
        assert condition_from({"value": condition.value, "labels": condition.labels}) == condition
