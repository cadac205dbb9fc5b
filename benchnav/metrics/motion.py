"""Metrics of the observed traversability and of the driven path.

Source: Endo, Honda and Ishigami (2024), IV-A, for the average traversability.
"""

import numpy as np

from benchnav.metrics.base import Episode, Metric


class Traversability(Metric):
    """Mean observed λ."""

    name = column = "traversability"
    words = "λ̄"
    unit = "points"
    scale = 100
    better = "higher"
    heading = "λ̄ [%]"
    meaning = "mean observed λ of an episode"

    def compute(self, episode: Episode) -> float:
        """Return the mean over steps, in [0, 1]."""
        return float(episode.traversability.mean())


class StuckFraction(Metric):
    """Fraction of steps with an observed λ ≤ λ_stuck."""

    name = column = "stuck_share"
    unit = "points"
    scale = 100
    better = "lower"
    heading = "stuck steps [%]"
    meaning = "fraction of steps with observed λ at most `free_space.above`"

    def compute(self, episode: Episode) -> float:
        """Return the fraction, in [0, 1]."""
        return float((episode.traversability <= episode.stuck_traversability).mean())


class PathLength(Metric):
    """Length of the driven path."""

    name = "path_length"
    column = "path_length_m"
    suffix = "_m"
    unit = "m"
    better = "lower"
    meaning = "length of the driven path"
    of_arrivals = True

    def compute(self, episode: Episode) -> float:
        """Return the length in metres."""
        return path_length_m(episode.positions_m)


class Roughness(Metric):
    """Mean change of the commanded turn rate."""

    name = "roughness"
    column = "roughness_radps2"
    suffix = "_radps2"
    unit = "rad/s²"
    better = "lower"
    meaning = "mean change of the commanded turn rate"
    min_steps = 2

    def compute(self, episode: Episode) -> float:
        """Return the mean of |Δω| / Δt in rad/s²."""
        return float(np.abs(np.diff(episode.turn_rate_radps)).mean() / episode.dt_s)


def path_length_m(track: np.ndarray) -> float:
    """Return the length of a driven path in metres.

    Args:
        track: positions (x, y) in metres, shape [N, 2].
    """
    return float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum())
