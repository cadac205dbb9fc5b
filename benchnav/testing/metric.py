"""The contract of metrics, tried on episodes that a robot drives without a planner."""

from functools import partial
from typing import Any

from benchnav.core import registry
from benchnav.metrics.base import Metric, measure
from benchnav.metrics.check import attribute_faults, sample_episodes
from benchnav.testing.breaches import NOTHING, Breaches


def check_metric(metric: Any, robot: Any = "unicycle") -> None:
    """Tries whether a metric keeps the contract.

    The contract: attributes as `benchnav.metrics.Metric` lists them; for a success, a
    failure that stood and a failure of one step a finite number or NaN, which is the
    same when computed again; arguments and global generators left as they were.

    Args:
        metric: any metric, or the name, file or mapping of one as suites have it.
        robot: that drives the episodes, likewise.

    Raises:
        ConfigError: If the metric breaks the contract; every breach is named.
    """
    made: Metric = registry.take("metric", metric)
    breaches = Breaches("metric", type(made).__name__)
    for fault in attribute_faults(made):
        breaches.expect(False, fault)
    breaches.refuse()
    for episode in sample_episodes(registry.take("robot", robot)):
        breaches.place = f"{episode}"
        value, again = (
            breaches.watch("compute", partial(measure, made, episode), metric=made)
            for _ in range(2)
        )
        breaches.expect(
            NOTHING in (value, again) or repr(value) == repr(again),
            "Expected the same value when computed again, got another.",
        )
    breaches.refuse()
