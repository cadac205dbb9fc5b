"""The contract of risk measures, tried on random mixtures. Letters in shapes: B maps, H×W cells, K components."""

from functools import partial
from typing import Any

import torch

from benchnav.core import registry
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning import risk
from benchnav.testing.breaches import NOTHING, Breaches, close, same

TOLERANCE = 1e-4


def check_risk(measure: Any, device: torch.device | str = "cpu", tolerance: float = TOLERANCE) -> None:
    """Tries whether a risk measure keeps the contract, on mixtures of one component and of three.

    The contract: λ̂ in [0, 1] of shape [B, H, W], floating-point, on the mixture's device; the same when asked again,
    and for a map alone what it is in a batch; the mixture and the global generators left as they were.

    Args:
        measure: a function of a mixture, or the name, file or mapping of one as suites have it, such as `cvar:0.9`.
        device: where the mixtures are.
        tolerance: by how much λ̂ of a map alone and in a batch may differ.

    Raises:
        ConfigError: the measure breaks the contract; every breach is named.
    """
    made = registry.take("risk", measure)
    name = measure if isinstance(measure, str) else getattr(measure, "__name__", type(measure).__name__)
    breaches = Breaches("risk", name)
    for group in ((0,), (0, 1, 0)):
        breaches.place = f"K = {len(group)}"
        mixture = _make_mixture(group, torch.device(device))
        risk_map = breaches.watch("risk", partial(risk.apply, made, mixture), mixture=mixture)
        shape = mixture.weights[:, 0].shape
        if risk_map is NOTHING or not breaches.expect_tensor("λ̂", risk_map, mixture.weights, shape):
            continue
        again = "Expected the same λ̂ when asked again, got another."
        breaches.expect(same(risk.apply(made, mixture), risk_map), again)
        alone = risk.apply(made, mixture.select(torch.tensor([-1], device=risk_map.device)))
        told = "Expected of a map alone the λ̂ that it has in a batch, got another."
        breaches.expect(close(alone, risk_map[-1:], tolerance), told)
    breaches.refuse()


def _make_mixture(group: tuple[int, ...], device: torch.device) -> TraversabilityMixture:
    """Mixtures with means beyond [0, 1] and, in part, without spread, shape [B, K, 8, 11]."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(3, 3, len(group), 8, 11, generator=generator).to(device)
    weights, means, stds = drawn / drawn.sum(2, keepdim=True), 1.4 * drawn - 0.2, 0.3 * drawn
    stds[2, :, :, :2] = 0
    return TraversabilityMixture(weights[0], means[1], stds[2], group)
