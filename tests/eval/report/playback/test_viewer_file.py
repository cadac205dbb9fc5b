from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from benchnav.core.grid import outline
from benchnav.eval.figures.moment import known_colours
from benchnav.eval.recorded_plans import MAX_POINTS, DrawnPlan, thinned
from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.viewer_file import (
    arrange,
    describe,
    drivers_of,
    map_views,
    write_rerun,
)
from benchnav.viz.maps import IMMOBILISING, field_colours, hatching, layer_colours
from benchnav.viz.style import bytes_of
from tests.eval.report import made
from tests.eval.report.playback.rrd import (
    chunks,
    column,
    image,
    read_path,
    static,
    verify,
)

"""What the viewer is given, read back from the file."""


def written(folder: Path, *recordings: Recording) -> Path:
    path = folder / "a.rrd"
    write_rerun(recordings, path)
    return path


def pair() -> list[Recording]:
    """Two conditions on one map: one arrives, one is held after 8 s."""
    other = made.held_recording(
        80, about={**made.held_recording().about, "risk": "mean"}
    )
    first = made.held_recording(
        120, about={**made.held_recording().about, "outcome": "success"}
    )
    return [
        first,
        replace(
            other,
            predicted=1 - first.predicted,
            free=first.predicted < 0.7,
            free_by="mean",
        ),
    ]


def test_a_file_verifies_and_holds_the_driven_path(tmp_path: Path) -> None:
    recording = made.recording(40, dt_s=0.2)
    path = written(tmp_path, recording)
    verify(path)
    times, positions = read_path(path)
    np.testing.assert_allclose(times, 0.2 * np.arange(41), atol=1e-6)
    np.testing.assert_array_equal(positions[:, :2], recording.states[:, :2])


def test_the_robot_shows_its_heading_on_the_ground_and_on_the_maps(
    tmp_path: Path,
) -> None:
    turning = made.recording(30).states.copy()
    turning[:, 2] = np.linspace(0, 3, 31)
    path = written(tmp_path, made.recording(30, states=turning))
    for entity, sign in (
        ("/world/heading", 1),
        ("/map/overlay/heading", -1),
    ):  # images have y downward
        times, vectors = column(path, entity, "vectors")
        np.testing.assert_allclose(times, 0.1 * np.arange(31), atol=1e-6)
        x, y = np.array(vectors)[:, 0, :2].T
        np.testing.assert_allclose(np.arctan2(sign * y, x), turning[:, 2], atol=1e-5)
    _, origins = column(path, "/map/overlay/heading", "origins")
    np.testing.assert_allclose(
        np.array(origins)[:, 0, 0] * 0.5, turning[:, 0], rtol=1e-5
    )
    np.testing.assert_allclose(
        (40 - np.array(origins)[:, 0, 1]) * 0.5, turning[:, 1], rtol=1e-5
    )


def test_commands_are_called_what_the_robot_calls_them(tmp_path: Path) -> None:
    recording = made.recording(12, action_names=("speed_mps", "arm [rad]"))
    path = written(tmp_path, recording)
    for index, entity in enumerate(
        ("/series/command/speed_mps", "/series/command/arm\\ \\[rad\\]")
    ):
        _, values = column(path, entity, "scalars")
        np.testing.assert_allclose(
            np.ravel(values), recording.actions[:, index], rtol=1e-6
        )


def test_λ_met_stands_beside_what_was_predicted_and_the_threshold_of_free_ground(
    tmp_path: Path,
) -> None:
    recording = made.recording(12, free_above=0.17, free_by="mean")
    path = written(tmp_path, recording)
    series = {name: column(path, f"/series/traversability/{name}", "scalars")[1] for name in
              ("observed", "predicted", "threshold")}  # fmt: skip
    np.testing.assert_allclose(
        np.ravel(series["observed"]), recording.traversability, rtol=1e-6
    )
    column_, row = np.floor(recording.states[:-1, :2] / 0.5).astype(int).T
    np.testing.assert_allclose(
        np.ravel(series["predicted"]), recording.predicted[row, column_], rtol=1e-6
    )
    assert np.ravel(series["threshold"]).tolist() == [0.17] * 12
    assert static(path, "/series/traversability/threshold", "names").tolist() == [
        "free: mean above"
    ]


def test_plans_are_shown_when_they_were_made(tmp_path: Path) -> None:
    recording = made.recording(40)
    times, strips = column(
        written(tmp_path, recording), "/world/plan/samples", "strips"
    )
    np.testing.assert_allclose(
        times, [plan.step * 0.1 for plan in recording.plans], atol=1e-6
    )
    for plan, shown in zip(recording.plans, strips, strict=True):
        assert len(shown) == 3  # type: ignore[arg-type]
        np.testing.assert_allclose(
            np.array(shown)[..., :2], np.array(plan.lines["samples"]), rtol=1e-6
        )


def test_a_layer_that_stays_is_not_written_again_and_one_that_goes_is_wiped_out(
    tmp_path: Path,
) -> None:
    line, other = (
        np.array([[1.0, 1], [2, 2]], np.float32),
        np.array([[1.0, 1], [2, 3]], np.float32),
    )
    layers: list[dict[str, list[np.ndarray]]] = [
        {"path": [line]},
        {"path": [line]},
        {"path": [other]},
        {},
    ]
    plans = [
        DrawnPlan(step=5 * place, lines=lines) for place, lines in enumerate(layers)
    ]
    times, strips = column(
        written(tmp_path, made.recording(40, plans=plans)),
        "/map/overlay/plan/path",
        "strips",
    )
    np.testing.assert_allclose(times, [0, 1.0, 1.5], atol=1e-6)
    assert [len(shown) for shown in strips] == [1, 1, 0]  # type: ignore[arg-type]


def test_maps_are_those_of_the_recording(tmp_path: Path) -> None:
    recording = made.held_recording()
    path = written(tmp_path, recording)
    assert recording.field is not None
    shown = image(path, "/map/field")
    np.testing.assert_array_equal(
        shown, field_colours(recording.field, recording.immobilising)
    )
    np.testing.assert_array_equal(
        (shown == bytes_of(IMMOBILISING)[:3]).all(axis=-1), recording.immobilising
    )
    viridis = matplotlib.colormaps["viridis"]
    expected = np.round(255 * viridis(recording.true_mean)[..., :3])
    np.testing.assert_array_equal(image(path, "/map/true_mean"), expected)
    predicted = np.round(255 * viridis(recording.predicted)[..., :3])
    shown = image(path, "/map/risk")
    np.testing.assert_array_equal(shown[recording.free], predicted[recording.free])
    assert (shown[~recording.free] == 64).all()
    np.testing.assert_array_equal(
        image(path, "/map/colour"), np.moveaxis(recording.rgb, 0, -1)
    )
    again = written(tmp_path, made.recording(10))
    assert not [e for e in chunks(again) if e.startswith(("/map/field", "/map/soft"))]


@pytest.mark.parametrize(
    ("entity", "region"),
    [
        ("/map/soft/outline", "soft"),
        ("/map/soft/hatching", "soft"),
        ("/map/closed", "free"),
    ],
)
def test_regions_are_marked_where_they_are(
    entity: str, region: str, tmp_path: Path
) -> None:
    recording = made.held_recording(field=None)
    lines = hatching if entity.endswith("hatching") else outline
    expected = lines(recording.soft if region == "soft" else ~recording.free, 0.5)
    shown = static(written(tmp_path, recording), entity, "strips")
    np.testing.assert_allclose(shown[..., 0] * 0.5, expected[..., 0], atol=1e-5)
    np.testing.assert_allclose((40 - shown[..., 1]) * 0.5, expected[..., 1], atol=1e-5)


@pytest.mark.parametrize("outcome", ["success", "out_of_bounds", "immobilised"])
def test_the_outcome_is_told_where_and_when_the_episode_ended(
    outcome: str, tmp_path: Path
) -> None:
    recording = made.held_recording(
        43, about={**made.recording().about, "outcome": outcome}
    )
    path = written(tmp_path, recording)
    for entity, place in (
        ("/world/outcome", recording.states[-1, :2]),
        ("/map/overlay/outcome", None),
    ):
        times, labels = column(path, entity, "labels")
        np.testing.assert_allclose(times, [4.3], atol=1e-6)
        assert labels == [[outcome.replace("_", " ")]]
        ((position,),) = column(path, entity, "positions")[1]  # type: ignore[misc]
        expected = (
            place
            if place is not None
            else (recording.states[-1, :2] / 0.5) * (1, -1) + (0, 40)
        )
        np.testing.assert_allclose(position[:2], expected, atol=1e-4)
    assert any("immobilised" in entity for entity in chunks(path)) == (
        outcome == "immobilised"
    )


def test_an_immobilised_robot_is_crossed_out_from_that_moment_on(
    tmp_path: Path,
) -> None:
    recording = made.held_recording(43)
    path = written(tmp_path, recording)
    x, y = recording.states[-1, :2]
    flat = (x / 0.5, 40 - y / 0.5)
    for entity, place, size in (
        ("/world/immobilised", (x, y), 2),
        ("/map/overlay/immobilised", flat, 4),
    ):
        times, ((cross,),) = column(path, entity, "strips")  # type: ignore[misc]
        np.testing.assert_allclose(times, [4.3], atol=1e-6)
        np.testing.assert_allclose(
            np.mean(np.array(cross)[:, :2], axis=0), place, atol=1e-4
        )
        np.testing.assert_allclose(
            np.ptp(np.array(cross)[:, :2], axis=0), size, atol=1e-4
        )


def test_the_driven_path_grows_to_the_end_and_stays(tmp_path: Path) -> None:
    recording = made.recording(237)
    path = written(tmp_path, recording)
    pieces = sorted(entity for entity in chunks(path) if "/overlay/driven/" in entity)
    assert len(pieces) > 1
    for time_s in (0.4, 0.5, 9.99, 10.0, 10.5, 23.7):
        shown: list[object] = []
        for entity in pieces:
            times, strips = column(path, entity, "strips")
            known = [
                strip
                for when, strip in zip(times, strips, strict=True)
                if when < time_s + 1e-6
            ]
            shown += known[-1] if known else []  # type: ignore[arg-type]
        # A plan is drawn twice a second, and with it what was driven by then.
        steps = 237 if time_s == 23.7 else 5 * int(time_s / 0.5 + 1e-6)
        assert len(shown) == steps
        if steps:
            ends = np.array(shown)[:, 1]
            np.testing.assert_allclose(
                ends[:, 0] * 0.5, recording.states[1 : steps + 1, 0], rtol=1e-5
            )


def test_a_long_recording_of_a_crowded_planner_is_small(tmp_path: Path) -> None:
    generator = np.random.default_rng(1)
    plans = [
        DrawnPlan(
            step=step,
            lines={
                "tree": list(generator.random((300, 12, 2), np.float32)),
                "reference": list(generator.random((1, 120, 2), np.float32)),
                "path": list(generator.random((1, 80, 2), np.float32)),
            },
        )
        for step in range(0, 1000, 5)
    ]
    recording = made.held_recording(1000, plans=plans)
    path = written(tmp_path, recording)
    recording.save(tmp_path / "a.npz")
    assert path.stat().st_size + (tmp_path / "a.npz").stat().st_size < 3e6
    _, strips = column(path, "/map/overlay/plan/tree", "strips")
    kept = thinned(plans[0]).lines["tree"]
    assert sum(map(len, kept)) <= MAX_POINTS
    for line, shown in zip(kept, strips[0], strict=True):  # type: ignore[call-overload]
        np.testing.assert_allclose(np.array(shown)[:, 0] * 0.5, line[:, 0], rtol=1e-5)
    for line in (plans[0].lines["tree"][0], plans[0].lines["tree"][-1]):
        assert any(np.array_equal(line[[0, -1]], other[[0, -1]]) for other in kept)


def test_an_episode_that_ended_at_once_can_be_played(tmp_path: Path) -> None:
    path = written(tmp_path, made.recording(0))
    verify(path)
    _, positions = read_path(path)
    assert len(positions) == 1


def test_several_conditions_have_paths_colours_and_maps_of_their_own(
    tmp_path: Path,
) -> None:
    recordings = pair()
    path = written(tmp_path, *recordings)
    verify(path)
    colours = []
    for recording, name in zip(recordings, ("CVaR", "mean"), strict=True):
        times, positions = read_path(path, f"/world/conditions/{name}/robot")
        np.testing.assert_array_equal(positions[:, :2], recording.states[:, :2])
        assert times[-1] == pytest.approx(recording.end_s)
        own = {
            entity: int(np.ravel(static(path, entity, "colors"))[0])
            for entity in (f"/world/conditions/{name}/robot", f"/map/overlay/conditions/{name}/robot",
                           f"/series/traversability/conditions/{name}/observed")
        }  # fmt: skip
        assert len(set(own.values())) == 1
        colours += [*set(own.values())]
        assert static(
            path, f"/series/traversability/conditions/{name}/observed", "names"
        ).tolist() == [name]
        assert column(path, f"/world/conditions/{name}/outcome", "labels")[1] == [
            [f"{name}: {recording.outcome}"]
        ]
        shown = image(path, f"/map/risk/conditions/{name}")
        assert ((shown == 64).all(axis=-1) == ~recording.free).all()
    assert colours[0] != colours[1]
    assert not [
        entity
        for entity in chunks(path)
        if entity.startswith(("/world/robot", "/map/overlay/robot"))
    ]


OVERLAY = ["/map/overlay/**", "/map/places/**"]


def test_each_map_shows_its_own_layer_under_what_is_driven_and_planned() -> None:
    resampled, frozen = (
        map_views(drivers_of([r])) for r in (made.recording(10), made.held_recording())
    )
    assert list(resampled.values()) == [
        ["/map/colour", "/map/soft/**", *OVERLAY],
        ["/map/true_mean", "/map/closed", *OVERLAY],
        ["/map/risk", *OVERLAY],
    ]
    assert list(frozen.values())[2] == ["/map/field", "/map/closed", *OVERLAY]
    assert list(frozen.values())[3] == list(resampled.values())[2]
    assert (
        list(resampled)[-1] == "λ̂ given to the planner; cells are free with λ̂ above 0.3"
    )


def test_the_blueprint_has_all_of_them() -> None:
    drivers = drivers_of(
        [
            made.held_recording(),
            replace(made.held_recording(), about=made.recording().about),
        ]
    )
    found, queue = [], [arrange(drivers).root_container]
    while queue:
        part = queue.pop(0)
        queue += [
            inner
            for inner in getattr(part, "contents", [])
            if not isinstance(inner, str)
        ]
        if type(part).__name__ == "Spatial2DView":
            found.append(part.name)
    assert found == list(map_views(drivers))


def test_an_episode_is_told_with_its_outcome_and_the_threshold() -> None:
    recording = made.held_recording(
        43, free_by="mean", free_above=0.1, time_budget_s=90.0
    )
    text = describe(drivers_of([recording]))
    for words in (
        "| outcome | **immobilised** |",
        "| time | 4.3 s of 90 s |",
        "| free cells | mean λ above 0.1 |",
        "| planner | MPPI |",
        "std 4",
    ):
        assert words in text


def test_each_layer_has_a_view_of_its_own_beside_the_colours(tmp_path: Path) -> None:
    canopy = np.linspace(0, 1.25, 2400, dtype=np.float32).reshape(40, 60)
    canopy[3, 4] = np.nan
    layers = {"vegetation_m": canopy, "wind azimuth_azimuth_deg": 360 * canopy}
    recording = made.recording(10, layers=layers)
    path = written(tmp_path, recording)
    verify(path)
    views = map_views(drivers_of([recording]))
    assert list(views)[:4] == [
        "Colour", "vegetation_m, 0 to 1.25", "wind azimuth_azimuth_deg, directions", "True mean of λ",
    ]  # fmt: skip
    entity = views["vegetation_m, 0 to 1.25"][0]
    assert entity == "/map/layers/vegetation_m"
    shown = image(path, entity)
    np.testing.assert_array_equal(shown, layer_colours("vegetation_m", canopy))
    assert shown[3, 4].tolist() == [178, 178, 178]  # the grey of what is not known
    darkness = -shown.astype(float).sum(axis=-1)
    darkness[3, 4] = darkness[3, 3]
    assert (np.diff(darkness.ravel()) >= -6).all()  # the higher the darker
    assert views["wind azimuth_azimuth_deg, directions"][0] in chunks(path)
    assert "/map/layers/vegetation_m" not in chunks(
        written(tmp_path, made.recording(10))
    )


def images(path: Path, entity: str) -> tuple[np.ndarray, list[np.ndarray]]:
    """Images over time, as the map has them, and their times."""
    times, buffers = column(path, entity, "buffer")
    shown = [
        np.array(buffer, np.uint8).reshape(40, 60, 3)[::-1] for (buffer,) in buffers
    ]  # type: ignore[misc]
    return times, shown


def test_what_was_known_is_shown_from_the_time_it_was(tmp_path: Path) -> None:
    recording = made.learning_recording(23)
    path = written(tmp_path, recording)
    verify(path)
    for name in ("risk", "mean", "spread", "seen"):
        times, shown = images(path, f"/map/{name}")
        np.testing.assert_allclose(times, [0, 0.5, 1.0, 1.5, 2.0], atol=1e-6)
        for known, colours in zip(recording.known, shown, strict=True):
            np.testing.assert_array_equal(
                colours, known_colours(recording, known.step)[name]
            )
    times, strips = column(path, "/map/closed", "strips")
    np.testing.assert_allclose(times, [0, 0.5, 1.0, 1.5, 2.0], atol=1e-6)
    for known, lines in zip(recording.known, strips, strict=True):
        wanted = outline(~known.free, 0.5) / 0.5 * (1, -1) + (0, 40)
        np.testing.assert_allclose(np.array(lines), wanted, atol=1e-4)
    for entity, scale in (("/world/reach", 1), ("/map/overlay/reach", 0.5)):
        times, strips = column(path, entity, "strips")
        np.testing.assert_allclose(times, [0, 0.5, 1.0, 1.5, 2.0], atol=1e-6)
        for known, lines in zip(recording.known, strips, strict=True):
            shown_x = np.array(lines)[..., 0] * scale
            np.testing.assert_allclose(
                shown_x, np.array(known.outlines)[..., 0], atol=1e-4
            )
    again = written(tmp_path, replace(recording, known=()))
    names = ("/map/mean", "/map/spread", "/map/seen", "/world/reach")
    assert not [entity for entity in chunks(again) if entity.startswith(names)]


def test_λ_predicted_under_the_robot_is_that_known_by_then(tmp_path: Path) -> None:
    recording = made.learning_recording(23)
    _, values = column(
        written(tmp_path, recording), "/series/traversability/predicted", "scalars"
    )
    for step, value in enumerate(np.ravel(values)):
        x, y = np.floor(recording.states[step, :2] / 0.5).astype(int)
        assert value == pytest.approx(recording.known[step // 5].predicted[y, x])


def test_a_robot_that_learns_has_views_of_what_it_knows() -> None:
    learning = made.learning_recording(20)
    views = map_views(drivers_of([learning]))
    assert list(views.values())[-3:] == [
        ["/map/mean", *OVERLAY], ["/map/spread", *OVERLAY], ["/map/seen", *OVERLAY]
    ]  # fmt: skip
    assert list(views)[:-3] == list(
        map_views(drivers_of([replace(learning, known=())]))
    )
    other = replace(learning, about=learning.about | {"ground": "contact"})
    assert not [
        name
        for name in map_views(drivers_of([learning, other]))
        if name.startswith("Belief")
    ]
