"""What colours classes show, and that tints leave look-alikes as the class table has
them.

`Terrain.look_alikes`, what colour can tell at best, goes by the class table. So a tint
may neither make classes alike nor tell those apart that are. Letters in shapes: C
classes.
"""

from collections.abc import Mapping

import numpy as np
from numpy import ndarray

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.datagen.recipe.classes import ClassTable
from benchnav.datagen.recipe.scenario import Scenario


def shown_colours(classes: ClassTable, scenario: Scenario) -> ndarray:
    """Return the colours of classes in full light, tinted: RGB, 0–255, float64, shape
    [C, 3].
    """
    ground = np.array([item.colour for item in classes], dtype=np.float64)
    for tint in scenario.tints:
        changed = [not tint.classes or item.name in tint.classes for item in classes]
        ground[changed] += tint.share * (np.array(tint.colour) - ground[changed])
    return ground


def check_tints(classes: ClassTable, scenarios: Mapping[str, Scenario]) -> None:
    """Check that tints leave look-alike classes as they are.

    Raises:
        ConfigError: If a scenario has other look-alikes than the class table.
    """
    names = [item.name for item in classes]
    table = shown_colours(classes, Scenario())
    for name, scenario in scenarios.items():
        for given in {given for tint in scenario.tints for given in tint.classes}:
            check_known(f"`classes` of a tint of scenario {name!r}", given, names)
        shown = np.rint(shown_colours(classes, scenario))
        for one, other in np.argwhere(_alike(shown) != _alike(table)).tolist():
            is_alike = (shown[one] == shown[other]).all()
            raise ConfigError(
                f"Expected `tints` of scenario {name!r} that leave look-alikes as "
                "they are in the class table, got "
                f"{names[one]!r} and {names[other]!r} in "
                f"{'one colour' if is_alike else 'two colours'}. "
                f"{'Lower a `share`' if is_alike else 'Tint both'}."
            )


def _alike(colours: ndarray) -> ndarray:
    """Whether two of N colours, of shape [N, 3], are the same, bool, shape [N, N]."""
    return (colours[:, None] == colours).all(axis=-1)
