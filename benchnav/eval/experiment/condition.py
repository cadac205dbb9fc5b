"""Conditions: the cell of an experiment as a value, and how a suite becomes a list of
them.

A condition says which data split, model, risk setting, planner, robot, objective, rules
and world. Its id is the digest of that value; its labels are for people. Seeds,
realisations and maps are how often a condition is run, and belong to the suite.
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

# What a robot knows of its map, whose defaults stand in no id: they are what there was
# before there were others.
KNOWLEDGE: Mapping[str, Mapping[str, Any]] = {
    "sensor": {"part": "full", "options": {}},
    "ground": {"part": "contact", "options": {}},
    "belief": {"part": "static", "options": {"correlated": True}},
}
PART_KINDS = ("model", "risk", "planner", "robot", "objective", *KNOWLEDGE)
# Columns of `Condition.labels`, in the order of tables.
LABELS = (
    "data",
    "scenario",
    "world",
    "robot",
    "objective",
    "model",
    *KNOWLEDGE,
    "planner",
    "risk",
)
NOT_USED = "–"
ANY_RISK = Part(part="mean", label=NOT_USED, kind="risk")
# What the numbers of a split's maps rest on besides the maps:
# `TerrainDataset.about_digest` is its digest.
MEANING = "class table, λ_stuck, resolution or kind of truth"
# The only input by which a setting bears on a planner where no robot learns.
_BEARS_BY: Mapping[str, str] = {"risk": "risk_map", "belief": "fields"}
_ORDER = ("robot", "objective", "model", *KNOWLEDGE, "risk", "planner")  # of tables


@dataclass(frozen=True, kw_only=True)
class Condition:
    """One cell of an experiment.

    Args:
        data: path or id of the dataset.
        scenario: its test split.
        model: predicts.
        risk: turns a prediction into λ̂.
        planner: plans.
        robot: F.
        objective: J.
        sensor: what the robot sees of its map.
        ground: what it senses of λ.
        belief: what is made of that.
        rules: free space, least λ̂, goal radius, and when what is known is updated.
        world: what λ does.
        world_label: what tables call rules and world.
        blind: the planner is blind; model and risk stand in for any.
        stands_for: by kind of part the labels of the settings that differ in nothing
            that the planner uses and are run as this one.
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
        """Leave out the task, whose classes another process may have to load from a
        file first.
        """
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def split(self) -> str:
        """Name of the data's split."""
        return f"test/{self.scenario}"

    @property
    def dataset(self) -> TerrainDataset:
        """The dataset, opened again each time, since its file may have changed."""
        return TerrainDataset(find_dataset(self.data))

    @property
    def parts(self) -> dict[str, Part]:
        """Its parts by kind."""
        return {kind: getattr(self, kind) for kind in PART_KINDS}

    @property
    def value(self) -> dict[str, Any]:
        """All that bears on the condition's rows, as plain data; no labels."""
        parts = {
            kind: {"part": part.part, "options": dict(part.options)}
            for kind, part in self.parts.items()
        }
        return {
            "data": self.data,
            "split": self.split,
            **{
                kind: part
                for kind, part in parts.items()
                if part != KNOWLEDGE.get(kind)
            },
            "rules": self.rules.to_dict(),
            "world": self.world.to_dict(),
        }

    @property
    def id(self) -> str:
        """Digest of the value, 16 hexadecimal digits."""
        return text_digest(self.value)[:16]

    @property
    def labels(self) -> dict[str, str]:
        """What tables call it, by column."""
        parts = {kind: part.label for kind, part in self.parts.items()}
        parts |= dict.fromkeys(self.stands_for, NOT_USED)
        if self.blind:
            parts |= dict.fromkeys(("model", "risk", *KNOWLEDGE), NOT_USED)
        return {
            "data": self.data,
            "scenario": self.scenario,
            **parts,
            "world": self.world_label,
        }

    @property
    def description(self) -> str:
        """All labels, each after its column."""
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
        """Its parts that are objects of this process, each as kind and label; no other
        process can create them.
        """
        return tuple(
            f"{kind} {part.label}"
            for kind, part in self.parts.items()
            if registry.is_object(kind, part.part)
        )

    @property
    def learns(self) -> bool:
        """Whether the robot learns anything on its way."""
        return not self.sensor.object.sees_all or self.belief.object.learns

    @property
    def statistics(self) -> GroundStatistics | None:
        """Statistics of the training maps, None if neither sensor nor belief needs
        them.

        Raises:
            ConfigError: If they are needed and missing.
        """
        if self.sensor.object.sees_all and not self.belief.object.needs_statistics:
            return None
        return find_ground_statistics(self.model, self.dataset)

    @property
    def planner_uses(self) -> frozenset[str]:
        """Names of the inputs that bear on what the planner does in this task, see
        `Planner.uses`.

        Raises:
            ConfigError: If the planner does not say it in the words of `INPUTS`.
        """
        owner = f"`uses` of planner {self.planner.label!r}"
        used = call(owner, self.planner.object.uses, {"task": self.task})
        expect(
            isinstance(used, frozenset) and used <= INPUTS,
            f"{owner} to return a frozenset of {', '.join(sorted(INPUTS))}, got "
            f"{used!r}.",
        )
        return used

    @property
    def unused(self) -> tuple[str, ...]:
        """Kinds of parts whose setting bears on no row, besides those that no blind
        planner uses.

        Where a robot learns, a change of λ̂ decides when its planner is given another
        map, so that every setting bears.
        """
        if self.blind or self.learns:
            return ()
        used = self.planner_uses
        return tuple(kind for kind, name in _BEARS_BY.items() if name not in used)

    @property
    def rows_id(self) -> str:
        """Digest of what bears on its rows; conditions that differ only in what is not
        used share it.
        """
        stand_ins: dict[str, Any] = {
            "risk": ANY_RISK,
            "belief": part_of("belief", KNOWLEDGE["belief"], NOT_USED),
        }
        return replace(self, **{kind: stand_ins[kind] for kind in self.unused}).id


def condition_from(about: Mapping[str, Any]) -> Condition:
    """Rebuilds a condition from its `value`, `labels` and `stands_for`, as `run.json`
    holds them.
    """
    value, labels = {**KNOWLEDGE, **about["value"]}, about["labels"]
    parts: dict[str, Any] = {
        kind: part_of(kind, value[kind], labels[kind]) for kind in PART_KINDS
    }
    return Condition(
        data=value["data"],
        scenario=value["split"].removeprefix("test/"),
        **parts,
        rules=read(Rules, value["rules"], of("rules")),
        world=read(World, {"time_budget_s": None} | value["world"], of("world")),
        world_label=labels["world"],
        blind=labels["model"] == NOT_USED,
        stands_for={
            kind: tuple(own) for kind, own in about.get("stands_for", {}).items()
        },
    )


def scenarios_of(data: str) -> list[str]:
    """The scenarios of a dataset's test splits, by its path or id."""
    splits = TerrainDataset(find_dataset(data)).splits
    return [name.removeprefix("test/") for name in splits if name.startswith("test/")]


def conditions_of(
    suite: Suite, scenarios_of: Callable[[str], Sequence[str]] = scenarios_of
) -> list[Condition]:
    """Lists the conditions of a suite, in the order of tables.

    Args:
        suite: what is evaluated.
        scenarios_of: returns the scenarios of a dataset's test splits, from its path or
            id.

    Raises:
        ConfigError: a part cannot be had as asked for, two parts share a label, or one
            is there twice.
    """
    every: list[Condition] = []
    for listed in suite.products:
        here: set[str] = set()
        for condition in _product(listed, scenarios_of):
            if condition.id in here:
                words = " ".join(label_words(condition.labels))
                raise ConfigError(f"Expected settings that differ, got {words} twice.")
            here.add(condition.id)
            every.append(_as_run_once(condition))
    check_labels(every)
    return merge_alike({condition.id: condition for condition in every}.values())


def merge_alike(conditions: Iterable[Condition]) -> list[Condition]:
    """Merges the conditions that share a `rows_id`; the first of them is run, or that
    under `mean`.
    """
    alike: dict[str, list[Condition]] = defaultdict(list)
    for condition in conditions:
        alike[condition.rows_id].append(condition)
    return [
        merge(next((one for one in same if one.risk.part == "mean"), same[0]), same)
        for same in alike.values()
    ]


def merge(kept: Condition, conditions: Sequence[Condition]) -> Condition:
    """Merges conditions that share a `rows_id` into one that stands for all.

    Args:
        kept: which of them is run.
        conditions: all of them.

    Returns:
        `kept`, labelled as not using what they differ in.
    """
    stands_for: dict[str, tuple[str, ...]] = {}
    for kind in _BEARS_BY:
        own = (
            one.stands_for.get(kind, (getattr(one, kind).label,)) for one in conditions
        )
        labels = itertools.chain.from_iterable(own)
        if len(names := tuple(dict.fromkeys(labels))) > 1:
            stands_for[kind] = names
    parts: dict[str, Any] = {
        kind: replace(getattr(kept, kind), label=NOT_USED) for kind in stands_for
    }
    return replace(kept, stands_for=stands_for, **parts)


def check_labels(conditions: Iterable[Condition]) -> None:
    """Refuses two settings under one label, which no reader of a table could tell
    apart, and two labels of one.

    Args:
        conditions: those that had their labels first come first; one condition may be
            there twice.

    Raises:
        ConfigError: there are such.
    """
    known: dict[tuple[str, str], str] = {}
    labels: dict[tuple[str, str], str] = {}
    for condition in conditions:
        value = condition.value
        described = {name: value.get(name) for name in PART_KINDS} | {
            "world": [value["world"], value["rules"]]
        }
        for name, about in described.items():
            label, digest = condition.labels[name], text_digest(about)
            if label == NOT_USED:
                continue
            if known.setdefault((name, label), digest) != digest:
                raise ConfigError(
                    f"Expected a label for each {name}, got two settings that are "
                    f"both called {label!r}. "
                    f"Write them as {{part: NAME, label: LABEL, options: {{…}}}}."
                )
            first = labels.setdefault((name, digest), label)
            if first != label:
                raise ConfigError(
                    f"Expected one label for one {name}, got {label!r} and {first!r} "
                    "for the same setting. Write "
                    f"label: {first}."
                )


def _product(listed: Mapping[str, list[Any]], scenarios_of: Any) -> Iterator[Condition]:
    scenarios = {
        data: listed["scenarios"] or scenarios_of(data) for data in listed["data"]
    }
    parts = {
        kind: [part for given in listed[f"{kind}s"] for part in read_parts(kind, given)]
        for kind in PART_KINDS
    }
    worlds = [
        read_world(world, task)
        for listed_world in listed["world"]
        for world in each_mapping(listed_world)
        for listed_task in listed["task"]
        for task in each_mapping(listed_task)
    ]
    check_count(
        [sum(map(len, scenarios.values())), len(worlds), *map(len, parts.values())]
    )
    for data in listed["data"]:
        for scenario, (world, rules, label), *chosen in itertools.product(
            scenarios[data], worlds, *(parts[kind] for kind in _ORDER)
        ):
            yield Condition(
                data=data,
                scenario=scenario,
                rules=rules,
                world=world,
                world_label=label,
                **dict(zip(_ORDER, chosen, strict=True)),
            )


def _as_run_once(condition: Condition) -> Condition:
    """One condition for every setting that would change nothing.

    What a blind planner is given is not looked at; of λ that is known every measure of
    risk is λ itself, and nothing is left to be learnt; and a belief that does not learn
    ignores what is sensed of the ground.
    """
    unused = {
        kind: part_of(kind, default, NOT_USED) for kind, default in KNOWLEDGE.items()
    }
    if condition.planner.object.blind or not condition.planner_uses:
        given: dict[str, Any] = {
            **unused,
            "model": ModelPart(part="oracle", label=NOT_USED),
            "risk": ANY_RISK,
        }
        return replace(condition, blind=True, **given)
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
    """The labels of some columns, those that are used."""
    return [labels[name] for name in names if labels[name] != NOT_USED]


def condition_names(conditions: Sequence[Condition]) -> list[str]:
    """Names conditions by scenario, planner, risk setting, and by those other labels
    that differ among them.
    """
    labels = [condition.labels for condition in conditions]
    varying = [
        name
        for name in LABELS
        if name in ("scenario", "planner", "risk")
        or len({one[name] for one in labels} - {NOT_USED}) > 1
    ]
    return [" ".join(label_words(one, varying)) for one in labels]


def differences(one: Any, other: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Where two values of plain data differ: dotted names of options, with both values;
    None where one has none.
    """
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for key in dict.fromkeys([*one, *other]):
            yield from differences(
                one.get(key), other.get(key), f"{name}.{key}".removeprefix(".")
            )
    elif one != other:
        yield name, one, other
