from benchnav.testing.model import check_model as check_model
from benchnav.testing.objective import check_objective as check_objective
from benchnav.testing.planner import check_planner as check_planner
from benchnav.testing.risk import check_risk as check_risk
from benchnav.testing.robot import check_robot as check_robot
