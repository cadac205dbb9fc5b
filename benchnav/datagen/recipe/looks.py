"""What colours cells show, and that no two kinds of ground show one colour but those that are said to look alike.

`Terrain.look_alikes`, what colour can tell at best, goes by the class table. So a tint may neither make classes
alike nor tell those apart that are, and what grows may not tell them apart by its colour or its cover. Its height
may: that is what vegetation shows and colour does not. Letters in shapes: C classes.
"""

from collections.abc import Mapping

import numpy as np
from numpy import ndarray

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.datagen.recipe.classes import ClassTable, TerrainClass, look_alike_classes
from benchnav.datagen.recipe.scenario import Scenario


def shown_colours(classes: ClassTable, scenario: Scenario) -> ndarray:
    """Colours in full light of each class's ground, tinted, and then of what grows on each.

    Returns:
        RGB, 0–255, float64, shape [2·C, 3]; what grows on a class without vegetation has its ground's colour.
    """
    ground = np.array([item.colour for item in classes], dtype=np.float64)
    for tint in scenario.tints:
        changed = [not tint.classes or item.name in tint.classes for item in classes]
        ground[changed] += tint.share * (np.array(tint.colour) - ground[changed])
    grown = ground.copy()
    for number, item in enumerate(classes):
        if item.vegetation:
            grown[number] = item.vegetation.colour
    return np.concatenate([ground, grown])


def check_looks(classes: ClassTable, scenarios: Mapping[str, Scenario]) -> None:
    """Refuses what would make ground look alike, or unlike, against the class table.

    Raises:
        ConfigError: classes of one colour have unlike vegetation, or a scenario has other look-alikes.
    """
    names = [item.name for item in classes]
    for own, alike in zip(classes, look_alike_classes(classes), strict=True):
        first = classes[alike[0]]
        if _looks_of(first) != _looks_of(own):
            raise ConfigError(
                f"Expected `vegetation` of one `colour` and `cover` on {first.name!r} and {own.name!r}, whose ground "
                f"has one colour, got {_looks_of(first)} and {_looks_of(own)}. Only `height_m` may tell them apart."
            )
    grows = np.array([item.vegetation is not None for item in classes])
    table = shown_colours(classes, Scenario())[: len(classes)]
    for name, scenario in scenarios.items():
        for given in {given for tint in scenario.tints for given in tint.classes}:
            check_known(f"`classes` of a tint of scenario {name!r}", given, names)
        shown = np.rint(shown_colours(classes, scenario))
        ground, grown = shown[: len(classes)], shown[len(classes) :]
        for one, other in np.argwhere(_alike(ground, ground) != _alike(table, table)).tolist():
            is_alike = (ground[one] == ground[other]).all()
            raise ConfigError(
                f"Expected `tints` of scenario {name!r} that leave look-alikes as they are in the class table, got "
                f"{names[one]!r} and {names[other]!r} in {'one colour' if is_alike else 'two colours'}. "
                f"{'Lower a `share`' if is_alike else 'Tint both'}."
            )
        for one, other in np.argwhere(_alike(grown, ground) & grows[:, None]).tolist():
            raise ConfigError(
                f"Expected vegetation on {names[one]!r} of a `colour` that no ground has in scenario {name!r}, "
                f"got that of {names[other]!r}."
            )


def _alike(one: ndarray, other: ndarray) -> ndarray:
    """Whether colours, of shapes [N, 3] and [M, 3], are the same, bool, shape [N, M]."""
    return (one[:, None] == other).all(axis=-1)


def _looks_of(item: TerrainClass) -> str:
    """What grows on a class, but for its height."""
    grown = item.vegetation
    return f"{list(grown.colour)} on {grown.cover:.6g}" if grown else "none"
