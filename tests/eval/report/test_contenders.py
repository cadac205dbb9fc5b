import pytest

from benchnav.eval.report.contenders import contender_names, trial_colours
from tests.eval.report import made


@pytest.mark.parametrize(
    ("trials", "names"),
    [
        ([made.trial(risk="mean"), made.trial(risk="cvar:0.9")], ["mean", "cvar:0.9"]),
        (
            [made.trial("mppi", "mean"), made.trial("straight", "–", model="–")],
            ["mppi", "straight"],
        ),
        ([made.trial(model="a"), made.trial(model="b")], ["a", "b"]),
        ([made.trial(robot="a"), made.trial(robot="b", world="stakes")], ["a, paper", "b, stakes"]),
        ([made.trial()], ["mppi"]),
    ],
)
def test_trials_are_called_by_what_tells_them_apart(trials: list[dict[str, str]], names: list[str]) -> None:
    assert contender_names(trials) == names


def test_eight_trials_have_eight_colours() -> None:
    assert len(set(trial_colours(8))) == 8
    assert trial_colours(9)[8] == trial_colours(1)[0]
