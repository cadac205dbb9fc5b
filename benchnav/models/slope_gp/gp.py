"""Class-wise Gaussian processes: latent traversability of a class as a function of slope.

The prior of each class's function is a line over slope plus a Matérn 5/2 process. By
default (`LatentGPConfig`) the line is 0.5 on flat terrain and falls by 0.03 ± 0.015 per
degree. This states only that traversability hardly rises with slope and that a robot is
likely to be immobilised beyond about 30°. Where a class has no data, because it never
occurs or the slope is steeper than all observed slopes, the GP follows this trend, with
a spread that grows with slope. The Matérn process has a standard deviation of at least
0.3 and a length scale of at most 10°. The data therefore do not determine the function
at slopes more than ten degrees beyond the data.

A batch of C independent sparse variational GPs is fitted to all cells at once, in bins
of slope. The posterior of the inducing values is fitted by natural gradient steps; with a
Gaussian likelihood one step suffices. Kernel and noise are fitted by a few steps of
Rprop. The inducing values are not whitened, so that the function remains close to the
data while the kernel changes.

The likelihood is that of the censored Gaussian: observed traversability is the latent
function plus Gaussian noise, clipped to [0, 1]. In (0, 1) an observation has the
Gaussian density; at 0 and 1 it has the probability mass that was clipped there.

Sources: paper III-B; Hensman et al. (2015), "Scalable variational Gaussian process
classification"; Salimbeni et al. (2018), "Natural gradients in practice"; Tobin (1958),
"Estimation of relationships for limited dependent variables". Letters in shapes: C
classes, M inducing points, B bins of slope, G nodes of the table.
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
_MIN_SPAN_DEG = 5.0  # minimum range of the inducing points
_QUADRATURE_NODES = 12
_NATURAL_RATE = 0.9  # step size of the natural gradient
_RPROP_STEP = 0.1  # initial step size
_RPROP_RANGE = (1e-6, 0.5)  # minimum and maximum step size
_QUADRATURE = np.polynomial.hermite_e.hermegauss(_QUADRATURE_NODES)
_NODES = torch.from_numpy(_QUADRATURE[0])
_WEIGHTS = torch.from_numpy(_QUADRATURE[1])


class SlopeGP(gpytorch.models.ApproximateGP):
    """C independent sparse GPs over slope in units of 10°.

    Args:
        inducing: slopes of the inducing points, in units of 10°, shape [C, M].
        config: settings of the GPs.
    """

    def __init__(self, inducing: Tensor, config: LatentGPConfig) -> None:
        """Build the GPs; `start` sets them to their prior."""
        batch = inducing.shape[:1]
        posterior = NaturalVariationalDistribution(inducing.shape[1], batch)
        points = inducing.unsqueeze(-1)
        strategy = UnwhitenedVariationalStrategy(
            self, points, posterior, learn_inducing_locations=False
        )
        # GPyTorch's initialisation would draw from the global generator.
        strategy.variational_params_initialized.fill_(1)
        super().__init__(strategy)
        length_range = (bound / _SLOPE_UNIT_DEG for bound in config.length_range_deg)
        variance_range = (std**2 for std in config.prior_std_range)
        base_kernel = gpytorch.kernels.MaternKernel(
            nu=2.5,
            batch_shape=batch,
            lengthscale_constraint=Interval(*length_range),
        )
        self.matern = gpytorch.kernels.ScaleKernel(
            base_kernel,
            batch_shape=batch,
            outputscale_constraint=Interval(*variance_range),
        )
        self.matern.base_kernel.lengthscale = config.length_deg / _SLOPE_UNIT_DEG
        self.matern.outputscale = config.prior_std**2
        self.trend = gpytorch.kernels.LinearKernel(batch_shape=batch)
        self.level = config.prior_level
        self.fall = config.prior_fall * _SLOPE_UNIT_DEG
        self.trend.variance = (config.prior_fall_std * _SLOPE_UNIT_DEG) ** 2
        self.trend.requires_grad_(False)

    def forward(self, x: Tensor) -> MultivariateNormal:
        """Return the prior at slopes `x`, in units of 10°, shape [C, N, 1]."""
        mean = self.level - self.fall * x[..., 0]
        return MultivariateNormal(mean, self.matern(x) + self.trend(x))

    @torch.no_grad()
    def start(self) -> None:
        """Set the posterior of the inducing values to their prior."""
        posterior = self.variational_strategy._variational_distribution
        mean, covariance = self.prior()
        precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
        natural_vec = (precision @ mean.unsqueeze(-1)).squeeze(-1)
        posterior.natural_vec.copy_(natural_vec)
        posterior.natural_mat.copy_(-0.5 * precision)

    def prior(self) -> tuple[Tensor, Tensor]:
        """Return mean [C, M] and covariance [C, M, M] of the inducing values."""
        strategy = self.variational_strategy
        prior = self(strategy.inducing_points, prior=True)
        eye = torch.eye(prior.mean.shape[-1]).to(prior.mean)
        return prior.mean, prior.covariance_matrix + strategy.jitter_val * eye


class LatentGPs(lightning.LightningModule):
    """Latent traversability functions of all classes, trained together.

    Args:
        config: settings of the GPs.
        steepest_deg: steepest slope of each class's training data, shape [C]; the
            inducing points cover [0, `steepest_deg`].
        soft: second modes of the classes; None if no class has one.
    """

    def __init__(
        self,
        config: LatentGPConfig,
        steepest_deg: Tensor,
        soft: SoftModes | None = None,
    ) -> None:
        """Build the GPs at their prior, in float64."""
        super().__init__()
        self.automatic_optimization = False
        self.config = config
        self.soft = soft
        self.steepest_deg = [round(slope, 4) for slope in steepest_deg.tolist()]
        steepest = torch.tensor(self.steepest_deg, dtype=torch.float64)
        span = steepest.clamp(min=_MIN_SPAN_DEG).unsqueeze(-1)
        positions = torch.linspace(0, 1, config.inducing_points, dtype=torch.float64)
        self.gp = SlopeGP(span * positions / _SLOPE_UNIT_DEG, config)
        variance_range = (std**2 for std in config.noise_std_range)
        self.likelihood = gpytorch.likelihoods.GaussianLikelihood(
            batch_shape=steepest_deg.shape,
            noise_constraint=Interval(*variance_range),
        )
        self.likelihood.noise = config.noise_std**2
        self.double()
        self.gp.start()

    def configure_optimizers(
        self,
    ) -> tuple[torch.optim.Optimizer, torch.optim.Optimizer]:
        """Return natural gradient descent for inducing values, Rprop for kernel and noise."""
        natural = gpytorch.optim.NGD(
            self.gp.variational_parameters(), num_data=1, lr=_NATURAL_RATE
        )
        hyperparameters = [*self.gp.hyperparameters(), *self.likelihood.parameters()]
        rprop = torch.optim.Rprop(
            hyperparameters, lr=_RPROP_STEP, step_sizes=_RPROP_RANGE
        )
        return natural, rprop

    def forward(self, slope_deg: Tensor) -> MultivariateNormal:
        """Return the latent functions at slopes in degrees per class, shape [C, N]."""
        return self.gp((slope_deg.double() / _SLOPE_UNIT_DEG).unsqueeze(-1))

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        """Take one step that increases the evidence lower bound of each class.

        A class without cells remains at its prior.

        Args:
            batch: result of `SlopeSums.bins` for all cells.
            batch_index: not used.
        """
        bound = self.bound(batch)
        optimizers = self.optimizers()
        assert isinstance(optimizers, list)
        natural, rprop = optimizers
        self.zero_grad()
        self.manual_backward(-bound.sum())
        natural.step()
        rprop.optimizer.step()  # not through Lightning, which would count a second step
        loss = -bound.detach().sum() / batch["count"].sum().clamp(min=1)
        self.log("loss", loss, on_step=False, on_epoch=True, batch_size=1)

    def bound(self, bins: dict[str, Tensor]) -> Tensor:
        """Return the evidence lower bound with the prior of the noise, shape [C].

        The bound is 0 for a class without cells.

        Args:
            bins: result of `SlopeSums.bins`.
        """
        latent = self(bins["slope_deg"])
        noise = self.likelihood.noise
        fit = expected_log_prob(bins, latent.mean, latent.variance, noise).sum(-1)
        log_noise_std = 0.5 * noise.squeeze(-1).log()
        prior_log_std = math.log(self.config.noise_std)
        deviation = (log_noise_std - prior_log_std) / self.config.noise_spread
        divergence = self.gp.variational_strategy.kl_divergence()
        bound = fit - divergence - 0.5 * deviation**2
        return torch.where(bins["count"] > 0, bound, 0.0)

    def tabulate(self) -> SlopeTable:
        """Evaluate mean, standard deviation and noise at the nodes of the table, float32."""
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
        """Return the table and all parameters by name, for a checkpoint."""
        state = {f"state.{name}": value for name, value in self.state_dict().items()}
        return {**self.tabulate().to_tensors(), **state}


def expected_log_prob(
    bins: dict[str, Tensor], mean: Tensor, variance: Tensor, noise: Tensor
) -> Tensor:
    """Return E[log p(observations | f)] under f ~ N(mean, variance), summed per bin.

    The expectation has a closed form in (0, 1). At 0 and 1, where the integrand log Φ
    is smooth, it is computed by Gauss-Hermite quadrature.

    Args:
        bins: result of `SlopeSums.bins`.
        mean: mean of the latent function at the bins, shape [C, B].
        variance: variance of the latent function at the bins, shape [C, B].
        noise: variance of the noise, shape [C, 1].

    Returns:
        Expected log-likelihoods, shape [C, B].
    """
    n_inside = bins["inside"]
    square = (
        bins["squares"] - 2 * mean * bins["total"] + n_inside * (mean**2 + variance)
    )
    log_scale = noise.log() + math.log(2 * math.pi)
    inside = -0.5 * (square / noise + n_inside * log_scale)
    weights = (_WEIGHTS / _WEIGHTS.sum()).to(mean).view(-1, 1, 1)
    latent = mean + variance.sqrt() * _NODES.to(mean).view(-1, 1, 1)
    below = torch.special.log_ndtr(-latent / noise.sqrt())
    above = torch.special.log_ndtr((latent - 1) / noise.sqrt())
    clipped = bins["zeros"] * below + bins["ones"] * above
    return inside + (weights * clipped).sum(0)
