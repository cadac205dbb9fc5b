"""Class-wise Gaussian processes: each class's latent traversability as a function of
slope.

The prior of each class's function is a line over slope, 0.5 on flat ground and falling
by 0.03 ± 0.015 a degree unless `LatentGPConfig` says otherwise, plus a Matérn 5/2
process. It says that a robot hardly gains traversability on steeper ground and is
likely to be stuck at thirty-odd degrees, and no more: where a class has no data — it
never occurs, or the slope is steeper than any seen — the GP falls back to this trend
with a spread that grows with slope. The Matérn process keeps a spread of at least 0.3
and a length scale of at most 10°, so that the data say nothing sure about slopes ten
degrees beyond them.

A batch of C independent sparse variational GPs, fitted to all cells at once in bins of
slope. The posterior of the inducing values takes natural gradients, for which a
Gaussian likelihood needs one step; they are not whitened, so that the data hold the
function in place while the kernel changes, and few steps of Rprop settle the kernel and
the noise. Sources: paper III-B; Hensman et al. (2015), "Scalable variational Gaussian
process classification"; Salimbeni et al. (2018), "Natural gradients in practice".
Letters in shapes: C classes, M inducing points, B bins of slope, G nodes of the table.

The likelihood is that of the censored Gaussian: observed traversability is the latent
plus Gaussian noise, clipped to [0, 1]. Inside (0, 1) an observation has the Gaussian
density; at 0 and 1 it has the probability mass of all that was
clipped there. Source: Tobin (1958), "Estimation of relationships for limited dependent
variables".
"""

import math

import gpytorch
import lightning
import numpy as np
import torch
from gpytorch.constraints import Interval
from gpytorch.distributions import MultivariateNormal
from gpytorch.variational import (
    NaturalVariationalDistribution,
    UnwhitenedVariationalStrategy,
)
from torch import Tensor

from benchnav.models.config import LatentGPConfig
from benchnav.models.slope_gp.table import SlopeTable, SoftModes, table_slopes

_SLOPE_UNIT_DEG = 10.0
_LEAST_SPAN_DEG = 5.0
_QUADRATURE_NODES = 12
_NATURAL_RATE, _RPROP_STEP, _RPROP_RANGE = 0.9, 0.1, (1e-6, 0.5)
_NODES, _SHARES = (
    torch.from_numpy(values)
    for values in np.polynomial.hermite_e.hermegauss(_QUADRATURE_NODES)
)


class SlopeGP(gpytorch.models.ApproximateGP):
    """C independent sparse GPs over slope in units of 10°.

    Args:
        inducing: slopes of the inducing points, shape [C, M].
        config: what says their prior.
    """

    def __init__(self, inducing: Tensor, config: LatentGPConfig) -> None:
        """Builds them; `start` puts them at their prior."""
        batch = inducing.shape[:1]
        posterior = NaturalVariationalDistribution(inducing.shape[1], batch)
        points = inducing.unsqueeze(-1)
        strategy = UnwhitenedVariationalStrategy(
            self, points, posterior, learn_inducing_locations=False
        )
        # GPyTorch's own start would draw on the global generator.
        strategy.variational_params_initialized.fill_(1)
        super().__init__(strategy)
        shortest, longest = (
            bound / _SLOPE_UNIT_DEG for bound in config.length_range_deg
        )
        self.matern = gpytorch.kernels.ScaleKernel(
            gpytorch.kernels.MaternKernel(
                nu=2.5,
                batch_shape=batch,
                lengthscale_constraint=Interval(shortest, longest),
            ),
            batch_shape=batch,
            outputscale_constraint=Interval(
                *(std**2 for std in config.prior_std_range)
            ),
        )
        self.matern.base_kernel.lengthscale = config.length_deg / _SLOPE_UNIT_DEG
        self.matern.outputscale = config.prior_std**2
        self.trend = gpytorch.kernels.LinearKernel(batch_shape=batch)
        self.level, self.fall = config.prior_level, config.prior_fall * _SLOPE_UNIT_DEG
        self.trend.variance = (config.prior_fall_std * _SLOPE_UNIT_DEG) ** 2
        self.trend.requires_grad_(False)

    def forward(self, x: Tensor) -> MultivariateNormal:
        """The prior at slopes `x`, shape [C, N, 1]."""
        return MultivariateNormal(
            self.level - self.fall * x[..., 0], self.matern(x) + self.trend(x)
        )

    @torch.no_grad()
    def start(self) -> None:
        """Puts the posterior of the inducing values at their prior."""
        strategy = self.variational_strategy
        mean, precision = self.prior()
        precision = torch.cholesky_inverse(torch.linalg.cholesky(precision))
        strategy._variational_distribution.natural_vec.copy_(
            (precision @ mean.unsqueeze(-1)).squeeze(-1)
        )
        strategy._variational_distribution.natural_mat.copy_(-0.5 * precision)

    def prior(self) -> tuple[Tensor, Tensor]:
        """Mean [C, M] and covariance [C, M, M] of the inducing values."""
        strategy = self.variational_strategy
        prior = self(strategy.inducing_points, prior=True)
        eye = torch.eye(prior.mean.shape[-1]).to(prior.mean)
        return prior.mean, prior.covariance_matrix + strategy.jitter_val * eye


class LatentGPs(lightning.LightningModule):
    """Learns the latent traversability functions of all classes at once.

    Args:
        config: what they are.
        steepest_deg: steepest slope of each class's training data, shape [C]; inducing
            points lie up to there.
        soft: second modes of the classes beside the GPs; None where no class has one.
    """

    def __init__(
        self,
        config: LatentGPConfig,
        steepest_deg: Tensor,
        soft: SoftModes | None = None,
    ) -> None:
        """Builds the GPs at their prior, in float64."""
        super().__init__()
        self.automatic_optimization = False
        self.config, self.soft = config, soft
        self.steepest_deg = [round(slope, 4) for slope in steepest_deg.tolist()]
        reach = torch.tensor(self.steepest_deg, dtype=torch.float64)
        places = torch.linspace(0, 1, config.inducing_points, dtype=torch.float64)
        self.gp = SlopeGP(
            reach.clamp(min=_LEAST_SPAN_DEG).unsqueeze(-1) * places / _SLOPE_UNIT_DEG,
            config,
        )
        self.likelihood = gpytorch.likelihoods.GaussianLikelihood(
            batch_shape=steepest_deg.shape,
            noise_constraint=Interval(*(std**2 for std in config.noise_std_range)),
        )
        self.likelihood.noise = config.noise_std**2
        self.double()
        self.gp.start()

    def configure_optimizers(
        self,
    ) -> tuple[torch.optim.Optimizer, torch.optim.Optimizer]:
        """Natural gradients for the inducing values, Rprop for kernel and noise."""
        natural = gpytorch.optim.NGD(
            self.gp.variational_parameters(), num_data=1, lr=_NATURAL_RATE
        )
        others = [*self.gp.hyperparameters(), *self.likelihood.parameters()]
        return natural, torch.optim.Rprop(
            others, lr=_RPROP_STEP, step_sizes=_RPROP_RANGE
        )

    def forward(self, slope_deg: Tensor) -> MultivariateNormal:
        """The latent functions at slopes of each class, shape [C, N]."""
        return self.gp((slope_deg.double() / _SLOPE_UNIT_DEG).unsqueeze(-1))

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        """Takes one step up the evidence lower bound of each class, over all its cells.

        A class without any is left at its prior. A batch is what `SlopeSums.bins`
        gives.
        """
        bound = self.bound(batch)
        optimizers = self.optimizers()
        assert isinstance(optimizers, list)
        natural, others = optimizers
        self.zero_grad()
        self.manual_backward(-bound.sum())
        natural.step()
        others.optimizer.step()  # past Lightning, which would count a second step
        loss = -bound.detach().sum() / batch["count"].sum().clamp(min=1)
        self.log("loss", loss, on_step=False, on_epoch=True, batch_size=1)

    def bound(self, bins: dict[str, Tensor]) -> Tensor:
        """The evidence lower bound of each class's cells and its noise, shape [C]; 0
        without cells.

        Args:
            bins: from `SlopeSums.bins`.
        """
        latent, noise = self(bins["slope_deg"]), self.likelihood.noise
        fit = expected_log_prob(bins, latent.mean, latent.variance, noise).sum(-1)
        usual, spread = math.log(self.config.noise_std), self.config.noise_spread
        surprise = (0.5 * noise.squeeze(-1).log() - usual) / spread
        divergence = self.gp.variational_strategy.kl_divergence()
        return torch.where(bins["count"] > 0, fit - divergence - 0.5 * surprise**2, 0.0)

    def tabulate(self) -> SlopeTable:
        """Evaluates mean, spread and noise at the nodes of the table, float32."""
        self.eval()
        slopes = table_slopes().to(self.device).expand(len(self.steepest_deg), -1)
        with torch.no_grad():
            latent = self(slopes)
            noise = self.likelihood.noise
            std = (latent.variance.clamp(min=0) + noise).sqrt()
        return SlopeTable(
            mean=latent.mean.float(),
            std=std.float(),
            noise_std=noise.sqrt().squeeze(-1).float(),
            soft=self.soft,
        )

    def to_tensors(self) -> dict[str, Tensor]:
        """Gives the table and all parameters by name, for a checkpoint."""
        state = {f"state.{name}": value for name, value in self.state_dict().items()}
        return {**self.tabulate().to_tensors(), **state}


def expected_log_prob(
    bins: dict[str, Tensor], mean: Tensor, variance: Tensor, noise: Tensor
) -> Tensor:
    """E[log p(observations | f)] under f ~ N(mean, variance), summed over a bin's
    cells.

    In closed form inside (0, 1); by Gauss-Hermite quadrature at 0 and 1, where the
    integrand log Φ is smooth.

    Args:
        bins: from `SlopeSums.bins`.
        mean: of the latent function at the bins, shape [C, B].
        variance: of the latent function there, shape [C, B].
        noise: variance of the noise, shape [C, 1].

    Returns:
        Shape [C, B].
    """
    square = (
        bins["squares"]
        - 2 * mean * bins["total"]
        + bins["inside"] * (mean**2 + variance)
    )
    inside = -0.5 * (
        square / noise + bins["inside"] * (noise.log() + math.log(2 * math.pi))
    )
    shares = (_SHARES / _SHARES.sum()).to(mean).view(-1, 1, 1)
    latent = mean + variance.sqrt() * _NODES.to(mean).view(-1, 1, 1)
    below = torch.special.log_ndtr(-latent / noise.sqrt())
    above = torch.special.log_ndtr((latent - 1) / noise.sqrt())
    return inside + (shares * (bins["zeros"] * below + bins["ones"] * above)).sum(0)
