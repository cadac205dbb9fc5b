"""Checks before training: inputs, maps, settings of the trainer, and network hooks."""

import json
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory_error
from benchnav.core.ground import SEEN
from benchnav.core.settings import call, of, one_line, read
from benchnav.core.shipped_files import PACKAGE
from benchnav.core.terrain import take_cells
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import predict_observation
from benchnav.models.config import TrainingConfig
from benchnav.models.nets.inputs import check_inputs
from benchnav.models.nets.trainable import (
    TrainableModel,
    TrainableNetwork,
    in_single_precision,
)
from benchnav.models.training.data import TRAIN, VALID, MapDataset, check_maps
from benchnav.models.training.fit import FitOptions, make_trainer, quietly
from benchnav.models.training.map_order import squares_per_map


@dataclass(frozen=True, kw_only=True)
class Trainable:
    """A network to train with `train_networks`.

    Args:
        kind: class of the network.
        config: settings of the network and its training.
        name: name of the network's part in a checkpoint; later members of an ensemble
            have a number appended.
        family: registered name of the model, or name of a custom class, for checkpoints.
        code: digest of the code of a custom class; empty for models of this package.
    """

    kind: type[TrainableNetwork]
    config: TrainingConfig
    name: str
    family: str
    code: str = ""


def fields_of(network: TrainableNetwork) -> tuple[str, ...]:
    """Return the fields of the maps for training a network: its inputs and its target."""
    return (*network.inputs, network.target)


def class_names(dataset: TerrainDataset) -> tuple[str, ...]:
    """Return the names of the terrain classes of a dataset."""
    return tuple(item.name for item in dataset.recipe.classes)


def check_network(
    trainable: Trainable, dataset: TerrainDataset, options: FitOptions
) -> None:
    """Check that a network can be trained: build the trainer and try one batch.

    Args:
        trainable: network to train.
        dataset: dataset of the maps.
        options: training options.

    Raises:
        ConfigError: If Lightning or the network does not accept the settings, the maps
            lack an input, a hook returns an invalid value, or no batch would be left
            for training or for validation.
        DatasetError: If there are too few maps, or no cell has a value to learn.
    """
    kind = trainable.kind
    config = trainable.config
    network = call(f"a model of {kind.__name__}", kind, {"config": config})
    _check_settings(network)
    available = ["rgb", "elevation_m", "slope_deg", *dataset.layer_names, SEEN]
    check_inputs(network.inputs, available)
    expect(
        SEEN not in network.inputs or config.masking.share > 0,
        f"`masking.share` > 0 for the input `{SEEN}`, got 0. If all cells are seen in "
        "training, this input carries no information. Raise `masking.share`, or leave "
        "the input out.",
    )
    check_maps(dataset, kind.target, config.crop)
    _check_trainer(config, dataset, options)
    maps = _first_batch(network, dataset, options)
    try:
        network.build(map_classes=class_names(dataset)).to(options.place)
    except BenchnavError:
        raise
    except Exception as error:  # custom code may raise any error
        raise _batch_error(network, maps, error) from error
    try_network(network, maps)
    overrides_predict = (
        isinstance(network, TrainableModel)
        and type(network).predict is not TrainableModel.predict
    )
    if overrides_predict:
        observation = dataset.terrain(TRAIN, [0]).to(options.place).observe()
        side = config.crop or max(dataset.grid.shape)
        rows, columns = (slice(min(side, size)) for size in dataset.grid.shape)
        try:
            predict_observation(network.eval(), take_cells(observation, rows, columns))
        except BenchnavError:
            raise
        except Exception as error:  # custom code may raise any error
            raise _batch_error(network, maps, error) from error


def _check_trainer(
    config: TrainingConfig, dataset: TerrainDataset, options: FitOptions
) -> None:
    """Check that Lightning accepts the settings and that each split has a batch."""
    with quietly():
        settings = options.chosen(max_epochs=config.max_epochs)
        trainer = make_trainer([], logger=False, **settings)
    interval = trainer.check_val_every_n_epoch or 0
    expect(
        interval <= config.max_epochs,
        f"`trainer.check_val_every_n_epoch` of at most {config.max_epochs}, which is "
        f"the number of epochs, got {interval}.",
    )
    for split, name in ((TRAIN, "limit_train_batches"), (VALID, "limit_val_batches")):
        n_samples = dataset.map_count(split)
        if split == TRAIN:
            n_samples *= squares_per_map(dataset.grid.shape, config.crop)
        n_batches = -(-n_samples // config.batch_size)
        limit = getattr(trainer, name)
        n_used = n_batches * limit if isinstance(limit, float) else limit
        expect(
            n_used >= 1,
            f"`trainer.{name}` to select at least one of the {n_batches} batches of split "
            f"{split}, got {limit}. Leave it out to use all batches.",
        )


def _first_batch(
    network: TrainableNetwork, dataset: TerrainDataset, options: FitOptions
) -> dict[str, Tensor]:
    """Return one or two training maps, cropped, as a batch."""
    config = network.config
    n_maps = dataset.map_count(TRAIN)
    n_samples = n_maps * squares_per_map(dataset.grid.shape, config.crop)
    n_batches = -(-n_samples // config.batch_size)
    size = min(2, n_samples // n_batches)
    indices = [index % n_maps for index in range(size)]
    maps = MapDataset(dataset.path, TRAIN, fields_of(network)).read(indices)
    crop = config.crop or None
    return {
        name: values[..., :crop, :crop].to(options.place)
        for name, values in maps.items()
    }


def _check_settings(network: TrainableNetwork) -> None:
    """Check that a checkpoint can store the settings, and check `inputs` and `stride`.

    Raises:
        ConfigError: If JSON cannot store the settings, or `inputs` or `stride` is
            invalid.
    """
    name = type(network).__name__
    try:
        inputs = tuple(network.inputs)
        stored = json.loads(json.dumps(network.settings()))
        stored.pop("temperature")
        restored = read(type(network.config), stored, of(name))
    except BenchnavError:
        raise
    except Exception as error:  # custom code may raise any error
        raise ConfigError(
            f"Expected `inputs` and settings of {name} that JSON can store (numbers, text "
            f"and lists of these), got: {one_line(error).rstrip('.')}. Check also that "
            "__init__ calls super().__init__(config)."
        ) from error
    expect(
        restored == network.config,
        f"settings of {name} that are unchanged after storage as JSON, got {stored!r}.",
    )
    expect(
        all(isinstance(item, str) for item in inputs),
        f"`inputs` of {name} to be names of layers, got {inputs!r}.",
    )
    stride = network.stride
    expect(
        isinstance(stride, int) and stride >= 1,
        f"`stride` of {name} to be an integer ≥ 1, got {stride!r}.",
    )


def try_network(network: TrainableNetwork, maps: Mapping[str, Tensor]) -> None:
    """Call the hooks of a built network on one batch, without a training step.

    Args:
        network: network to train.
        maps: layers of B maps by name, including the network's inputs and target.

    Raises:
        ConfigError: If the network does not accept the maps, or a hook returns an invalid
            value.
    """
    name = type(network).__name__
    target = maps[network.target]
    outputs = None
    try:
        with torch.random.fork_rng(devices=[]):
            loss, _ = network.train().assess(maps)
            if isinstance(network, TrainableModel):
                with torch.no_grad():
                    raw = in_single_precision(network.eval()(maps))
                    outputs = network.to_distribution(raw)
    except BenchnavError:
        raise
    except Exception as error:  # custom code may raise any error
        raise _batch_error(network, maps, error) from error
    _check_loss(loss, target, name)
    if isinstance(network, TrainableModel):
        check_distribution(outputs, tuple(target.shape), target.device, name)
    try:
        network.configure_schedule(torch.optim.AdamW(network.parameters()), 2)
        network.metrics.to(target.device)
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            network.eval().tally(maps)
        network.metrics.compute()
        network.metrics.reset()
    except BenchnavError:
        raise
    except Exception as error:  # custom code may raise any error
        raise _batch_error(network, maps, error) from error


def _check_loss(loss: Any, target: Tensor, name: str) -> None:
    """Check that a loss is a finite scalar with a gradient, on the target's device."""
    description = type(loss).__name__
    if isinstance(loss, Tensor):
        description = f"shape {list(loss.shape)}"
    expect(
        description == "shape []",
        f"`configure_losses` of {name} to return a loss that is a scalar, got "
        f"{description}.",
    )
    expect(
        loss.device == target.device,
        f"the loss of {name} on {target.device}, got it on {loss.device}.",
    )
    hint = ""
    if not bool(target.isfinite().any()):
        hint = " λ is NaN (not observed) in the whole batch."
    expect(
        bool(loss.isfinite()),
        f"`configure_losses` of {name} to return a finite loss, got {loss.item()}.{hint}",
    )
    expect(
        loss.requires_grad,
        f"a loss of {name} with a gradient, got a loss without one. Compute it from the "
        "outputs.",
    )


def check_distribution(
    predicted: Any, shape: tuple[int, ...], device: torch.device, name: str
) -> None:
    """Check that a prediction is a distribution of λ for each cell of a batch.

    Args:
        predicted: result of `to_distribution`.
        shape: (B, H, W) of the batch.
        device: device of the batch.
        name: name of the model's class.

    Raises:
        ConfigError: If the prediction has the wrong type, shape or device, or its mean,
            quantiles or CDF are invalid.
    """
    expected = f"`to_distribution` of {name} to return"
    kind = type(predicted).__name__
    expect(
        isinstance(predicted, TraversabilityDistribution),
        f"{expected} a TraversabilityDistribution, got {kind}.",
    )
    expect(
        is_dataclass(predicted),
        f"{expected} a frozen dataclass of maps, got {kind}, which is not a dataclass.",
    )
    expect(
        tuple(predicted.shape) == shape,
        f"{expected} a distribution of shape {list(shape)}, got {list(predicted.shape)}.",
    )
    expect(
        predicted.device == device,
        f"{expected} a distribution on {device}, got one on {predicted.device}.",
    )
    mean = predicted.mean()
    expect(
        bool(((mean >= 0) & (mean <= 1)).all()),
        f"{expected} a distribution whose `mean` is in [0, 1], got values outside or NaN.",
    )
    levels = (0.01, 0.2, 0.5, 0.8, 0.99)
    quantiles = torch.stack([predicted.quantile(level).double() for level in levels])
    is_in_range = (quantiles[0] >= 0).all() and (quantiles[-1] <= 1).all()
    expect(
        bool((quantiles.diff(dim=0) >= -1e-6).all() and is_in_range),
        f"{expected} a distribution whose `quantile` ascends with the level and stays in "
        "[0, 1], got one whose `quantile` does not. See `benchnav.testing.check_model`.",
    )
    values = (0.0, 0.2, 0.5, 0.8, 1.0)
    cdf = torch.stack([predicted.cdf(value).double() for value in values])
    expect(
        bool((cdf.diff(dim=0) >= -1e-6).all() and (cdf[-1] == 1).all()),
        f"{expected} a distribution whose `cdf` ascends and is 1 at λ = 1, got one whose "
        "`cdf` does not. See `benchnav.testing.check_model`.",
    )


def _batch_error(
    network: TrainableNetwork, maps: Mapping[str, Tensor], error: Exception
) -> BenchnavError:
    """Return the error for a network that fails on a batch.

    The error names the line of custom code, or else the architecture and encoder.
    """
    config = network.config
    batch, height, width = maps[network.target].shape
    owner = type(network).__name__
    remedy = "Choose another network."
    custom_frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if "site-packages" not in frame.filename and str(PACKAGE) not in frame.filename
    ]
    if custom_frames:
        frame = custom_frames[-1]
        file = Path(frame.filename).name
        remedy = f"See {file}, line {frame.lineno}, in `{frame.name}`."
    elif hasattr(config, "architecture") and hasattr(config, "encoder"):
        owner = f"{config.architecture} with the encoder {config.encoder}"
    return out_of_memory_error(error) or ConfigError(
        f"Expected a network that accepts batches of {batch} maps of {height}×{width} "
        f"cells, got {owner}, which fails: {one_line(error).rstrip('.')}. {remedy}"
    )
