from benchnav.testing.model import check_model
from benchnav.testing.objective import check_objective
from benchnav.testing.planner import check_planner
from benchnav.testing.risk import check_risk
from benchnav.testing.robot import check_robot

__all__ = ["check_model", "check_objective", "check_planner", "check_risk", "check_robot"]
