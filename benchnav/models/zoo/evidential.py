"""Deep evidential regression: each cell's mean and variance are normal-inverse-gamma.

λ then has a Student-t distribution with 2α degrees of freedom, location γ and squared
scale β (1 + ν) / (ν α). The prediction is a mixture of Gaussians with a common mean and
with precisions weighted by the gamma distribution, clipped to [0, 1]; its CDF differs
from that of the Student-t by at most 10⁻⁴. The loss is that of Amini et al., without
censoring. The likelihood does not identify the epistemic part, β / (ν (α − 1)), so the
model serves only as a baseline.
Sources: Amini et al. (2020), "Deep evidential regression"; Meinert et al. (2023), "The
unreasonable effectiveness of deep evidential regression". Letters in shapes: B maps,
H×W cells, K nodes.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from benchnav.core.errors import expect
from benchnav.core.mixture import TraversabilityMixture
from benchnav.models.config import JoinedConfig
from benchnav.models.nets.joined import JoinedModel
from benchnav.models.nets.trainable import Loss

# γ, ν > 0, α > 1 and β > 0, each of shape [B, 1, H, W].
Evidence = tuple[Tensor, Tensor, Tensor, Tensor]

# Nodes of log precision, in standard deviations from its mean.
_NODES = torch.linspace(-7, 3.5, 20, dtype=torch.float64)
_MIN_EVIDENCE = 1e-3  # minimum of ν and of α − 1
_MIN_BETA = 1e-5
_FIRST = (0.5, 0.5413, 0.5413, -2.25)  # numbers for γ = 0.5, ν = 1, α = 2, β = 0.1


@dataclass(frozen=True, kw_only=True)
class EvidentialConfig(JoinedConfig):
    """Settings of the network and its training.

    Args:
        regulariser: weight of |λ − γ| (2ν + α), which reduces the evidence where the mean
            is wrong; finite, ≥ 0.
    """

    regulariser: float = 0.01

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        expect(
            0 <= self.regulariser < math.inf,
            f"`regulariser` ≥ 0 and finite, got {self.regulariser!r}.",
        )


class EvidentialModel(JoinedModel):
    """Model that predicts γ, ν, α and β of each cell.

    Args:
        config: settings of the model and its training.
    """

    no_graph: ClassVar[str] = "needs the digamma function, which ONNX lacks"

    def __init__(self, config: EvidentialConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """Return numbers for γ = 0.5, ν = 1, α = 2 and β = 0.1."""
        return torch.tensor(_FIRST)

    def to_outputs(self, numbers: Tensor) -> Evidence:
        """Return γ, ν, α and β, each of shape [B, 1, H, W]."""
        mean, *raw = numbers.chunk(4, dim=1)
        nu, alpha, beta = (nn.functional.softplus(value) for value in raw)
        return mean, nu + _MIN_EVIDENCE, alpha + 1 + _MIN_EVIDENCE, beta + _MIN_BETA

    def configure_losses(self) -> Loss:
        """Return the negative log density of the Student-t plus the regulariser."""

        def loss(outputs: Evidence, observed: Tensor) -> Tensor:
            return evidential_loss(outputs, observed, self.config.regulariser)

        return loss

    def to_distribution(self, outputs: Evidence) -> TraversabilityMixture:
        """Return the clipped Student-t as a mixture of K Gaussians."""
        _, nu, alpha, beta = (value.double() for value in outputs)
        # log precision has mean ψ(α) and variance ψ′(α); τ ~ Gamma(α, 1) has density
        # τ^α exp(−τ) over log τ.
        nodes = _NODES.to(nu.device).view(-1, 1, 1)
        log_tau = torch.digamma(alpha) + torch.polygamma(1, alpha).sqrt() * nodes
        weights = (alpha * log_tau - log_tau.exp()).softmax(1)
        stds = (beta * (1 + nu) / nu / log_tau.exp()).sqrt()
        dtype = outputs[0].dtype
        means = outputs[0].expand_as(stds).contiguous()
        return TraversabilityMixture(weights.to(dtype), means, stds.to(dtype))


def evidential_loss(evidence: Evidence, observed: Tensor, regulariser: float) -> Tensor:
    """Return the Student-t's negative log density plus the regulariser (eqs. 8 and 9).

    The regulariser is |λ − γ| (2ν + α).

    Args:
        evidence: γ, ν, α and β, each of shape [B, 1, H, W].
        observed: λ, NaN if not observed, shape [B, H, W].
        regulariser: weight of the regulariser.

    Returns:
        Mean over the observed cells, a scalar; 0 if no cell is observed.
    """
    mean, nu, alpha, beta = (value.squeeze(1) for value in evidence)
    has_value = observed.isfinite()
    error = torch.where(has_value, observed, 0.5) - mean
    omega = 2 * beta * (1 + nu)
    nll = (
        0.5 * (math.pi / nu).log()
        - alpha * omega.log()
        + (alpha + 0.5) * (nu * error.square() + omega).log()
        + torch.lgamma(alpha)
        - torch.lgamma(alpha + 0.5)
    )
    loss = nll + regulariser * error.abs() * (2 * nu + alpha)
    return torch.where(has_value, loss, 0.0).sum() / has_value.sum().clamp(min=1)
