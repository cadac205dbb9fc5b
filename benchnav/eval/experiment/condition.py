"""Conditions: the cell of an experiment as a value, and how a suite becomes a list of them.

A condition says which data split, model, risk setting, planner, robot, objective, rules and world. Its id is
the digest of that value; its labels are for people. Seeds, realisations and maps are how often a condition
is run, and belong to the suite.
"""

import hashlib
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.registry import Part
from benchnav.core.settings import of, read
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.sweep import each_mapping, each_part
from benchnav.planning.free_space import Rules
from benchnav.planning.problem import Task
from benchnav.planning.risk import RiskMeasure
from benchnav.planning.world.world import World, read_world

PART_KINDS = ("model", "risk", "planner", "robot", "objective")
# Columns of `Condition.labels`, in the order of tables.
LABELS = ("data", "scenario", "world", "robot", "objective", "model", "planner", "risk")
NOT_USED = "–"

# What the mappings of `conditions` may hold, with the other way to write it.
_KEYS = {
    **{"data": "datas", "scenarios": "scenario", "models": "model", "risks": "risk", "planners": "planner"},
    **{"robots": "robot", "objectives": "objective", "world": "worlds", "task": "tasks"},
}
_SINGULAR = {other: key for key, other in _KEYS.items()}


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
        rules: free space, least λ̂, goal radius.
        world: what λ does.
        world_label: what tables call rules and world.
        blind: the planner is blind; model and risk stand in for any.
    """

    data: str
    scenario: str
    model: Part
    risk: Part
    planner: Part
    robot: Part
    objective: Part
    rules: Rules
    world: World
    world_label: str
    blind: bool = False

    @property
    def split(self) -> str:
        """Name of the data's split."""
        return f"test/{self.scenario}"

    @property
    def value(self) -> dict[str, Any]:
        """All that bears on the condition's rows, as plain data; no labels."""
        parts = {kind: getattr(self, kind) for kind in PART_KINDS}
        return {
            "data": self.data,
            "split": self.split,
            **{kind: {"part": part.part, "options": dict(part.options)} for kind, part in parts.items()},
            "rules": asdict(self.rules),
            "world": self.world.to_dict(),
        }

    @property
    def id(self) -> str:
        """Digest of the value, 16 hexadecimal digits."""
        text = json.dumps(self.value, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def labels(self) -> dict[str, str]:
        """What tables call it, by column."""
        parts = {kind: getattr(self, kind).label for kind in PART_KINDS}
        if self.blind:
            parts |= {"model": NOT_USED, "risk": NOT_USED}
        return {"data": self.data, "scenario": self.scenario, **parts, "world": self.world_label}

    def make_task(self) -> Task:
        """Makes the robot, the objective and with them the task."""
        robot = registry.make("robot", self.robot)
        objective = registry.make(
            "objective", self.objective, robot=robot, goal_radius_m=self.rules.goal_radius_m
        )
        return Task(robot=robot, objective=objective, rules=self.rules)

    def make_planner(self) -> Any:
        """Makes the planner."""
        return registry.make("planner", self.planner)

    def make_model(self) -> Any:
        """Makes the model, or loads its checkpoint."""
        from benchnav.models.predictor import load_model

        return load_model(self.model)

    def make_risk(self) -> RiskMeasure:
        """Makes the risk measure."""
        return registry.make("risk", self.risk)


def condition_from(about: Mapping[str, Any]) -> Condition:
    """Rebuilds a condition from its `value` and `labels`, as `run.json` holds them."""
    value, labels = about["value"], about["labels"]
    parts = {
        kind: Part(part=value[kind]["part"], label=labels[kind], options=value[kind]["options"])
        for kind in PART_KINDS
    }
    return Condition(
        data=value["data"],
        scenario=value["split"].removeprefix("test/"),
        **parts,
        rules=read(Rules, value["rules"], of("rules")),
        world=read(World, {"time_budget_s": None} | value["world"], of("world")),
        world_label=labels["world"],
        blind=labels["model"] == NOT_USED,
    )


def conditions_of(suite: Suite, scenarios_of: Any) -> list[Condition]:
    """Lists the conditions of a suite, in the order of tables.

    Args:
        suite: what is evaluated.
        scenarios_of: gives the scenarios of a dataset's test splits, from its path or id.

    Raises:
        ConfigError: a part cannot be had as asked for, two parts share a label, or one is there twice.
    """
    _check_options_used(suite)
    every: list[Condition] = []
    for product in suite.conditions or ({},):
        here: set[str] = set()
        for condition in _product(suite, product, scenarios_of):
            if condition.id in here and condition.risk.label != NOT_USED:
                raise ConfigError(f"Expected settings that differ, got twice what {_words(condition)} is.")
            here.add(condition.id)
            every.append(condition)
    check_labels(every)
    return list({condition.id: condition for condition in every}.values())


def check_labels(conditions: Iterable[Condition]) -> None:
    """Refuses two settings under one label, which no reader of a table could tell apart, and two labels of one.

    Args:
        conditions: those that had their labels first come first; one condition may be there twice.

    Raises:
        ConfigError: there are such.
    """
    known: dict[tuple[str, str], Any] = {}
    labels: dict[tuple[str, str], str] = {}
    for condition in conditions:
        for name, label in condition.labels.items():
            if label == NOT_USED:
                continue
            value = _labelled(condition, name)
            if known.setdefault((name, label), value) != value:
                raise ConfigError(
                    f"Expected a label for each {name}, got two settings that are both called {label!r}. "
                    f"Write them as {{part: NAME, label: LABEL, options: {{…}}}}."
                )
            first = labels.setdefault((name, repr(value)), label)
            if value is not None and first != label:
                raise ConfigError(
                    f"Expected one label for one {name}, got {label!r} for what is called {first!r}. Write "
                    f"label: {first}."
                )


def _product(suite: Suite, product: Mapping[str, Any], scenarios_of: Any) -> Iterator[Condition]:
    given = {}
    for key, values in product.items():
        key = _SINGULAR.get(key, key)
        if key not in _KEYS:
            known = [*_KEYS, *_SINGULAR]
            raise ConfigError(
                f"Expected keys of `conditions` among {', '.join(_KEYS)}, got {key!r}.{registry.hint(key, known)}"
            )
        given[key] = values if isinstance(values, list | tuple) else [values]

    def chosen(key: str, default: Sequence[Any]) -> Sequence[Any]:
        return given.get(key, default)

    parts = {
        "model": chosen("models", suite.models or (suite.model,)),
        "risk": chosen("risks", suite.risks),
        "planner": chosen("planners", suite.planners),
        "robot": chosen("robots", suite.robots),
        "objective": chosen("objectives", suite.objectives),
    }
    ready = {
        kind: [part for given in listed for part in _parts(kind, given, suite)]
        for kind, listed in parts.items()
    }
    worlds = [
        _world(suite, world, task)
        for listed_world in chosen(
            "world", suite.world if isinstance(suite.world, list | tuple) else (suite.world,)
        )
        for world in each_mapping(listed_world)
        for listed_task in chosen("task", (suite.task,))
        for task in each_mapping(listed_task)
    ]
    for data in chosen("data", (suite.data,)):
        for scenario, (world, rules, label), robot, objective, model, risk, planner in itertools.product(
            chosen("scenarios", suite.scenarios) or scenarios_of(data),
            worlds,
            *(ready[kind] for kind in ("robot", "objective", "model", "risk", "planner")),
        ):
            condition = Condition(
                data=data, scenario=scenario, model=model, risk=risk, planner=planner, robot=robot,
                objective=objective, rules=rules, world=world, world_label=label,
            )  # fmt: skip
            yield _as_run_once(condition)


def _parts(kind: str, given: Any, suite: Suite) -> list[Part]:
    """What is given as one part: several where options are given lists of values."""
    part = registry.read_part(kind, given)
    if kind == "model" and part.part not in registry.names("model") and ":" not in part.part:
        return [read_model(part)]
    if kind == "planner" and part.part in suite.planner_options:
        part = replace(part, options={**suite.planner_options[part.part], **part.options})
    every = each_part(kind, part)
    made = [read_model(one) if kind == "model" else registry.complete(kind, one) for one in every]
    for one in made if kind == "risk" else ():
        _check_risk(one)
    return made


def _check_risk(part: Part) -> None:
    """Lets a shipped risk measure refuse its options, on one cell, also where no condition uses it."""
    measure = registry.make("risk", part)
    if registry.find("risk", part.part).shipped:
        cell = torch.full((1, 1, 1, 1), 0.5)
        measure(TraversabilityMixture(torch.ones_like(cell), cell, cell, (0,)))


def read_model(given: Any) -> Part:
    """Reads a model: a registered one, or a checkpoint, which has no options.

    Raises:
        ConfigError: there is no such model, or it is refused its options.
    """
    from benchnav.models.base import is_family
    from benchnav.models.predictor import find_checkpoint, load_model

    part = registry.read_part("model", given)
    if part.part in registry.names("model") or ":" in part.part:
        if is_family(registry.find("model", part.part).target):
            load_model(part)  # says what to name in place of a family
        return registry.complete("model", part)
    find_checkpoint(part.part)
    if part.options:
        raise ConfigError(f"Expected no options for the checkpoint {part.part!r}, got {dict(part.options)}.")
    return replace(part, label=Path(part.part).name) if part.label == part.part else part


def _check_options_used(suite: Suite) -> None:
    """Refuses options of planners that no product names, such as a mistyped one."""
    listed: list[Any] = []
    for product in suite.conditions or ({},):
        given = next((product[key] for key in ("planners", "planner") if key in product), suite.planners)
        listed += given if isinstance(given, list | tuple) else [given]
    known = list(dict.fromkeys(registry.read_part("planner", part).part for part in listed))
    for name in suite.planner_options:
        if name not in known:
            raise ConfigError(
                f"Expected `planner_options` of planners of the suite, {', '.join(known)}, got {name!r}."
                f"{registry.hint(name, known)}"
            )


def _world(suite: Suite, world: Any, task: Any) -> tuple[World, Rules, str]:
    """The world and rules of a product, with the suite's short forms where it names none itself."""
    if suite.noise == "frozen":
        raise ConfigError(
            "Expected `noise` 'resampled' or 'stored', got 'frozen', which is now 'stored': the map's own λ. "
            "For λ drawn once an episode say `world.noise` frozen, or take the world stakes."
        )
    short: dict[str, Any] = {"noise": suite.noise} if suite.noise else {}
    if suite.time_budget_s:
        short["time_budget_s"] = suite.time_budget_s
    return read_world(world, task, short)


def _as_run_once(condition: Condition) -> Condition:
    """One condition for every setting that would change nothing.

    What a blind planner is given is not looked at; and of λ that is known every measure of risk is λ itself.
    """
    any_risk = Part(part="mean", label=NOT_USED)
    if condition.make_planner().blind:
        return replace(condition, model=Part(part="oracle", label=NOT_USED), risk=any_risk, blind=True)
    if condition.model.part != "clairvoyant":
        return condition
    if condition.world.noise == "resampled":
        raise ConfigError(
            f"Expected a world whose λ can be known for the model 'clairvoyant', got {condition.world_label!r}, where "
            "it is resampled at each step. Take the world stakes, or `world.noise` frozen or stored."
        )
    return replace(condition, risk=any_risk)


def _labelled(condition: Condition, name: str) -> Any:
    if name == "world":
        return condition.world, condition.rules
    return condition.value[name] if name in PART_KINDS else None


def _words(condition: Condition) -> str:
    return ", ".join(
        f"{condition.labels[name]}" for name in ("scenario", "model", "planner", "risk", "world")
    )
