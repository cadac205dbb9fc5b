"""What a recipe has to keep to: numbers in range, names that are there, ways of making that go together."""

import re
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from benchnav.core.copula import LONGEST_CORRELATION
from benchnav.core.errors import ConfigError
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.environments import never_shown
from benchnav.datagen.recipe.places import check_places
from benchnav.datagen.schema import FIELDS, UNLABELLED

if TYPE_CHECKING:
    from benchnav.datagen.recipe.recipe import Recipe

_MOST_CRATERED = 0.4  # share of a map; discs laid at random one by one jam at 0.55
_LEAST_TWIN_GAP = 0.3  # between classes of one colour, in E[λ] on flat ground


def check_recipe(recipe: "Recipe") -> None:
    """Refuses a recipe that contradicts itself.

    Raises:
        ConfigError: one line that names the key.
    """
    if recipe.synthesis not in (1, 2):
        raise ConfigError(f"Expected `synthesis` 1 or 2, got {recipe.synthesis}.")
    if not 0 <= recipe.seed < 2**63:
        raise ConfigError(f"Expected `seed` in 0–2^63 − 1, got {recipe.seed}.")
    if not 0 <= recipe.stuck_threshold < 1:
        raise ConfigError(f"Expected `stuck_threshold` in [0, 1), got {recipe.stuck_threshold}.")
    _check_places(recipe)
    _check_scenarios(recipe)
    _check_environments(recipe)
    check_name("id", recipe.id)
    _check_splits(recipe)
    if recipe.synthesis == 1:
        _check_first_synthesis(recipe)
    else:
        _check_look_alikes(recipe)
        _check_correlation(recipe)


def check_name(kind: str, name: str) -> None:
    """Refuses names that would not do as a file's or a group's.

    Raises:
        ConfigError: with `kind` in its message.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name) or name == "manifest":
        raise ConfigError(f"Expected {kind} of letters, digits, '.', '_' and '-', got {name!r}.")


def _check_places(recipe: "Recipe") -> None:
    given = [name for name in ("start_m", "goal_m", "places") if getattr(recipe, name) is not None]
    if given not in (["start_m", "goal_m"], ["places"]):
        raise ConfigError(
            f"Expected either `start_m` and `goal_m`, or `places`, got {' and '.join(given) or 'neither'}."
        )
    if recipe.places is not None:
        return check_places(recipe.places, recipe.grid)
    extent_x, extent_y = recipe.grid.extent_m
    for name in ("start_m", "goal_m"):
        x, y = getattr(recipe, name)
        if not (0 <= x < extent_x and 0 <= y < extent_y):
            raise ConfigError(
                f"Expected `{name}` on the map of {extent_x:g} m × {extent_y:g} m, got ({x}, {y})."
            )
    ends = np.array([recipe.start_m, recipe.goal_m])
    if len(np.unique(np.stack(recipe.cells_of(ends), axis=1), axis=0)) == 1:
        raise ConfigError(
            f"Expected `goal_m` in another cell than `start_m`, got both in that of {recipe.goal_m}."
        )


def _check_scenarios(recipe: "Recipe") -> None:
    extent_x, extent_y = recipe.grid.extent_m
    for name, scenario in recipe.scenarios.items():
        most = scenario.crater_count[1] if recipe.synthesis == 1 else recipe.craters(scenario)[1]
        if most > 0 and 2 * scenario.crater_radius_m[1] > min(extent_x, extent_y):
            raise ConfigError(
                f"Expected `crater_radius_m` of scenario {name!r} to fit a map of {extent_x:g} m × {extent_y:g} m, "
                f"got {scenario.crater_radius_m}."
            )
        covered = most * scenario.mean_crater_area_m2 / (extent_x * extent_y)
        if covered > _MOST_CRATERED:
            raise ConfigError(
                f"Expected the craters of scenario {name!r} to cover at most {_MOST_CRATERED:.0%} of a map, "
                f"so that they fit side by side, got {covered:.0%}. Lower `crater_count` or `crater_radius_m`."
            )


def _check_environments(recipe: "Recipe") -> None:
    shares, classes = recipe.occupancy, recipe.classes
    if not classes:
        raise ConfigError("Expected at least one class in `classes`, got none.")
    if not np.isclose(sum(shares), 1, atol=1e-6) or not all(0 < share <= 1 for share in shares):
        raise ConfigError(f"Expected `occupancy` as shares > 0 summing to 1, got {list(shares)}.")
    if len(shares) > len(classes):
        raise ConfigError(
            f"Expected at most {len(classes)} shares in `occupancy`, one a class, got {len(shares)}."
        )
    most = FIELDS["environment"].most
    if not 1 <= recipe.environments <= most:
        raise ConfigError(f"Expected `environments` in 1–{most}, got {recipe.environments}.")
    periods = recipe.class_periods_m
    if not periods or not all(recipe.resolution_m <= period < np.inf for period in periods):
        raise ConfigError(
            f"Expected `class_periods_m` of at least a cell, {recipe.resolution_m} m, got {list(periods)}."
        )
    if len(classes) > UNLABELLED:
        raise ConfigError(f"Expected at most {UNLABELLED} classes, got {len(classes)}.")


def _check_splits(recipe: "Recipe") -> None:
    for split_name in recipe.splits:
        for part in split_name.split("/"):
            check_name("split name", part)
        if any(other.startswith(f"{split_name}/") for other in recipe.splits):
            raise ConfigError(f"Expected splits side by side, got one inside {split_name!r}.")
    if not recipe.splits:
        raise ConfigError("Expected at least one split in `splits`, got none.")
    for name, split in recipe.splits.items():
        if split.scenario not in recipe.scenarios:
            raise ConfigError(
                f"Expected `scenario` of split {name!r} to be one of {sorted(recipe.scenarios)}, "
                f"got {split.scenario!r}."
            )


def _check_first_synthesis(recipe: "Recipe") -> None:
    asked = {
        "soft": any(item.soft for item in recipe.classes),
        "places": recipe.places is not None,
        "correlation_m": recipe.correlation_m != 0,
    }
    for name, given in asked.items():
        if given:
            raise ConfigError(
                f"Expected `synthesis: 2` with `{name}`, got 1, which makes maps as version 0.1 did. "
                "Set `synthesis: 2` in the recipe."
            )


def _check_look_alikes(recipe: "Recipe") -> None:
    names, groups = [item.name for item in recipe.classes], recipe.units
    flat = np.zeros((len(names), 1, 1))
    order = np.arange(len(names)).reshape(flat.shape)
    expected = latent.expected_of(latent.truth(order, flat, recipe.classes)).ravel()
    for first, second in (pair for group in groups for pair in combinations(group, 2)):
        if abs(expected[first] - expected[second]) < _LEAST_TWIN_GAP:
            raise ConfigError(
                f"Expected classes of one colour to differ by at least {_LEAST_TWIN_GAP:g} in E[λ] on flat ground, "
                f"got {expected[first]:.3f} for {names[first]!r} and {expected[second]:.3f} for {names[second]!r}. "
                "Change an `offset` or a `colour`."
            )
    lost = never_shown(groups, len(recipe.occupancy))
    if lost:
        raise ConfigError(
            f"Expected classes that can be shown {len(recipe.occupancy)} at a time, one for each share in "
            f"`occupancy`, those of one colour together; got no choice of others that goes with "
            f"{', '.join(names[member] for member in lost[0])}. Change `occupancy` or a `colour`."
        )


def _check_correlation(recipe: "Recipe") -> None:
    most_m = LONGEST_CORRELATION * min(recipe.grid.extent_m)
    if not 0 <= recipe.correlation_m <= most_m:
        raise ConfigError(
            f"Expected `correlation_m` in 0–{most_m:g} m, a quarter of the map's shorter side, "
            f"got {recipe.correlation_m:g}."
        )
