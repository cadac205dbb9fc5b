from benchnav.planning.footprint import Footprint, minimum_over_footprint
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.objective import GoalDistance, Objective, TravelTime, distance
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.planners.astar.astar_mppi import AStarMPPI
from benchnav.planning.planners.cl_rrt.cl_rrt import CLRRT
from benchnav.planning.planners.mppi import MPPI
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.optimal.optimal import NearOptimal, Optimal
from benchnav.planning.planners.planner import LocalPlanner, Plan, Planner, PlanStatus
from benchnav.planning.planners.straight import Straight
from benchnav.planning.problem import Prediction, Problem, Task, pose_problem
from benchnav.planning.risk import (
    Chance,
    CVaR,
    ExpectedTime,
    Mean,
    RiskMeasure,
    SingleClass,
    TimeCVaR,
    VaR,
)
from benchnav.planning.robots import (
    SPEED,
    STEERING,
    TURN_RATE,
    Ackermann,
    Bicycle,
    DifferentialDrive,
    Robot,
    SkidSteer,
    Unicycle,
)
from benchnav.planning.sensing.belief import Belief, CovarianceModel, Static
from benchnav.planning.sensing.classes import Classes
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.near import Near
from benchnav.planning.sensing.sensor import (
    Appearance,
    Contact,
    Full,
    Measurement,
    NoiseKey,
    Probe,
    Sensor,
    Step,
)
from benchnav.planning.world.physics.settings import Body, Entrapment, Physics
from benchnav.planning.world.physics.soil import (
    Calibrated,
    CustomSoil,
    Isotropic,
    Janosi,
    Soil,
)
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.tracks import create_simulation
from benchnav.planning.world.world import Endpoints, World

__all__ = [
    "CLRRT",
    "MPPI",
    "SPEED",
    "STEERING",
    "TURN_RATE",
    "AStarDWA",
    "AStarMPPI",
    "Ackermann",
    "Appearance",
    "Belief",
    "Bicycle",
    "Body",
    "CVaR",
    "Calibrated",
    "Chance",
    "Classes",
    "Contact",
    "Copula",
    "CovarianceModel",
    "CustomSoil",
    "DifferentialDrive",
    "Endpoints",
    "Entrapment",
    "ExpectedTime",
    "Footprint",
    "FreeSpace",
    "Full",
    "GoalDistance",
    "Isotropic",
    "Janosi",
    "LocalPlanner",
    "MPPIConfig",
    "Mean",
    "Measurement",
    "Near",
    "NearOptimal",
    "NoiseKey",
    "Objective",
    "Optimal",
    "Physics",
    "Plan",
    "PlanStatus",
    "Planner",
    "Prediction",
    "Probe",
    "Problem",
    "RiskMeasure",
    "Robot",
    "Rules",
    "Sensor",
    "Simulation",
    "SingleClass",
    "SkidSteer",
    "Soil",
    "Static",
    "Step",
    "Straight",
    "Task",
    "TimeCVaR",
    "TravelTime",
    "Unicycle",
    "VaR",
    "World",
    "create_simulation",
    "distance",
    "minimum_over_footprint",
    "pose_problem",
]
