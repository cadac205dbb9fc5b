from benchnav.env.environment import OffRoadEnv as OffRoadEnv
from benchnav.env.environment import OffRoadVectorEnv as OffRoadVectorEnv
