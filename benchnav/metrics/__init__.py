"""Metrics of episodes: one column of the episodes' table each, with what tables, tests
and reports say of it.
"""

from benchnav.core.public_names import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "benchnav.metrics.base": ("Episode", "Learnt", "Metric", "MetricError"),
        "benchnav.metrics.energy": ("Energy",),
        "benchnav.metrics.shipped": ("SHIPPED",),
    },
)
