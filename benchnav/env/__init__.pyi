from benchnav.env.egocentric import EgocentricEnv, EgocentricVectorEnv
from benchnav.env.environment import OffRoadEnv, OffRoadVectorEnv
from benchnav.env.policy import PolicyPlanner

__all__ = [
    "EgocentricEnv",
    "EgocentricVectorEnv",
    "OffRoadEnv",
    "OffRoadVectorEnv",
    "PolicyPlanner",
]
