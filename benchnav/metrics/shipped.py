"""The metrics of every run, in the order of columns; a suite may add other metrics."""

from collections.abc import Mapping

from benchnav.core.quantity import Quantity
from benchnav.metrics import draw, learning, motion, planning, times
from benchnav.metrics.base import Metric

SUCCESS = times.Success()
TOTAL_TIME = times.TotalTime()
TRAVERSABILITY = motion.Traversability()
TIME_RATIO = times.TimeRatio()
SCORE = times.Score()
PATH_LENGTH = motion.PathLength()
STUCK_FRACTION = motion.StuckFraction()
ROUGHNESS = motion.Roughness()
PLANNING = (planning.PlanningTime(), planning.HighPlanningTime(), planning.StartTime())
REVISIONS = learning.Revisions()
SEEN_CELLS = learning.SeenCells()
SENSED_CELLS = learning.SensedCells()
AHEAD = (learning.AheadRmse(), learning.AheadLogScore())
LEARNING_TIME = learning.LearningTime()
LOWER_BOUND = draw.LowerBound()

SHIPPED: tuple[Metric, ...] = (
    SUCCESS,
    TOTAL_TIME,
    times.EndTime(),
    TRAVERSABILITY,
    times.ReferenceTime(),
    TIME_RATIO,
    SCORE,
    PATH_LENGTH,
    STUCK_FRACTION,
    ROUGHNESS,
    *PLANNING,
    REVISIONS,
    SEEN_CELLS,
    SENSED_CELLS,
    *AHEAD,
    LEARNING_TIME,
    draw.RejectedDraws(),
    LOWER_BOUND,
)
QUANTITIES: Mapping[str, Quantity] = {
    metric.name: metric.quantity for metric in SHIPPED
}
