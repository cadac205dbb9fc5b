"""Planning under predicted traversability.

The package contains problems, planners, robots, objectives, risk measures and worlds.
"""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.planning.free_space": ("FreeSpace", "Rules"),
        "benchnav.planning.objective": (
            "GoalDistance",
            "Objective",
            "TravelTime",
            "distance",
        ),
        "benchnav.planning.planners.astar.astar_dwa": ("AStarDWA",),
        "benchnav.planning.planners.astar.astar_mppi": ("AStarMPPI",),
        "benchnav.planning.planners.cl_rrt.cl_rrt": ("CLRRT",),
        "benchnav.planning.planners.mppi": ("MPPI",),
        "benchnav.planning.planners.mppi_config": ("MPPIConfig",),
        "benchnav.planning.planners.optimal.optimal": ("NearOptimal", "Optimal"),
        "benchnav.planning.planners.planner": (
            "LocalPlanner",
            "Plan",
            "PlanStatus",
            "Planner",
        ),
        "benchnav.planning.planners.straight": ("Straight",),
        "benchnav.planning.problem": ("Prediction", "Problem", "Task", "pose_problem"),
        "benchnav.planning.risk": (
            "CVaR",
            "Chance",
            "ExpectedTime",
            "Mean",
            "RiskMeasure",
            "SingleClass",
            "TimeCVaR",
            "VaR",
        ),
        "benchnav.planning.robots": (
            "SPEED",
            "STEERING",
            "TURN_RATE",
            "Ackermann",
            "Bicycle",
            "DifferentialDrive",
            "Robot",
            "SkidSteer",
            "Unicycle",
        ),
        "benchnav.planning.sensing.belief": ("Belief", "CovarianceModel", "Static"),
        "benchnav.planning.sensing.classes": ("Classes",),
        "benchnav.planning.sensing.copula": ("Copula",),
        "benchnav.planning.sensing.near": ("Near",),
        "benchnav.planning.sensing.sensor": (
            "Appearance",
            "Contact",
            "Full",
            "NoiseKey",
            "Probe",
            "Measurement",
            "Sensor",
            "Step",
        ),
        "benchnav.planning.footprint": ("Footprint", "minimum_over_footprint"),
        "benchnav.planning.world.physics.settings": ("Body", "Entrapment", "Physics"),
        "benchnav.planning.world.physics.soil": (
            "Calibrated",
            "CustomSoil",
            "Isotropic",
            "Janosi",
            "Soil",
        ),
        "benchnav.planning.world.simulation": ("Simulation",),
        "benchnav.planning.world.tracks": ("create_simulation",),
        "benchnav.planning.world.world": ("Endpoints", "World"),
    },
)
