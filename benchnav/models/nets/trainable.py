"""Base classes of trainable models, with hooks that a subclass implements.

`benchnav-train fit` trains any `TrainableModel`, including custom ones. A model learns
one field of the maps, observed λ, from layers of the same maps. A subclass names the
layers (`inputs` among its settings), creates its network, loss and distribution, and
inherits everything else:

    class Mine(TrainableModel):
        def __init__(self, config: MyConfig = MyConfig()) -> None:
            super().__init__(config)

        def configure_network(self, channels: int) -> nn.Module: ...
        def configure_losses(self) -> Loss: ...
        def to_distribution(self, outputs) -> TraversabilityDistribution: ...

Letters in shapes: B maps, H×W cells, N channels of all inputs.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import lightning
import numpy as np
import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from lightning_utilities import apply_to_collection
from torch import Tensor, nn
from torchmetrics import MeanMetric, MeanSquaredError, Metric, MetricCollection

from benchnav.core import rng
from benchnav.core.batch import map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.pooled import pool
from benchnav.core.settings import config_class, of, read
from benchnav.core.terrain import Observation
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.base import ModelFamily, TraversabilityModel, layers_of
from benchnav.models.checkpoint import Checkpoint, Part, member_names
from benchnav.models.config import TrainingConfig, plain_config
from benchnav.models.nets.calibration import fit_width, sample_scores
from benchnav.models.nets.ensemble import Ensemble, widened
from benchnav.models.nets.inputs import InputStack, LayerScale, Maps

CHUNK_CELLS = 2**17  # number of cells that a network receives at a time
WARM_UP_FRACTION = 0.15  # fraction of the steps in which the learning rate increases

Loss = Callable[[Any, Tensor], Tensor]


class TrainableNetwork(lightning.LightningModule):
    """Network that learns one field of the maps; base of models and of the classifier.

    Args:
        config: settings of the network and its training.
    """

    target: ClassVar[str] = "traversability"
    """Name of the field of the maps that the network learns."""

    stops_early: ClassVar[bool] = True
    """Whether training stops after `patience` epochs without a lower validation loss and
    keeps the best epoch; if false, it keeps the last epoch."""

    no_graph: ClassVar[str] = ""
    """Reason why the model cannot be exported to ONNX; empty if it can."""

    def __init__(self, config: TrainingConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__()
        self.config: Any = config
        self.map_classes: tuple[str, ...] = ()
        self.seed = 0
        self.temperature = 1.0

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the layers that the network receives, such as `rgb` and `slope_deg`."""
        return tuple(self.config.inputs)

    @property
    def stride(self) -> int:
        """Maps are padded to multiples of this number of cells; outputs are cropped."""
        return 1

    @abstractmethod
    def configure_network(self, channels: int) -> nn.Module:
        """Create the network with new weights, drawn from PyTorch's global generator.

        The generator has been seeded.

        Args:
            channels: N, number of channels of the images [B, N, H, W].
        """

    @abstractmethod
    def configure_losses(self) -> Loss:
        """Return the loss, a function of `forward`'s outputs and the target [B, H, W].

        The loss returns a scalar. The target is NaN in cells without a value, or 255 in
        unlabelled cells; the loss must ignore these cells.
        """

    def configure_metrics(self) -> dict[str, Metric]:
        """Return additional metrics of the validation maps by name; see `update_metrics`."""
        return {}

    def update_metrics(self, outputs: Any, target: Tensor) -> None:
        """Update `self.metrics` with a batch of validation maps.

        Args:
            outputs: outputs of `forward`.
            target: values of the field to learn, shape [B, H, W].
        """

    def build(
        self,
        scale: Mapping[str, LayerScale] | None = None,
        map_classes: tuple[str, ...] = (),
        seed: int = 0,
    ) -> Self:
        """Create the network with new weights; restore PyTorch's global generator.

        Args:
            scale: statistics of the training maps by layer; None to load a state dict.
            map_classes: names of the terrain classes of the maps.
            seed: root seed of the weights and of all draws in training.
        """
        self.map_classes = map_classes
        self.seed = seed
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            self.make_modules(scale)
        # A NaN loss must make the mean NaN.
        loss = MeanMetric(nan_strategy=math.nan)
        metrics: dict[str, Any] = {"loss": loss, **self.configure_metrics()}
        self.metrics = MetricCollection(metrics, prefix="valid_", compute_groups=False)
        self.loss = self.configure_losses()
        return self

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Create the modules: `stack`, which makes layers one image, and `network`."""
        self.stack = InputStack(self.inputs, scale)
        self.network = self.configure_network(self.stack.channels)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without the loss, which may be a closure.

        `__setstate__` configures the loss again.
        """
        state = super().__getstate__()
        if "loss" in state:
            state["loss"] = None
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled or copied network with a loss that refers to the copy."""
        super().__setstate__(state)
        if "loss" in state:
            self.loss = self.configure_losses()

    @classmethod
    def from_tensors(
        cls, config: Mapping[str, Any], map_classes: tuple[str, ...], tensors: Maps
    ) -> Self:
        """Rebuild a trained network without any download.

        Args:
            config: settings of the network, and optionally `temperature`.
            map_classes: names of the terrain classes of the training maps.
            tensors: a state dict.

        Raises:
            ConfigError: If the settings are not valid for this network.
            RuntimeError: If the tensors do not match the settings.
        """
        settings = dict(config)
        temperature = settings.pop("temperature", 1.0)
        is_number = isinstance(temperature, int | float)
        expect(
            is_number and 0 < temperature < math.inf,
            f"a finite `temperature` > 0, got {temperature!r}.",
        )
        kind = config_class(cls)
        if "pretrained" in settings:
            settings["pretrained"] = False
        network = cls(read(kind, settings, of(kind.__name__)))
        network.build(map_classes=map_classes)
        network.load_state_dict(tensors)
        network.temperature = float(temperature)
        return network.eval()

    def settings(self) -> dict[str, Any]:
        """Return the settings and the temperature as plain data, for `from_tensors`."""
        return {**plain_config(self.config), "temperature": self.temperature}

    def forward(self, maps: Maps) -> Any:
        """Compute the outputs for maps of any size, by padding and cropping.

        Args:
            maps: layers of B maps by name, including `inputs`.

        Returns:
            The cropped output, shape [B, *, H, W]; the network's output must be one
            tensor.
        """
        image = self.stack(maps)
        height, width = image.shape[-2:]
        if self.stride > 1:
            padding = (0, -width % self.stride, 0, -height % self.stride)
            image = nn.functional.pad(image, padding, mode="replicate")
        image = image.contiguous(memory_format=torch.channels_last)
        return self.network(image)[..., :height, :width]

    def assess(self, maps: Maps) -> tuple[Tensor, int]:
        """Compute the loss of a batch; in evaluation mode also update the metrics.

        Returns:
            The loss, and the number of cells over which it is averaged.
        """
        outputs = self(maps)
        target = maps[self.target]
        if target.is_floating_point():
            has_value = target.isfinite()
            with torch.autocast(target.device.type, enabled=False):
                outputs = in_single_precision(outputs)
                loss = self.loss(outputs, target)
        else:
            target = target.long()
            has_value = target != UNLABELLED
            loss = self.loss(outputs, target)
        if not self.training:
            self.update_metrics(outputs, target)
        return loss, int(has_value.sum())

    def calibrate(self, maps: Any, device: torch.device) -> None:
        """Calibrate on the validation maps after training, in evaluation mode.

        Args:
            maps: a `models.training.data.MapDataset` with `inputs` and the field to learn.
            device: device of the computation.
        """

    @classmethod
    def fit_pool(
        cls, members: Sequence[Self], maps: Any, seed: int, device: torch.device
    ) -> float:
        """Fit the temperature of the average of several members.

        Args:
            members: trained and calibrated networks.
            maps: a `models.training.data.MapDataset` with the inputs of the members and
                the field to learn.
            seed: root seed for sampling cells.
            device: device of the computation.
        """
        raise NotImplementedError

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """Return AdamW with the schedule of `configure_schedule`."""
        rate = self.config.learning_rate
        # Under mixed precision, fused AdamW unscales gradients itself, so Lightning
        # could not clip them.
        fused = not self.trainer.gradient_clip_val
        optimizer = torch.optim.AdamW(
            self.parameters(), rate, weight_decay=self.config.weight_decay, fused=fused
        )
        steps = max(int(self.trainer.estimated_stepping_batches), 2)
        schedule = self.configure_schedule(optimizer, steps)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def configure_schedule(self, optimizer: torch.optim.Optimizer, steps: int) -> Any:
        """Return the learning rate schedule over all steps: one cycle.

        Source: Smith and Topin (2018), "Super-convergence: very fast training of neural
        networks using large learning rates".
        """
        return torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            self.config.learning_rate,
            total_steps=steps,
            pct_start=WARM_UP_FRACTION,
        )

    def on_train_epoch_start(self) -> None:
        """Seed the epoch's draws, such as dropout, so that a resumed training repeats them."""
        world_size = self.trainer.world_size
        index = np.array([self.current_epoch * world_size + self.global_rank])
        key = rng.stream_key(self.seed, "models", "epoch")
        uniform = rng.uniform(key, index, (1,))
        torch.manual_seed(int(uniform.item() * 2**53))

    def training_step(self, batch: Maps, batch_index: int) -> Tensor:
        """Compute the loss of a batch."""
        loss, cells = self.assess(batch)
        self.log(
            "train_loss",
            loss,
            on_step=False,
            on_epoch=True,
            sync_dist=True,
            batch_size=cells,
        )
        return loss

    def validation_step(self, batch: Maps, batch_index: int) -> None:
        """Measure a batch of validation maps."""
        self.tally(batch)
        # The loss comes first, so that tables start with it.
        metrics = {"valid_loss": self.metrics["loss"], **dict(self.metrics.items())}
        self.log_dict(metrics, on_epoch=True, batch_size=len(batch[self.target]))

    def measure(self, maps: Any) -> dict[str, float]:
        """Return metrics of maps by name, such as `valid_loss`, as in training.

        The network must be in evaluation mode.

        Args:
            maps: a `models.training.data.MapDataset` with `inputs` and the field to learn.
        """
        self.metrics.to(self.device).reset()
        with torch.inference_mode():
            for _, batch in maps.chunks(self.device):
                self.tally(batch)
        return {name: float(value) for name, value in self.metrics.compute().items()}

    def tally(self, batch: Maps) -> None:
        """Update the metrics with a batch; the network must be in evaluation mode."""
        loss, cells = self.assess(batch)
        self.metrics["loss"].update(loss, cells)


class TrainableModel(TrainableNetwork, ModelFamily):
    """Model that `benchnav-train fit` trains and that checkpoints store.

    Calibration: the temperature T widens or narrows each distribution on the scale of
    normal scores, to F⁻¹(Φ(T·Φ⁻¹(u))). It is fitted to the validation maps by maximum
    likelihood and does not change medians.
    """

    @abstractmethod
    def to_distribution(self, outputs: Any) -> TraversabilityDistribution:
        """Return the distribution of λ in each cell, [B, H, W].

        Args:
            outputs: outputs of `forward`, float32.
        """

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Predict on the observation's device, in chunks of maps.

        Args:
            observation: B maps of any size, with the layers of `inputs`. The network is moved
                to its device.

        Returns:
            Distributions of shape [B, H, W].
        """
        return self.sharpen(self.predict_raw(layers_of(observation, self.inputs)))

    def predict_raw(self, maps: Maps) -> TraversabilityDistribution:
        """Predict without calibration.

        Args:
            maps: layers by name, at least one.
        """
        first = next(iter(maps.values()))
        self.eval().to(first.device)
        cells_per_map = first.shape[-2] * first.shape[-1]
        chunk_size = max(1, CHUNK_CELLS // cells_per_map)
        distributions = []
        with torch.inference_mode():
            for start in range(0, len(first), chunk_size):
                chunk = slice(start, start + chunk_size)
                outputs = self({name: layer[chunk] for name, layer in maps.items()})
                distributions.append(self.to_distribution(in_single_precision(outputs)))
        return map_tensors(
            distributions[0], lambda *values: torch.cat(values), *distributions[1:]
        )

    def sharpen(
        self, distribution: TraversabilityDistribution
    ) -> TraversabilityDistribution:
        """Return a distribution whose normal scores are multiplied by the temperature."""
        return widened(distribution, self.temperature)

    def configure_metrics(self) -> dict[str, Metric]:
        """Return the root mean square error of E[λ] relative to observed λ."""
        return {"rmse": MeanSquaredError(squared=False)}

    def update_metrics(self, outputs: Any, target: Tensor) -> None:
        """Update every metric with E[λ] and observed λ of the observed cells."""
        seen = target.isfinite()
        mean = self.to_distribution(outputs).mean()[seen]
        for name, metric in self.metrics.items(keep_base=True):
            if name != "loss":
                metric.update(mean, target[seen])

    def calibrate(self, maps: Any, device: torch.device) -> None:
        """Fit the temperature."""
        lower, upper = sample_scores(
            self.predict_raw, maps, self.inputs, self.seed, device
        )
        self.temperature = fit_width(lower, upper)

    @classmethod
    def fit_pool(
        cls, members: Sequence[Self], maps: Any, seed: int, device: torch.device
    ) -> float:
        """Fit the temperature of the average of several members' distributions."""

        def predict(layers: dict[str, Tensor]) -> TraversabilityDistribution:
            calibrated = (m.sharpen(m.predict_raw(layers)) for m in members)
            return pool(list(calibrated))

        lower, upper = sample_scores(predict, maps, members[0].inputs, seed, device)
        return fit_width(lower, upper)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> TraversabilityModel:  # type: ignore[override]
        """Rebuild the model, or the ensemble.

        Raises:
            CheckpointError: If the checkpoint has no part of this model.
        """
        name = checkpoint.model
        members = [
            cls.from_part(checkpoint.part(part), checkpoint)
            for part in member_names(checkpoint, name)
        ]
        if len(members) == 1:
            return members[0]
        return Ensemble(members, checkpoint.pool_temperature)

    @classmethod
    def from_part(cls, part: Part, checkpoint: Checkpoint) -> Self:
        """Rebuild one member from its part."""
        return cls.from_tensors(part.config, checkpoint.class_names, part.tensors)


def in_single_precision(outputs: Any) -> Any:
    """Return a network's outputs, a tensor or a collection of tensors, as float32."""
    return apply_to_collection(outputs, Tensor, Tensor.float)
