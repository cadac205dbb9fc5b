"""Deep evidential regression: a normal-inverse-gamma distribution over mean and variance
of each cell.

λ is then Student-t with 2α degrees of freedom, location γ and squared scale β (1 + ν) /
(ν α). The prediction is a mixture of Gaussians with a common mean, whose precisions are
weighted by the gamma distribution, clipped to [0, 1]; its CDF is within 10⁻⁴ of that of
the t. The loss is the authors', without censoring. The likelihood does not identify the
epistemic part, β / (ν (α − 1)): the model is a reference row with a known weakness.
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

# Nodes of log precision, in its standard deviations.
_NODES = torch.linspace(-7, 3.5, 20, dtype=torch.float64)
_MIN_EVIDENCE = 1e-3  # of ν and α − 1
_MIN_BETA = 1e-5
_FIRST = (0.5, 0.5413, 0.5413, -2.25)  # γ = 0.5, ν = 1, α = 2, β = 0.1


@dataclass(frozen=True, kw_only=True)
class EvidentialConfig(JoinedConfig):
    """Settings of the network and its training.

    Args:
        regulariser: weight of |λ − γ| (2ν + α), which reduces the evidence if the mean is
            wrong.
    """

    regulariser: float = 0.01

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        expect(
            0 <= self.regulariser < math.inf,
            f"`regulariser` ≥ 0, got {self.regulariser!r}.",
        )


class EvidentialModel(JoinedModel):
    """Evidence of each cell.

    Args:
        config: settings.
    """

    no_graph: ClassVar[str] = "needs the digamma function, which ONNX lacks"

    def __init__(self, config: EvidentialConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """Return numbers for γ = 0.5, ν = 1, α = 2 and β = 0.1."""
        return torch.tensor(_FIRST)

    def to_outputs(self, numbers: Tensor) -> Evidence:
        """Return γ, ν, α and β."""
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
        evidence: γ, ν, α and β.
        observed: λ, NaN if not observed, shape [B, H, W].
        regulariser: its weight.

    Returns:
        Mean over the observed cells, a scalar; 0 without observed cells.
    """
    mean, nu, alpha, beta = (value.squeeze(1) for value in evidence)
    seen = observed.isfinite()
    error = torch.where(seen, observed, 0.5) - mean
    omega = 2 * beta * (1 + nu)
    nll = (
        0.5 * (math.pi / nu).log()
        - alpha * omega.log()
        + (alpha + 0.5) * (nu * error.square() + omega).log()
        + torch.lgamma(alpha)
        - torch.lgamma(alpha + 0.5)
    )
    loss = nll + regulariser * error.abs() * (2 * nu + alpha)
    return torch.where(seen, loss, 0.0).sum() / seen.sum().clamp(min=1)
