"""Metrics of episodes.

Each metric defines one column of the table of episodes, and the texts that tables and
reports show for it.
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
