"""Conditions: the cells of an experiment, which a suite lists.

A condition is a data split, a model, a risk setting, a planner, a robot, an objective,
sensors, a belief, rules and a world. Its id is the digest of these settings; its labels
are names for readers. Seeds, realisations and maps are no part of a condition.
"""

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

from benchnav.core import registry
from benchnav.core.errors import ConfigError, expect
from benchnav.core.ground import GroundStatistics
from benchnav.core.registry import Part
from benchnav.core.settings import call, of, read
from benchnav.core.short_repr import short_repr
from benchnav.core.store import text_digest
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.clearance import largest_footprint_m, with_clearance
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.sweep import (
    check_count,
    each_mapping,
    part_of,
    read_parts,
)
from benchnav.models.predictor import ModelPart, find_ground_statistics
from benchnav.planning.free_space import Rules
from benchnav.planning.planners.planner import INPUTS
from benchnav.planning.problem import Task
from benchnav.planning.world.world import World, read_world

# Default parts of sensing and belief. Ids leave them out, so that conditions of runs
# from before these parts existed keep their ids.
KNOWLEDGE: Mapping[str, Mapping[str, Any]] = {
    "sensor": {"part": "full", "options": {}},
    "ground": {"part": "contact", "options": {}},
    "belief": {"part": "static", "options": {"correlated": True}},
}
PART_KINDS = ("model", "risk", "planner", "robot", "objective", *KNOWLEDGE)
# Columns of `Condition.labels`, in the order of tables.
_TASK_LABELS = ("data", "scenario", "world", "robot", "objective")
LABELS = (*_TASK_LABELS, "model", *KNOWLEDGE, "planner", "risk")
NOT_USED = "–"
ANY_RISK = Part(part="mean", label=NOT_USED, kind="risk")
# Properties of a split that affect results in addition to its maps;
# `TerrainDataset.about_digest` is their digest.
SPLIT_PROPERTIES = "class table, λ_stuck, resolution or kind of truth"
# If the robot does not learn, a setting affects the planner only by this input.
_INPUT_OF_SETTING: Mapping[str, str] = {"risk": "risk_map", "belief": "fields"}
# Order of the rows of tables: the last kind varies fastest.
_ORDER = ("robot", "objective", "model", *KNOWLEDGE, "risk", "planner")


@dataclass(frozen=True, kw_only=True)
class Condition:
    """One cell of an experiment.

    Args:
        data: path or id of the dataset.
        scenario: scenario of the test split.
        model: model that predicts traversability.
        risk: risk measure that turns a prediction into λ̂.
        planner: planner, which chooses actions from λ̂.
        robot: robot dynamics F.
        objective: objective J.
        sensor: appearance sensor.
        ground: traversability sensor.
        belief: update of the prediction by measured λ.
        rules: free space, minimum λ̂, goal radius and replanning interval.
        world: draws of λ and immobilising terrain.
        world_label: label of rules and world in tables.
        blind: whether the planner is blind, so that model and risk measure have no
            effect.
        stands_for: labels of the settings that are merged into this condition, by kind
            of part. They differ only in inputs that the planner does not use.
    """

    __repr__ = short_repr

    data: str
    scenario: str
    model: ModelPart
    risk: Part
    planner: Part
    robot: Part
    objective: Part
    sensor: Part
    ground: Part
    belief: Part
    rules: Rules
    world: World
    world_label: str
    blind: bool = False
    stands_for: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields without the cached task, whose classes may be unknown."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @property
    def split(self) -> str:
        """Name of the split of the dataset."""
        return f"test/{self.scenario}"

    @property
    def dataset(self) -> TerrainDataset:
        """The dataset, opened at each access, since its file may have changed."""
        return TerrainDataset(find_dataset(self.data))

    @property
    def parts(self) -> dict[str, Part]:
        """Parts by kind."""
        return {kind: getattr(self, kind) for kind in PART_KINDS}

    @property
    def value(self) -> dict[str, Any]:
        """All settings that affect the condition's rows, as plain data without labels."""
        value: dict[str, Any] = {"data": self.data, "split": self.split}
        for kind, part in self.parts.items():
            spec = {"part": part.part, "options": dict(part.options)}
            if spec != KNOWLEDGE.get(kind):
                value[kind] = spec
        value["rules"] = self.rules.to_dict()
        value["world"] = self.world.to_dict()
        return value

    @property
    def id(self) -> str:
        """Digest of the value, 16 hexadecimal digits."""
        return text_digest(self.value)[:16]

    @property
    def labels(self) -> dict[str, str]:
        """Labels in tables, by column; `NOT_USED` for parts without effect."""
        labels = {"data": self.data, "scenario": self.scenario}
        for kind, part in self.parts.items():
            labels[kind] = part.label
        labels |= dict.fromkeys(self.stands_for, NOT_USED)
        if self.blind:
            labels |= dict.fromkeys(("model", "risk", *KNOWLEDGE), NOT_USED)
        labels["world"] = self.world_label
        return labels

    @property
    def description(self) -> str:
        """All labels, each preceded by its column."""
        return ", ".join(f"{name} {label}" for name, label in self.labels.items())

    @cached_property
    def task(self) -> Task:
        """The task: robot, objective and rules."""
        robot = self.robot.object
        objective = self.objective.create(
            robot=robot, goal_radius_m=self.rules.goal_radius_m
        )
        return Task(robot=robot, objective=objective, rules=self.rules)

    @property
    def unreproducible(self) -> tuple[str, ...]:
        """Kind and label of each part that is an object of this process only."""
        names = []
        for kind, part in self.parts.items():
            if registry.is_object(kind, part.part):
                names.append(f"{kind} {part.label}")
        return tuple(names)

    @property
    def learns(self) -> bool:
        """Whether the robot updates its prediction during the episode."""
        return not self.sensor.object.sees_all or self.belief.object.learns

    @property
    def statistics(self) -> GroundStatistics | None:
        """Statistics of the training maps; None if no sensor or belief needs them.

        Raises:
            ConfigError: If they are needed and missing.
        """
        if self.sensor.object.sees_all and not self.belief.object.needs_statistics:
            return None
        return find_ground_statistics(self.model, self.dataset)

    @property
    def planner_uses(self) -> frozenset[str]:
        """Names of the inputs that affect the planner in this task; see `Planner.uses`.

        Raises:
            ConfigError: If the planner returns names that are not in `INPUTS`.
        """
        owner = f"`uses` of planner {self.planner.label!r}"
        used = call(owner, self.planner.object.uses, {"task": self.task})
        is_valid = isinstance(used, frozenset) and used <= INPUTS
        names = ", ".join(sorted(INPUTS))
        expect(
            is_valid,
            f"{owner} to return a frozenset of names from ({names}), got {used!r}.",
        )
        return used

    @property
    def unused(self) -> tuple[str, ...]:
        """Kinds of parts without effect on rows; empty if the planner is blind.

        If the robot learns, changes of λ̂ determine when its planner receives a new map.
        Every setting then affects rows.
        """
        if self.blind or self.learns:
            return ()
        used = self.planner_uses
        inputs = _INPUT_OF_SETTING.items()
        return tuple(kind for kind, name in inputs if name not in used)

    @property
    def rows_id(self) -> str:
        """Digest of the settings that affect rows."""
        any_belief = part_of("belief", KNOWLEDGE["belief"], NOT_USED)
        defaults: dict[str, Any] = {"risk": ANY_RISK, "belief": any_belief}
        unused_parts = {kind: defaults[kind] for kind in self.unused}
        return replace(self, **unused_parts).id


def condition_from(entry: Mapping[str, Any]) -> Condition:
    """Return the condition of an entry in `run.json`."""
    value = {**KNOWLEDGE, **entry["value"]}
    labels = entry["labels"]
    parts: dict[str, Any] = {
        kind: part_of(kind, value[kind], labels[kind]) for kind in PART_KINDS
    }
    world = {"time_budget_s": None} | value["world"]
    stands_for = entry.get("stands_for", {})
    return Condition(
        data=value["data"],
        scenario=value["split"].removeprefix("test/"),
        **parts,
        rules=read(Rules, value["rules"], of("rules")),
        world=read(World, world, of("world")),
        world_label=labels["world"],
        blind=labels["model"] == NOT_USED,
        stands_for={kind: tuple(merged) for kind, merged in stands_for.items()},
    )


def scenarios_of(data: str) -> list[str]:
    """Return the scenarios of the test splits of a dataset, from its path or id."""
    splits = TerrainDataset(find_dataset(data)).splits
    return [name.removeprefix("test/") for name in splits if name.startswith("test/")]


def conditions_of(
    suite: Suite, scenarios_of: Callable[[str], Sequence[str]] = scenarios_of
) -> list[Condition]:
    """List the conditions of a suite, in the order of tables.

    Args:
        suite: suite, as a user wrote it.
        scenarios_of: function that maps the path or id of a dataset to the scenarios of
            its test splits.

    Raises:
        ConfigError: If a part cannot be created as requested, two parts share a label,
            or a condition is listed twice.
    """
    conditions: list[Condition] = []
    products = [list(_product(listed, scenarios_of)) for listed in suite.products]
    all_conditions = itertools.chain.from_iterable(products)
    clearance_m = largest_footprint_m(condition.robot for condition in all_conditions)
    for product in products:
        ids: set[str] = set()
        for condition in product:
            world, label = with_clearance(
                condition.world, condition.world_label, condition.rules, clearance_m
            )
            condition = replace(condition, world=world, world_label=label)
            if condition.id in ids:
                words = " ".join(label_words(condition.labels))
                raise ConfigError(
                    f"Expected settings that differ, got {words} twice. Leave one out."
                )
            ids.add(condition.id)
            conditions.append(_without_unused(condition))
    check_labels(conditions)
    by_id = {condition.id: condition for condition in conditions}
    return merge_alike(by_id.values())


def merge_alike(conditions: Iterable[Condition]) -> list[Condition]:
    """Merge conditions that share a `rows_id`.

    Each group is merged into its first condition with risk `mean`, or else its first.
    """
    groups: dict[str, list[Condition]] = defaultdict(list)
    for condition in conditions:
        groups[condition.rows_id].append(condition)
    merged = []
    for group in groups.values():
        with_mean = [condition for condition in group if condition.risk.part == "mean"]
        representative, *_ = [*with_mean, *group]
        merged.append(merge(representative, group))
    return merged


def merge(representative: Condition, conditions: Sequence[Condition]) -> Condition:
    """Merge conditions that share a `rows_id` into one that stands for all of them.

    Args:
        representative: the condition that is run.
        conditions: all conditions, including `representative`.

    Returns:
        `representative`, in which parts that differ have the label `NOT_USED`.
    """
    stands_for: dict[str, tuple[str, ...]] = {}
    parts: dict[str, Any] = {}
    for kind in _INPUT_OF_SETTING:
        labels: dict[str, None] = {}
        for condition in conditions:
            label = getattr(condition, kind).label
            labels |= dict.fromkeys(condition.stands_for.get(kind, (label,)))
        if len(labels) > 1:
            stands_for[kind] = tuple(labels)
            parts[kind] = replace(getattr(representative, kind), label=NOT_USED)
    return replace(representative, stands_for=stands_for, **parts)


def check_labels(conditions: Iterable[Condition]) -> None:
    """Reject two settings with the same label, and two labels of the same setting.

    Args:
        conditions: conditions, which may be repeated. Messages take the labels of
            earlier conditions as the correct ones.

    Raises:
        ConfigError: If there are such settings or labels.
    """
    digests: dict[tuple[str, str], str] = {}
    labels: dict[tuple[str, str], str] = {}
    for condition in conditions:
        value = condition.value
        settings = {name: value.get(name) for name in PART_KINDS}
        settings["world"] = [value["world"], value["rules"]]
        for name, setting in settings.items():
            label = condition.labels[name]
            if label == NOT_USED:
                continue
            digest = text_digest(setting)
            if digests.setdefault((name, label), digest) != digest:
                raise ConfigError(
                    f"Expected a different label for each {name}, got two settings "
                    f"with the label {label!r}. Write them as "
                    f"{{part: NAME, label: LABEL, options: {{…}}}}."
                )
            first = labels.setdefault((name, digest), label)
            if first != label:
                raise ConfigError(
                    f"Expected one label for each {name}, got {label!r} and {first!r} "
                    f"for the same setting. Write label: {first} for both."
                )


def _product(listed: Mapping[str, list[Any]], scenarios_of: Any) -> Iterator[Condition]:
    """Yield the conditions of one product of a suite.

    Args:
        listed: values by field, from `Suite.products`.
        scenarios_of: as in `conditions_of`.
    """
    scenarios = {}
    for data in listed["data"]:
        scenarios[data] = listed["scenarios"] or scenarios_of(data)
    parts: dict[str, list[Part]] = {}
    for kind in PART_KINDS:
        lists = [read_parts(kind, spec) for spec in listed[f"{kind}s"]]
        parts[kind] = list(itertools.chain.from_iterable(lists))
    world_specs = itertools.chain.from_iterable(map(each_mapping, listed["world"]))
    task_specs = itertools.chain.from_iterable(map(each_mapping, listed["task"]))
    worlds = [
        read_world(world, task)
        for world, task in itertools.product(world_specs, task_specs)
    ]
    n_scenarios = sum(map(len, scenarios.values()))
    check_count([n_scenarios, len(worlds), *map(len, parts.values())])
    ordered_parts = [parts[kind] for kind in _ORDER]
    for data in listed["data"]:
        settings = itertools.product(scenarios[data], worlds, *ordered_parts)
        for scenario, (world, rules, label), *chosen in settings:
            yield Condition(
                data=data,
                scenario=scenario,
                rules=rules,
                world=world,
                world_label=label,
                **dict(zip(_ORDER, chosen, strict=True)),
            )


def _without_unused(condition: Condition) -> Condition:
    """Replace settings without effect by defaults.

    A blind planner uses no prediction. The model `clairvoyant` predicts λ itself, so
    that every risk measure returns λ and the robot has nothing to learn. A belief that
    does not learn ignores measured λ.
    """
    unused: dict[str, Any] = {}
    for kind, default in KNOWLEDGE.items():
        unused[kind] = part_of(kind, default, NOT_USED)
    if condition.planner.object.blind or not condition.planner_uses:
        any_model = ModelPart(part="oracle", label=NOT_USED)
        return replace(condition, blind=True, model=any_model, risk=ANY_RISK, **unused)
    if not condition.belief.object.learns:
        condition = replace(condition, ground=unused["ground"])
    if condition.model.part != "clairvoyant":
        return condition
    if condition.sensor.object.sees_all:
        condition = replace(condition, ground=unused["ground"], belief=unused["belief"])
    return replace(condition, risk=ANY_RISK)


def label_words(
    labels: Mapping[str, str], names: Iterable[str] = LABELS[1:]
) -> list[str]:
    """Return the labels of some columns, without labels of unused parts."""
    return [labels[name] for name in names if labels[name] != NOT_USED]


def condition_names(conditions: Sequence[Condition]) -> list[str]:
    """Return names: scenario, planner, risk setting and other labels that differ."""
    labels = [condition.labels for condition in conditions]
    columns = []
    for name in LABELS:
        values = {row[name] for row in labels} - {NOT_USED}
        if name in ("scenario", "planner", "risk") or len(values) > 1:
            columns.append(name)
    return [" ".join(label_words(row, columns)) for row in labels]


def differences(a: Any, b: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the dotted name and both values of each difference; None if missing."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in dict.fromkeys([*a, *b]):
            path = f"{name}.{key}".removeprefix(".")
            yield from differences(a.get(key), b.get(key), path)
    elif a != b:
        yield name, a, b
