import numpy as np
import pytest

from benchnav.eval.report.recording import take_snapshot
from tests.eval.report import made


@pytest.mark.parametrize(
    ("steps", "dt_s", "time_s", "step"),
    [
        (200, 0.1, 15.0, 150),  # a moment is a time, whatever the step
        (200, 0.2, 15.0, 75),
        (200, 0.3, 15.0, 50),
        (200, 0.1, 15.3, 150),  # the last plan that was drawn by then
        (42, 0.1, 15.0, 40),  # an episode that had ended by then
    ],
)
def test_a_snapshot_is_of_the_last_plan_by_its_time(
    steps: int, dt_s: float, time_s: float, step: int
) -> None:
    recording = made.recording(steps, dt_s)
    snapshot = take_snapshot(recording, time_s)
    assert (snapshot.plan.step, snapshot.now) == (step, step)
    assert snapshot.time_s == pytest.approx(step * dt_s)
    np.testing.assert_array_equal(snapshot.track, recording.states[:, :2])
    np.testing.assert_array_equal(snapshot.extent_m, [30, 20])


def test_a_snapshot_is_of_the_recordings_own_ground() -> None:
    recording = made.held_recording()
    snapshot = take_snapshot(recording)
    for name in ("field", "soft", "holding"):
        np.testing.assert_array_equal(getattr(snapshot, name), getattr(recording, name))
    assert take_snapshot(made.recording()).field is None


def test_fifteen_seconds_is_the_moment() -> None:
    assert take_snapshot(made.recording(400, 0.1)).time_s == pytest.approx(15)


def test_plans_after_the_end_are_not_the_episodes_own() -> None:
    whole = made.recording(100)
    ended = made.recording(7, plans=whole.plans)
    assert [plan.step for plan in ended.own_plans] == [0, 5]
    at_once = made.recording(0, plans=whole.plans)
    assert [plan.step for plan in at_once.own_plans] == [0]


def test_an_episode_that_ended_before_it_was_planned_has_a_snapshot_all_the_same() -> None:
    snapshot = take_snapshot(made.recording(0, plans=()))
    assert (snapshot.now, snapshot.time_s) == (0, 0)
    assert not any(snapshot.plan.lines.values())


def test_its_title_says_what_is_seen() -> None:
    assert made.recording().title == "mppi, cvar, paper-v1, std, 4, success"
