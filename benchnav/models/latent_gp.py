"""Class-wise Gaussian processes: each class's latent traversability as a function of slope.

A batch of C independent sparse variational GPs over slope, whitened, with a Matérn kernel. Where a
class has no data — it never occurs, or the slope is steeper than any seen — the GP falls back to its
prior, N(0.5, at least 0.3²), which says that nothing is known. Sources: paper III-B; Hensman et al.
(2015), "Scalable variational Gaussian process classification". Letters in shapes: C classes, N cells
a class, M inducing points, G nodes of the table.
"""

from collections.abc import Iterator
from typing import Any

import gpytorch
import lightning
import numpy as np
import torch
from gpytorch.constraints import GreaterThan, Interval
from gpytorch.distributions import MultivariateNormal
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.variational import CholeskyVariationalDistribution, VariationalStrategy
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from benchnav import rng
from benchnav.errors import ConfigError
from benchnav.models.config import LatentGPConfig
from benchnav.models.data import PixelTable
from benchnav.models.likelihood import CensoredGaussianLikelihood
from benchnav.models.slope_table import SlopeTable, table_slopes

_SLOPE_UNIT_DEG = 10.0
_PRIOR_MEAN = 0.5  # the middle of traversability's range
_PRIOR_STD, _LEAST_PRIOR_STD = 0.5, 0.3
_LENGTHSCALE_DEG, _LENGTHSCALE_RANGE_DEG = 10.0, (2.0, 15.0)
_NOISE_STD = 0.2
_LEAST_SPAN_DEG = 1.0


class SlopeGP(gpytorch.models.ApproximateGP):
    """C independent sparse GPs over slope in units of 10°.

    Args:
        inducing: slopes of the inducing points, shape [M].
        class_count: C.
    """

    def __init__(self, inducing: Tensor, class_count: int) -> None:
        """Starts at the prior."""
        batch = torch.Size([class_count])
        posterior = CholeskyVariationalDistribution(len(inducing), batch)
        points = inducing.view(1, -1, 1).repeat(class_count, 1, 1)
        strategy = VariationalStrategy(self, points, posterior, learn_inducing_locations=False)
        # Whitened, zeros and ones are the prior; GPyTorch's own start would draw on the global generator.
        strategy.variational_params_initialized.fill_(1)
        super().__init__(strategy)
        shortest, longest = (bound / _SLOPE_UNIT_DEG for bound in _LENGTHSCALE_RANGE_DEG)
        matern = gpytorch.kernels.MaternKernel(
            nu=2.5, batch_shape=batch, lengthscale_constraint=Interval(shortest, longest)
        )
        self.kernel = gpytorch.kernels.ScaleKernel(
            matern, batch_shape=batch, outputscale_constraint=GreaterThan(_LEAST_PRIOR_STD**2)
        )
        matern.lengthscale = _LENGTHSCALE_DEG / _SLOPE_UNIT_DEG
        self.kernel.outputscale = _PRIOR_STD**2

    def forward(self, x: Tensor) -> MultivariateNormal:
        """The prior at slopes `x`, shape [C, N, 1]."""
        return MultivariateNormal(torch.full_like(x[..., 0], _PRIOR_MEAN), self.kernel(x))


class LatentGPs(lightning.LightningModule):
    """Learns the latent traversability functions of all classes at once.

    Args:
        config: what they are.
        class_count: C.
        steepest_deg: steepest slope of the training data; inducing points lie up to there.
    """

    def __init__(self, config: LatentGPConfig, class_count: int, steepest_deg: float) -> None:
        """Builds the GPs at their prior, in float64."""
        super().__init__()
        self.config, self.class_count, self.steepest_deg = config, class_count, steepest_deg
        reach = max(steepest_deg, _LEAST_SPAN_DEG) / _SLOPE_UNIT_DEG
        self.gp = SlopeGP(torch.linspace(0, reach, config.inducing_points), class_count)
        self.likelihood = self.configure_likelihood()
        self.double()

    def configure_likelihood(self) -> GaussianLikelihood:
        """The censored or the plain Gaussian, with noise learned for each class."""
        kind = CensoredGaussianLikelihood if self.config.likelihood == "censored" else GaussianLikelihood
        likelihood = kind(batch_shape=torch.Size([self.class_count]))
        likelihood.noise = _NOISE_STD**2
        return likelihood

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Adam, its rate falling to 0 along a cosine over all steps."""
        optimizer = torch.optim.Adam(self.parameters(), lr=self.config.learning_rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            optimizer, int(self.trainer.estimated_stepping_batches)
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def forward(self, slope_deg: Tensor) -> MultivariateNormal:
        """The latent functions at slopes of each class, shape [C, N]."""
        return self.gp((slope_deg.double() / _SLOPE_UNIT_DEG).unsqueeze(-1))

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:
        """The negative evidence lower bound an observation, summed over classes.

        A batch holds `slope_deg` and `traversability` of shape [C, b], and `count` [C], the cells that
        each class has in all. A class without any is left at its prior.
        """
        fit = self.likelihood.expected_log_prob(batch["traversability"].double(), self(batch["slope_deg"]))
        divergence = self.gp.variational_strategy.kl_divergence()
        seen = batch["count"] > 0
        bound = torch.where(seen, fit.mean(-1), 0.0) - divergence / batch["count"].clamp(min=1)
        loss = -bound.sum()
        self.log("loss", loss.detach() / seen.sum(), on_step=False, on_epoch=True, batch_size=len(bound))
        return loss

    def tabulate(self) -> SlopeTable:
        """Evaluates mean, spread and noise at the nodes of the table, float32."""
        self.eval()
        slopes = table_slopes().to(self.device).expand(self.class_count, -1)
        with torch.no_grad():
            latent = self(slopes)
            noise = self.likelihood.noise
            std = (latent.variance.clamp(min=0) + noise).sqrt()
        return SlopeTable(
            mean=latent.mean.float(), std=std.float(), noise_std=noise.sqrt().squeeze(-1).float()
        )

    def to_tensors(self) -> dict[str, Tensor]:
        """Gives the table and all parameters by name, for a checkpoint."""
        table = self.tabulate()
        state = {f"state.{name}": value for name, value in self.state_dict().items()}
        return {"mean": table.mean, "std": table.std, "noise_std": table.noise_std, **state}

    @classmethod
    def from_tensors(
        cls, config: dict[str, Any], class_count: int, tensors: dict[str, Tensor]
    ) -> "LatentGPs":
        """Rebuilds trained GPs.

        Args:
            config: fields of `LatentGPConfig`, and `steepest_deg`.
            class_count: C.
            tensors: from `to_tensors`.

        Raises:
            ConfigError: the settings are not those of the GPs.
            RuntimeError: the tensors do not fit them.
        """
        try:
            settings = {name: value for name, value in config.items() if name != "steepest_deg"}
            model = cls(LatentGPConfig(**settings), class_count, float(config["steepest_deg"]))
        except (KeyError, TypeError) as error:
            raise ConfigError(f"Expected the settings of the GPs, got {sorted(config)}.") from error
        prefix = "state."
        model.load_state_dict({n.removeprefix(prefix): v for n, v in tensors.items() if n.startswith(prefix)})
        return model.eval()


class PixelBatches(Dataset[dict[str, Tensor]]):
    """Cells of a table; indexed by a whole batch at a time.

    Args:
        table: cells by class.
    """

    def __init__(self, table: PixelTable) -> None:
        """Keeps the table."""
        self.table = table

    def __getitem__(self, index: Tensor) -> dict[str, Tensor]:
        """Gives `slope_deg`, `traversability` [C, b] and `count` [C] of the places `index` [C, b]."""
        return {
            "slope_deg": self.table.slope_deg.gather(1, index),
            "traversability": self.table.traversability.gather(1, index),
            "count": self.table.count,
        }


class PixelSampler(Sampler[Tensor]):
    """Draws places in a table with replacement, each class on its own, keyed by (seed, epoch).

    Args:
        count: cells of each class, shape [C].
        batch_size: draws a class and step.
        steps: steps an epoch.
        seed: root seed.
    """

    def __init__(self, count: Tensor, batch_size: int, steps: int, seed: int) -> None:
        """Starts at epoch 0."""
        self.count, self.batch_size, self.steps, self.seed = count, batch_size, steps, seed
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Chooses the epoch that the next iteration gives; the trainer calls this."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Steps an epoch."""
        return self.steps

    def __iter__(self) -> Iterator[Tensor]:
        """Yields places, int64, shape [C, batch_size]; 0 for a class without cells."""
        key = rng.stream_key(self.seed, "models", "pixel batches", self.epoch)
        for step in range(self.steps):
            drawn = rng.uniform(key, np.array([step]), (len(self.count), self.batch_size))[0]
            yield (torch.from_numpy(drawn) * self.count.unsqueeze(-1)).long()


def load_batches(config: LatentGPConfig, table: PixelTable, seed: int) -> DataLoader[dict[str, Tensor]]:
    """Makes the loader of training batches."""
    sampler = PixelSampler(table.count, config.batch_size, config.epoch_steps, seed)
    return DataLoader(PixelBatches(table), batch_size=None, sampler=sampler, generator=torch.Generator())
