from benchnav.eval.report.playback.rerun_file import drivers_of
from benchnav.eval.report.playback.words import describe
from tests.eval.report import made


def test_an_episode_is_told_with_its_outcome_and_the_threshold() -> None:
    recording = made.held_recording(43, free_by="mean", free_above=0.1, time_budget_s=90.0)
    text = describe(drivers_of([recording]))
    for words in (
        "**immobilised** after 4.3 s of 90 s",
        "Free: mean λ above 0.1",
        "| planner | mppi |",
        "std 4",
    ):
        assert words in text


def test_conditions_are_told_side_by_side() -> None:
    first = made.recording(200, labels=made.condition(risk="cvar:0.9"))
    about = {**made.recording().about, "risk": "mean", "outcome": "out_of_bounds"}
    text = describe(drivers_of([first, made.recording(150, about=about)]))
    assert "| cvar:0.9 | **success** | 20.0 |" in text
    assert "| mean | **out of bounds** | 15.0 |" in text


def test_an_episode_that_ended_at_once_met_nothing() -> None:
    assert "observed λ on average: –" in describe(drivers_of([made.recording(0)]))
