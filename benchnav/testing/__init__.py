"""Checks for the tests of whoever writes a planner, model, robot, objective or risk measure."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.testing.model": ("check_model",),
        "benchnav.testing.objective": ("check_objective",),
        "benchnav.testing.planner": ("check_planner",),
        "benchnav.testing.risk": ("check_risk",),
        "benchnav.testing.robot": ("check_robot",),
    },
)
