"""Metrics of episodes.

Each metric is one column of the table of episodes, with the texts that tables, tests
and reports show.
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
