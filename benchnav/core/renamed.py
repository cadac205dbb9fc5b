"""Names of version 1 and their replacements in version 2, for error messages."""

# New dotted names of modules, classes and functions, by old dotted name.
IMPORTS = {
    "benchnav.core.figures": "benchnav.viz",
    "benchnav.metrics.Learnt": "benchnav.metrics.LearningRecord",
    "benchnav.metrics.motion.StuckShare": "benchnav.metrics.motion.StuckFraction",
    "benchnav.planning.Law": "benchnav.planning.CovarianceModel",
    "benchnav.planning.Moment": "benchnav.planning.NoiseKey",
    "benchnav.planning.OptimalBound": "benchnav.planning.NearOptimal",
    "benchnav.planning.Places": "benchnav.planning.Endpoints",
    "benchnav.planning.Sensed": "benchnav.planning.Measurement",
    "benchnav.planning.risk.chance": "benchnav.planning.Chance",
    "benchnav.planning.risk.cvar": "benchnav.planning.CVaR",
    "benchnav.planning.risk.expected_time": "benchnav.planning.ExpectedTime",
    "benchnav.planning.risk.mean": "benchnav.planning.Mean",
    "benchnav.planning.risk.single_class": "benchnav.planning.SingleClass",
    "benchnav.planning.risk.time_cvar": "benchnav.planning.TimeCVaR",
    "benchnav.planning.risk.var": "benchnav.planning.VaR",
}

# New names of parts, by kind and old name.
PARTS = {("planner", "optimal_bound"): "near_optimal"}
