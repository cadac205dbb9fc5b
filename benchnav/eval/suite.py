"""Evaluation suites: planners × risk settings × scenarios × instances, as data.

This module imports nothing heavy, so that the command's help is quick.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from benchnav.errors import ConfigError

BLOCK_INSTANCES = 20


@dataclass(frozen=True, kw_only=True)
class Suite:
    """What is evaluated.

    Args:
        data: Path or id of a dataset with splits test/SCENARIO.
        model: Checkpoint, by folder or by name in `checkpoints/`, or name of a registered model; `oracle`
            knows the truth.
        planners: Planners by name.
        risks: Risk settings, `name` or `name:level`.
        scenarios: Test splits by scenario.
        instances: Instances a scenario, the first ones of the split; 0 takes all.
        seed: Root seed of all luck.
        noise: `resampled` at each step, or `frozen` at the map's realised traversability.
        time_budget_s: T, the time allotted to an episode.
        planner_options: Changes to the planners' settings, as {planner: {option: value}}.
        recorded: Instances a planner that are recorded for playback, under the first risk setting and
            scenario.
        recording_options: Changes to the planners' settings while recording; they must not change
            what a planner does.
    """

    data: str = "paper-v1"
    model: str = "paper-v1"
    planners: tuple[str, ...] = ("astar_dwa", "cl_rrt", "mppi")
    risks: tuple[str, ...] = ("cvar", "var", "mean", "single-class")
    scenarios: tuple[str, ...] = ("std", "hg", "hs")
    instances: int = 20
    seed: int = 0
    noise: str = "resampled"
    time_budget_s: float = 100.0
    planner_options: dict[str, dict[str, Any]] = field(default_factory=dict)
    recorded: int = 1
    recording_options: dict[str, dict[str, Any]] = field(
        default_factory=lambda: {"mppi": {"drawn_samples": 40}}
    )

    def __post_init__(self) -> None:
        """Refuses suites with nothing in them or with doubles."""
        for name in ("planners", "risks", "scenarios"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise ConfigError(f"Expected `{name}` as one or more different names, got {list(values)}.")
        if self.instances < 0 or self.recorded < 0:
            raise ConfigError(
                f"Expected `instances` and `recorded` ≥ 0, got {self.instances} and {self.recorded}."
            )

    def to_dict(self) -> dict[str, Any]:
        """Gives the suite as plain data for JSON."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}


@dataclass(frozen=True, kw_only=True)
class Unit:
    """A unit of work: one cell's block of instances, always run as one batch.

    Args:
        planner: name of the planner.
        risk: risk setting as text.
        scenario: name of the scenario.
        instances: which instances of the scenario's test split.
        recorded: how many of them, from the first on, are recorded.
    """

    planner: str
    risk: str
    scenario: str
    instances: tuple[int, ...]
    recorded: int = 0

    @property
    def name(self) -> str:
        """A name for files, unique in a suite."""
        return self.episode_name(0)

    def episode_name(self, member: int) -> str:
        """A name for files of one of the unit's episodes."""
        cell = f"{self.planner}+{self.risk}+{self.scenario}".replace(":", "_").replace("/", "_")
        return f"{cell}+{self.instances[member]:05d}"


def units(suite: Suite, sizes: dict[str, int]) -> Iterator[Unit]:
    """Cuts a suite into units of work.

    Args:
        suite: what is evaluated.
        sizes: number of instances in each scenario's test split.
    """
    for scenario in suite.scenarios:
        count = min(suite.instances or sizes[scenario], sizes[scenario])
        for risk in suite.risks:
            for planner in suite.planners:
                for start in range(0, count, BLOCK_INSTANCES):
                    first = start == 0 and risk == suite.risks[0] and scenario == suite.scenarios[0]
                    block = tuple(range(start, min(start + BLOCK_INSTANCES, count)))
                    yield Unit(
                        planner=planner,
                        risk=risk,
                        scenario=scenario,
                        instances=block,
                        recorded=min(suite.recorded, len(block)) if first else 0,
                    )


def containing(
    suite: Suite, sizes: dict[str, int], planner: str, risk: str, scenario: str, instance: int
) -> Unit:
    """Finds the unit that an episode belongs to, set to record up to that instance.

    Raises:
        ConfigError: the suite has no such episode.
    """
    for unit in units(suite, sizes):
        if (unit.planner, unit.risk, unit.scenario) == (
            planner,
            risk,
            scenario,
        ) and instance in unit.instances:
            return replace(unit, recorded=unit.instances.index(instance) + 1)
    raise ConfigError(
        f"Expected an episode of the run, got planner {planner!r}, risk {risk!r}, scenario {scenario!r}, "
        f"instance {instance}. It has planners {list(suite.planners)}, risks {list(suite.risks)}, "
        f"scenarios {list(suite.scenarios)}, and instances 0–{(suite.instances or sizes.get(scenario, 1)) - 1}."
    )
