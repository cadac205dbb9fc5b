"""How the Rerun viewer arranges a recording."""

from collections.abc import Sequence
from typing import Any

from benchnav.eval.report.playback.robot import TIMELINE, Driver
from benchnav.eval.report.playback.words import free_rule

_ALL, _PLACES = "/map/overlay/**", "/map/places/**"


def arrange(drivers: Sequence[Driver]) -> Any:
    """Arranges the views: the terrain and time series to the left, maps to the right."""
    import rerun.blueprint as rrb

    series = [
        rrb.TimeSeriesView(
            name="Observed λ", origin="/series/traversability", axis_y=rrb.ScalarAxis(range=(0, 1))
        ),
        rrb.TimeSeriesView(name="Distance to the goal [m]", origin="/series/goal"),
    ]
    if len(drivers) == 1:
        series.insert(1, rrb.TimeSeriesView(name="Commanded", origin="/series/command"))
    flat = [
        rrb.Spatial2DView(name=name, origin="/map", contents=contents)
        for name, contents in map_views(drivers).items()
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(name=_name(drivers), origin="/world"),
                rrb.Horizontal(*series, rrb.TextDocumentView(name="About", origin="/about")),
                row_shares=[3, 1],
            ),
            rrb.Grid(*flat, grid_columns=2),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def map_views(drivers: Sequence[Driver]) -> dict[str, list[str]]:
    """What each view of a map shows, by its name."""
    recording = drivers[0].recording
    edges = [driver.entity("/map/closed") for driver in drivers]
    own = edges if len(drivers) == 1 else []
    colour = "Colour, soft ground hatched" if recording.soft.any() else "Colour"
    views = {
        colour: ["/map/colour", "/map/soft/**", _ALL, _PLACES],
        "Mean λ in truth": ["/map/true_mean", *own, _ALL, _PLACES],
    }
    if recording.field is not None:
        views["λ as it was, dark red: immobilises a robot"] = ["/map/field", *own, _ALL, _PLACES]
    for driver in drivers:
        name = f"λ̂ given to {driver.name or 'the planner'}, free: {free_rule(driver.recording)}"
        shown = driver.entity("/map/overlay", "**")
        views[name] = [driver.entity("/map/risk"), shown, _PLACES]
    return views


def _name(drivers: Sequence[Driver]) -> str:
    return drivers[0].recording.title if len(drivers) == 1 else "All conditions"
