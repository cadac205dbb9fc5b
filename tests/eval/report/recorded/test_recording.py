from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from benchnav.core.errors import ConfigError
from benchnav.eval.report.recorded.drawn_plan import DrawnPlan, thinned
from benchnav.eval.report.recorded.recording import Recording, read_snapshots, take_snapshot
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
    for name in ("field", "soft", "immobilising"):
        np.testing.assert_array_equal(getattr(snapshot, name), getattr(recording, name))
    assert take_snapshot(made.recording()).field is None


def test_fifteen_seconds_is_the_moment_and_half_way_of_a_short_episode() -> None:
    assert take_snapshot(made.recording(400, 0.1)).time_s == pytest.approx(15)
    assert take_snapshot(made.recording(200, 0.1)).time_s == pytest.approx(10)


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


def crowded(steps: int) -> Recording:
    """An episode of a planner with more points than are kept."""
    generator = np.random.default_rng(5)
    plans = [
        DrawnPlan(step=step, lines={"path": [generator.random((9, 2), np.float32)],
                                    "samples": list(generator.random((40, 30, 2), np.float32))})
        for step in range(0, steps, 5)
    ]  # fmt: skip
    return made.held_recording(steps, plans=plans, free_by="mean", free_above=0.1, time_budget_s=77.5)


@pytest.mark.parametrize(
    "recording", [made.recording(60), made.recording(0), made.recording(0, plans=()), crowded(200)]
)
def test_a_recording_comes_back_as_it_was(recording: Recording, tmp_path: Path) -> None:
    recording.save(tmp_path / "there" / "a.npz")
    again = Recording.load(tmp_path / "there" / "a.npz")
    for item in fields(Recording):
        before, after = getattr(recording, item.name), getattr(again, item.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(after, before)
        elif item.name != "plans":
            assert after == before
    # The plan of figures is whole; the others are thinned, as the viewer is given them.
    moment = recording.plan_at(recording.moment_s).step
    for before, after in zip(recording.own_plans, again.plans, strict=True):
        expected = before if before.step == moment else thinned(before)
        assert (after.step, set(after.lines)) == (before.step, set(before.lines))
        for name, lines in expected.lines.items():
            assert len(after.lines[name]) == len(lines)
            for one, other in zip(lines, after.lines[name], strict=True):
                np.testing.assert_array_equal(one, other)
    assert [path.name for path in (tmp_path / "there").iterdir()] == ["a.npz"]


def test_thinning_keeps_ends_and_what_was_thinned() -> None:
    plan = crowded(10).plans[0]
    once = thinned(plan)
    for before, after in zip(plan.lines["samples"], once.lines["samples"], strict=True):
        np.testing.assert_array_equal(after[[0, -1]], before[[0, -1]])
        assert len(after) == 4
    np.testing.assert_array_equal(once.lines["path"][0], plan.lines["path"][0])
    for before, after in zip(once.lines["samples"], thinned(once).lines["samples"], strict=True):
        np.testing.assert_array_equal(after, before)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "playback" / "a.npz"
    made.recording(20).save(path)
    whole = path.read_bytes()
    for damage in (b"", b"no zip", whole[: len(whole) // 2], whole[:500] + bytes(400) + whole[900:]):
        path.write_bytes(damage)
        for read in (lambda: Recording.load(path), lambda: read_snapshots(tmp_path)):
            with pytest.raises(ConfigError, match=r"a\.npz is damaged"):
                read()
