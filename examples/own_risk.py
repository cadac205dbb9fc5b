"""Custom risk measures: functions of the predicted distribution.

benchnav-eval run --planners '[straight,astar_dwa]' --risks
  '[mean,examples/own_risk.py:worst, {part: examples/own_risk.py:cautious, label: mean -
  2 std, options: {deviations: 2.0}}]' --out runs/risks

To test one, call `benchnav.testing.check_risk("examples/own_risk.py:worst")`.
"""

import torch

from benchnav import ConfigError, TraversabilityDistribution, TraversabilityMixture


def worst(
    distribution: TraversabilityDistribution, min_weight: float = 0.05
) -> torch.Tensor:
    """Return the lowest mean of components with enough weight, shape [B, H, W].

    Args:
        distribution: predicted λ, a mixture.
        min_weight: minimum weight of a component, in [0, 1].

    Raises:
        ConfigError: If the distribution is not a mixture.
    """
    if not isinstance(distribution, TraversabilityMixture):
        raise ConfigError(
            f"Expected a TraversabilityMixture, got a {type(distribution).__name__}. "
            "Use a model that predicts mixtures."
        )
    means = torch.where(distribution.weights >= min_weight, distribution.means, 1.0)
    return means.amin(dim=1).clamp(0, 1)


def cautious(
    distribution: TraversabilityDistribution, deviations: float = 1.0
) -> torch.Tensor:
    """Return the mean minus some standard deviations, shape [B, H, W].

    A standard deviation is half the distance between the 16 % and the 84 % quantile.

    Args:
        distribution: predicted λ.
        deviations: number of standard deviations.
    """
    spread = distribution.quantile(0.84) - distribution.quantile(0.16)
    return (distribution.mean() - deviations * spread / 2).clamp(0, 1)
