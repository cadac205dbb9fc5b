from benchnav.testing.belief import check_belief
from benchnav.testing.functions import check_objective, check_risk, check_robot
from benchnav.testing.metric import check_metric
from benchnav.testing.model import check_model
from benchnav.testing.planner import check_planner
from benchnav.testing.sensor import check_sensor

__all__ = [
    "check_belief",
    "check_metric",
    "check_model",
    "check_objective",
    "check_planner",
    "check_risk",
    "check_robot",
    "check_sensor",
]
