"""Latent traversability (LT) functions: how a class's traversability falls with slope.

f_c(ψ) = clip(1 − (a_c·10⁻³·ψ^b_c + o_c), 0, 1), ψ in degrees; observed λ = clip(f_c(ψ) + ε_c, 0, 1)
with ε_c zero-mean Gaussian of standard deviation σ_c. Source: paper III-A.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from benchnav.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class TerrainClass:
    """A terrain class: its looks and its LT function.

    Args:
        name: what people call it.
        colour: RGB in full light, 0–255.
        scale: a_c, in [1, 9] in the shipped table.
        exponent: b_c, in [1.4, 2.0] in the shipped table.
        offset: o_c, loss on flat ground, in [0, 0.1] in the shipped table.
        noise: σ_c, in [0.1, 0.2] in the shipped table.
    """

    name: str
    colour: tuple[int, int, int]
    scale: float
    exponent: float
    offset: float
    noise: float

    def __post_init__(self) -> None:
        """Refuses values that make no LT function or no colour."""
        if not all(0 <= value <= 255 for value in self.colour):
            raise ConfigError(f"Expected `colour` of class {self.name!r} in 0–255, got {self.colour}.")
        numbers = (self.scale, self.exponent, self.offset, self.noise)
        if not all(np.isfinite(numbers)) or self.scale < 0 or self.exponent <= 0 or self.noise <= 0:
            raise ConfigError(
                f"Expected `scale` ≥ 0, `exponent` > 0 and `noise` > 0 of class {self.name!r}, "
                f"got {self.scale}, {self.exponent} and {self.noise}."
            )


def latent_mean(class_id: np.ndarray, slope_deg: np.ndarray, classes: tuple[TerrainClass, ...]) -> np.ndarray:
    """f_c(ψ) of each cell, in [0, 1], shape of `class_id`."""
    scale, exponent, offset = (
        np.array([getattr(c, name) for c in classes]) for name in ("scale", "exponent", "offset")
    )
    loss = slope_deg ** np.take(exponent, class_id)
    loss *= np.take(scale * 1e-3, class_id)
    loss += np.take(offset, class_id)
    return np.minimum(np.maximum(1 - loss, 0), 1)


def latent_std(class_id: np.ndarray, classes: tuple[TerrainClass, ...]) -> np.ndarray:
    """σ_c of each cell, shape of `class_id`."""
    return np.take(np.array([c.noise for c in classes]), class_id)


def expected_traversability(mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """E[λ] of the clipped Gaussian N(mean, std), shape of `mean`.

    The integral of 1 − Φ from 0 to 1; `TraversabilityMixture.mean` says the same for mixtures of tensors.
    """
    below = (np.array([[1.0], [0.0]]) - mean.ravel()) / std.ravel()
    integral = below * ndtr(below) + np.exp(-0.5 * below * below) / np.sqrt(2 * np.pi)
    return 1 - std * (integral[0] - integral[1]).reshape(mean.shape)
