"""Recipes: everything that determines a dataset, as data, with its checks.

`benchnav.datagen.recipe.load` reads recipes from YAML files and plain data.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
from numpy import ndarray

from benchnav.core.copula import LONGEST_CORRELATION
from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.core.settings import plain
from benchnav.core.short_repr import short_repr
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
from benchnav.datagen.recipe.scenario import Scenario
from benchnav.datagen.schema import FIELDS, UNLABELLED, Fields, truth_fields

# Maximum fraction of a map in craters. Discs that are placed at random cannot cover
# more than 0.55 without overlap.
_MAX_CRATERED = 0.4
_MIN_GAP = 0.3  # minimum difference of E[λ] between look-alike classes on flat terrain
# Side in metres of the square to which relief and crater counts refer in synthesis 2.
REFERENCE_M = 32.0

# The name of a shard contains map indices of eight digits.
MAX_MAPS = 10**8 - 1
MAX_CELLS = 2**40


@dataclass(frozen=True, kw_only=True)
class Split:
    """Split of a dataset, with the number and kind of its maps.

    Args:
        scenario: name of one of the recipe's scenarios.
        maps: number of maps, ≥ 1; map i has environment i mod the number of
            environments.
        solvable: whether to keep only maps whose goal is reachable, and to store the
            grid reference time.
    """

    scenario: str
    maps: int
    solvable: bool = False

    def __post_init__(self) -> None:
        """Reject empty splits."""
        expect(
            self.maps >= 1,
            f"`maps` ≥ 1 in each split, got {self.maps}. Leave the split out of the "
            "recipe instead.",
        )


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that determines a dataset.

    A recipe yields the same maps on any machine.

    Args:
        id: name and version of the dataset, for example `paper-v1`.
        seed: root seed, in 0–2⁶³ − 1; another seed yields other maps with the same
            class table.
        height: number of rows of a map.
        width: number of columns of a map.
        resolution_m: cell width in metres.
        start_m: (x, y) of the start in metres; None if `places` is given.
        goal_m: (x, y) of the goal in metres; None if `places` is given.
        places: rule that draws start and goal for each map, instead of `start_m` and
            `goal_m`; synthesis 2 only.
        stuck_threshold: λ_stuck in [0, 1); a cell is free if its true E[λ] is greater.
        synthesis: version of the generator. 1 reproduces version 0.1 bit for bit. 2
            adds soft spots, look-alike classes, drawn start and goal, and correlated λ;
            its terrain does not depend on the size of the map.
        correlation_m: correlation length ℓ of stored λ in metres, at most a quarter of
            the map's shorter side: the noise of two cells at distance d has the
            correlation exp(−d²/2ℓ²). At 0, as in synthesis 1, cells are independent.
        layers: further layers, in the order in which they are drawn. `Layer` objects
            are converted to their specs. Synthesis 2 only.
        closed_corners: whether solvable maps and reference times exclude diagonal steps
            between two non-free cells; synthesis 2 only. It is false in the shipped
            recipes and in files of versions before 1.2. In custom recipes of synthesis
            2, it is true by default.
        environments: number of environments; each is a selection of classes.
        occupancy: fraction of a map's cells of each class of an environment; sums to 1.
        class_periods_m: lattice spacings of the class noise in metres, one per octave.
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
        """Reject values that are out of range or contradict each other."""
        object.__setattr__(self, "layers", read_layers(self.layers))
        expect(self.synthesis in (1, 2), f"`synthesis` 1 or 2, got {self.synthesis}.")
        expect(0 <= self.seed < 2**63, f"`seed` in 0–2^63 − 1, got {self.seed}.")
        expect(
            0 <= self.stuck_threshold < 1,
            f"`stuck_threshold` in [0, 1), got {self.stuck_threshold}.",
        )
        check_name("id", self.id)
        _check_start_and_goal(self)
        _check_scenarios(self)
        _check_environments(self)
        _check_splits(self)
        check_tints(self.classes, self.scenarios)
        _check_layers(self)
        if self.synthesis == 1:
            return _check_synthesis_1(self)
        _check_look_alikes(self)
        max_m = LONGEST_CORRELATION * min(self.grid.extent_m)
        expect(
            0 <= self.correlation_m <= max_m,
            f"`correlation_m` in 0–{max_m:g} m (a quarter of the map's shorter side), "
            f"got {self.correlation_m:g} m.",
        )

    @property
    def grid(self) -> Grid:
        """Size and resolution of every map."""
        return Grid(self.height, self.width, self.resolution_m)

    @property
    def fields(self) -> Fields:
        """Fields of a dataset of the recipe's maps."""
        fields = FIELDS | {spec.name: spec.stored_field for spec in self.layers}
        if not any(spec.affects for spec in self.layers):
            return fields
        has_soft_spots = any(item.soft for item in self.classes)
        components = 2 if has_soft_spots else 1
        return fields | truth_fields(components)

    @property
    def class_rows(self) -> list[dict[str, Any]]:
        """Rows of the class table as plain data, with the vegetation of each class."""
        rows = plain(list(self.classes))
        return vegetation.write_classes(rows, self._vegetation)

    @property
    def _vegetation(self) -> vegetation.Vegetation | None:
        layers = [spec.layer for spec in self.layers if spec.is_vegetation]
        if layers and isinstance(layers[0], vegetation.Vegetation):
            return layers[0]
        return None

    def cells_of(self, positions_m: ndarray) -> tuple[ndarray, ndarray]:
        """Return the rows and columns of the cells that contain positions.

        Positions are rounded to single precision, in which they are stored.

        Args:
            positions_m: (x, y) in metres, shape [B, 2].

        Returns:
            Rows and columns, each int64, shape [B].
        """
        cells = positions_m.astype(np.float32) / np.float32(self.resolution_m)
        column, row = np.floor(cells).astype(np.int64).T
        return row.clip(0, self.height - 1), column.clip(0, self.width - 1)

    @cached_property
    def units(self) -> tuple[AlikeClasses, ...]:
        """Groups of class indices of one colour, which environments show together."""
        return tuple(dict.fromkeys(look_alike_classes(self.classes)))

    @cached_property
    def environment_classes(self) -> ndarray:
        """Distinct class indices of each environment, shape [E, len(occupancy)]."""
        shown = len(self.occupancy)
        if self.synthesis == 1:
            return deal_classes(len(self.classes), shown, self.environments)
        return deal_units(self.units, shown, self.environments)

    def craters(self, scenario: Scenario) -> tuple[int, int]:
        """Return the minimum and maximum number of craters on a map.

        In synthesis 2, the scenario's counts refer to 32 m × 32 m and are scaled.
        """
        extent_x, extent_y = self.grid.extent_m
        scale = 1.0
        if self.synthesis == 2:
            scale = extent_x * extent_y / REFERENCE_M**2
        low, high = (round(scale * count) for count in scenario.crater_count)
        return low, high

    def to_dict(self) -> dict[str, Any]:
        """Return the recipe as plain data for JSON, with presets resolved."""
        data: dict[str, Any] = {}
        for name, value in plain(self).items():
            if name == "layers" and self._vegetation is not None:
                data["vegetation_period_m"] = self._vegetation.period_m
            data[name] = value
        data["classes"] = self.class_rows
        data["layers"] = plain([spec for spec in self.layers if not spec.is_vegetation])
        for scenario in data["scenarios"].values():
            if not scenario["tints"]:
                del scenario["tints"]  # earlier versions did not write this key
        unused = ["places"] if self.places is None else ["start_m", "goal_m"]
        if not data["layers"]:
            unused.append("layers")
        if not self.closed_corners:
            unused.append("closed_corners")
        if self.synthesis == 1:
            # Version 0.1 did not write these keys, and its files must not change.
            unused += ["synthesis", "correlation_m"]
            for item in data["classes"]:
                item.pop("soft")
        return {name: value for name, value in data.items() if name not in unused}


def check_name(kind: str, name: str) -> None:
    """Check that a name is valid for files and HDF5 groups.

    Args:
        kind: description of the name, for the message.
        name: name to check.

    Raises:
        ConfigError: If the name is invalid.
    """
    is_plain = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name)
    expect(
        is_plain and name != "manifest",
        f"{kind} of letters, digits, '.', '_' and '-' that begins with a letter or "
        f"digit and is not 'manifest', got {name!r}.",
    )


def _check_start_and_goal(recipe: Recipe) -> None:
    keys = ("start_m", "goal_m", "places")
    names = [name for name in keys if getattr(recipe, name) is not None]
    is_complete = names in (["start_m", "goal_m"], ["places"])
    got = " and ".join(names) or "neither"
    expect(is_complete, f"either `start_m` and `goal_m`, or `places`, got {got}.")
    if recipe.places is not None:
        return check_places(recipe.places, recipe.grid)
    extent_x, extent_y = recipe.grid.extent_m
    positions_m = np.array([recipe.start_m, recipe.goal_m])
    for name, (x, y) in zip(names, positions_m.tolist(), strict=True):
        is_on_map = 0 <= x < extent_x and 0 <= y < extent_y
        expect(
            is_on_map,
            f"`{name}` on the map of {extent_x:g} m × {extent_y:g} m, got ({x}, {y}).",
        )
    start, goal = np.transpose(recipe.cells_of(positions_m)).tolist()
    expect(
        start != goal,
        "`start_m` and `goal_m` in different cells, got both in the cell of "
        f"{recipe.goal_m}.",
    )


def _check_synthesis_1(recipe: Recipe) -> None:
    values: dict[str, Any] = {"soft": any(item.soft for item in recipe.classes)}
    values |= {f"layer {spec.name}": True for spec in recipe.layers}
    for name in ("places", "correlation_m", "closed_corners"):
        values[name] = getattr(recipe, name)
    for name, value in values.items():
        expect(
            not value,
            f"`synthesis: 2` with `{name}`, got `synthesis: 1`, which generates the "
            "maps of version 0.1. Set `synthesis: 2` in the recipe.",
        )


def _check_scenarios(recipe: Recipe) -> None:
    extent_x, extent_y = recipe.grid.extent_m
    used = {split.scenario for split in recipe.splits.values()}
    for name, scenario in recipe.scenarios.items():
        if name not in used:
            continue
        _, max_craters = recipe.craters(scenario)
        _, max_radius_m = scenario.crater_radius_m
        fits = 2 * max_radius_m <= min(extent_x, extent_y)
        expect(
            fits or max_craters == 0,
            f"`crater_radius_m` of scenario {name!r} to be at most half of the shorter "
            f"side of a map of {extent_x:g} m × {extent_y:g} m, got "
            f"{scenario.crater_radius_m}.",
        )
        area_m2 = extent_x * extent_y
        covered = max_craters * scenario.mean_crater_area_m2 / area_m2
        expect(
            covered <= _MAX_CRATERED,
            f"the craters of scenario {name!r} to cover at most {_MAX_CRATERED:.0%} of "
            f"a map, got {covered:.0%}. Craters must fit without overlap. Lower "
            "`crater_count` or `crater_radius_m`.",
        )


def _check_environments(recipe: Recipe) -> None:
    occupancy = recipe.occupancy
    classes = recipe.classes
    periods = recipe.class_periods_m
    expect(
        1 <= len(classes) <= UNLABELLED,
        f"1–{UNLABELLED} classes in `classes`, got {len(classes)}.",
    )
    sums_to_1 = np.isclose(sum(occupancy), 1, atol=1e-6)
    expect(
        sums_to_1 and min(occupancy) > 0,
        f"`occupancy` as fractions > 0 that sum to 1, got {list(occupancy)}.",
    )
    expect(
        len(occupancy) <= len(classes),
        f"at most {len(classes)} fractions in `occupancy`, one per class, got "
        f"{len(occupancy)}.",
    )
    maximum = np.iinfo(FIELDS["environment"].dtype).max
    expect(
        1 <= recipe.environments <= maximum,
        f"`environments` in 1–{maximum}, got {recipe.environments}.",
    )
    are_valid = all(recipe.resolution_m <= period < np.inf for period in periods)
    expect(
        periods and are_valid,
        f"`class_periods_m` as finite lengths of at least {recipe.resolution_m} m (a "
        f"cell), got {list(periods)}.",
    )


def _check_splits(recipe: Recipe) -> None:
    expect(recipe.splits, "at least one split in `splits`, got none.")
    maps = sum(split.maps for split in recipe.splits.values())
    cells = recipe.height * recipe.width
    expect(
        maps <= MAX_MAPS and maps * cells <= MAX_CELLS,
        f"at most {MAX_MAPS:,} maps with at most {MAX_CELLS:,} cells in total, got "
        f"{maps:,} maps of {cells:,} cells each. Lower `maps`.",
    )
    for name, split in recipe.splits.items():
        for part in name.split("/"):
            check_name("split name", part)
        nested = [inner for inner in recipe.splits if inner.startswith(f"{name}/")]
        expect(
            not nested,
            f"names of splits that are not nested, got {nested} inside {name!r}. "
            "Rename one.",
        )
        expect(
            split.scenario in recipe.scenarios,
            f"`scenario` of split {name!r} to be one of {sorted(recipe.scenarios)}, "
            f"got {split.scenario!r}.",
        )


def _check_look_alikes(recipe: Recipe) -> None:
    names = [item.name for item in recipe.classes]
    shown = len(recipe.occupancy)
    flat = np.zeros((len(names), 1, 1))
    class_id = np.arange(len(names)).reshape(flat.shape)
    truth = latent.truth(class_id, flat, recipe.classes)
    means = latent.expected_of(truth).ravel()
    for unit in recipe.units:
        for a, b in combinations(unit, 2):
            gap = abs(means[a] - means[b])
            expect(
                gap >= _MIN_GAP,
                f"classes of the same colour to differ by at least {_MIN_GAP:g} in "
                f"E[λ] on flat terrain, got {means[a]:.3f} for {names[a]!r} and "
                f"{means[b]:.3f} for {names[b]!r}. Change an `offset` or a `colour`.",
            )
    for unit in never_shown(recipe.units, shown):
        members = ", ".join(names[member] for member in unit)
        raise ConfigError(
            f"Expected each class to occur on a map of {shown} classes on which the "
            "classes of one colour occur all together or not at all, got no such map "
            f"for {members}. A map has {shown} classes, as many as `occupancy` has "
            "fractions. Change `occupancy` or a `colour`."
        )


def _check_layers(recipe: Recipe) -> None:
    colours = {}
    for name, scenario in recipe.scenarios.items():
        colours[name] = np.rint(shown_colours(recipe.classes, scenario))
    for spec in recipe.layers:
        # Layers without an object come from a dataset, whose recipe was checked when
        # the dataset was created.
        if spec.is_vegetation or spec.is_built:
            check_layer(spec.layer, recipe.grid, recipe.classes, colours)
