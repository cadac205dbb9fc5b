"""The censored Gaussian: observed traversability is the latent plus Gaussian noise, clipped to [0, 1].

Inside (0, 1) an observation has the Gaussian density; at 0 and 1 it has the probability mass of all
that was clipped there. Source: Tobin (1958), "Estimation of relationships for limited dependent
variables". Letters in shapes: C classes, N observations a class.
"""

import math
from typing import Any

import numpy as np
import torch
from gpytorch.distributions import MultivariateNormal
from gpytorch.likelihoods import GaussianLikelihood
from torch import Tensor

_QUADRATURE_NODES = 12


class CensoredGaussianLikelihood(GaussianLikelihood):
    """A Gaussian likelihood clipped to [0, 1], with noise learned for each class.

    The expected log probability is in closed form inside (0, 1) and by Gauss-Hermite quadrature at 0
    and 1, where the integrand log Φ is smooth.

    Args:
        batch_shape: shape [C] of the classes.
        settings: as of GPyTorch's Gaussian likelihood.
    """

    nodes: Tensor
    shares: Tensor

    def __init__(self, batch_shape: torch.Size, **settings: Any) -> None:
        """Prepares the quadrature."""
        super().__init__(batch_shape=batch_shape, **settings)
        nodes, shares = np.polynomial.hermite_e.hermegauss(_QUADRATURE_NODES)
        self.register_buffer("nodes", torch.from_numpy(nodes), persistent=False)
        self.register_buffer("shares", torch.from_numpy(shares / shares.sum()), persistent=False)

    def expected_log_prob(
        self, target: Tensor, input: MultivariateNormal, *params: Any, **kwargs: Any
    ) -> Tensor:
        """E[log p(target | f)] under f ~ `input`.

        Args:
            target: observed traversability in [0, 1], shape [C, N].
            input: distribution of the latent function at the observations, [C, N].
            params: unused.
            kwargs: unused.

        Returns:
            Shape [C, N].
        """
        mean, variance = input.mean, input.variance.clamp(min=0)
        noise = self.noise.expand_as(mean)
        inside = -0.5 * (((target - mean) ** 2 + variance) / noise + noise.log() + math.log(2 * math.pi))
        clipped = (target <= 0) | (target >= 1)
        at, mean, std, noise_std = (
            target[clipped],
            mean[clipped],
            variance[clipped].sqrt(),
            noise[clipped].sqrt(),
        )
        latent = mean + std * self.nodes.to(mean).unsqueeze(-1)
        beyond = torch.where(at >= 1, latent - 1, -latent) / noise_std
        mass = (self.shares.to(mean).unsqueeze(-1) * torch.special.log_ndtr(beyond)).sum(0)
        return inside.masked_scatter(clipped, mass)
