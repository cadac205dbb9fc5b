from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import KNOWLEDGE, NOT_USED
from benchnav.eval.stats.pairs import Compared, Pair, check_one_value_each, find_pairs
from tests.eval.report.made import condition, row, rows

STAKES = {
    "noise": "frozen",
    "correlation_m": 1.5,
    "immobile": {"below": 0.1, "for_s": 2.0},
    "time_budget_s": 100.0,
}
RULES = {
    "free_space": {"by": "risk", "above": 0.1},
    "min_traversability": 0.1,
    "goal_radius_m": 1.0,
}


def value_of(labels: Mapping[str, str], **changes: Any) -> dict[str, Any]:
    """What `run.json` says of a condition with these labels; parts stand in for what is
    not used.
    """
    kinds = ("model", "risk", "planner", "robot", "objective")
    stand_in = {"model": "oracle", "risk": "mean"}
    parts = {
        kind: {
            "part": stand_in[kind] if labels[kind] == NOT_USED else labels[kind],
            "options": {},
        }
        for kind in kinds
    }
    own = {
        "data": labels["data"],
        "split": f"test/{labels['scenario']}",
        "rules": RULES,
        "world": STAKES,
    }
    known = {kind: {"part": labels[kind], "options": {}} for kind in KNOWLEDGE}
    known = {
        kind: part
        for kind, part in known.items()
        if part["part"] not in (NOT_USED, KNOWLEDGE[kind]["part"])
    }
    return own | parts | known | changes


def compared(planner: str = "mppi", risk: str = "mean", **changes: Any) -> Compared:
    """A condition on four maps, all of which it solves in 30 s."""
    given = {
        "maps": ["a", "b", "c", "d"],
        "episodes": None,
        "run": NOT_USED,
        "value": {},
    } | changes
    labels = {
        name: value
        for name, value in given.items()
        if name not in ("maps", "episodes", "run", "value")
    }
    names = condition(planner, risk, **labels)
    episodes = given["episodes"]
    if episodes is None:
        episodes = [row(names, map_index) for map_index in range(4)]
    return Compared(
        labels={**names, "run": given["run"]},
        value=value_of(names, **given["value"]),
        maps=given["maps"],
        episodes=rows(episodes).assign(time_budget_s=100.0),
        code={given["run"]: {}},
    )


def left_out(pair: Pair) -> int:
    """Episodes of either condition that the other does not have."""
    return sum(len(member.episodes) - len(pair.episodes) for member in pair.members)


def names(pairs: list[Pair]) -> list[tuple[str, str]]:
    return [(pair.one, pair.other) for pair in pairs]


def test_all_pairs_of_settings_with_all_else_alike() -> None:
    conditions = [
        compared(planner, risk)
        for risk in ("mean", "var", "cvar")
        for planner in ("mppi", "cl_rrt")
    ]
    pairs = find_pairs(conditions)
    each = [("var", "mean"), ("cvar", "mean"), ("cvar", "var")]
    assert names(pairs) == each * 2
    assert [pair.shared["planner"] for pair in pairs] == ["mppi"] * 3 + ["cl_rrt"] * 3
    assert "risk" not in pairs[0].shared


def test_all_against_one() -> None:
    conditions = [compared(risk=risk) for risk in ("cvar", "mean", "var")]
    assert names(find_pairs(conditions, against="mean")) == [
        ("cvar", "mean"),
        ("var", "mean"),
    ]
    assert names(find_pairs(conditions, against="cvar")) == [
        ("mean", "cvar"),
        ("var", "cvar"),
    ]


def test_a_blind_planner_goes_with_every_setting_and_model() -> None:
    blind = compared("straight", NOT_USED, model=NOT_USED)
    conditions = [
        blind,
        compared("mppi", "mean"),
        compared("mppi", "cvar"),
        compared("mppi", "cvar", model="oracle"),
    ]
    pairs = find_pairs(conditions, against="straight")
    assert [(pair.shared["model"], pair.shared["risk"]) for pair in pairs] == [
        ("paper-v1", "mean"),
        ("paper-v1", "cvar"),
        ("oracle", "cvar"),
    ]
    # Compared by what it does not use it has no part.
    assert names(find_pairs(conditions)) == [("cvar", "mean")]


def test_noise_is_matched_episode_by_episode() -> None:
    def timed(labels: dict[str, str], late: float) -> list[dict[str, Any]]:
        return [
            row(
                labels,
                i,
                30.0 + i + 10 * draw + 40 * seed + late,
                seed=seed,
                realisation=draw,
            )
            for seed in (1, 0)
            for draw in (0, 1)
            for i in range(3)
        ]

    one = compared(risk="cvar", episodes=timed(condition("mppi", "cvar"), 0.5))
    backwards = timed(condition("mppi", "mean"), 0.0)[::-1]
    (pair,) = find_pairs([compared(episodes=backwards), one])
    assert len(pair.episodes) == 12
    assert (
        (pair.episodes["total_time_s"] - pair.episodes["total_time_s_other"])
        .eq(0.5)
        .all()
    )
    assert left_out(pair) == 0


def test_what_only_one_condition_met_is_left_out_and_counted() -> None:
    more = [
        row(condition("mppi", "cvar"), map_index, seed=seed)
        for seed in (0, 1)
        for map_index in range(4)
    ]
    (pair,) = find_pairs([compared(), compared(risk="cvar", episodes=more)])
    assert (len(pair.episodes), left_out(pair)) == (4, 4)
    # A map that one met under one seed of two counts with that one.
    both = [
        row(condition(), map_index, seed=seed)
        for seed in (0, 1)
        for map_index in range(3)
    ]
    part = [
        row(condition("mppi", "cvar"), i, seed=s)
        for s, i in ((0, 0), (1, 0), (0, 1), (0, 2), (1, 2))
    ]
    (pair,) = find_pairs(
        [compared(episodes=both), compared(risk="cvar", episodes=part)]
    )
    assert sorted(pair.episodes["map"]) == [0, 0, 1, 2, 2]
    assert left_out(pair) == 6 + 5 - 2 * 5


def test_runs_that_share_conditions_are_compared_with_each_other() -> None:
    conditions = [
        compared(run=run, risk=risk)
        for run in ("before", "after")
        for risk in ("mean", "var")
    ]
    assert names(find_pairs(conditions)) == [("after", "before")] * 2
    assert names(find_pairs(conditions, against="before")) == [("after", "before")] * 2


@pytest.mark.parametrize(
    ("changes", "asked", "message"),
    [
        (
            {"value": {"world": {**STAKES, "correlation_m": 3.0}}},
            {},
            "differ only in their risk",
        ),
        (
            {"value": {"planner": {"part": "mppi", "options": {"samples": 9}}}},
            {},
            "differ only in their",
        ),
        (
            {"value": {"rules": {**RULES, "goal_radius_m": 2.0}}},
            {},
            "differ only in their risk",
        ),
        ({"maps": ["a", "b", "x", "d"]}, {}, "whose maps differ"),
        (
            {"episodes": [row(condition("mppi", "cvar"), 0, seed=7)]},
            {},
            "seeds 7, realisations 0 and seeds 0",
        ),
        ({"scenario": "hg"}, {}, "differ only in their risk"),
        (
            {"risk": "mean", "planner": "cl_rrt"},
            {},
            r"They differ in planner \(cl_rrt, mppi\). Try `--by planner`",
        ),
        ({}, {"by": "scenario"}, "data and scenario determine the maps"),
        ({}, {"by": "planer"}, "Did you mean 'planner'"),
        ({}, {"against": "meen"}, "Did you mean 'mean'"),
        ({}, {"by": "risk", "against": "mppi"}, "Expected `against` among mean, cvar"),
        (
            {"model": "mean"},
            {"against": "mean"},
            "a label of risk and of model. Pass --by risk or --by model",
        ),
    ],
)
def test_what_cannot_be_paired_is_refused_with_the_reason(
    changes: dict[str, Any], asked: dict[str, str], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        find_pairs([compared(), compared(**{"risk": "cvar", **changes})], **asked)


def world(label: str, **changes: Any) -> Compared:
    rules = {name: changes.pop(name) for name in list(changes) if name in RULES}
    own = {"world": {**STAKES, **changes}, "rules": {**RULES, **rules}}
    return compared(world=label, value=own)


def test_worlds_are_paired_where_the_same_λ_is_drawn() -> None:
    same = [
        world("stakes"),
        world("stakes radius", goal_radius_m=2.0),
        world("stakes T", time_budget_s=50.0),
        world("stakes for", immobile={"below": 0.1, "for_s": 5.0}),
    ]
    assert len(find_pairs(same, by="world")) == 6
    for other in (
        {"correlation_m": 3.0},
        {"kernel": "matern32"},
        {"noise": "stored"},
        {"immobile": {"below": 0.2, "for_s": 2.0}},
    ):
        with pytest.raises(ConfigError, match="Their worlds draw different λ"):
            find_pairs([world("stakes"), world("other", **other)], by="world")
    resampled = [
        world("paper", noise="resampled"),
        world("paper held", noise="resampled", immobile={"below": 0.2, "for_s": 2.0}),
    ]
    assert names(find_pairs(resampled, by="world")) == [("paper held", "paper")]


def test_values_decide_and_labels_are_for_people() -> None:
    one_value = {"risk": {"part": "cvar", "options": {"level": 0.5}}}
    conditions = [
        compared(risk="cvar:0.5", value=one_value),
        compared(risk="half", value=one_value),
    ]
    with pytest.raises(ConfigError, match="differ only in their risk"):
        find_pairs(conditions)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("risk", {"risk": {"part": "mean", "options": {"level": 0.9}}}),
        ("planner", {"planner": {"part": "mppi", "options": {"level": 0.9}}}),
        ("model", {"model": {"part": "paper-v1", "options": {"level": 0.9}}}),
        ("robot", {"robot": {"part": "unicycle", "options": {"level": 0.9}}}),
        (
            "objective",
            {"objective": {"part": "goal_distance", "options": {"level": 0.9}}},
        ),
        ("world", {"world": {**STAKES, "level": 0.9}}),
        ("world", {"rules": {**RULES, "level": 0.9}}),
    ],
)
def test_two_values_under_one_label_are_refused(
    kind: str, value: dict[str, Any]
) -> None:
    conditions = [compared(run="a"), compared(run="b", value=value)]
    with pytest.raises(
        ConfigError,
        match=rf"one {kind} for each label, got two with the label .* in a and b: .*level None and 0\.9",
    ):
        check_one_value_each(conditions)
    check_one_value_each([compared(run="a"), compared(run="b")])


def test_what_is_not_used_needs_no_one_value() -> None:
    check_one_value_each(
        [
            compared("straight", NOT_USED, model=NOT_USED),
            compared(
                "straight",
                NOT_USED,
                model=NOT_USED,
                value={"risk": {"part": "other", "options": {}}},
            ),
        ]
    )


def test_pairs_hold_the_group_of_each_map() -> None:
    grouped = [row(condition("mppi", "cvar"), i, group=i // 2 + 7) for i in range(4)]
    (pair,) = find_pairs(
        [compared(episodes=grouped), compared(risk="cvar", episodes=grouped)]
    )
    assert list(pair.episodes.sort_values("map")["group"]) == [7, 7, 8, 8]
    assert pair.episodes["group"].dtype == np.int64


def learning(ground: str, belief: str = "copula", **changes: Any) -> Compared:
    """A condition of robots that learn by some sensor of the ground."""
    return compared("mppi", **({"ground": ground, "belief": belief} | changes))


def test_what_robots_know_by_is_compared_one_thing_at_a_time() -> None:
    known = [
        learning("contact"),
        learning("probe"),
        learning("probe", "classes"),
        compared("mppi"),
    ]
    assert names(find_pairs(known, "ground")) == [("probe", "contact")]
    # A belief that does not learn is given nothing of the ground, whatever the other
    # senses.
    assert sorted(names(find_pairs(known, "belief"))) == sorted(
        [
            ("static", "copula"),
            ("static", "copula"),
            ("static", "classes"),
            ("classes", "copula"),
        ]
    )
    seen = [
        compared("mppi"),
        compared("mppi", sensor="near"),
        learning("probe", sensor="near"),
    ]
    assert names(find_pairs(seen, "sensor")) == [("near", "full")]
    assert names(find_pairs(seen, "belief")) == [("copula", "static")]
    for label, by in (("probe", "ground"), ("near", "sensor"), ("static", "belief")):
        (pair, *_) = find_pairs([*known, *seen], against=label)
        assert pair.other == label
        assert pair.members[0].labels[by] != label
    with pytest.raises(
        ConfigError,
        match=r"They differ in .*belief \(copula, static\). Try `--by belief`",
    ):
        find_pairs([learning("contact"), compared("mppi")], "risk")


def test_a_blind_planner_is_compared_with_one_that_learns() -> None:
    blind = compared("straight", NOT_USED, model=NOT_USED)
    assert blind.labels["belief"] == NOT_USED
    learns = learning("probe", sensor="near")
    (pair,) = find_pairs([learns, blind], "planner")
    assert (pair.one, pair.other) == ("straight", "mppi")
    # What the blind planner does not use is named as the other one has it.
    assert pair.shared == {
        name: label for name, label in learns.labels.items() if name != "planner"
    }
