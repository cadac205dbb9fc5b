"""What a trainable model is: named hooks that a subclass fills in.

`benchnav-train fit` trains any `TrainableModel`, a user's own as well as ours. It
learns one field of the maps, λ as it was observed, from layers of the same maps. A
subclass says which layers (`inputs` among its settings), makes its network, its loss
and its distribution, and leaves the rest as it is:

    class Mine(TrainableModel):
        def __init__(self, config: MyConfig = MyConfig()) -> None:
            super().__init__(config)

        def configure_network(self, channels: int) -> nn.Module: ...
        def configure_losses(self) -> Loss: ...
        def to_distribution(self, outputs) -> TraversabilityDistribution: ...

Letters in shapes: B maps, H×W cells, N channels of all inputs together.
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
from benchnav.core.conditioned import conditioned
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
from benchnav.models.nets.inputs import InputStack, LayerScale, Maps

CHUNK_CELLS = 2**17

WARM_UP_SHARE = 0.15

Loss = Callable[[Any, Tensor], Tensor]


class TrainableNetwork(lightning.LightningModule):
    """A network that learns one field of the maps from others: the base of trainable
    models, and of the classifier.

    Args:
        config: what it is and how it is trained.
    """

    target: ClassVar[str] = "traversability"
    """Field of the maps that is learned."""

    stops_early: ClassVar[bool] = True
    """Whether training ends after `patience` epochs without a gain, and keeps the best;
    if not, it keeps the last.
    """

    no_graph: ClassVar[str] = ""
    """Why no ONNX graph can be made of it; empty where one can."""

    def __init__(self, config: TrainingConfig) -> None:
        """Keeps the settings; `build` makes the network."""
        super().__init__()
        self.config: Any = config
        self.map_classes: tuple[str, ...] = ()
        self.seed, self.temperature = 0, 1.0

    @property
    def inputs(self) -> tuple[str, ...]:
        """Layers that the network is given: `rgb`, `elevation_m`, `slope_deg`, and
        others that the maps have.
        """
        return tuple(self.config.inputs)

    @property
    def stride(self) -> int:
        """Maps are padded to multiples of so many cells for the network, and its
        outputs cropped.
        """
        return 1

    @abstractmethod
    def configure_network(self, channels: int) -> nn.Module:
        """Makes the network with fresh weights, drawn from PyTorch's global generator,
        which has been seeded.

        Args:
            channels: N, of the images that it is given, [B, N, H, W].
        """

    @abstractmethod
    def configure_losses(self) -> Loss:
        """Gives the loss of a batch, from outputs of `forward` and the field that is
        learned, [B, H, W], to a number.

        The field is NaN, or 255 of classes, where it is not known; those cells are to
        be left out.
        """

    def configure_metrics(self) -> dict[str, Metric]:
        """Gives what is measured on the validation maps beside the loss, by name;
        `update_metrics` updates it.
        """
        return {}

    def update_metrics(self, outputs: Any, target: Tensor) -> None:
        """Updates `self.metrics` by a batch of validation maps, [B, H, W] of the field
        that is learned.
        """

    def build(
        self,
        scale: Mapping[str, LayerScale] | None = None,
        map_classes: tuple[str, ...] = (),
        seed: int = 0,
    ) -> Self:
        """Makes the network with fresh weights; leaves PyTorch's global generator as it
        was.

        Args:
            scale: of the training maps, by layer of `inputs`.
            map_classes: names of the terrain classes of the maps.
            seed: root seed of the weights, and of what is drawn in training.
        """
        self.map_classes, self.seed = map_classes, seed
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            self.make_modules(scale)
        # A loss that is no number is to be seen, not left out.
        measured: dict[str, Any] = {
            "loss": MeanMetric(nan_strategy=math.nan),
            **self.configure_metrics(),
        }
        self.metrics = MetricCollection(measured, prefix="valid_", compute_groups=False)
        self.loss = self.configure_losses()
        return self

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Makes what has weights: `stack`, from layers to one image, and `network`."""
        self.stack = InputStack(self.inputs, scale)
        self.network = self.configure_network(self.stack.channels)

    def __getstate__(self) -> dict[str, Any]:
        """The state without the loss, which may be a closure; `__setstate__` configures
        it again.
        """
        state = super().__getstate__()
        if "loss" in state:
            state["loss"] = None
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a pickled or copied network, whose loss refers to it and not to the
        original.
        """
        super().__setstate__(state)
        if "loss" in state:
            self.loss = self.configure_losses()

    @classmethod
    def from_tensors(
        cls, config: Mapping[str, Any], map_classes: tuple[str, ...], tensors: Maps
    ) -> Self:
        """Rebuilds a trained network, downloading nothing.

        Args:
            config: fields of its settings, and perhaps a `temperature`.
            map_classes: names of the terrain classes of the maps it was trained on.
            tensors: a state dict.

        Raises:
            ConfigError: the settings are not those of such a network.
            RuntimeError: the tensors do not fit them.
        """
        settings = dict(config)
        temperature = settings.pop("temperature", 1.0)
        fits = isinstance(temperature, int | float) and 0 < temperature < math.inf
        expect(fits, f"a `temperature` > 0, got {temperature!r}.")
        kind = config_class(cls)
        if "pretrained" in settings:
            settings["pretrained"] = False
        network = cls(read(kind, settings, of(kind.__name__))).build(
            map_classes=map_classes
        )
        network.load_state_dict(tensors)
        network.temperature = float(temperature)
        return network.eval()

    def settings(self) -> dict[str, Any]:
        """Plain data that it is rebuilt from, beside its tensors: the configuration and
        the temperature.
        """
        return {**plain_config(self.config), "temperature": self.temperature}

    def forward(self, maps: Maps) -> Any:
        """Computes the outputs of the network for maps of any size, which are padded
        and the outputs cropped.

        Args:
            maps: B maps by field, `inputs` among them.

        Returns:
            Of a network whose output is one tensor, shape [B, *, H, W].
        """
        image = self.stack(maps)
        height, width = image.shape[-2:]
        if self.stride > 1:
            padding = (0, -width % self.stride, 0, -height % self.stride)
            image = nn.functional.pad(image, padding, mode="replicate")
        return self.network(image.contiguous(memory_format=torch.channels_last))[
            ..., :height, :width
        ]

    def assess(self, maps: Maps) -> tuple[Tensor, int]:
        """Computes the loss of a batch, and of how many cells it is the mean; in
        evaluation updates `metrics`.
        """
        outputs, target = self(maps), maps[self.target]
        if target.is_floating_point():
            known = target.isfinite()
            with torch.autocast(target.device.type, enabled=False):
                outputs = in_single_precision(outputs)
                loss = self.loss(outputs, target)
        else:
            target = target.long()
            known, loss = target != UNLABELLED, self.loss(outputs, target)
        if not self.training:
            self.update_metrics(outputs, target)
        return loss, int(known.sum())

    def calibrate(self, maps: Any, device: torch.device) -> None:
        """Is called with the validation maps when the training has ended; the network
        is in evaluation.

        Args:
            maps: a `models.training.data.MapDataset` with `inputs` and the field that
                is learned.
            device: where to compute.
        """

    @classmethod
    def fit_pool(
        cls, members: Sequence[Self], maps: Any, seed: int, device: torch.device
    ) -> float:
        """Fits the temperature of the average of several members.

        Args:
            members: trained and calibrated.
            maps: a `models.training.data.MapDataset` with their inputs and the field
                that is learned.
            seed: root seed of the cells to fit to.
            device: where to compute.
        """
        raise NotImplementedError

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW under the schedule of `configure_schedule`."""
        rate = self.config.learning_rate
        # Under mixed precision the fused kind unscales gradients by itself, and
        # Lightning would not clip them.
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
        """Gives the schedule of the learning rate over all steps of a training: one
        cycle (Smith and Topin, 2018).
        """
        return torch.optim.lr_scheduler.OneCycleLR(
            optimizer,
            self.config.learning_rate,
            total_steps=steps,
            pct_start=WARM_UP_SHARE,
        )

    def on_train_epoch_start(self) -> None:
        """Seeds what an epoch draws, such as dropout: by seed and epoch, so that a
        resumed training draws the same.
        """
        place = np.array(
            [self.current_epoch * self.trainer.world_size + self.global_rank]
        )
        drawn = rng.uniform(rng.stream_key(self.seed, "models", "epoch"), place, (1,))
        torch.manual_seed(int(drawn.item() * 2**53))

    def training_step(self, batch: Maps, batch_index: int) -> Tensor:
        """Computes the loss of a batch."""
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
        """Measures a batch."""
        self.tally(batch)
        # tables begin with it
        named = {
            "valid_loss": self.metrics["loss"],
            **dict(self.metrics.items()),
        }
        self.log_dict(named, on_epoch=True, batch_size=len(batch[self.target]))

    def measure(self, maps: Any) -> dict[str, float]:
        """Measures maps as training does, by name, such as `valid_loss`; the network is
        in evaluation.

        Args:
            maps: a `models.training.data.MapDataset` with `inputs` and the field that
                is learned.
        """
        self.metrics.to(self.device).reset()
        with torch.inference_mode():
            for _, batch in maps.chunks(self.device):
                self.tally(batch)
        return {name: float(value) for name, value in self.metrics.compute().items()}

    def tally(self, batch: Maps) -> None:
        """Updates `metrics` by a batch; the network is in evaluation."""
        loss, cells = self.assess(batch)
        self.metrics["loss"].update(loss, cells)


class TrainableModel(TrainableNetwork, ModelFamily):
    """A model that `benchnav-train fit` trains, and that is kept in checkpoints.

    Calibration: the temperature T widens or narrows every distribution on the scale of
    normal scores, to F⁻¹(Φ(T·Φ⁻¹(u))). It is fitted to the validation maps by maximum
    likelihood and leaves every median as it is.
    """

    @abstractmethod
    def to_distribution(self, outputs: Any) -> TraversabilityDistribution:
        """Gives the distribution of λ in each cell, [B, H, W], from outputs of
        `forward`, float32.
        """

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Predicts on the observation's device, to which the network is moved, some
        maps at a time.

        Args:
            observation: B maps of any size, with the layers of `inputs`.

        Returns:
            Distributions of shape [B, H, W].
        """
        return self.sharpen(self.predict_raw(layers_of(observation, self.inputs)))

    def predict_raw(self, maps: Maps) -> TraversabilityDistribution:
        """Predicts before calibration, from layers by name."""
        first = next(iter(maps.values()))
        self.eval().to(first.device)
        size = max(1, CHUNK_CELLS // (first.shape[-2] * first.shape[-1]))
        with torch.inference_mode():
            chunks = [
                self._some(
                    {name: layer[at : at + size] for name, layer in maps.items()}
                )
                for at in range(0, len(first), size)
            ]
        return map_tensors(chunks[0], lambda *values: torch.cat(values), *chunks[1:])

    def _some(self, maps: Maps) -> TraversabilityDistribution:
        return self.to_distribution(in_single_precision(self(maps)))

    def sharpen(
        self, distribution: TraversabilityDistribution
    ) -> TraversabilityDistribution:
        """Applies the temperature."""
        return widened(distribution, self.temperature)

    def configure_metrics(self) -> dict[str, Metric]:
        """The root mean square error of E[λ] to λ as observed."""
        return {"rmse": MeanSquaredError(squared=False)}

    def update_metrics(self, outputs: Any, target: Tensor) -> None:
        """Updates every metric by E[λ] and λ of the cells where it was observed, each
        of shape [N].
        """
        seen = target.isfinite()
        mean = self.to_distribution(outputs).mean()[seen]
        for name, metric in self.metrics.items(keep_base=True):
            if name != "loss":
                metric.update(mean, target[seen])

    def calibrate(self, maps: Any, device: torch.device) -> None:
        """Fits the temperature."""
        self.temperature = fit_width(
            *sample_scores(self.predict_raw, maps, self.inputs, self.seed, device)
        )

    @classmethod
    def fit_pool(
        cls, members: Sequence[Self], maps: Any, seed: int, device: torch.device
    ) -> float:
        """Fits the temperature of the average of several members' distributions."""

        def predict(layers: dict[str, Tensor]) -> TraversabilityDistribution:
            return pool(
                [member.sharpen(member.predict_raw(layers)) for member in members]
            )

        return fit_width(*sample_scores(predict, maps, members[0].inputs, seed, device))

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> TraversabilityModel:  # type: ignore[override]
        """Rebuilds the model, or the ensemble.

        Raises:
            CheckpointError: there is no part of it.
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
        """Rebuilds one member."""
        return cls.from_tensors(part.config, checkpoint.class_names, part.tensors)


class Ensemble(TraversabilityModel):
    """Several models as one: the average of their distribution functions, calibrated as
    a whole.

    Source: Lakshminarayanan et al. (2017), "Simple and scalable predictive uncertainty
    estimation using deep ensembles".

    Args:
        members: the models.
        temperature: of the average; see `TrainableModel`.
    """

    def __init__(
        self, members: Sequence[TrainableModel], temperature: float = 1.0
    ) -> None:
        """Keeps them."""
        self.members, self.temperature = tuple(members), temperature

    def predict(self, observation: Observation) -> TraversabilityDistribution:
        """Predicts by all members; distributions of shape [B, H, W]."""
        averaged = pool([member.predict(observation) for member in self.members])
        return widened(averaged, self.temperature)


def widened(
    distribution: TraversabilityDistribution, temperature: float
) -> TraversabilityDistribution:
    """Multiplies the normal scores of distributions by a temperature, over 1 to make
    them wider.

    Args:
        distribution: of shape [B, H, W].
        temperature: > 0; at 1 nothing is changed.
    """
    if temperature == 1:
        return distribution
    zeros = torch.zeros(
        distribution.shape, dtype=distribution.dtype, device=distribution.device
    )
    return conditioned(distribution, zeros, zeros + temperature)


def in_single_precision(outputs: Any) -> Any:
    """Outputs of a network, a tensor or a collection of them, as float32."""
    return apply_to_collection(outputs, Tensor, Tensor.float)
