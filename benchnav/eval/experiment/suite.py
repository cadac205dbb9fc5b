"""Evaluation suites as users write them: what is to be compared, as plain data.

`condition` makes conditions of a suite. This module imports nothing heavy, so that the
command's help is quick.
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

# What a product lists, by the names that a suite has for it.
_LISTED = ("data", "scenarios", *PART_FIELDS, "world", "task")

# What is kept of episodes beside their rows, each with all that stands before it.
Record = Literal["none", "steps", "first", "failures", "all"]
RECORDS: tuple[Record, ...] = get_args(Record)

# More than any study needs; what exceeds them is a slip, and would fill memory before
# anything is run.
MAX_EPISODES = 10**8
MAX_UNITS = 10**6
MAX_CONDITIONS = 10**5

_SEEDS = 2**63  # what a table's column of whole numbers holds


@dataclass(frozen=True, kw_only=True)
class Suite:
    """What is evaluated: the product of everything listed, or of each mapping in
    `conditions`.

    A planner, model, risk measure, robot, objective, sensor, belief, metric or figure
    is given as NAME, package.module:Name, path/to/file.py:Name, or {part: NAME, label:
    LABEL, options: {...}}; in a program also as an object, which is replaced by the
    description that creates it again.

    Args:
        data: Path or id of a dataset with splits test/SCENARIO.
        scenarios: Test splits by scenario; all of the dataset when none is named.
        model: Model, or checkpoint by folder or by name in `checkpoints/`; `oracle` is
            given the true distribution.
        models: Several models; refused with `model`.
        planners: Planners.
        risks: Risk settings, such as `mean` or `cvar:0.9`.
        robots: Robots F.
        objectives: Objectives J.
        sensors: What a robot sees of its map: `full`, all of it before it sets out, or
            `near`, the ground around it.
        grounds: Which λ it senses on its way: `contact`, under it, or `probe`, around
            it.
        beliefs: How measured λ updates the prediction: `static`, not; `copula`, λ of
            nearby cells; `classes`, also which of two look-alike classes cells are of.
        world: What λ does: a preset by name, paper or stakes, or {preset: NAME, noise:
            resampled | stored |
            frozen, correlation_m: 1.5, kernel: gaussian | matern32, immobile: {below:
                0.1, for_s: 2},
            time_budget_s: T or time_budget_ratio: T over the map's reference time}; or
                a list of several.
        task: Changes to the preset's rules: {free_space: {by: risk | mean, above: 0.3},
            min_traversability: 0.3,
            goal_radius_m: 1.0, unseen: prior | optimistic | pessimistic,
                replan_every_s: 0.5}.
        maps: Maps of each scenario, the first of its split; 0 takes all.
        seed: Root seed of all draws.
        seeds: Several root seeds; refused with `seed`.
        realisations: How often λ is drawn for each map and seed.
        record: Kept beside the rows, each with all before it: none; steps of all
            episodes; recordings for playback of each condition's first map; of
            failures; of all episodes.
        conditions: Several products: mappings of the keys above. A key that a mapping
            lacks has its value above.
        hypotheses: Hypotheses, fixed before the first unit is run: mappings of `one`
            and `other`, conditions by their labels, such as {planner: mppi, risk:
            mean}; `metric`: success, T_total, score, traversability, path_length or the
            name of another metric; `kind`: difference, non-inferiority, superiority or
            equivalence;
            `direction`: higher or lower; `margin`.
        metrics: Metrics of episodes besides those that every run has, such as
            energy:120.
        figures: Figures of your own for the report, after the shipped ones.
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
        for name, kind in {
            **PART_FIELDS,
            "metrics": "metric",
            "figures": "figure",
        }.items():
            object.__setattr__(
                self,
                name,
                tuple(_as_plain(kind, given) for given in getattr(self, name)),
            )
        object.__setattr__(self, "model", _as_plain("model", self.model))
        for name in (
            "planners",
            "risks",
            "robots",
            "objectives",
            "sensors",
            "grounds",
            "beliefs",
            "world",
        ):
            if not getattr(self, name):
                raise ConfigError(f"Expected one or more `{name}`, got none.")
        for name in ("model", "seed"):
            value, values = getattr(self, name), getattr(self, f"{name}s")
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
        """The suite as plain data, as `run.json` holds it."""
        return dict(plain(self))

    @property
    def products(self) -> list[dict[str, list[Any]]]:
        """What each product lists, by the field of the suite; the suite's own values
        where it names none.

        Raises:
            ConfigError: If a mapping of `conditions` has an unknown key, or one in the
                singular and in the plural.
        """
        whole = {key: getattr(self, key) for key in _LISTED} | {
            "models": self.models or self.model
        }
        products = []
        for product in self.conditions or ({},):
            listed, spelt = dict(whole), dict[str, str]()
            for given, values in product.items():
                spellings = (given, f"{given}s", str(given).removesuffix("s"))
                key = next((key for key in spellings if key in listed), given)
                check_known("keys of `conditions`", key, listed)
                first = spelt.setdefault(key, given)
                expect(
                    first == given,
                    f"`{first}` or `{given}` in one of `conditions`, got both. Leave "
                    "one out.",
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


def _as_plain(kind: str, given: Any) -> PartSpec:
    """Return what describes a part as text or mapping; an object is described by
    `describe`.
    """
    if isinstance(given, str) or (
        isinstance(given, dict) and isinstance(given.get("part"), str)
    ):
        return given
    if isinstance(given, dict) and "part" in given:
        return {
            **_described(kind, given["part"]),
            **{name: given[name] for name in given if name != "part"},
        }
    return given if isinstance(given, dict) else _described(kind, given)


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
    """Refuse a run that is larger than any study, before anything of it is built.

    Args:
        conditions: their number.
        seeds: root seeds of each.
        realisations: draws of λ for each seed.
        maps: of each draw.
        block_maps: most maps of a unit.

    Raises:
        ConfigError: If it has more than `MAX_EPISODES` episodes or `MAX_UNITS` units.
    """
    draws = conditions * seeds * realisations
    episodes, n_units = draws * maps, draws * -(-maps // block_maps)
    if episodes > MAX_EPISODES or n_units > MAX_UNITS:
        raise ConfigError(
            f"Expected a run of at most {MAX_EPISODES:,} episodes in {MAX_UNITS:,} "
            f"units, got {episodes:,} episodes in "
            f"{n_units:,}: {conditions} conditions × {seeds} seeds × {realisations} "
            f"`realisations` × {maps} `maps`. "
            "Ask for fewer."
        )


@dataclass(frozen=True, kw_only=True)
class Labels:
    """Which conditions of a run are meant, by what its table calls them: of each column
    one label or several.

    Args:
        planner: Planners, with commas between, such as astar_dwa; a part of a file by
            the name of its class. The other labels work alike.
        risk: Risk settings.
        scenario: Scenarios.
        model: Models.
        robot: Robots.
        objective: Objectives.
        sensor: Sensors of appearance.
        ground: Sensors of λ.
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
    def asked(self) -> dict[str, tuple[str, ...]]:
        """Labels by column, of the columns that are named."""
        return {column: labels for column, labels in vars(self).items() if labels}
