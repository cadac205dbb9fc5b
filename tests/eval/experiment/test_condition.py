"""Conditions as values, and how a suite becomes a list of them."""

from dataclasses import replace
from importlib.resources import files
from itertools import pairwise, product

import pytest
import yaml

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import (
    KNOWLEDGE,
    NOT_USED,
    Condition,
    check_labels,
    condition_from,
    conditions_of,
)
from benchnav.eval.experiment.suite import Suite
from benchnav.planning.free_space import FreeSpace, Immobile, Rules
from benchnav.planning.world.world import PRESETS, World

FAN = "tests.eval.parts:Faulty"


def conditions(**changes: object) -> list[Condition]:
    given = {"models": ("oracle",), "planners": (FAN,), "risks": ("mean",)} | changes
    if "model" in changes:
        del given["models"]
    return conditions_of(Suite(**given), lambda data: ["std", "hg"])  # type: ignore[arg-type]


def one(**changes: object) -> Condition:
    (condition,) = conditions(**({"scenarios": ("std",)} | changes))
    return condition


def test_travel_time_ends_where_the_tasks_goal_begins() -> None:
    for changes, radius_m in (({}, 1.0), ({"task": {"goal_radius_m": 0.3}}, 0.3)):
        task = one(objectives=("travel_time",), **changes).task
        assert (task.objective.goal_radius_m, task.rules.goal_radius_m) == (
            radius_m,
            radius_m,
        )


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
        {"task": {"unseen": "optimistic"}},
        {"task": {"replan_every_s": 1.0}},
        {"sensors": ("near",)},
        {"sensors": ({"part": "near", "options": {"range_m": 4.0}},)},
        {"beliefs": ({"part": "static", "options": {"correlated": False}},)},
        {"beliefs": ("copula",)},
        {"beliefs": ("copula",), "grounds": ("probe",)},
        {
            "beliefs": ("copula",),
            "grounds": ({"part": "probe", "options": {"radius_m": 2.0}},),
        },
        {"beliefs": ("copula",), "sensors": ("near",)},
    )
    ids = [condition.id, *(one(**change).id for change in changes)]
    assert len(set(ids)) == len(ids)


def test_a_condition_is_read_back_from_what_a_run_holds() -> None:
    for condition in conditions(
        planners=(
            {"part": FAN, "label": "late", "options": {"after_s": 2.0}},
            "straight",
        ),
        task={"free_space": {"by": "mean", "above": 0.1}},
        conditions=(
            {
                "world": [
                    {"noise": "stored"},
                    "stakes",
                    {"preset": "stakes", "immobile": None},
                ]
            },
        ),
        robots=({"part": "unicycle", "options": {"speed_mps": [0.0, 2.0]}},),
    ):
        again = condition_from({"value": condition.value, "labels": condition.labels})
        assert again.id == condition.id
        assert again == condition


def test_every_setting_reaches_its_place() -> None:
    condition = one(
        task={
            "free_space": {"by": "mean", "above": 0.1},
            "min_traversability": 0.05,
            "goal_radius_m": 2,
        },
        world={"preset": "paper", "noise": "stored", "time_budget_s": 30.0},
        robots=({"part": "unicycle", "options": {"dt_s": 0.2}},),
        planners=({"part": FAN, "options": {"after_s": 3.0}},),
    )
    assert (condition.rules.free_space.by, condition.rules.free_space.above) == (
        "mean",
        0.1,
    )
    assert (condition.rules.min_traversability, condition.rules.goal_radius_m) == (
        0.05,
        2.0,
    )
    assert (condition.world.noise, condition.world.time_budget_s) == ("stored", 30.0)
    assert condition.task.robot.dt_s == 0.2
    assert condition.task.rules == condition.rules
    assert condition.planner.object.after_s == 3.0
    assert (
        condition.world_label
        == "paper noise=stored time_budget_s=30 by=mean above=0.1 min_traversability=0.05 goal_radius_m=2"
    )
    travel = one(
        objectives=("travel_time",),
        robots=({"part": "unicycle", "options": {"dt_s": 0.2}},),
    )
    assert travel.task.objective.robot.dt_s == 0.2  # type: ignore[attr-defined]


def test_several_worlds_stand_at_the_top_of_a_suite() -> None:
    suite = Suite(
        model="oracle",
        planners=("straight",),
        world=("paper", {"preset": "stakes", "correlation_m": [1.0, 2.0]}),
    )
    worlds = [
        condition.world for condition in conditions_of(suite, lambda data: ["std"])
    ]
    assert [(world.noise, world.correlation_m) for world in worlds] == [
        ("resampled", 1.5), ("frozen", 1.0), ("frozen", 2.0),
    ]  # fmt: skip


def test_a_product_has_every_combination_once_in_the_order_of_tables() -> None:
    made = conditions(
        planners=(FAN, "mppi"),
        risks=("mean", "cvar"),
        models=("oracle", "tests.eval.parts:Gaussian"),
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
            {
                "planner": FAN,
                "world": ["paper", {"noise": "stored"}],
                "scenarios": "hg",
            },
        ),
    )
    seen = [
        (t.labels["planner"], t.labels["risk"], t.scenario, t.world.noise) for t in made
    ]
    assert seen == [
        ("mppi", "cvar", "std", "resampled"), ("mppi", "var", "std", "resampled"),
        ("Faulty", "mean", "hg", "resampled"), ("Faulty", "mean", "hg", "stored"),
    ]  # fmt: skip


def test_a_blind_planner_is_one_condition_for_all_models_and_risks() -> None:
    made = conditions(
        planners=("straight", FAN),
        risks=("mean", "cvar"),
        models=("oracle", "tests.eval.parts:Gaussian"),
    )
    blind = [condition for condition in made if condition.blind]
    assert [(t.scenario, t.labels["risk"], t.labels["model"]) for t in blind] == [
        ("std", "–", "–"),
        ("hg", "–", "–"),
    ]
    assert len(made) == 2 + 2 * 2 * 2
    alone = conditions(
        planners=("straight",), risks=("cvar",), model="tests.eval.parts:Gaussian"
    )
    assert [t.id for t in alone] == [t.id for t in blind]


COST = {"part": "mppi", "label": "cost", "options": {"risk_on": "cost", "samples": 8}}
MEAN_FREE = {"free_space": {"by": "mean"}}


def test_conditions_that_differ_in_nothing_used_are_one() -> None:
    given = {"planners": (COST,), "scenarios": ("std",), "world": "stakes"}
    ids = {risk: one(**given, risks=(risk,)).id for risk in ("mean", "cvar:0.9", "var")}
    for risks, kept in (
        (("cvar:0.9", "mean", "var"), "mean"),
        (("var", "cvar:0.9"), "var"),
    ):
        merged = one(**given, risks=risks)
        assert (merged.id, merged.labels["risk"]) == (ids[kept], NOT_USED)
        assert merged.stands_for == {"risk": risks}
        about = {
            "value": merged.value,
            "labels": merged.labels,
            "stands_for": merged.stands_for,
        }
        assert condition_from(about) == merged
    # A setting with no copy keeps its label, as its id.
    assert one(**given, risks=("var",)).labels["risk"] == "var"
    # Fields bear on risk of the cost alone, where nothing is learnt.
    beliefs = tuple(
        {"part": "static", "label": name, "options": {"correlated": name == "whole"}}
        for name in ("whole", "cells")
    )
    made = conditions(
        planners=(COST, "mppi", "optimal"),
        risks=("mean", "var"),
        beliefs=beliefs,
        scenarios=("std",),
        world="stakes",
    )
    assert sorted((c.labels["planner"], c.labels["risk"], c.labels["belief"]) for c in made) == [
        ("cost", NOT_USED, "cells"), ("cost", NOT_USED, "whole"), ("mppi", "mean", NOT_USED),
        ("mppi", "var", NOT_USED), ("optimal", "mean", NOT_USED), ("optimal", "var", NOT_USED),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        {"task": {"free_space": {"by": "risk"}}},
        {"sensors": ("near",)},
        {"beliefs": ("copula",)},
        {"planners": ({"part": "mppi", "options": {"samples": 8}},)},
        {"planners": ({**COST, "options": COST["options"] | {"cost_to_go": "map"}},)},
        {
            "planners": ({"part": "astar_mppi", "options": {"mppi": COST["options"]}},),
            "objectives": ("travel_time",),
        },
        {"planners": (FAN,)},
    ],
)
def test_conditions_whose_planner_may_use_the_difference_stay_apart(
    changes: dict[str, object],
) -> None:
    made = conditions(
        **{
            "planners": (COST,),
            "risks": ("mean", "var"),
            "scenarios": ("std",),
            "world": "stakes",
        }
        | changes
    )
    assert [(condition.labels["risk"], condition.stands_for) for condition in made] == [
        ("mean", {}),
        ("var", {}),
    ]


def test_a_planner_that_uses_nothing_is_as_a_blind_one() -> None:
    made = conditions(
        planners=("tests.eval.parts:Unseeing",),
        risks=("mean", "var"),
        models=("oracle", "tests.eval.parts:Gaussian"),
    )
    assert [condition.blind for condition in made] == [True, True]
    with pytest.raises(
        ConfigError,
        match="to return a frozenset of names from",
    ):
        conditions(planners=("tests.eval.parts:Vague",))


def test_two_settings_of_one_part_stand_side_by_side_with_labels() -> None:
    few, many = (
        {"part": "mppi", "label": name, "options": {"samples": n}}
        for name, n in (("few", 8), ("many", 9))
    )
    made = conditions(planners=(few, many), scenarios=("std",))
    assert [(t.labels["planner"], t.planner.object.config.samples) for t in made] == [
        ("few", 8),
        ("many", 9),
    ]
    for first, second in pairwise(made):
        assert first.id != second.id


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"risks": ("cvar", "cvar:0.9")}, "twice"),
        ({"risks": ("cvr",)}, "Did you mean 'cvar'"),
        ({"planners": ("mpi",)}, "Did you mean 'mppi'"),
        ({"planners": ("mppi", {"part": "mppi", "options": {"samples": 8}})}, "label"),
        (
            {"planners": ({"part": "mppi", "options": {"sample": 8}},)},
            "Did you mean 'samples'",
        ),
        ({"planners": ({"part": "mppi", "option": {}},)}, "options"),
        ({"model": "no-such-model"}, "no-such-model"),
        ({"model": "fused"}, "family"),
        ({"model": {"part": "paper-v1", "options": {"a": 1}}}, "no options"),
        ({"world": {"noise": "loud"}}, "loud"),
        ({"conditions": ({"noise": "stored"},)}, "got 'noise'"),
        ({"world": "papr"}, "Did you mean 'paper'"),
        ({"world": {"nois": "stored"}}, "Did you mean 'noise'"),
        ({"task": {"min_traversabilty": 0.1}}, "Did you mean 'min_traversability'"),
        ({"task": {"free_space": {"by": "noise"}}}, "noise"),
        ({"task": {"min_traversability": "much"}}, "min_traversability"),
        ({"conditions": ({"planer": "mppi"},)}, "Did you mean 'planner"),
        (
            {"conditions": ({"risk": "mean", "risks": ["var"]},)},
            "`risk` or `risks` in each mapping of",
        ),
    ],
)
def test_what_cannot_be_had_is_refused(
    changes: dict[str, object], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        conditions(**changes)


def test_a_suite_refuses_what_means_nothing() -> None:
    for bad in (
        {"planners": ()},
        {"realisations": 0},
        {"maps": -1},
        {"seeds": (1, 1)},
        {"seed": 3, "seeds": (1, 2)},
        {"model": "oracle", "models": ("ideal",)},
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
        world={
            "preset": "stakes",
            "correlation_m": 2,
            "immobile": {"below": 0.2},
            "time_budget_s": 50,
        },
        task={"min_traversability": 0.1, "free_space": {"by": "risk"}},
    )
    assert changed.world == World(
        noise="frozen",
        correlation_m=2.0,
        immobile=Immobile(below=0.2, for_s=2.0),
        time_budget_s=50.0,
    )
    assert changed.rules == Rules(
        free_space=FreeSpace(by="risk", above=0.1), min_traversability=0.1
    )
    assert changed.world_label == (
        "stakes correlation_m=2 immobile=0.2/2s time_budget_s=50 by=risk min_traversability=0.1"
    )
    assert (
        one(world={"preset": "stakes", "immobile": None}).world_label
        == "stakes immobile=none"
    )
    held = one(world={"immobile": {"for_s": 4}})
    assert held.world.immobile == Immobile(below=0.1, for_s=4.0)
    assert (
        one(world={"preset": "stakes", "time_budget_s": 50.0}).world.time_budget_s
        == 50.0
    )
    own = one(world={"time_budget_ratio": 2}).world
    assert (own.time_budget_s, own.time_budget_ratio) == (None, 2.0)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"world": {"correlation_m": 2.0}},
            "`world.noise` 'frozen' with .*, got 'resampled'",
        ),
        ({"world": {"time_budget_s": 5.0, "time_budget_ratio": 2.0}}, "exactly one of"),
        ({"world": {"time_budget_s": None}}, "exactly one of"),
        (
            {"world": {"preset": "stakes", "correlation_m": False}},
            "as a number, got False",
        ),
        ({"world": {"immobile": 3}}, "`world.immobile` as a mapping or null, got 3"),
        ({"world": {"immobile": {"belw": 0.2}}}, "Did you mean 'below'"),
    ],
)
def test_worlds_that_contradict_themselves_are_refused(
    changes: dict[str, object], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        conditions(**changes)


def test_the_clairvoyant_is_one_condition_a_planner_for_all_risks() -> None:
    made = conditions(
        planners=("straight", FAN, "mppi"), risks=("mean", "cvar"), models=("oracle", "clairvoyant"),
        world="stakes", scenarios=("std",),
    )  # fmt: skip
    seen = [(t.labels["model"], t.labels["planner"], t.labels["risk"]) for t in made]
    assert sorted(seen) == sorted(
        [
            ("–", "straight", "–"),
            ("clairvoyant", "Faulty", "–"),
            ("clairvoyant", "mppi", "–"),
        ]
        + [
            ("oracle", planner, risk)
            for planner in ("Faulty", "mppi")
            for risk in ("mean", "cvar")
        ]
    )
    for condition in made:
        assert (
            condition_from({"value": condition.value, "labels": condition.labels})
            == condition
        )


# Of the suites of version 0.10.0, whose runs go on under this one.
IDS = {
    "demo": {"84d239b3a1f2a5fd", "d1855ba4455918de"},
    "paper": {"5dbed6747e6870d3", "fb91f100b66ed556"},
    "risk": {"d1855ba4455918de", "01852dbaf2655229"},
    "full": {"431bbb85e715853d", "a4fb112c0e776709"},
    "severity": {"d1855ba4455918de", "bb7f4a68325b35a3"},
}


@pytest.mark.parametrize("name", IDS)
def test_conditions_of_earlier_versions_have_their_ids(name: str) -> None:
    about = yaml.safe_load(
        files("benchnav.eval").joinpath("suites", f"{name}.yaml").read_text()
    )
    lists = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in about.items()
    }
    ids = [
        condition.id
        for condition in conditions_of(Suite(**lists), lambda data: ["std"])
    ]
    assert {ids[0], ids[-1]} == IDS[name]


def known(made: list[Condition]) -> list[tuple[str, ...]]:
    """Labels of what robots know by, a tuple a condition."""
    return [tuple(condition.labels[kind] for kind in KNOWLEDGE) for condition in made]


def test_a_belief_that_does_not_learn_is_one_condition_for_all_sensors_of_the_ground() -> (
    None
):
    made = conditions(
        scenarios=("std",), grounds=("contact", "probe", "probe:2"), beliefs=("static", "copula"),
        sensors=("full", "near"),
    )  # fmt: skip
    beside = [("copula", ground) for ground in ("contact", "probe", "probe:2")]
    wanted = [(sensor, NOT_USED, "static") for sensor in ("full", "near")]
    wanted += [
        (sensor, ground, belief)
        for sensor in ("full", "near")
        for belief, ground in beside
    ]
    assert sorted(known(made)) == sorted(wanted)
    static = next(
        c
        for c in made
        if c.labels["belief"] == "static" and c.labels["sensor"] == "full"
    )
    assert static.id == one().id
    assert not static.learns
    assert all(condition.learns for condition in made if condition is not static)
    assert not set(KNOWLEDGE) & set(static.value)


def test_a_blind_planner_is_one_condition_whatever_robots_know_by() -> None:
    (blind,) = conditions(
        planners=("straight",), scenarios=("std",), grounds=("contact", "probe"), beliefs=("static", "copula"),
        sensors=("full", "near"),
    )  # fmt: skip
    assert known([blind]) == [(NOT_USED,) * 3]
    assert blind.id == one(planners=("straight",)).id
    assert not blind.learns


def test_a_clairvoyant_that_sees_all_has_nothing_to_learn() -> None:
    made = conditions(
        scenarios=("std",), models=("clairvoyant",), world="stakes", risks=("mean", "cvar"),
        grounds=("contact", "probe"), beliefs=("static", "copula"), sensors=("full", "near"),
    )  # fmt: skip
    assert sorted(known(made)) == sorted(
        [
            ("full", NOT_USED, NOT_USED), ("near", NOT_USED, "static"), ("near", "contact", "copula"),
            ("near", "probe", "copula"),
        ]
    )  # fmt: skip
    alone = one(models=("clairvoyant",), world="stakes")
    assert [
        condition.id for condition in made if condition.labels["sensor"] == "full"
    ] == [alone.id]


def test_grounds_and_beliefs_are_crossed_and_their_options_swept() -> None:
    made = conditions(
        scenarios=("std",),
        grounds=(
            "contact",
            {
                "part": "probe",
                "options": {"radius_m": [1.0, 2.0], "noise_std": [0.1, 0.3]},
            },
        ),
        beliefs=({"part": "copula", "options": {"correlation_m": ["world", 1.0]}},),
    )
    found = {(ground, belief) for _, ground, belief in known(made)}
    assert len(made) == len(found) == 10
    assert {condition.belief.object.correlation_m for condition in made} == {
        "world",
        1.0,
    }
    probes = [
        condition.ground.object
        for condition in made
        if condition.ground.part == "probe"
    ]
    chosen = {(probe.radius_m, probe.noise_std) for probe in probes}
    assert (len(probes), chosen) == (8, set(product((1.0, 2.0), (0.1, 0.3))))
    for first, second in pairwise(made):
        assert first.id != second.id


def test_what_robots_know_by_is_read_back() -> None:
    made = conditions(
        planners=(FAN, "straight"), scenarios=("std",), grounds=("contact", "probe:2"),
        beliefs=("static", "copula", {"part": "static", "label": "free", "options": {"correlated": False}}),
        sensors=("full", {"part": "near", "label": "far", "options": {"range_m": 16.0}}),
        task={"unseen": "pessimistic", "replan_every_s": 0.2},
    )  # fmt: skip
    for condition in made:
        again = condition_from({"value": condition.value, "labels": condition.labels})
        assert (again, again.id) == (condition, condition.id)
        assert (again.rules.unseen, again.rules.replan_every_s) == ("pessimistic", 0.2)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"grounds": ("probe", "probe:1")}, "twice"),
        (
            {"grounds": ("probe", {"part": "probe", "options": {"radius_m": 2.0}})},
            "with the label 'probe'",
        ),
        (
            {"sensors": ("near", {"part": "near", "options": {"range_m": 2.0}})},
            "with the label 'near'",
        ),
        (
            {"beliefs": ({"part": "copula", "options": {"windw": 3}},)},
            "Did you mean 'window'",
        ),
        ({"grounds": ("prob",)}, "Did you mean 'probe'"),
        ({"sensors": ("nera",)}, "Did you mean 'near'"),
        ({"beliefs": ("copla",)}, "Did you mean 'copula'"),
        ({"beliefs": ()}, "one or more `beliefs`"),
        ({"task": {"unseen": "dark"}}, "unseen"),
        ({"task": {"replan_every_s": -1}}, "replan_every_s"),
    ],
)
def test_what_robots_cannot_know_by_is_refused(
    changes: dict[str, object], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        conditions(**({"beliefs": ("copula",)} | changes))


def test_labels_of_what_robots_know_by_are_one_each() -> None:
    probe, far = (
        one(beliefs=("copula",), grounds=("probe",)),
        one(beliefs=("copula",), grounds=("probe:2",)),
    )
    check_labels([probe, far, one()])
    with pytest.raises(ConfigError, match="two settings with the label 'probe'"):
        check_labels([probe, replace(far, ground=replace(far.ground, label="probe"))])
    with pytest.raises(ConfigError, match="for each ground, got 'mine' and 'probe'"):
        check_labels(
            [probe, replace(probe, ground=replace(probe.ground, label="mine"))]
        )
    # What is not used has no label that it could share.
    check_labels([one(), one(planners=("straight",)), one(sensors=("near",))])
