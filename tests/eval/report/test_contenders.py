import pytest

from benchnav.eval.report.contenders import condition_colours, contender_names
from tests.eval.report import made


@pytest.mark.parametrize(
    ("conditions", "names"),
    [
        ([made.condition(risk="mean"), made.condition(risk="cvar:0.9")], ["mean", "cvar:0.9"]),
        (
            [made.condition("mppi", "mean"), made.condition("straight", "–", model="–")],
            ["mppi", "straight"],
        ),
        ([made.condition(model="a"), made.condition(model="b")], ["a", "b"]),
        ([made.condition(robot="a"), made.condition(robot="b", world="stakes")], ["a, paper", "b, stakes"]),
        ([made.condition()], ["mppi"]),
    ],
)
def test_conditions_are_called_by_what_tells_them_apart(
    conditions: list[dict[str, str]], names: list[str]
) -> None:
    assert contender_names(conditions) == names


def test_eight_conditions_have_eight_colours() -> None:
    assert len(set(condition_colours(8))) == 8
    assert condition_colours(9)[8] == condition_colours(1)[0]
