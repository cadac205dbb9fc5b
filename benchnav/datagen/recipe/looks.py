"""Tinted colours of classes, and a check that tints preserve look-alikes.

`Terrain.look_alikes`, the best prediction from colours, uses the colours of the class
table. A tint may therefore neither create nor separate look-alike classes. Letters in
shapes: C classes.
"""

from collections.abc import Mapping

import numpy as np
from numpy import ndarray

from benchnav.core.errors import ConfigError
from benchnav.core.settings import check_known
from benchnav.datagen.recipe.classes import ClassTable
from benchnav.datagen.recipe.scenario import Scenario


def shown_colours(classes: ClassTable, scenario: Scenario) -> ndarray:
    """Return the tinted colours of classes in full light.

    Args:
        classes: class table.
        scenario: scenario whose tints apply.

    Returns:
        RGB in 0–255, float64, shape [C, 3].
    """
    colours = np.array([item.colour for item in classes], dtype=np.float64)
    for tint in scenario.tints:
        mask = [not tint.classes or item.name in tint.classes for item in classes]
        difference = np.array(tint.colour) - colours[mask]
        colours[mask] += tint.share * difference
    return colours


def check_tints(classes: ClassTable, scenarios: Mapping[str, Scenario]) -> None:
    """Check that tints preserve look-alike classes.

    Raises:
        ConfigError: If look-alikes of a scenario differ from those of the class table,
            or a scenario tints an unknown class.
    """
    names = [item.name for item in classes]
    untinted = shown_colours(classes, Scenario())
    for name, scenario in scenarios.items():
        for tint in scenario.tints:
            for tinted in tint.classes:
                check_known(f"`classes` of a tint of scenario {name!r}", tinted, names)
        colours = np.rint(shown_colours(classes, scenario))
        differs = _is_alike(colours) != _is_alike(untinted)
        for a, b in np.argwhere(differs).tolist():
            is_alike = (colours[a] == colours[b]).all()
            problem = "the same colour" if is_alike else "different colours"
            remedy = "Lower a `share`" if is_alike else "Tint both"
            raise ConfigError(
                f"Expected `tints` of scenario {name!r} to give classes the same "
                "colour exactly if the class table does, got "
                f"{names[a]!r} and {names[b]!r} in {problem}. {remedy}."
            )


def _is_alike(colours: ndarray) -> ndarray:
    """Return a mask of the equal pairs of N colours [N, 3], bool, shape [N, N]."""
    return (colours[:, None] == colours).all(axis=-1)
