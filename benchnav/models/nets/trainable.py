"""What a network is that `models.training` can train: named hooks, which a subclass fills in.

Letters in shapes: B maps, H×W cells.
"""

import math
from dataclasses import asdict
from typing import Any, ClassVar, NamedTuple, Self

import lightning
import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torchmetrics import MeanMetric, MetricCollection

from benchnav.core.settings import of, read
from benchnav.models.config import NetworkConfig

_WARM_UP_SHARE = 0.15


class MapScale(NamedTuple):
    """What values of maps are scaled by.

    Args:
        colour_mean: of the training maps, 0–255, shape [3].
        colour_std: of the training maps, shape [3].
        slope_deg: by which slopes are divided; the root mean square of the training maps', at least 1.
    """

    colour_mean: Tensor
    colour_std: Tensor
    slope_deg: Tensor


NO_SCALE = MapScale(torch.zeros(3), torch.ones(3), torch.ones(()))


class TrainableNetwork(lightning.LightningModule):
    """A network that learns one field of the maps from their colours and perhaps other fields.

    A subclass is built from its settings, the number of classes, a `MapScale` and the root seed of its weights.

    Args:
        config: what it is, and how it is trained.
        metrics: what is measured on the validation maps beside the loss, by name.
    """

    part: ClassVar[str]  # name of the part of a model that it is
    kind: ClassVar[type[NetworkConfig]]  # of its settings
    fields: ClassVar[tuple[str, ...]]  # that are read beside `rgb`; the last is what it learns

    def __init__(self, config: NetworkConfig, **metrics: Any) -> None:
        """Prepares what is measured."""
        super().__init__()
        self.config: Any = config
        # A loss that is no number is to be seen, not left out.
        measured = {"loss": MeanMetric(nan_strategy=math.nan), **metrics}
        self.metrics = MetricCollection(measured, prefix="valid_", compute_groups=False)

    @classmethod
    def from_tensors(cls, config: dict[str, Any], class_count: int, tensors: dict[str, Tensor]) -> Self:
        """Rebuilds a trained network, downloading nothing.

        Args:
            config: fields of its settings.
            class_count: of the maps.
            tensors: a state dict.

        Raises:
            ConfigError: the settings are not those of such a network.
            RuntimeError: the tensors do not fit them.
        """
        built = read(cls.kind, {**config, "pretrained": False}, of(cls.kind.__name__))
        network: Any = cls(built, class_count)  # type: ignore[call-arg]
        network.load_state_dict(tensors)
        return network.eval()

    def assess(self, batch: dict[str, Tensor]) -> tuple[Tensor, int]:
        """Computes the loss of a batch, and of how many cells it is the mean; in evaluation updates `metrics`."""
        raise NotImplementedError

    def calibrate(self, maps: Any, seed: int, device: torch.device) -> None:
        """Is called with the validation maps when the training has ended."""

    def settings(self) -> dict[str, Any]:
        """Plain data that it is rebuilt from, beside its tensors."""
        return asdict(self.config)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW under a one-cycle schedule over all steps of a training (Smith and Topin, 2018)."""
        rate = self.config.learning_rate
        # Under mixed precision the fused kind unscales gradients by itself, and Lightning would not clip them.
        fused = not self.trainer.gradient_clip_val
        optimizer = torch.optim.AdamW(
            self.parameters(), rate, weight_decay=self.config.weight_decay, fused=fused
        )
        steps = max(int(self.trainer.estimated_stepping_batches), 2)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, rate, total_steps=steps, pct_start=_WARM_UP_SHARE
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def training_step(self, batch: dict[str, Tensor], batch_index: int) -> Tensor:
        """Computes the loss of a batch with `rgb` and `fields`."""
        loss, cells = self.assess(batch)
        self.log("train_loss", loss, on_step=False, on_epoch=True, sync_dist=True, batch_size=cells)
        return loss

    def validation_step(self, batch: dict[str, Tensor], batch_index: int) -> None:
        """Measures a batch with `rgb` and `fields`."""
        self._update(batch)
        named = {"valid_loss": self.metrics["loss"], **dict(self.metrics.items())}  # tables begin with it
        self.log_dict(named, on_epoch=True, batch_size=len(batch["rgb"]))

    def measure(self, maps: Any) -> dict[str, float]:
        """Measures maps as training does, by name, such as `valid_loss`; the network is in evaluation.

        Args:
            maps: a `models.training.data.MapDataset` with `rgb` and `fields`.
        """
        self.metrics.to(self.device).reset()
        with torch.inference_mode():
            for _, batch in maps.chunks(self.device):
                self._update(batch)
        return {name: float(value) for name, value in self.metrics.compute().items()}

    def _update(self, batch: dict[str, Tensor]) -> None:
        self.metrics["loss"].update(*self.assess(batch))
