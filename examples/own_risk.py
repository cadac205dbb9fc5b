"""Risk measures of one's own: functions of the predicted distribution.

benchnav-eval run --planners '[straight,astar_dwa]' --risks
  '[mean,examples/own_risk.py:worst, {part: examples/own_risk.py:cautious, label: mean -
  2 std, options: {deviations: 2.0}}]' --out runs/risks

Its tests need one line, `check_risk("examples/own_risk.py:worst")` of
`benchnav.testing`.
"""

import torch

from benchnav import ConfigError, TraversabilityDistribution, TraversabilityMixture


def worst(
    distribution: TraversabilityDistribution, share: float = 0.05
) -> torch.Tensor:
    """Mean of the worst component that has a weight of at least `share`, shape [B, H,
    W]; of mixtures alone.
    """
    if not isinstance(distribution, TraversabilityMixture):
        raise ConfigError(
            f"Expected a TraversabilityMixture, got a {type(distribution).__name__}."
        )
    means = torch.where(distribution.weights >= share, distribution.means, 1.0)
    return means.amin(dim=1).clamp(0, 1)


def cautious(
    distribution: TraversabilityDistribution, deviations: float = 1.0
) -> torch.Tensor:
    """Mean less some standard deviations, by half of what is between the quantiles 0.16
    and 0.84, shape [B, H, W].
    """
    spread = distribution.quantile(0.84) - distribution.quantile(0.16)
    return (distribution.mean() - deviations * spread / 2).clamp(0, 1)
