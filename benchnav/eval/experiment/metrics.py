"""Metrics that a suite adds to the built-in ones, and their entries in `run.json`."""

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

# Columns of the table of episodes that are not metrics.
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
# Fields of a metric's quantity that affect results and hypotheses.
_FIXED = ("name", "column", "unit", "scale", "of_arrivals")


@dataclass(frozen=True, kw_only=True)
class NamedMetric:
    """A metric that a suite names.

    Args:
        part: the metric and its options.
        quantity: name, column, unit and direction of its values.
    """

    part: Part
    quantity: Quantity

    @property
    def spec(self) -> dict[str, Any]:
        """The part and options that create the metric, as plain data."""
        return {"part": self.part.part, "options": dict(self.part.options)}

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of `metrics` in `run.json`."""
        entry = self.spec
        entry["label"] = self.part.label
        entry["quantity"] = asdict(self.quantity)
        if self.is_object:
            entry["unreproducible"] = True
        return entry

    @property
    def is_object(self) -> bool:
        """Whether the metric is an object of this process only."""
        return registry.is_object("metric", self.part.part)


def read_metrics(
    specs: Sequence[PartSpec], robots: Iterable[Robot]
) -> tuple[NamedMetric, ...]:
    """Read the metrics of a suite, and test each on sample episodes of each robot.

    Args:
        specs: metrics as the suite lists them.
        robots: robots of the suite.

    Raises:
        ConfigError: If a metric does not exist or breaks its contract, or two metrics
            share a name or a column.
    """
    parts = [part for spec in specs for part in read_parts("metric", spec)]
    episodes = []
    if parts:
        episodes = [episode for robot in robots for episode in sample_episodes(robot)]
    named: list[NamedMetric] = []
    for part in parts:
        metric: Metric = part.object
        if type(metric) in map(type, SHIPPED):
            raise ConfigError(
                f"Expected `metrics` other than the built-in ones, got {part.part!r}. "
                "Every run has the built-in metrics. Leave it out."
            )
        faults = attribute_faults(metric)
        if faults:
            raise ConfigError(
                f"metric {part.part!r} breaks its contract. {' '.join(faults)}"
            )
        for episode in episodes:
            try:
                measure(metric, episode)
            except MetricError as error:
                message = f"{error} It was tested on {episode} before the run."
                raise ConfigError(message) from error
        named = add_metric(named, NamedMetric(part=part, quantity=metric.quantity))
    return tuple(named)


def add_metric(metrics: Sequence[NamedMetric], new: NamedMetric) -> list[NamedMetric]:
    """Return the metrics of a run with a new one.

    A metric that the run already has keeps its position and takes the new label and
    quantity.

    Args:
        metrics: metrics of the run in addition to the built-in ones.
        new: the new metric.

    Raises:
        ConfigError: If another metric has the new metric's name or column, if each run
            has a column of that name, or if the metric's name, column or unit has
            changed.
    """
    quantity = new.quantity
    taken = [(builtin.name, builtin.column) for builtin in QUANTITIES.values()]
    taken += [("", column) for column in _BOOKKEEPING]
    for index, metric in enumerate(metrics):
        if metric.spec == new.spec and _is_unchanged(metric.quantity, quantity):
            return [*metrics[:index], new, *metrics[index + 1 :]]
        taken.append((metric.quantity.name, metric.quantity.column))
    for name, column in taken:
        if name == quantity.name or column == quantity.column:
            raise ConfigError(
                "Expected metrics that differ in name and column, got "
                f"{new.part.part!r} with name {quantity.name!r} and column "
                f"{quantity.column!r}, and {name or 'bookkeeping'!r} with column "
                f"{column!r}. Give one of them a different `name` and `column`, or the "
                "run a different `out`."
            )
    return [*metrics, new]


def _is_unchanged(before: Quantity, now: Quantity) -> bool:
    return all(getattr(before, name) == getattr(now, name) for name in _FIXED)


def metrics_of_run(manifest: Mapping[str, Any]) -> tuple[NamedMetric, ...]:
    """Return the metrics that a run has in addition to the built-in ones.

    Args:
        manifest: contents of `run.json`.
    """
    metrics = []
    for entry in manifest.get("metrics", ()):
        part = Part(
            part=entry["part"],
            label=entry["label"],
            options=entry["options"],
            kind="metric",
        )
        quantity = Quantity(**entry["quantity"])
        metrics.append(NamedMetric(part=part, quantity=quantity))
    return tuple(metrics)


def further_quantities(manifest: Mapping[str, Any]) -> list[Quantity]:
    """Return the quantities of a run's metrics beyond the built-in ones.

    Args:
        manifest: contents of `run.json`.
    """
    return [metric.quantity for metric in metrics_of_run(manifest)]


def quantities(further: Iterable[Quantity]) -> dict[str, Quantity]:
    """Return the built-in quantities and further ones, by name."""
    return {**QUANTITIES, **{quantity.name: quantity for quantity in further}}
