"""What a network is that `models.training` can train: named hooks, which a subclass fills in.

Letters in shapes: B maps, H×W cells.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any, ClassVar, Self

import lightning
import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torchmetrics import MeanMetric, Metric, MetricCollection

from benchnav.models.config import ClassifierConfig, MDNConfig

_WARM_UP_SHARE = 0.15


class TrainableNetwork(lightning.LightningModule):
    """A network that learns one field of the maps from their colours and perhaps other fields.

    Args:
        config: what it is, and how it is trained.
    """

    part: ClassVar[str]  # name of the part of a model that it is
    fields: ClassVar[tuple[str, ...]]  # that are read beside `rgb`; the last is what it learns

    def __init__(self, config: ClassifierConfig | MDNConfig) -> None:
        """Prepares what is measured."""
        super().__init__()
        self.config: Any = config
        # A loss that is no number is to be seen, not left out.
        metrics: dict[str, Metric | MetricCollection] = {
            "loss": MeanMetric(nan_strategy=math.nan),
            **self.configure_metrics(),
        }
        self.metrics = MetricCollection(metrics, prefix="valid_", compute_groups=False)

    @classmethod
    def untrained(cls, config: Any, class_count: int, data: Any = None, seed: int = 0) -> Self:
        """Builds it with fresh weights.

        Args:
            config: what it is.
            class_count: of the maps.
            data: training data, whose colours and slopes it is scaled by; None for any scale.
            seed: root seed of the weights.
        """
        raise NotImplementedError

    def configure_metrics(self) -> dict[str, Metric]:
        """What is measured on the validation maps beside the loss, by name."""
        return {}

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

    def measure(self, batches: Iterable[dict[str, Tensor]]) -> dict[str, float]:
        """Measures batches as training does, by name; the network is in evaluation, on their device."""
        self.metrics.to(self.device).reset()
        with torch.inference_mode():
            for batch in batches:
                self._update(batch)
        return {name: float(value) for name, value in self.metrics.compute().items()}

    def _update(self, batch: dict[str, Tensor]) -> None:
        self.metrics["loss"].update(*self.assess(batch))
