"""The Gymnasium environments."""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.env.environment": ("OffRoadEnv", "OffRoadVectorEnv"),
    },
)
