from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.objective import GoalDistance, Objective, TravelTime, distance
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.planners.astar.astar_mppi import AStarMPPI
from benchnav.planning.planners.cl_rrt.cl_rrt import CLRRT
from benchnav.planning.planners.mppi import MPPI, MPPIConfig
from benchnav.planning.planners.planner import LocalPlanner, Plan, Planner, PlanStatus
from benchnav.planning.planners.straight import Straight
from benchnav.planning.problem import Problem, Task, pose_problem
from benchnav.planning.robots import SPEED, STEERING, TURN_RATE, Bicycle, DifferentialDrive, Robot, Unicycle
from benchnav.planning.sensing.sensor import Step
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import Places, World

__all__ = [
    "CLRRT",
    "MPPI",
    "SPEED",
    "STEERING",
    "TURN_RATE",
    "AStarDWA",
    "AStarMPPI",
    "Bicycle",
    "DifferentialDrive",
    "FreeSpace",
    "GoalDistance",
    "LocalPlanner",
    "MPPIConfig",
    "Objective",
    "Places",
    "Plan",
    "PlanStatus",
    "Planner",
    "Problem",
    "Robot",
    "Rules",
    "Simulation",
    "Step",
    "Straight",
    "Task",
    "TravelTime",
    "Unicycle",
    "World",
    "distance",
    "pose_problem",
]
