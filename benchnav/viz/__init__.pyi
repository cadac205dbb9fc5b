from benchnav.viz.drives import Drive, draw_drive, draw_path, mark
from benchnav.viz.figure import Figure
from benchnav.viz.maps import show_map
from benchnav.viz.panels import (
    Curves,
    draw_estimates,
    draw_interval,
    line_looks,
    panel_grid,
)
from benchnav.viz.style import (
    condition_colours,
    legend_outside,
    planner_colours,
    planner_name,
    risk_name,
    save_twice,
    stack_panels,
    styled,
)

__all__ = [
    "Curves",
    "Drive",
    "Figure",
    "condition_colours",
    "draw_drive",
    "draw_estimates",
    "draw_interval",
    "draw_path",
    "legend_outside",
    "line_looks",
    "mark",
    "panel_grid",
    "planner_colours",
    "planner_name",
    "risk_name",
    "save_twice",
    "show_map",
    "stack_panels",
    "styled",
]
