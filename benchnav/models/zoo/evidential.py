"""Deep evidential regression: a normal-inverse-gamma distribution over mean and
variance of each cell.

λ is then Student-t with 2α degrees of freedom about γ, of scale² β (1 + ν) / (ν α). It
is predicted as Gaussians of one mean whose precisions are weighed by the gamma
distribution, and clipped to [0, 1]: within 10⁻⁴ of the t's CDF. The loss is the
authors', which does not censor. Its epistemic share, β / (ν (α − 1)), is not identified
by the likelihood: a reference row of the field with a known weakness.
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

# γ, ν > 0, α > 1 and β > 0, each of shape [B, 1, H, W]
Evidence = tuple[Tensor, Tensor, Tensor, Tensor]

# of log precision, in its standard deviations
_NODES = torch.linspace(-7, 3.5, 20, dtype=torch.float64)
_LEAST = 1e-3  # of ν and α − 1
_LEAST_BETA = 1e-5
_FIRST = (0.5, 0.5413, 0.5413, -2.25)  # γ = 0.5, ν = 1, α = 2, β = 0.1


@dataclass(frozen=True, kw_only=True)
class EvidentialConfig(JoinedConfig):
    """What the network is and how it is trained.

    Args:
        regulariser: weight of |λ − γ| (2ν + α), which takes evidence away where the
            mean is wrong.
    """

    regulariser: float = 0.01

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        super().__post_init__()
        expect(
            0 <= self.regulariser < math.inf,
            f"`regulariser` ≥ 0, got {self.regulariser!r}.",
        )


class EvidentialModel(JoinedModel):
    """Predicts the evidence of every cell.

    Args:
        config: what it is.
    """

    no_graph: ClassVar[str] = "needs the digamma function, which ONNX has not"

    def __init__(self, config: EvidentialConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)

    def first_numbers(self) -> Tensor:
        """γ = 0.5, ν = 1, α = 2 and β = 0.1."""
        return torch.tensor(_FIRST)

    def to_outputs(self, numbers: Tensor) -> Evidence:
        """γ, ν, α and β."""
        mean, *raw = numbers.chunk(4, dim=1)
        nu, alpha, beta = (nn.functional.softplus(value) for value in raw)
        return mean, nu + _LEAST, alpha + 1 + _LEAST, beta + _LEAST_BETA

    def configure_losses(self) -> Loss:
        """The likelihood of the Student-t, and the regulariser."""

        def loss(outputs: Evidence, observed: Tensor) -> Tensor:
            return evidential_loss(outputs, observed, self.config.regulariser)

        return loss

    def to_distribution(self, outputs: Evidence) -> TraversabilityMixture:
        """The Student-t, clipped, as a mixture of K Gaussians."""
        mean, nu, alpha, beta = (value.double() for value in outputs)
        # log precision has mean ψ(α) and variance ψ′(α); τ ~ Gamma(α, 1), of density
        # τ^α exp(−τ) over log τ.
        log_tau = torch.digamma(alpha) + torch.polygamma(1, alpha).sqrt() * _NODES.to(
            mean.device
        ).view(-1, 1, 1)
        weights = (alpha * log_tau - log_tau.exp()).softmax(1)
        stds = (beta * (1 + nu) / nu / log_tau.exp()).sqrt()
        dtype, means = outputs[0].dtype, outputs[0].expand_as(stds).contiguous()
        return TraversabilityMixture(weights.to(dtype), means, stds.to(dtype))


def evidential_loss(evidence: Evidence, observed: Tensor, regulariser: float) -> Tensor:
    """Negative log density of the Student-t, and `regulariser` times |λ − γ| (2ν + α);
    equations 8 and 9.

    Args:
        evidence: γ, ν, α and β.
        observed: λ, and NaN where it was not observed, shape [B, H, W].
        regulariser: its weight.

    Returns:
        Mean over the observed cells, a number; 0 where none was.
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
