from benchnav.metrics.base import Episode, LearningRecord, Metric, MetricError
from benchnav.metrics.energy import Energy
from benchnav.metrics.shipped import SHIPPED

__all__ = ["SHIPPED", "Energy", "Episode", "LearningRecord", "Metric", "MetricError"]
