"""Videos, decoded again."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.figures import bytes_of
from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.video import (
    FRAMES_A_SECOND,
    HOLD_S,
    ROBOT,
    SPEED,
    Frames,
    frame_times,
    write_video,
)
from tests.eval.report import made


def grey(steps: int, **changes: object) -> Recording:
    """An episode on ground of no colour, so that what is drawn stands out."""
    recording = made.recording(steps, plans=(), **changes)
    return replace(recording, rgb=np.full_like(recording.rgb, 128))


def test_a_moment_lasts_a_frame_and_the_end_a_while() -> None:
    times = frame_times(12.0)
    held = round(HOLD_S * FRAMES_A_SECOND)
    assert len(times) == 12 / SPEED * FRAMES_A_SECOND + held
    np.testing.assert_allclose(times[:3], [0, SPEED / FRAMES_A_SECOND, 2 * SPEED / FRAMES_A_SECOND])
    assert (times[-held:] == 12.0).all()
    assert times[-held - 1] < 12.0
    assert set(frame_times(0.0)) == {0.0}


def robot_at(frame: np.ndarray, panel: tuple[int, int]) -> np.ndarray:
    """Where the robot's mark is in the upper panel of a frame: column and row of its middle."""
    left, right = panel
    own = np.abs(frame[:, left:right].astype(int) - bytes_of(ROBOT)[:3]).sum(axis=-1) < 60
    rows, columns = np.nonzero(own[: frame.shape[0] // 2])
    return np.array([columns.mean() + left, rows.mean()])


def test_a_video_has_its_frames_size_and_duration_and_the_robot_where_the_path_says(tmp_path: Path) -> None:
    first, second = grey(40), grey(24, labels=made.condition(risk="mean"))
    second = replace(second, states=second.states * np.array([1, 0.5, 1, 1, 1], np.float32))
    path = tmp_path / "there" / "a.mp4"
    steps = list(write_video([first, second], path))
    times = frame_times(4.0)
    assert steps[-1] == (len(times), len(times))
    assert [p.name for p in path.parent.iterdir()] == ["a.mp4"]
    frames = Frames([first, second])
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == frames.size
        assert stream.average_rate == FRAMES_A_SECOND
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert container.duration / 1e6 == pytest.approx(len(times) / FRAMES_A_SECOND, abs=0.06)
    assert len(decoded) == len(times)
    half = frames.size[0] // 2
    for number in (0, 5, 12, len(times) - 1):
        for place, recording in enumerate((first, second)):
            step = min(round(times[number] / recording.dt_s), len(recording.traversability))
            panel = frames._columns[place].panels[0]
            x, y = panel.transData.transform(recording.states[step, :2])
            expected = (x, frames.size[1] - y)
            found = robot_at(decoded[number], ((0, half), (half, 2 * half))[place])
            np.testing.assert_allclose(found, expected, atol=5)


def test_the_robot_points_where_it_heads() -> None:
    turned = grey(3)
    states = turned.states.copy()
    states[:, 2] = np.pi / 2
    middle = {}
    for name, recording in (("east", replace(turned, states=states * (1, 1, 0, 1, 1))),
                            ("north", replace(turned, states=states))):  # fmt: skip
        frames = Frames([recording])
        shown = robot_at(frames.draw(0.1), (0, frames.size[0]))
        own = np.abs(frames.draw(0.1).astype(int) - bytes_of(ROBOT)[:3]).sum(axis=-1) < 60
        rows, columns = np.nonzero(own[: frames.size[1] // 2])
        middle[name] = (np.ptp(columns), np.ptp(rows))
        assert np.isfinite(shown).all()
    assert middle["east"][0] > middle["east"][1]
    assert middle["north"][1] > middle["north"][0]


def test_what_moves_is_told_in_words() -> None:
    recording = made.held_recording(80)
    frames = Frames([recording])
    column = frames._columns[0]
    frames.draw(2.0)
    assert column._time.get_text() == f"t =   2.0 s   observed λ = {recording.traversability[20]:.2f}"
    assert column._outcome.get_text() == ""
    assert len(column._driven.get_segments()) == 20
    np.testing.assert_array_equal(column._driven.get_array(), recording.traversability[:20])
    plan = recording.plan_at(2.0).lines["path"][0]
    np.testing.assert_array_equal(column._layers["path"].get_segments()[0], plan)
    frames.draw(99.0)
    assert column._outcome.get_text() == "immobilised"
    np.testing.assert_array_equal(np.ravel(column._crosses[0].get_data()), recording.states[-1, :2])
    assert not column._layers["path"].get_segments()


def test_below_is_λ_as_it_was_or_else_what_was_given() -> None:
    frozen, resampled = made.held_recording(20), made.recording(20, plans=())
    for recording, words in ((frozen, "λ as it was"), (resampled, "λ̂ given to the planner")):
        panel = Frames([recording])._columns[0].panels[1]
        assert words in [text.get_text() for text in panel.texts]
        shown = np.asarray(panel.images[0].get_array())
        if recording.field is None:
            assert ((shown == 64).all(axis=-1) == ~recording.free).all()


def test_an_episode_that_ended_at_once_is_shown(tmp_path: Path) -> None:
    list(write_video([made.recording(0, plans=())], tmp_path / "a.mp4"))
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == HOLD_S * FRAMES_A_SECOND


def test_more_than_can_be_seen_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at most 6 conditions"):
        list(write_video([made.recording(3)] * 7, tmp_path / "a.mp4"))
    assert not list(tmp_path.iterdir())
