from typing import Any

import pytest

from benchnav.errors import ConfigError
from benchnav.eval.stats.pairing import Compared, Pair, find_pairs
from benchnav.eval.trial import NOT_USED
from tests.eval.report.made import row, rows, trial

STAKES = {"noise": "frozen", "correlation_m": 1.5}


def compared(planner: str = "mppi", risk: str = "mean", **changes: Any) -> Compared:
    """A trial on four maps, all of which it solves in 30 s."""
    given = {"world": STAKES, "maps": ["a", "b", "c", "d"], "episodes": None, "run": NOT_USED} | changes
    labels = {
        name: value for name, value in given.items() if name not in ("world", "maps", "episodes", "run")
    }
    names = trial(planner, risk, **labels)
    episodes = given["episodes"]
    if episodes is None:
        episodes = [row(names, instance) for instance in range(4)]
    return Compared(
        labels={**names, "run": given["run"]},
        world=given["world"],
        maps=given["maps"],
        episodes=rows(episodes).assign(time_budget_s=100.0),
    )


def names(pairs: list[Pair]) -> list[tuple[str, str]]:
    return [(pair.one, pair.other) for pair in pairs]


def test_all_pairs_of_settings_with_all_else_alike() -> None:
    trials = [compared(planner, risk) for risk in ("mean", "var", "cvar") for planner in ("mppi", "cl_rrt")]
    pairs = find_pairs(trials)
    each = [("var", "mean"), ("cvar", "mean"), ("cvar", "var")]
    assert names(pairs) == each * 2
    assert [pair.shared["planner"] for pair in pairs] == ["mppi"] * 3 + ["cl_rrt"] * 3
    assert "risk" not in pairs[0].shared


def test_all_against_one() -> None:
    trials = [compared(risk=risk) for risk in ("cvar", "mean", "var")]
    assert names(find_pairs(trials, against="mean")) == [("cvar", "mean"), ("var", "mean")]
    assert names(find_pairs(trials, against="cvar")) == [("mean", "cvar"), ("var", "cvar")]


def test_by_follows_what_is_compared_with() -> None:
    trials = [compared("mppi", "mean"), compared("mppi", "cvar"), compared("cl_rrt", "mean")]
    assert names(find_pairs(trials, against="cl_rrt")) == [("mppi", "cl_rrt")]
    assert names(find_pairs(trials, by="planner")) == [("cl_rrt", "mppi")]


def test_a_blind_planner_goes_with_every_setting_and_model() -> None:
    blind = compared("straight", NOT_USED, model=NOT_USED)
    trials = [
        blind,
        compared("mppi", "mean"),
        compared("mppi", "cvar"),
        compared("mppi", "cvar", model="oracle"),
    ]
    pairs = find_pairs(trials, against="straight")
    assert [(pair.shared["model"], pair.shared["risk"]) for pair in pairs] == [
        ("paper-v1", "mean"),
        ("paper-v1", "cvar"),
        ("oracle", "cvar"),
    ]
    # Compared by what it does not use it has no part.
    assert names(find_pairs(trials)) == [("cvar", "mean")]


def test_luck_is_matched_episode_by_episode() -> None:
    def timed(labels: dict[str, str], late: float) -> list[dict[str, Any]]:
        return [
            row(labels, i, 30.0 + i + 10 * draw + 40 * seed + late, seed=seed, realisation=draw)
            for seed in (1, 0)
            for draw in (0, 1)
            for i in range(3)
        ]

    one = compared(risk="cvar", episodes=timed(trial("mppi", "cvar"), 0.5))
    backwards = timed(trial("mppi", "mean"), 0.0)[::-1]
    (pair,) = find_pairs([compared(episodes=backwards), one])
    assert len(pair.episodes) == 12
    assert (pair.episodes["total_time_s"] - pair.episodes["total_time_s_other"]).eq(0.5).all()
    assert pair.left_out == 0


def test_what_only_one_trial_met_is_left_out_and_counted() -> None:
    more = [row(trial("mppi", "cvar"), instance, seed=seed) for seed in (0, 1) for instance in range(4)]
    (pair,) = find_pairs([compared(), compared(risk="cvar", episodes=more)])
    assert (len(pair.episodes), pair.left_out) == (4, 4)
    # A map that one trial met under one seed of two is left out, so that maps count alike.
    both = [row(trial(), instance, seed=seed) for seed in (0, 1) for instance in range(3)]
    part = [row(trial("mppi", "cvar"), i, seed=s) for s, i in ((0, 0), (1, 0), (0, 1), (0, 2), (1, 2))]
    (pair,) = find_pairs([compared(episodes=both), compared(risk="cvar", episodes=part)])
    assert sorted(set(pair.episodes["instance"])) == [0, 2]
    assert pair.left_out == 6 + 5 - 2 * 4


def test_a_map_that_was_met_more_often_leaves_the_others_in() -> None:
    again = [[row(trial("mppi", risk), 0, seed=5)] for risk in ("mean", "cvar")]
    plain = [[row(trial("mppi", risk), instance) for instance in range(4)] for risk in ("mean", "cvar")]
    (pair,) = find_pairs(
        [
            compared(risk=risk, episodes=own + more)
            for risk, own, more in zip(("mean", "cvar"), plain, again, strict=True)
        ]
    )
    # Of four maps the one that has two draws is left out, not the three that have one.
    assert sorted(pair.episodes["instance"]) == [1, 2, 3]
    assert pair.left_out == 4


def test_runs_that_share_trials_are_compared_with_each_other() -> None:
    trials = [compared(run=run, risk=risk) for run in ("before", "after") for risk in ("mean", "var")]
    assert names(find_pairs(trials)) == [("after", "before")] * 2
    assert names(find_pairs(trials, against="before")) == [("after", "before")] * 2
    assert [pair.shared["run"] for pair in find_pairs(trials, by="risk")] == ["before", "after"]


@pytest.mark.parametrize(
    ("changes", "asked", "message"),
    [
        ({"world": {**STAKES, "correlation_m": 3.0}}, {}, "correlation_m 3.0 and 1.5"),
        ({"maps": ["a", "b", "x", "d"]}, {}, "other digests"),
        ({"episodes": [row(trial("mppi", "cvar"), 0, seed=7)]}, {}, "seeds 7, realisations 0 and seeds 0"),
        ({"scenario": "hg"}, {}, "differ in their risk and in nothing else"),
        (
            {"risk": "mean", "planner": "cl_rrt"},
            {},
            r"They differ in planner \(cl_rrt, mppi\): try `--by planner`",
        ),
        ({}, {"by": "scenario"}, "other maps"),
        ({}, {"by": "planer"}, "Did you mean 'planner'"),
        ({}, {"against": "meen"}, "Did you mean 'mean'"),
        ({}, {"by": "risk", "against": "mppi"}, "Expected `against` among mean, cvar"),
        ({"model": "mean"}, {"against": "mean"}, "Expected `by` risk or model"),
    ],
)
def test_what_cannot_be_paired_is_refused_with_the_reason(
    changes: dict[str, Any], asked: dict[str, str], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        find_pairs([compared(), compared(**{"risk": "cvar", **changes})], **asked)


def test_a_shorter_trial_is_paired_on_the_maps_it_met() -> None:
    short = [row(trial("mppi", "cvar"), instance) for instance in range(2)]
    (pair,) = find_pairs([compared(), compared(risk="cvar", maps=["a", "b"], episodes=short)])
    assert (len(pair.episodes), pair.left_out) == (2, 2)


def test_one_world_under_two_rules_can_be_paired() -> None:
    trials = [compared(), compared(**{"risk": "mean"})]
    labelled = [
        Compared(labels={**t.labels, "world": name}, world=t.world, maps=t.maps, episodes=t.episodes)
        for t, name in zip(trials, ("stakes", "stakes above=0.3"), strict=True)
    ]
    assert names(find_pairs(labelled, by="world")) == [("stakes above=0.3", "stakes")]
