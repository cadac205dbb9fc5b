"""The Gymnasium environments, and policies as planners."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.env.egocentric": ("EgocentricEnv", "EgocentricVectorEnv"),
        "benchnav.env.environment": ("OffRoadEnv", "OffRoadVectorEnv"),
        "benchnav.env.policy": ("PolicyPlanner",),
    },
)
