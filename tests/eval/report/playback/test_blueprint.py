from dataclasses import replace

import numpy as np

from benchnav.eval.report.playback.blueprint import arrange, map_views
from benchnav.eval.report.playback.rerun_file import drivers_of
from tests.eval.report import made

OVERLAY = ["/map/overlay/**", "/map/places/**"]


def test_each_map_shows_its_own_layer_under_what_is_driven_and_planned() -> None:
    resampled, frozen = (map_views(drivers_of([r])) for r in (made.recording(10), made.held_recording()))
    assert list(resampled.values()) == [
        ["/map/colour", "/map/soft/**", *OVERLAY],
        ["/map/true_mean", "/map/closed", *OVERLAY],
        ["/map/risk", *OVERLAY],
    ]
    assert list(frozen.values())[2] == ["/map/field", "/map/closed", *OVERLAY]
    assert list(frozen.values())[3] == list(resampled.values())[2]
    assert list(resampled)[-1] == "λ̂ given to the planner, free: λ̂ above 0.3"


def test_each_planner_is_seen_on_what_it_was_given() -> None:
    recordings = [
        made.recording(10, labels=made.condition(risk=risk), free_by="mean", free_above=above)
        for risk, above in (("cvar:0.9", 0.1), ("mean", 0.2))
    ]
    views = map_views(drivers_of(recordings))
    assert views["λ̂ given to mean, free: mean λ above 0.2"] == [
        "/map/risk/conditions/mean", "/map/overlay/conditions/mean/**", "/map/places/**"
    ]  # fmt: skip
    assert views["λ̂ given to cvar:0.9, free: mean λ above 0.1"][0] == "/map/risk/conditions/cvar\\:0.9"
    assert views["Colour"] == ["/map/colour", "/map/soft/**", *OVERLAY]


def test_hatching_is_named_where_there_is_some() -> None:
    hard = made.recording(10)
    soft = replace(hard, soft=np.ones_like(hard.soft))
    assert [next(iter(map_views(drivers_of([one])))) for one in (hard, soft)] == [
        "Colour", "Colour, soft ground hatched"
    ]  # fmt: skip


def test_the_blueprint_has_all_of_them() -> None:
    drivers = drivers_of(
        [made.held_recording(), replace(made.held_recording(), about=made.recording().about)]
    )
    found, queue = [], [arrange(drivers).root_container]
    while queue:
        part = queue.pop(0)
        queue += [inner for inner in getattr(part, "contents", []) if not isinstance(inner, str)]
        if type(part).__name__ == "Spatial2DView":
            found.append(part.name)
    assert found == list(map_views(drivers))
