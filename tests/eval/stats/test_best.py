import numpy as np
import pandas as pd
import pytest

from benchnav.eval.stats.best import (
    PRIVILEGED,
    against_best,
    competing,
    privileged_models,
)
from tests.eval.report import made

BLIND = {"planner": "straight", "risk": "–", "model": "–"}
MAPS = 30


def episodes(labels: dict[str, str], successes: range, **changes: object) -> list[dict]:  # type: ignore[type-arg]
    return [
        made.row(labels, i, 30.0 if i in successes else None, **changes)
        for i in range(MAPS)
    ]


def compared(*conditions: list[dict]) -> pd.DataFrame:  # type: ignore[type-arg]
    rows = made.rows(*conditions)
    summary = made.summarised(rows)
    found = against_best(rows, summary, privileged_models(made.conditions(rows)))
    assert list(found["condition"]) == list(summary["condition"])
    return found.assign(risk=summary["risk"], model=summary["model"]).set_index("risk")


def test_the_best_is_compared_with_all_others_and_corrected_over_them() -> None:
    found = compared(
        episodes(made.condition(risk="low"), range(10)),
        episodes(made.condition(risk="best"), range(29)),
        episodes(made.condition(risk="near"), range(27)),
    )
    assert set(found["best"]) == {found.loc["best", "condition"]}
    assert list(found["best_rivals"]) == [2, 2, 2]
    assert list(found["best_maps"]) == [MAPS] * 3
    # None of 2 000 samples is as far as the 19 maps that the lowest lost; the near one
    # lost two.
    assert found.loc["low", "best_p"] == pytest.approx(1 / 2001)
    assert found.loc["near", "best_p"] > 0.2
    assert found["best_alike"].to_dict() == {"low": False, "best": True, "near": True}
    assert found["best_marked"].to_dict() == {"low": False, "best": True, "near": True}
    assert found.loc["low", "best_difference"] == pytest.approx(19 / 30)
    assert found.loc["low", "best_low"] < 19 / 30 < found.loc["low", "best_high"]
    assert np.isnan(found.loc["best", "best_difference"])


def test_groups_of_maps_are_the_unit_of_the_best() -> None:
    """The same episodes: thirty maps tell two settings apart, three groups of them
    cannot.
    """

    def conditions(**changes: object) -> list[list[dict]]:  # type: ignore[type-arg]
        return [
            [made.row(made.condition(risk=risk), i, 30.0 if i < count else None) | {n: f(i) for n, f in changes.items()}
             for i in range(MAPS)]
            for risk, count in (("a", 28), ("b", 8))
        ]  # fmt: skip

    by_map, by_group = (
        compared(*conditions()),
        compared(*conditions(group=lambda i: i // 10)),
    )
    assert not by_map.loc["b", "best_alike"]
    assert by_group.loc["b", "best_alike"]
    assert by_group.loc["b", "best_p"] == 1  # no test has so few
    assert list(by_group["best_maps"]) == [3, 3]


def test_of_equal_rates_the_faster_is_the_best() -> None:
    slow = [made.row(made.condition(risk="slow"), i, 40.0) for i in range(5)]
    found = compared(
        slow, [made.row(made.condition(risk="fast"), i, 20.0) for i in range(5)]
    )
    assert set(found["best"]) == {found.loc["fast", "condition"]}
    assert found["best_alike"].all()


def test_each_block_has_a_best_of_its_own() -> None:
    for name in ("data", "scenario", "world", "robot", "objective"):
        found = compared(
            *(
                episodes(
                    made.condition(risk=f"{risk} {place}", **{name: place}),
                    range(count),
                )
                for place, counts in (("here", (20, 5)), ("there", (4, 25)))
                for risk, count in zip("ab", counts, strict=True)
            )
        )
        assert (
            found.loc["a here", "best"]
            == found.loc["b here", "best"]
            == found.loc["a here", "condition"]
        )
        assert found.loc["a there", "best"] == found.loc["b there", "condition"]
        assert (found["best_rivals"] == 1).all()


def test_maps_are_paired_under_the_same_noise() -> None:
    """The same rates on the same maps, but under seeds of which each has its own
    successes.
    """
    one = [
        made.row(made.condition(risk="one"), i, 30.0, seed=s)
        for i in range(30)
        for s in (0, 1)
    ]
    other = [
        made.row(made.condition(risk="two"), i, None if s else 31.0, seed=s)
        for i in range(30)
        for s in (0, 1)
    ]
    found = compared(one, other)
    assert found.loc["two", "best_difference"] == pytest.approx(0.5)
    assert found.loc["two", "best_p"] < 0.01
    # only under the first seed
    few = [made.row(made.condition(risk="three"), i, None) for i in range(4)]
    assert compared(one, few).loc["three", "best_difference"] == pytest.approx(1)


def test_what_was_run_on_more_maps_is_judged_by_those_that_all_have() -> None:
    """On the first maps the one wins, in all of its own it has the lower rate."""
    more = [
        made.row(made.condition(risk="more"), i, 30.0 if i < 10 else None)
        for i in range(40)
    ]
    less = [
        made.row(made.condition(risk="less"), i, 30.0 if i < 5 else None)
        for i in range(10)
    ]
    found = compared(more, less)
    assert set(found["best"]) == {found.loc["more", "condition"]}
    assert list(found["best_episodes"]) == [10, 10]
    assert found.loc["less", "best_difference"] == pytest.approx(0.5)


def test_a_map_that_was_met_more_often_leaves_the_others_in() -> None:
    conditions = [
        episodes(made.condition(risk="a"), range(29)),
        episodes(made.condition(risk="b"), range(5)),
    ]
    again = [[made.row(made.condition(risk=risk), 0, 30.0, seed=5)] for risk in "ab"]
    plain, with_one = compared(*conditions), compared(*conditions, *again)
    # All 30 maps stay, one of them with two draws, of which the second ended alike.
    assert with_one.loc["b", "best_difference"] == pytest.approx(24 / 31)
    assert list(with_one["best_maps"]) == [30, 30]
    assert not with_one.loc["b", "best_alike"]
    assert plain.loc["b", "best_difference"] == pytest.approx(24 / 30)


def test_the_detectable_difference_is_at_the_level_of_the_first_step() -> None:
    two = compared(
        episodes(made.condition(risk="a"), range(20)),
        episodes(made.condition(risk="b"), range(10)),
    )
    more = [episodes(made.condition(risk=f"r{n}"), range(n, n + 15)) for n in range(6)]
    many = compared(
        episodes(made.condition(risk="a"), range(20)),
        episodes(made.condition(risk="b"), range(10)),
        *more,
    )
    assert many.loc["b", "best_shown"] > two.loc["b", "best_shown"]


@pytest.mark.parametrize(
    ("models", "left"),
    [
        (["paper-v1", "oracle", "clairvoyant", "–"], ["paper-v1", "–"]),
        (["oracle", "ideal", "clairvoyant", "–"], ["oracle", "ideal", "–"]),
        (["clairvoyant", "–"], ["clairvoyant", "–"]),
        (["–"], ["–"]),
        (["a", "b"], ["a", "b"]),
    ],
)
def test_a_privileged_model_competes_only_where_nothing_else_does(
    models: list[str], left: list[str]
) -> None:
    rows = pd.DataFrame(
        {
            "model": models,
            "privileged": [model if model in PRIVILEGED else "" for model in models],
        }
    )
    assert list(rows["model"][competing(rows)]) == left


def test_a_privileged_model_is_known_by_its_part_and_not_by_its_name() -> None:
    def about(part: str, label: str) -> dict[str, object]:
        return {
            "value": {"model": {"part": part, "options": {}}},
            "labels": {"model": label},
        }

    conditions = {
        "a": about("oracle", "truth"),
        "b": about("checkpoints/mine", "oracle"),
        "c": about("oracle", "–"),
    }
    assert privileged_models(conditions) == {"a": "oracle"}


def test_privileged_models_are_not_compared() -> None:
    found = compared(
        episodes(made.condition(risk="mine"), range(5)),
        episodes(made.condition(risk="privileged", model="oracle"), range(30)),
        episodes(made.condition(**BLIND), range(2)),
    )
    assert set(found["best"]) == {found.loc["mine", "condition"]}
    assert list(found["best_rivals"]) == [1, 1, 1]
    assert np.isnan(found.loc["privileged", "best_p"])
    assert not found.loc["privileged", "best_alike"]


def test_conditions_without_a_map_in_common_and_with_one_map_are_not_distinguished() -> (
    None
):
    apart = compared(
        [made.row(made.condition(risk="a"), i, 30.0) for i in range(9)],
        [made.row(made.condition(risk="b"), i, None) for i in range(9, 18)],
    )
    assert apart["best_alike"].all()
    single = compared(
        [made.row(made.condition(risk="a"), 0)],
        [made.row(made.condition(risk="b"), 0, None)],
    )
    assert single["best_alike"].all()
    assert single.loc["b", "best_difference"] == 1


@pytest.mark.parametrize("maps", [2, 5, 6, 20])
def test_fewer_than_six_maps_detect_nothing(maps: int) -> None:
    found = compared(
        [made.row(made.condition(risk="a"), i, 30.0) for i in range(maps)],
        [
            made.row(made.condition(risk="b"), i, 30.0 if i else None)
            for i in range(maps)
        ],
    )
    assert np.isinf(found.loc["b", "best_shown"]) == (maps < 6)
