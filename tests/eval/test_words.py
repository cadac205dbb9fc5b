import pytest

from benchnav.eval.words import contender_names, failures_in_words, p_in_words
from benchnav.stats.tables import p_value
from tests.eval.report import made


@pytest.mark.parametrize(
    ("conditions", "names"),
    [
        (
            [made.condition(risk="mean"), made.condition(risk="cvar:0.9")],
            ["mean", "CVaR₀.₉"],
        ),
        (
            [
                made.condition("mppi", "mean"),
                made.condition("straight", "–", model="–"),
            ],
            ["MPPI", "straight"],
        ),
        ([made.condition(model="a"), made.condition(model="b")], ["a", "b"]),
        (
            [made.condition(robot="a"), made.condition(robot="b", world="stakes")],
            ["a, paper", "b, stakes"],
        ),
        ([made.condition()], ["MPPI"]),
    ],
)
def test_conditions_are_called_by_what_tells_them_apart(
    conditions: list[dict[str, str]], names: list[str]
) -> None:
    assert contender_names(conditions) == names


def test_p_in_words() -> None:
    assert [p_in_words(p) for p in (0.00001, 0.0123, 1.0)] == [
        "p ≤ 0.0001",
        "p = 0.012",
        "p = 1",
    ]
    assert [p_value(p) for p in (0.00001, 0.0123, 1.0)] == ["≤ 0.0001", "0.012", "1"]


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        ([], "–"),
        (["stuck", "stalled", "stuck"], "2 stuck, 1 stalled"),
        (
            ["model_error", "planner_error", "timeout"],
            "1 timeout, 1 planner error, 1 model error",
        ),
    ],
)
def test_failures_in_words(outcomes: list[str], expected: str) -> None:
    labels = made.condition()
    failed = (
        made.row(labels, i, None, outcome=outcome) for i, outcome in enumerate(outcomes)
    )
    summary = made.summarised(made.rows(made.row(labels, 99), failed))
    assert failures_in_words(summary.to_dict("records")[0]) == expected
