from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.eval.recorded_plans import (
    DrawnPlan,
    KnownMap,
    drawn_plan,
    footprint_outline,
    thinned,
)
from benchnav.eval.recording import Recording, drawing_interval, read_recordings
from benchnav.planning.planners.planner import Plan
from benchnav.viz.plans import STYLES
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
def test_a_moment_has_the_last_plan_by_its_time(
    steps: int, dt_s: float, time_s: float, step: int
) -> None:
    recording = made.recording(steps, dt_s)
    assert recording.plan_at(time_s).step == step
    np.testing.assert_array_equal(recording.track, recording.states[:, :2])
    assert recording.grid.extent_m == (30, 20)


def test_fifteen_seconds_is_the_moment_and_half_way_of_a_short_episode() -> None:
    assert (made.recording(400, 0.1).plan.step, made.recording(400, 0.1).now) == (
        150,
        150,
    )
    assert made.recording(200, 0.1).now == 100


def test_plans_after_the_end_are_not_the_episodes_own() -> None:
    whole = made.recording(100)
    ended = made.recording(7, plans=whole.plans)
    assert [plan.step for plan in ended.own_plans] == [0, 5]
    at_once = made.recording(0, plans=whole.plans)
    assert [plan.step for plan in at_once.own_plans] == [0]


def test_an_episode_that_ended_before_it_was_planned_has_a_moment_all_the_same() -> (
    None
):
    recording = made.recording(0, plans=())
    assert recording.now == 0
    assert not any(recording.plan.lines.values())


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
    return made.held_recording(
        steps, plans=plans, free_by="mean", free_above=0.1, time_budget_s=77.5
    )


@pytest.mark.parametrize(
    "recording",
    [made.recording(60), made.recording(0), made.recording(0, plans=()), crowded(200)],
)
def test_a_recording_comes_back_as_it_was(recording: Recording, tmp_path: Path) -> None:
    recording.save(tmp_path / "there" / "a.npz")
    again = Recording.load(tmp_path / "there" / "a.npz")
    for item in fields(Recording):
        before, after = getattr(recording, item.name), getattr(again, item.name)
        if isinstance(before, np.ndarray):
            assert before.dtype == after.dtype
            np.testing.assert_array_equal(after, before)
        elif item.name not in ("plans", "known"):
            assert after == before
    # The plan of figures is whole; the others are thinned, as the viewer is given them.
    moment = recording.plan.step
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
    for before, after in zip(
        once.lines["samples"], thinned(once).lines["samples"], strict=True
    ):
        np.testing.assert_array_equal(after, before)


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "playback" / "a.npz"
    made.recording(20).save(path)
    whole = path.read_bytes()
    for damage in (
        b"",
        b"no zip",
        whole[: len(whole) // 2],
        whole[:500] + bytes(400) + whole[900:],
    ):
        path.write_bytes(damage)
        for read in (lambda: Recording.load(path), lambda: read_recordings(tmp_path)):
            with pytest.raises(ConfigError, match=r"a\.npz is damaged"):
                read()


def test_points_that_are_not_used_and_lines_without_two_are_left_out() -> None:
    nan = torch.nan
    samples = torch.tensor(
        [
            [[0.0, 1.0], [2.0, 3.0], [nan, nan]],
            [[4.0, 5.0], [nan, nan], [nan, nan]],
            [[nan, nan]] * 3,
        ]
    )
    plan = drawn_plan(7, {"samples": samples, "tree": torch.empty(0, 0, 2)})
    assert plan.step == 7
    assert plan.lines["tree"] == []
    (line,) = plan.lines["samples"]
    np.testing.assert_array_equal(line, [[0, 1], [2, 3]])


def test_every_layer_of_a_plan_has_a_style_and_the_members_own_lines() -> None:
    path = torch.arange(24.0).reshape(3, 4, 2)
    lines = drawn_plan(0, Plan.empty(3, path=path).lines(1)).lines
    assert set(lines) == set(STYLES)
    np.testing.assert_array_equal(lines["path"][0], path[1])
    assert [name for name, layer in lines.items() if layer] == ["path"]


@pytest.mark.parametrize(("dt_s", "steps"), [(0.1, 5), (0.05, 10), (0.3, 2), (2.0, 1)])
def test_plans_are_drawn_twice_a_second(dt_s: float, steps: int) -> None:
    assert drawing_interval(dt_s) == steps


@pytest.mark.parametrize("outcome", ["immobilised", "stuck", "success"])
def test_an_immobilised_robot_is_where_its_episode_ended(outcome: str) -> None:
    recording = made.recording(9)
    recording = replace(recording, about={**recording.about, "outcome": outcome})
    if outcome == "immobilised":
        np.testing.assert_array_equal(
            recording.immobilised_at, recording.states[-1, :2]
        )
    else:
        assert recording.immobilised_at is None


@pytest.mark.parametrize(
    ("place", "cell"),
    [
        ((29.9, 0.1), (0, 59)),
        ((0.2, 19.9), (39, 0)),
        ((30.1, 1.0), None),
        ((1.0, -0.1), None),
    ],
)
def test_what_was_predicted_at_the_end_is_that_of_the_cell_it_lies_in(
    place: tuple[float, float], cell: tuple[int, int] | None
) -> None:
    recording = made.recording(3)
    states = recording.states.copy()
    states[-1, :2] = place
    found = replace(recording, states=states).predicted_at_end
    assert np.isnan(found) if cell is None else found == recording.predicted[cell]


def test_layers_are_kept_in_the_file(tmp_path: Path) -> None:
    layers = {
        "vegetation_m": np.full((40, 60), 0.5, np.float32),
        "rock share": np.full((40, 60), np.nan, np.float32),
    }
    made.recording(10, layers=layers).save(tmp_path / "a.npz")
    found = Recording.load(tmp_path / "a.npz").layers
    assert list(found) == list(layers)
    for name in layers:
        np.testing.assert_array_equal(found[name], layers[name])
    made.recording(10).save(tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as stored:
        assert not any("layers" in name for name in stored)  # as before there were any
    assert Recording.load(tmp_path / "b.npz").layers == {}


def test_what_was_known_comes_back_within_a_level(tmp_path: Path) -> None:
    recording = made.learning_recording(60)
    first, *others = recording.known
    # Masks and numbers that go both ways, and maps without an outline.
    flipped = replace(
        first, step=61, seen=~first.seen, mean=1 - first.mean, outline=np.empty((0, 2))
    )
    recording = replace(
        recording, known=(first, *others, flipped, replace(first, step=62))
    )
    recording.save(tmp_path / "a.npz")
    again = Recording.load(tmp_path / "a.npz")
    assert len(again.known) == len(recording.known) == 15
    for before, after in zip(recording.known, again.known, strict=True):
        assert after.step == before.step
        for name in ("free", "seen", "sensed"):
            assert getattr(after, name).dtype == bool
            np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
        for name in ("predicted", "mean", "spread"):
            np.testing.assert_allclose(
                getattr(after, name), getattr(before, name), atol=0.5 / 255 + 1e-6
            )
        np.testing.assert_array_equal(after.outline, before.outline)
    # Stored again it stays as it is.
    again.save(tmp_path / "b.npz")
    for one, other in zip(
        again.known, Recording.load(tmp_path / "b.npz").known, strict=True
    ):
        for item in fields(KnownMap):
            np.testing.assert_array_equal(
                getattr(one, item.name), getattr(other, item.name)
            )


def test_forty_seconds_of_learning_are_small(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    recording = made.recording(
        400, predicted=generator.random((64, 64)), free=np.ones((64, 64), bool)
    )
    recording.save(tmp_path / "without.npz")
    numbers = {
        name: generator.random((64, 64)).astype(np.float16)
        for name in ("predicted", "mean", "spread")
    }
    masks = {name: np.zeros((64, 64), bool) for name in ("free", "seen", "sensed")}
    known = []
    for place in range(80):
        # Each update changes cells within 4 m, in all that is kept.
        row, column = (
            range(max(0, middle - 8), middle + 8)
            for middle in (place * 48 // 80 + 8, 30)
        )
        cells = np.ix_(list(row), list(column))
        for values in (numbers, masks):
            for name, value in values.items():
                values[name] = value.copy()
                values[name][cells] = generator.random((len(row), len(column))) > (
                    0.5 if values is masks else -1
                )
        for value in numbers.values():
            value[cells] = generator.random((len(row), len(column)))
        known.append(
            KnownMap(
                step=5 * place,
                **numbers,
                **masks,
                outline=footprint_outline(masks["seen"], 0.5),
            )
        )
    replace(recording, known=tuple(known)).save(tmp_path / "with.npz")
    sizes = [(tmp_path / f"{name}.npz").stat().st_size for name in ("with", "without")]
    assert sizes[0] - sizes[1] < 400_000


def test_what_is_known_holds_until_more_is() -> None:
    recording = made.learning_recording(40)
    for step in (0, 4, 5, 39, 40, 99):
        known = recording.known_at(step)
        assert known is recording.known[min(step, 40) // 5]
        assert known is not None
        predicted, free = recording.given_at(step)
        assert predicted is known.predicted
        assert free is known.free
    later = replace(recording, known=recording.known[1:])
    for unlearnt in (later.known_at(4), made.recording(40).known_at(4)):
        assert unlearnt is None
    assert later.given_at(4) == (later.predicted, later.free)


def test_an_outline_goes_around_what_was_reached_line_by_line() -> None:
    cells = np.zeros((6, 5), bool)
    cells[2, 3] = True
    (known, *_) = made.learning_recording(5).known
    lines = replace(known, outline=footprint_outline(cells, 0.5)).outlines
    assert sorted(line.tolist() for line in lines) == [
        [[1.5, 1.0], [1.5, 1.5]], [[1.5, 1.0], [2.0, 1.0]], [[1.5, 1.5], [2.0, 1.5]], [[2.0, 1.0], [2.0, 1.5]],
    ]  # fmt: skip
    whole = np.array([[0.0, 1], [1, 1], [2, 0]])
    (line,) = replace(known, outline=whole).outlines
    np.testing.assert_array_equal(line, whole)
    assert not replace(known, outline=np.empty((0, 2))).outlines


def test_a_body_is_stored_and_recordings_without_one_stay_readable(
    tmp_path: Path,
) -> None:
    recording = made.body_recording(23)
    path = tmp_path / "a.npz"
    recording.save(path)
    loaded = Recording.load(path)
    assert loaded.body.keys() == recording.body.keys()
    for name, values in recording.body.items():
        assert loaded.body[name].dtype == np.float32
        np.testing.assert_array_equal(loaded.body[name], values)
    assert loaded.layers == {}
    # A file of an earlier version has no such names.
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored if not name.startswith("body:")}
    assert len(arrays) == len(np.load(path)) - len(recording.body)
    np.savez_compressed(path, **arrays)
    older = Recording.load(path)
    assert older.body == {}
    assert older.contacts_m is None
    np.testing.assert_array_equal(older.states, recording.states)
