"""Energy along the driven path, from the power that a robot's drive draws under slip."""

import numpy as np

from benchnav.core.errors import expect
from benchnav.metrics.base import Episode, Metric


class Energy(Metric):
    """Energy E = ∫ P/λ dt that the drive draws along the path.

    Wheels that turn at the commanded speed u and push with a force F draw the power
    F·u. The robot moves at v = λ·u, because slip is 1 − λ. The power P = F·v = λ·F·u
    moves the robot, and slip dissipates the remaining power. A drive with constant P
    thus draws P/λ. A λ below `min_traversability` counts as `min_traversability`, which
    limits the power. In steps whose action commands no motion, the drive draws no
    power.

    Args:
        power_w: constant power P that moves the robot over terrain, in watts, > 0.
        min_traversability: lower limit of λ in P/λ, in (0, 1].
    """

    name = "energy"
    column = "energy_j"
    suffix = "_j"
    unit = "J"
    meaning = (
        "energy ∫ P/λ dt that the drive draws along the path, with λ limited to at least "
        "`min_traversability`"
    )
    better = "lower"
    of_arrivals = True

    def __init__(self, power_w: float = 100.0, min_traversability: float = 0.1) -> None:
        """Validate the options."""
        expect(
            0 < power_w < np.inf,
            f"`power_w` of metric 'energy' > 0 and finite, got {power_w}.",
        )
        expect(
            0 < min_traversability <= 1,
            "`min_traversability` of metric 'energy' in (0, 1], got "
            f"{min_traversability}.",
        )
        self.power_w = power_w
        self.min_traversability = min_traversability

    def compute(self, episode: Episode) -> float:
        """Return the energy in joules."""
        moves = (episode.speed_mps != 0) | (episode.turn_rate_radps != 0)
        traversability = np.maximum(
            episode.traversability[moves], self.min_traversability
        )
        return float((self.power_w / traversability).sum() * episode.dt_s)
