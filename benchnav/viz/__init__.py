"""Drawing: the base class of figures; shared sizes, colours, names, maps and panels."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.viz.figure": ("Figure",),
        "benchnav.viz.drives": ("Drive", "draw_drive", "draw_path", "mark"),
        "benchnav.viz.maps": ("show_map",),
        "benchnav.viz.panels": (
            "Curves",
            "draw_estimates",
            "draw_interval",
            "line_looks",
            "panel_grid",
        ),
        "benchnav.viz.style": (
            "condition_colours",
            "legend_outside",
            "planner_colours",
            "planner_name",
            "risk_name",
            "save_twice",
            "stack_panels",
            "styled",
        ),
    },
)
