"""Metrics that a suite names besides those that every run has: how they are read, and
how `run.json` holds them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.quantity import Quantity
from benchnav.core.registry import Part
from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.experiment.suite import PartSpec
from benchnav.eval.experiment.sweep import read_parts
from benchnav.eval.experiment.unit import DRAW
from benchnav.metrics.base import Metric, MetricError, measure
from benchnav.metrics.check import attribute_faults, sample_episodes
from benchnav.metrics.shipped import QUANTITIES, SHIPPED
from benchnav.planning.robots import Robot

# Columns of a row of episodes that are no metrics.
_BOOKKEEPING = (
    "condition",
    *LABELS,
    *DRAW,
    "group",
    "outcome",
    "compiled",
    "error",
    "code",
    "time_budget_s",
)
# What of a metric's description results and hypotheses rest on.
_FIXED = ("name", "column", "unit", "scale", "of_arrivals")


@dataclass(frozen=True, kw_only=True)
class NamedMetric:
    """A metric that a suite names.

    Args:
        part: which, with its options.
        quantity: what is said of its values.
    """

    part: Part
    quantity: Quantity

    @property
    def spec(self) -> dict[str, Any]:
        """What makes the metric, as plain data."""
        return {"part": self.part.part, "options": dict(self.part.options)}

    @property
    def about(self) -> dict[str, Any]:
        """The entry of `metrics` in `run.json`."""
        marked = {"unreproducible": True} if self.is_object else {}
        return {
            **self.spec,
            "label": self.part.label,
            "quantity": asdict(self.quantity),
            **marked,
        }

    @property
    def is_object(self) -> bool:
        """Whether it is an object of this process, which no other process can create."""
        return registry.is_object("metric", self.part.part)


def read_metrics(
    given: Sequence[PartSpec], robots: Iterable[Robot]
) -> tuple[NamedMetric, ...]:
    """Reads the metrics of a suite, and tries each on an episode of each robot.

    Args:
        given: as the suite lists them.
        robots: of the suite.

    Raises:
        ConfigError: If there is no such metric, it breaks its contract, or two have one
            name or column.
    """
    parts = [part for spec in given for part in read_parts("metric", spec)]
    episodes = (
        [episode for robot in robots for episode in sample_episodes(robot)]
        if parts
        else []
    )
    named: list[NamedMetric] = []
    for part in parts:
        metric: Metric = part.object
        if type(metric) in map(type, SHIPPED):
            raise ConfigError(
                "Expected `metrics` besides those that every run has, got "
                f"{part.part!r}. Leave it out."
            )
        if faults := attribute_faults(metric):
            raise ConfigError(
                f"metric {part.part!r} breaks its contract. {' '.join(faults)}"
            )
        try:
            for episode in episodes:
                measure(metric, episode)
        except MetricError as error:
            raise ConfigError(
                f"{error} It was tried on {episode} before the run."
            ) from error
        named = add_metric(named, NamedMetric(part=part, quantity=metric.quantity))
    return tuple(named)


def add_metric(known: Sequence[NamedMetric], new: NamedMetric) -> list[NamedMetric]:
    """Adds a metric to those of a run; one that is there already keeps its place and
    takes the new description.

    Raises:
        ConfigError: If another metric, or a column of every run, has its name or
            column, or it has another name, column or unit than before.
    """
    quantity = new.quantity
    owned = [(other.name, other.column) for other in QUANTITIES.values()]
    owned += [("", column) for column in _BOOKKEEPING]
    for other in known:
        if other.spec == new.spec and all(
            getattr(other.quantity, name) == getattr(quantity, name) for name in _FIXED
        ):
            return [new if one is other else one for one in known]
        owned.append((other.quantity.name, other.quantity.column))
    for name, column in owned:
        if name == quantity.name or column == quantity.column:
            raise ConfigError(
                "Expected metrics with names and columns of their own, got "
                f"{new.part.part!r} named {quantity.name!r} "
                f"with column {quantity.column!r}, and {name or 'bookkeeping'!r} with "
                f"{column!r}. Give one another "
                "`name` and `column`, or another `out` to the run."
            )
    return [*known, new]


def metrics_of_run(about: Mapping[str, Any]) -> tuple[NamedMetric, ...]:
    """The metrics that a run has besides those that every run has.

    Args:
        about: all of `run.json`.
    """
    return tuple(
        NamedMetric(
            part=Part(
                part=entry["part"],
                label=entry["label"],
                options=entry["options"],
                kind="metric",
            ),
            quantity=Quantity(**entry["quantity"]),
        )
        for entry in about.get("metrics", ())
    )


def further_quantities(about: Mapping[str, Any]) -> list[Quantity]:
    """What is said of each metric that a run has besides those that every run has.

    Args:
        about: all of `run.json`.
    """
    return [metric.quantity for metric in metrics_of_run(about)]


def quantities(further: Iterable[Quantity]) -> dict[str, Quantity]:
    """All quantities by name: those that every run has, and further ones."""
    return {**QUANTITIES, **{quantity.name: quantity for quantity in further}}
