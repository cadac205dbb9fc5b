"""Recipes: everything that fixes a dataset, as data.

A recipe is a YAML file. Shipped ones are named by id (`paper-v1`); a user's own is
named by path.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.copula import LONGEST_CORRELATION
from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.core.settings import changed, plain, read
from benchnav.core.short_repr import short_repr
from benchnav.core.yaml_text import load_yaml, read_yaml
from benchnav.datagen.layers import vegetation
from benchnav.datagen.layers.spec import LayerSpec, read_layers
from benchnav.datagen.layers.stack import check_layer
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.classes import ClassTable, look_alike_classes
from benchnav.datagen.recipe.environments import (
    AlikeClasses,
    deal_classes,
    deal_units,
    never_shown,
)
from benchnav.datagen.recipe.looks import check_tints, shown_colours
from benchnav.datagen.recipe.places import PlacesRule, check_places
from benchnav.datagen.recipe.scenario import (
    DEFAULTS,
    PRESETS,
    RECIPES,
    Scenario,
    load_presets,
    resolve,
)
from benchnav.datagen.schema import FIELDS, UNLABELLED, Fields, truth_fields

_MOST_CRATERED = 0.4  # share of a map; discs laid at random one by one jam at 0.55
_LEAST_GAP = 0.3  # between classes of one colour, in E[λ] on flat ground
REFERENCE_M = (
    32.0  # side of the square that relief and crater counts of synthesis 2 are for
)


# More than a machine makes; a shard's name counts maps in eight digits.
MAX_MAPS = 10**8 - 1
MAX_CELLS = 2**40


@dataclass(frozen=True, kw_only=True)
class Split:
    """One split of a dataset.

    Args:
        scenario: name of one of the recipe's scenarios.
        maps: number of maps; map i shows environment i mod the number of environments.
        solvable: keep only maps whose goal can be reached, and store the grid reference
            time.
    """

    scenario: str
    maps: int
    solvable: bool = False

    def __post_init__(self) -> None:
        """Refuses empty splits."""
        expect(
            self.maps >= 1,
            f"`maps` ≥ 1 in every split, got {self.maps}. Leave the split out instead.",
        )


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that fixes a dataset: same recipe, same maps, on any machine.

    Args:
        id: name and version of the dataset, for example `paper-v1`.
        seed: root seed; another seed makes a sibling with other maps and the same class
            table.
        height: rows of a map.
        width: columns of a map.
        resolution_m: cell width.
        start_m: (x, y) where navigation starts; None where `places` says.
        goal_m: (x, y) where it ends; None where `places` says.
        places: how start and goal are drawn a map, in place of `start_m` and `goal_m`;
            synthesis 2 only.
        stuck_threshold: λ_stuck; a cell is truly free when E[λ] exceeds it.
        synthesis: how maps are made: 1 as by version 0.1, bit for bit, or 2, which
            knows soft spots, classes that look alike, drawn places and correlated λ,
            and makes the same ground at any size.
        correlation_m: ℓ of stored λ: at distance d the noise of two cells has the
            correlation exp(−d²/2ℓ²); at 0, as in synthesis 1, each cell's is its own.
        layers: what else is drawn, in this order; objects of `Layer` become their
            specs. Synthesis 2 only.
        closed_corners: whether a diagonal step between two cells that are not free is
            no way, for solvable maps and reference times. False in the shipped recipes
            and in files of versions before 1.2; in a recipe of synthesis 2 with an id
            of its own true, unless it says otherwise. Synthesis 2 only.
        environments: number of environments; each shows its own choice of classes.
        occupancy: share of the cells that each class of an environment covers, summing
            to 1.
        class_periods_m: lattice spacings of the class noise, one an octave.
        classes: the class table.
        scenarios: scenarios by name.
        splits: splits by name.
    """

    __repr__ = short_repr

    id: str
    seed: int
    height: int
    width: int
    resolution_m: float
    start_m: tuple[float, float] | None = None
    goal_m: tuple[float, float] | None = None
    environments: int
    occupancy: tuple[float, ...]
    class_periods_m: tuple[float, ...]
    classes: ClassTable
    scenarios: dict[str, Scenario]
    splits: dict[str, Split]
    stuck_threshold: float = 0.3
    synthesis: int = 1
    places: PlacesRule | None = None
    correlation_m: float = 0.0
    layers: tuple[LayerSpec, ...] = ()
    closed_corners: bool = False

    def __post_init__(self) -> None:
        """Refuses recipes that contradict themselves."""
        object.__setattr__(self, "layers", read_layers(self.layers))
        expect(self.synthesis in (1, 2), f"`synthesis` 1 or 2, got {self.synthesis}.")
        expect(0 <= self.seed < 2**63, f"`seed` in 0–2^63 − 1, got {self.seed}.")
        expect(
            0 <= self.stuck_threshold < 1,
            f"`stuck_threshold` in [0, 1), got {self.stuck_threshold}.",
        )
        check_name("id", self.id)
        _check_ends(self)
        _check_scenarios(self)
        _check_environments(self)
        _check_splits(self)
        check_tints(self.classes, self.scenarios)
        _check_layers(self)
        if self.synthesis == 1:
            soft = any(item.soft for item in self.classes)
            asked = {
                "soft": soft,
                **{f"layer {spec.name}": True for spec in self.layers},
                "places": self.places,
                "correlation_m": self.correlation_m,
                "closed_corners": self.closed_corners,
            }
            for name, value in asked.items():
                expect(
                    not value,
                    f"`synthesis: 2` with `{name}`, got 1, which makes maps as "
                    "version 0.1 did. "
                    "Set `synthesis: 2` in the recipe.",
                )
            return
        _check_look_alikes(self)
        most_m = LONGEST_CORRELATION * min(self.grid.extent_m)
        expect(
            0 <= self.correlation_m <= most_m,
            f"`correlation_m` in 0–{most_m:g} m, a quarter of the map's shorter side, "
            f"got {self.correlation_m:g}.",
        )

    @property
    def grid(self) -> Grid:
        """Size and resolution of every map."""
        return Grid(self.height, self.width, self.resolution_m)

    @property
    def fields(self) -> Fields:
        """What a dataset of the recipe's maps has of each."""
        components = 2 if any(item.soft for item in self.classes) else 1
        truth = (
            truth_fields(components)
            if any(spec.affects for spec in self.layers)
            else {}
        )
        return FIELDS | {spec.name: spec.stored_field for spec in self.layers} | truth

    @property
    def class_rows(self) -> list[dict[str, Any]]:
        """The class table as plain data, with what grows on the classes."""
        return vegetation.write_classes(plain(list(self.classes)), self._vegetation)

    @property
    def _vegetation(self) -> vegetation.Vegetation | None:
        grown = [spec.layer for spec in self.layers if spec.is_vegetation]
        return (
            grown[0] if grown and isinstance(grown[0], vegetation.Vegetation) else None
        )

    def cells_of(self, positions_m: ndarray) -> tuple[ndarray, ndarray]:
        """Rows and columns of the cells that positions [B, 2] lie in, read in single
        precision as stored.
        """
        column, row = (
            np.floor(positions_m.astype(np.float32) / np.float32(self.resolution_m))
            .astype(np.int64)
            .T
        )
        return row.clip(0, self.height - 1), column.clip(0, self.width - 1)

    @cached_property
    def units(self) -> tuple[AlikeClasses, ...]:
        """Classes that are shown together in synthesis 2: those of one colour, in the
        table's order.
        """
        return tuple(dict.fromkeys(look_alike_classes(self.classes)))

    @cached_property
    def environment_classes(self) -> ndarray:
        """The classes that each environment shows: indices, distinct in a row, shape
        [E, len(occupancy)].
        """
        shown = len(self.occupancy)
        if self.synthesis == 1:
            return deal_classes(len(self.classes), shown, self.environments)
        return deal_units(self.units, shown, self.environments)

    def craters(self, scenario: Scenario) -> tuple[int, int]:
        """Fewest and most craters of a map; in synthesis 2 a scenario's counts are for
        32 m × 32 m.
        """
        extent_x, extent_y = self.grid.extent_m
        share = 1.0 if self.synthesis == 1 else extent_x * extent_y / REFERENCE_M**2
        low, high = (round(share * count) for count in scenario.crater_count)
        return low, high

    def to_dict(self) -> dict[str, Any]:
        """Gives the recipe as plain data for JSON, fully resolved."""
        data: dict[str, Any] = {}
        for name, value in (plain(self) | {"classes": self.class_rows}).items():
            if name == "layers" and self._vegetation is not None:
                data["vegetation_period_m"] = self._vegetation.period_m
            data[name] = value
        data["layers"] = plain([spec for spec in self.layers if not spec.is_vegetation])
        for scenario in data["scenarios"].values():
            if not scenario["tints"]:
                del scenario["tints"]  # as versions without them wrote it
        unused = ["places"] if self.places is None else ["start_m", "goal_m"]
        unused += [] if data["layers"] else ["layers"]
        unused += [] if self.closed_corners else ["closed_corners"]
        if self.synthesis == 1:
            # As version 0.1 wrote it, so that its files and readers stay as they are.
            unused += ["synthesis", "correlation_m"]
            for item in data["classes"]:
                item.pop("soft")
        return {name: value for name, value in data.items() if name not in unused}


def load_recipe(source: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """Reads a recipe by shipped id or by path of a YAML file.

    Args:
        source: id or path.
        overrides: changes `key.key=value`, the value in YAML, such as
            `splits.train.maps=50`; an item of a list goes by its `name`, as in
            `classes.dune_sand.soft.weight=0.2`. What differs needs a name of its own,
            so `id=NAME` has to be among them.

    Raises:
        ConfigError: there is no such recipe, or it is not one; or other maps would bear
            its id.
    """
    path = RECIPES / f"{source}.yaml"
    if not path.exists():
        path = Path(source)
    shipped = shipped_recipes()
    expect(
        path.is_file(),
        f"a shipped recipe ({', '.join(shipped)}) or the path of a YAML file, got "
        f"{str(source)!r}.",
    )
    data = read_yaml(path)
    own = _with_class_table(data)
    for text in overrides:
        name, equals, value = text.partition("=")
        expect(
            equals and all(name.split(".")),
            f"an override such as splits.train.maps=50, got {text!r}.",
        )
        own = changed(own, name.split("."), load_yaml(value))
    if (
        isinstance(own, dict)
        and own.get("synthesis") == 2
        and own.get("id") not in shipped
    ):
        own = {"closed_corners": True, **own}
    recipe = recipe_from_dict(own, str(source))
    expect(
        not overrides or recipe.id != data.get("id"),
        f"`id=NAME` among the overrides, since {recipe.id!r} names the maps of the "
        "recipe as it is.",
    )
    as_shipped = path == RECIPES / f"{recipe.id}.yaml" and not overrides
    expect(
        as_shipped or recipe.id not in shipped or recipe == load_recipe(recipe.id),
        f"an `id` of its own in {source}, got {recipe.id!r}, which names other maps: "
        "a recipe shipped with the package.",
    )
    return recipe


def shipped_recipes() -> list[str]:
    """Ids of the recipes in the package."""
    return sorted(path.stem for path in RECIPES.glob("*.yaml") if path != PRESETS)


def shipped_sizes(recipe: str) -> dict[str, int]:
    """Maps by split of a shipped recipe, read without all that is to be checked of it."""
    splits = read_yaml(RECIPES / f"{recipe}.yaml")["splits"]
    return {split: entry["maps"] for split, entry in splits.items()}


def _with_class_table(data: Any) -> Any:
    """Puts the shipped class table in the place of `default`, or of none."""
    if not isinstance(data, dict) or data.get("classes", "default") != "default":
        return data
    return {**data, "classes": load_presets(data.get("synthesis"))[0]}


def recipe_from_dict(data: Any, origin: str) -> Recipe:
    """Builds a recipe from plain data, resolving presets.

    Args:
        data: a mapping as in a recipe file or a manifest.
        origin: where it came from, for messages.

    Raises:
        ConfigError: a key is unknown or missing, or a value is of the wrong type or out
            of range.
    """
    expect(
        isinstance(data, dict),
        f"a mapping in recipe {origin}, got {type(data).__name__}.",
    )
    data = _with_class_table(data)
    _, presets = load_presets(data.get("synthesis"))
    scenarios = data.get("scenarios", {name: {"preset": name} for name in DEFAULTS})
    if isinstance(scenarios, dict):
        scenarios = {
            name: resolve(entry, presets, name) for name, entry in scenarios.items()
        }
    try:
        growth, data = vegetation.read_keys(data)
        layers = read_layers(data.get("layers", []))
        data["layers"] = read_layers((*([growth] if growth else []), *layers))
        return read(
            Recipe,
            data | {"scenarios": scenarios},
            lambda key: f"`{key}`" if key else "a recipe",
        )
    except ConfigError as error:
        raise ConfigError(f"Recipe {origin}: {error}") from error


def check_name(kind: str, name: str) -> None:
    """Refuses names that would not do as a file's or a group's.

    Raises:
        ConfigError: with `kind` in its message.
    """
    expect(
        re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name) and name != "manifest",
        f"{kind} of letters, digits, '.', '_' and '-', got {name!r}.",
    )


def _check_ends(recipe: Recipe) -> None:
    given = [
        name
        for name in ("start_m", "goal_m", "places")
        if getattr(recipe, name) is not None
    ]
    expect(
        given in (["start_m", "goal_m"], ["places"]),
        "either `start_m` and `goal_m`, or `places`, got "
        f"{' and '.join(given) or 'neither'}.",
    )
    if recipe.places is not None:
        return check_places(recipe.places, recipe.grid)
    extent_x, extent_y = recipe.grid.extent_m
    ends = np.array([recipe.start_m, recipe.goal_m])
    for name, (x, y) in zip(given, ends.tolist(), strict=True):
        expect(
            0 <= x < extent_x and 0 <= y < extent_y,
            f"`{name}` on the map of {extent_x:g} m × {extent_y:g} m, got ({x}, {y}).",
        )
    start, goal = np.transpose(recipe.cells_of(ends)).tolist()
    expect(
        start != goal,
        "`goal_m` in another cell than `start_m`, got both in that of "
        f"{recipe.goal_m}.",
    )


def _check_scenarios(recipe: Recipe) -> None:
    extent_x, extent_y = recipe.grid.extent_m
    used = {split.scenario for split in recipe.splits.values()}
    for name, scenario in recipe.scenarios.items():
        if name not in used:
            continue
        _, most = recipe.craters(scenario)
        expect(
            most == 0 or 2 * scenario.crater_radius_m[1] <= min(extent_x, extent_y),
            f"`crater_radius_m` of scenario {name!r} to fit a map of {extent_x:g} m × "
            f"{extent_y:g} m, "
            f"got {scenario.crater_radius_m}.",
        )
        covered = most * scenario.mean_crater_area_m2 / (extent_x * extent_y)
        expect(
            covered <= _MOST_CRATERED,
            f"the craters of scenario {name!r} to cover at most {_MOST_CRATERED:.0%} "
            "of a map, "
            f"so that they fit side by side, got {covered:.0%}. Lower `crater_count` "
            "or `crater_radius_m`.",
        )


def _check_environments(recipe: Recipe) -> None:
    shares, classes, periods = recipe.occupancy, recipe.classes, recipe.class_periods_m
    expect(
        1 <= len(classes) <= UNLABELLED,
        f"1–{UNLABELLED} classes in `classes`, got {len(classes)}.",
    )
    expect(
        np.isclose(sum(shares), 1, atol=1e-6) and min(shares) > 0,
        f"`occupancy` as shares > 0 summing to 1, got {list(shares)}.",
    )
    expect(
        len(shares) <= len(classes),
        f"at most {len(classes)} shares in `occupancy`, one a class, got "
        f"{len(shares)}.",
    )
    most = np.iinfo(FIELDS["environment"].dtype).max
    expect(
        1 <= recipe.environments <= most,
        f"`environments` in 1–{most}, got {recipe.environments}.",
    )
    expect(
        periods and all(recipe.resolution_m <= period < np.inf for period in periods),
        f"`class_periods_m` of at least a cell, {recipe.resolution_m} m, got "
        f"{list(periods)}.",
    )


def _check_splits(recipe: Recipe) -> None:
    expect(recipe.splits, "at least one split in `splits`, got none.")
    maps, cells = (
        sum(split.maps for split in recipe.splits.values()),
        recipe.height * recipe.width,
    )
    expect(
        maps <= MAX_MAPS and maps * cells <= MAX_CELLS,
        f"at most {MAX_MAPS:,} maps of {MAX_CELLS:,} cells together, got {maps:,} of "
        f"{cells:,}. Ask for fewer `maps`.",
    )
    for name, split in recipe.splits.items():
        for part in name.split("/"):
            check_name("split name", part)
        expect(
            not any(other.startswith(f"{name}/") for other in recipe.splits),
            f"splits side by side, got one inside {name!r}.",
        )
        expect(
            split.scenario in recipe.scenarios,
            f"`scenario` of split {name!r} to be one of {sorted(recipe.scenarios)}, "
            f"got {split.scenario!r}.",
        )


def _check_look_alikes(recipe: Recipe) -> None:
    names, shown = [item.name for item in recipe.classes], len(recipe.occupancy)
    flat = np.zeros((len(names), 1, 1))
    order = np.arange(len(names)).reshape(flat.shape)
    means = latent.expected_of(latent.truth(order, flat, recipe.classes)).ravel()
    for first, second in (
        pair for group in recipe.units for pair in combinations(group, 2)
    ):
        expect(
            abs(means[first] - means[second]) >= _LEAST_GAP,
            f"classes of one colour to differ by at least {_LEAST_GAP:g} in E[λ] on "
            "flat ground, "
            f"got {means[first]:.3f} for {names[first]!r} and {means[second]:.3f} for "
            f"{names[second]!r}. "
            "Change an `offset` or a `colour`.",
        )
    for unit in never_shown(recipe.units, shown):
        raise ConfigError(
            f"Expected classes that can be shown {shown} at a time, one for each "
            "share in `occupancy`, those of one "
            "colour together; got no choice of others that goes with "
            f"{', '.join(names[member] for member in unit)}. Change `occupancy` or a "
            "`colour`."
        )


def _check_layers(recipe: Recipe) -> None:
    colours = {
        name: np.rint(shown_colours(recipe.classes, scenario))
        for name, scenario in recipe.scenarios.items()
    }
    for spec in recipe.layers:
        # Others are of a dataset, whose recipe was checked when it was made.
        if spec.is_vegetation or spec.is_built:
            check_layer(spec.layer, recipe.grid, recipe.classes, colours)
