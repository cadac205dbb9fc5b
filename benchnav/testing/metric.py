"""The check of metrics, on sample episodes of a robot without a planner."""

from functools import partial
from typing import Any

from benchnav.core import registry
from benchnav.metrics.base import Metric, measure
from benchnav.metrics.check import attribute_faults, sample_episodes
from benchnav.testing.breaches import NOTHING, Breaches


def check_metric(metric: Any, robot: Any = "unicycle") -> None:
    """Check that a metric fulfils its contract.

    The contract:

    - its attributes are valid, see `benchnav.metrics.Metric`;
    - `compute` returns a finite number or NaN for three sample episodes: a success, a
      failure without motion, and a failure after one step;
    - the number is the same when repeated;
    - arguments and global generators are unchanged.

    Args:
        metric: a metric, or its name, file or mapping as in suites.
        robot: robot of the episodes, or its name, file or mapping.

    Raises:
        ConfigError: If the metric breaks the contract; the message lists all breaches.
    """
    new_metric: Metric = registry.take("metric", metric)
    breaches = Breaches("metric", type(new_metric).__name__)
    for fault in attribute_faults(new_metric):
        breaches.expect(False, fault)
    breaches.raise_any()
    for episode in sample_episodes(registry.take("robot", robot)):
        breaches.location = f"{episode}"
        compute = partial(measure, new_metric, episode)
        value = breaches.watch("compute", compute, metric=new_metric)
        repeated = breaches.watch("compute", compute, metric=new_metric)
        is_same = NOTHING in (value, repeated) or repr(value) == repr(repeated)
        breaches.expect(
            is_same,
            "Expected the same value when computed again, got a different value.",
        )
    breaches.raise_any()
