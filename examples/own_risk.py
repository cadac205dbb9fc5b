"""Risk measures of one's own: functions of the predicted mixture.

benchnav-eval run --planners '[straight,astar_dwa]' --risks '[mean,examples/own_risk.py:worst,
  {part: examples/own_risk.py:cautious, label: mean - 2 std, options: {deviations: 2.0}}]' --out runs/risks

Its tests need one line, `check_risk("examples/own_risk.py:worst")` of `benchnav.testing`.
"""

import torch

from benchnav import TraversabilityMixture


def worst(mixture: TraversabilityMixture, share: float = 0.05) -> torch.Tensor:
    """Mean of the worst component that has a weight of at least `share`, shape [B, H, W]."""
    means = torch.where(mixture.weights >= share, mixture.means, 1.0)
    return means.amin(dim=1).clamp(0, 1)


def cautious(mixture: TraversabilityMixture, deviations: float = 1.0) -> torch.Tensor:
    """Mean of the mixture less some standard deviations, shape [B, H, W]."""
    mean = (mixture.weights * mixture.means).sum(dim=1)
    square = (mixture.weights * (mixture.means**2 + mixture.stds**2)).sum(dim=1)
    return (mean - deviations * (square - mean**2).clamp(min=0).sqrt()).clamp(0, 1)
