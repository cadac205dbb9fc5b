"""Terrain classes: colours, and parameters of latent traversability (LT) functions.

In addition to the paper, a class may have soft spots, a second mode of λ that neither
colour nor slope shows, and several classes may have the same colour.
"""

from dataclasses import dataclass

import numpy as np

from benchnav.core.errors import check_label, expect


@dataclass(frozen=True, kw_only=True)
class SoftSpots:
    """Second mode of a class's λ, which no image shows, such as buried loose sand.

    Args:
        weight: fraction of the class's cells, in (0, 1).
        mean: mean of λ in soft spots before clipping, at any slope, in [0, 1].
        std: standard deviation of λ in soft spots before clipping, in (0, 1].
    """

    weight: float
    mean: float
    std: float

    def __post_init__(self) -> None:
        """Reject values out of range."""
        in_range = 0 < self.weight < 1 and 0 <= self.mean <= 1 and 0 < self.std <= 1
        expect(
            in_range,
            "soft spots of `weight` in (0, 1), `mean` in [0, 1] and `std` in (0, 1], "
            f"got {self.weight}, {self.mean} and {self.std}.",
        )


@dataclass(frozen=True, kw_only=True)
class TerrainClass:
    """Terrain class: its colour and its LT function.

    Args:
        name: name of the class.
        colour: RGB in full light, 0–255.
        scale: a_c ≥ 0, factor of the loss on slopes; 1–9 in the shipped table.
        exponent: b_c > 0, exponent of the slope; 1.4–2.0 in the shipped table.
        offset: o_c, loss on flat terrain; 0–0.1 in the shipped table.
        noise: σ_c > 0, standard deviation of λ before clipping; 0.1–0.2 in the shipped
            table.
        soft: soft spots of the class; None for a class without soft spots.
    """

    name: str
    colour: tuple[int, int, int]
    scale: float
    exponent: float
    offset: float
    noise: float
    soft: SoftSpots | None = None

    def __post_init__(self) -> None:
        """Reject an invalid name or colour, and parameters out of range."""
        check_label("`name` of a class", self.name)
        check_colour(f"class {self.name!r}", self.colour)
        numbers = self.scale, self.exponent, self.offset, self.noise
        is_finite = np.isfinite(numbers).all()
        in_range = self.scale >= 0 and self.exponent > 0 and self.noise > 0
        expect(
            is_finite and in_range,
            "finite `scale` ≥ 0, `exponent` > 0, `noise` > 0 and `offset` for class "
            f"{self.name!r}, got `scale` {self.scale}, `exponent` {self.exponent}, "
            f"`noise` {self.noise} and `offset` {self.offset}.",
        )


ClassTable = tuple[TerrainClass, ...]


def look_alike_classes(classes: ClassTable) -> list[tuple[int, ...]]:
    """Return, for each class, the indices of all classes of its colour, itself too."""
    by_colour: dict[tuple[int, int, int], tuple[int, ...]] = {}
    for class_id, item in enumerate(classes):
        by_colour[item.colour] = (*by_colour.get(item.colour, ()), class_id)
    return [by_colour[item.colour] for item in classes]


def check_colour(owner: str, colour: tuple[int, int, int]) -> None:
    """Check that the channels of a colour are in 0–255.

    Args:
        owner: description of what has the colour, for the message.
        colour: RGB.

    Raises:
        ConfigError: If a channel is not in 0–255.
    """
    expect(
        all(0 <= value <= 255 for value in colour),
        f"channels of `colour` of {owner} in 0–255, got {colour}.",
    )
