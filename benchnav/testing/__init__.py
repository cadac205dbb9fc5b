"""Checks that custom parts, such as planners and models, fulfil their contracts."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.testing.belief": ("check_belief",),
        "benchnav.testing.functions": ("check_objective", "check_risk", "check_robot"),
        "benchnav.testing.metric": ("check_metric",),
        "benchnav.testing.model": ("check_model",),
        "benchnav.testing.planner": ("check_planner",),
        "benchnav.testing.sensor": ("check_sensor",),
    },
)
