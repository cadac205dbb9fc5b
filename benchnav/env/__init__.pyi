from benchnav.env.environment import OffRoadEnv, OffRoadVectorEnv

__all__ = ["OffRoadEnv", "OffRoadVectorEnv"]
