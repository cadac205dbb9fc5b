"""Evaluation suites as users write them, as plain data.

`condition` derives conditions from a suite. This module imports nothing slow, so that
the command's help is quick.
"""

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from benchnav.core.errors import ConfigError, expect
from benchnav.core.settings import check_known, plain
from benchnav.core.short_repr import short_repr

PartSpec = str | dict[str, Any]

# Fields that list parts of conditions, with their kinds.
PART_FIELDS = {
    "models": "model",
    "planners": "planner",
    "risks": "risk",
    "robots": "robot",
    "objectives": "objective",
    "sensors": "sensor",
    "grounds": "ground",
    "beliefs": "belief",
}

# Fields of a suite whose product is evaluated.
_LISTED = ("data", "scenarios", *PART_FIELDS, "world", "task")

# Data of episodes stored in addition to rows; each level includes the levels before it.
Record = Literal["none", "steps", "first", "failures", "all"]
RECORDS: tuple[Record, ...] = get_args(Record)

# More than any study needs: a larger suite is a mistake that would fill memory.
MAX_EPISODES = 10**8
MAX_UNITS = 10**6
MAX_CONDITIONS = 10**5

_SEEDS = 2**63  # limit of an int64 column


@dataclass(frozen=True, kw_only=True)
class Suite:
    """An evaluation suite: the product of all listed values, or several products.

    A planner, model, risk measure, robot, objective, sensor, belief, metric or figure
    is given as NAME, package.module:Name, path/to/file.py:Name, or {part: NAME, label:
    LABEL, options: {...}}. A program can also give an object; the suite stores the
    description from which the object can be created again.

    Args:
        data: Path or id of a dataset with splits test/SCENARIO.
        scenarios: Test splits by scenario; if empty, all of the dataset.
        model: Model, or checkpoint by folder or by name in `checkpoints/`; `oracle` is
            given the true distribution.
        models: Several models; not together with `model`.
        planners: Planners.
        risks: Risk settings, such as `mean` or `cvar:0.9`.
        robots: Robots F.
        objectives: Objectives J.
        sensors: Appearance sensors: `full` observes the whole map before the start,
            `near` the cells around the robot.
        grounds: Traversability sensors: `contact` measures λ under the robot, `probe`
            also around the robot.
        beliefs: Updates of the prediction by measured λ: `static` updates nothing;
            `copula` updates λ of nearby cells; `classes` also updates the classes of
            look-alike cells.
        world: Draws of λ: a preset by name, paper or stakes, or {preset: NAME, noise:
            resampled | stored | frozen, correlation_m: 1.5, kernel: gaussian |
            matern32, immobile: {below: 0.1, for_s: 2}, time_budget_s: T or
            time_budget_ratio: ratio of T to the map's reference time}; or a list.
        task: Changes to the preset's rules: {free_space: {by: risk | mean, above: 0.3},
            min_traversability: 0.3, goal_radius_m: 1.0, unseen: prior | optimistic |
            pessimistic, replan_every_s: 0.5}.
        maps: Number of maps of each scenario, from the start of its split; 0 for all.
        seed: Root seed of all draws.
        seeds: Several root seeds; not together with `seed`.
        realisations: Number of draws of λ for each map and seed.
        record: Data stored in addition to rows; each level includes the levels before
            it: none; steps, of all episodes; first, recordings of each condition's
            first map; failures, also recordings of failures; all, recordings of all
            episodes.
        conditions: Several products: mappings with the keys above. A missing key takes
            the suite's value.
        hypotheses: Hypotheses, fixed before the first unit is run: mappings of `one`
            and `other`, conditions by their labels, such as {planner: mppi, risk:
            mean}; `metric`: success, T_total, score, traversability, path_length or the
            name of another metric; `kind`: difference, non-inferiority, superiority or
            equivalence; `direction`: higher or lower; `margin`.
        metrics: Metrics of episodes in addition to the built-in ones, such as
            energy:120.
        figures: Custom figures for the report, after the shipped ones.
    """

    __repr__ = short_repr

    data: str = "paper-v1"
    scenarios: tuple[str, ...] = ()
    model: PartSpec = "paper-v1"
    models: tuple[PartSpec, ...] = ()
    planners: tuple[PartSpec, ...] = ("straight", "astar_dwa", "cl_rrt", "mppi")
    risks: tuple[PartSpec, ...] = ("cvar", "var", "mean")
    robots: tuple[PartSpec, ...] = ("unicycle",)
    objectives: tuple[PartSpec, ...] = ("goal_distance",)
    sensors: tuple[PartSpec, ...] = ("full",)
    grounds: tuple[PartSpec, ...] = ("contact",)
    beliefs: tuple[PartSpec, ...] = ("static",)
    world: tuple[PartSpec, ...] | PartSpec = "paper"
    task: dict[str, Any] = field(default_factory=dict)
    maps: int = 20
    seed: int = 0
    seeds: tuple[int, ...] = ()
    realisations: int = 1
    record: Record = "first"
    conditions: tuple[dict[str, Any], ...] = ()
    hypotheses: tuple[dict[str, Any], ...] = ()
    metrics: tuple[PartSpec, ...] = ()
    figures: tuple[PartSpec, ...] = ()

    def __post_init__(self) -> None:
        """Describe objects as plain data, and reject a suite without conditions."""
        kinds = {**PART_FIELDS, "metrics": "metric", "figures": "figure"}
        for name, kind in kinds.items():
            specs = tuple(_as_plain(kind, spec) for spec in getattr(self, name))
            object.__setattr__(self, name, specs)
        object.__setattr__(self, "model", _as_plain("model", self.model))
        for name in (*PART_FIELDS, "world"):
            if name != "models" and not getattr(self, name):
                raise ConfigError(
                    f"Expected one or more `{name}`, got none. Leave the key out for "
                    "its default."
                )
        for name in ("model", "seed"):
            value = getattr(self, name)
            values = getattr(self, f"{name}s")
            if values and value != getattr(Suite, name):
                raise ConfigError(
                    f"Expected `{name}` or `{name}s`, got both, {value!r} and "
                    f"{list(values)}. Leave one out."
                )
        if self.maps < 0:
            raise ConfigError(f"Expected `maps` ≥ 0, got {self.maps}.")
        if self.realisations < 1:
            raise ConfigError(f"Expected `realisations` ≥ 1, got {self.realisations}.")
        for seed in self.all_seeds:
            if not 0 <= seed < _SEEDS:
                raise ConfigError(f"Expected `seed` ≥ 0 and below 2^63, got {seed}.")
        if len(set(self.all_seeds)) != len(self.all_seeds):
            raise ConfigError(f"Expected `seeds` that differ, got {list(self.seeds)}.")
        check_size(1, len(self.all_seeds), self.realisations, max(1, self.maps))
        if self.record not in RECORDS:
            raise ConfigError(
                f"Expected `record` as {', '.join(RECORDS[:-1])} or {RECORDS[-1]}, "
                f"got {self.record!r}."
            )

    @property
    def plain(self) -> dict[str, Any]:
        """The suite as plain data, as in `run.json`."""
        return dict(plain(self))

    @property
    def products(self) -> list[dict[str, list[Any]]]:
        """Listed values by field, for each product; by default the suite's values.

        Raises:
            ConfigError: If a mapping of `conditions` has an unknown key, or a key both
                in the singular and in the plural.
        """
        defaults = {key: getattr(self, key) for key in _LISTED}
        defaults["models"] = self.models or self.model
        products = []
        for product in self.conditions or ({},):
            listed = dict(defaults)
            spelling_of: dict[str, str] = {}
            for spelling, values in product.items():
                spellings = (spelling, f"{spelling}s", str(spelling).removesuffix("s"))
                key = next((key for key in spellings if key in listed), spelling)
                check_known("keys of `conditions`", key, listed)
                first = spelling_of.setdefault(key, spelling)
                expect(
                    first == spelling,
                    f"`{first}` or `{spelling}` in each mapping of `conditions`, got "
                    "both. Leave one out.",
                )
                listed[key] = values
            products.append({key: _as_list(values) for key, values in listed.items()})
        return products

    @property
    def all_seeds(self) -> tuple[int, ...]:
        """The root seeds."""
        return self.seeds or (self.seed,)

    @property
    def draws(self) -> list[tuple[int, int]]:
        """Root seed and realisation of each draw of λ."""
        return [(seed, r) for seed in self.all_seeds for r in range(self.realisations)]


def _as_plain(kind: str, spec: Any) -> PartSpec:
    """Describe a part as text or as a mapping, which `run.json` can store."""
    if isinstance(spec, str):
        return spec
    if not isinstance(spec, dict):
        return _described(kind, spec)
    if "part" not in spec or isinstance(spec["part"], str):
        return spec
    other_keys = {name: value for name, value in spec.items() if name != "part"}
    return {**_described(kind, spec["part"]), **other_keys}


def _described(kind: str, instance: Any) -> dict[str, Any]:
    from benchnav.core.describe import describe
    from benchnav.models.predictor import describe_model

    part = describe_model(instance) if kind == "model" else describe(kind, instance)
    return {"part": part.part, "label": part.label, "options": dict(part.options)}


def _as_list(values: Any) -> list[Any]:
    return list(values) if isinstance(values, list | tuple) else [values]


def check_size(
    conditions: int,
    seeds: int,
    realisations: int,
    maps: int,
    block_maps: int = MAX_EPISODES,
) -> None:
    """Reject a run that is larger than any study needs, before its units are listed.

    Args:
        conditions: number of conditions.
        seeds: number of root seeds.
        realisations: number of draws of λ for each seed.
        maps: number of maps of each draw.
        block_maps: maximum number of maps of a unit.

    Raises:
        ConfigError: If the run has more than `MAX_EPISODES` episodes or `MAX_UNITS`
            units.
    """
    draws = conditions * seeds * realisations
    episodes = draws * maps
    n_units = draws * -(-maps // block_maps)
    if episodes > MAX_EPISODES or n_units > MAX_UNITS:
        raise ConfigError(
            f"Expected a run of at most {MAX_EPISODES:,} episodes in {MAX_UNITS:,} "
            f"units, got {episodes:,} episodes in {n_units:,}: {conditions} conditions "
            f"× {seeds} seeds × {realisations} `realisations` × {maps} `maps`. Reduce "
            "one of these numbers."
        )


@dataclass(frozen=True, kw_only=True)
class Labels:
    """Labels that select conditions of a run: one or several for each column.

    Args:
        planner: Planners, separated by commas, such as astar_dwa; for a planner in a
            file, the name of its class. Other columns are given in the same way.
        risk: Risk settings.
        scenario: Scenarios.
        model: Models.
        robot: Robots.
        objective: Objectives.
        sensor: Appearance sensors.
        ground: Traversability sensors.
        belief: Beliefs.
        world: Worlds.
        data: Datasets.
    """

    planner: tuple[str, ...] = ()
    risk: tuple[str, ...] = ()
    scenario: tuple[str, ...] = ()
    model: tuple[str, ...] = ()
    robot: tuple[str, ...] = ()
    objective: tuple[str, ...] = ()
    sensor: tuple[str, ...] = ()
    ground: tuple[str, ...] = ()
    belief: tuple[str, ...] = ()
    world: tuple[str, ...] = ()
    data: tuple[str, ...] = ()

    @property
    def selected(self) -> dict[str, tuple[str, ...]]:
        """Labels by column, without the columns that select nothing."""
        return {column: labels for column, labels in vars(self).items() if labels}
