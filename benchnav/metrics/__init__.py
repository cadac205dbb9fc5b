"""Metrics of episodes: each is one column of the episodes' table, with the texts that
tables, tests and reports show.
"""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.metrics.base": ("Episode", "LearningRecord", "Metric", "MetricError"),
        "benchnav.metrics.energy": ("Energy",),
        "benchnav.metrics.shipped": ("SHIPPED",),
    },
)
