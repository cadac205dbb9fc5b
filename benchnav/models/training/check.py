"""What is refused before anything is trained: inputs, maps, settings of the trainer,
and hooks that do not fit.
"""

import json
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory
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
from benchnav.models.training.map_order import squares_a_map


@dataclass(frozen=True, kw_only=True)
class Trainable:
    """What `train_networks` trains.

    Args:
        kind: class of the network.
        config: its settings.
        name: of its parts; the members of an ensemble are counted behind it.
        family: registered name of the model that checkpoints name, or the name of a
            user's class.
        code: digest of its code; empty where that is ours.
    """

    kind: type[TrainableNetwork]
    config: TrainingConfig
    name: str
    family: str
    code: str = ""


def fields_of(network: TrainableNetwork) -> tuple[str, ...]:
    """Fields of the maps that a network is trained on: its inputs, and what it learns."""
    return (*network.inputs, network.target)


def class_names(dataset: TerrainDataset) -> tuple[str, ...]:
    """Names of the terrain classes of a dataset."""
    return tuple(item.name for item in dataset.recipe.classes)


def check_network(
    trainable: Trainable, dataset: TerrainDataset, options: FitOptions
) -> None:
    """Refuses what could not be trained before anything is: builds the trainer and
    tries the network on a batch.

    Args:
        trainable: the network.
        dataset: the maps.
        options: how to train.

    Raises:
        ConfigError: Lightning or the network does not take the settings, the maps lack
            an input, a hook gives what it should not, or nothing would be trained or
            measured.
        DatasetError: there are too few maps, or none of their cells has what is
            learned.
    """
    kind, config = trainable.kind, trainable.config
    network = call(f"a model of {kind.__name__}", kind, {"config": config})
    _check_settings(network)
    check_inputs(
        network.inputs, ["rgb", "elevation_m", "slope_deg", *dataset.layer_names, SEEN]
    )
    expect(
        SEEN not in network.inputs or config.masking.share > 0,
        f"`masking.share` > 0 for the input {SEEN}, got 0: where all is seen in "
        "training, it teaches nothing.",
    )
    check_maps(dataset, kind.target, config.crop)
    with quietly():
        chosen = options.chosen(max_epochs=config.max_epochs)
        trainer = make_trainer([], logger=False, **chosen)
    every = trainer.check_val_every_n_epoch or 0
    expect(
        every <= config.max_epochs,
        f"`trainer.check_val_every_n_epoch` of at most {config.max_epochs}, the "
        f"number of epochs, got {every}.",
    )
    squares = squares_a_map(dataset.grid.shape, config.crop)
    for split, name in ((TRAIN, "limit_train_batches"), (VALID, "limit_val_batches")):
        places = dataset.map_count(split) * (squares if split == TRAIN else 1)
        limit, batches = getattr(trainer, name), -(-places // config.batch_size)
        expect(
            (batches * limit if isinstance(limit, float) else limit) >= 1,
            f"`trainer.{name}` that leaves a batch of the {batches} of split {split}, "
            f"got {limit}. "
            "Leave it out to take all.",
        )
    places = dataset.map_count(TRAIN) * squares
    together = min(2, places // -(-places // config.batch_size))
    indices = [index % dataset.map_count(TRAIN) for index in range(together)]
    maps = MapDataset(dataset.path, TRAIN, fields_of(network)).read(indices)
    crop = config.crop or None
    maps = {
        name: values[..., :crop, :crop].to(options.place)
        for name, values in maps.items()
    }
    try:
        network.build(map_classes=class_names(dataset)).to(options.place)
    except BenchnavError:
        raise
    except Exception as error:  # a user's code may raise anything
        raise _unfit(network, maps, error) from error
    try_network(network, maps)
    if (
        isinstance(network, TrainableModel)
        and type(network).predict is not TrainableModel.predict
    ):
        observation = dataset.terrain(TRAIN, [0]).to(options.place).observe()
        side = config.crop or max(dataset.grid.shape)
        rows, columns = (slice(min(side, size)) for size in dataset.grid.shape)
        try:
            predict_observation(network.eval(), take_cells(observation, rows, columns))
        except BenchnavError:
            raise
        except Exception as error:  # a user's code may raise anything
            raise _unfit(network, maps, error) from error


def _check_settings(network: TrainableNetwork) -> None:
    """Refuses a network of which a checkpoint could not keep the settings, and inputs
    that are no list of names.
    """
    name = type(network).__name__
    try:
        inputs, settings = tuple(network.inputs), network.settings()
        kept = json.loads(json.dumps(settings))
        kept.pop("temperature")
        again = read(type(network.config), kept, of(name))
    except BenchnavError:
        raise
    except Exception as error:  # a user's code may raise anything
        raise ConfigError(
            f"Expected {name} with `inputs` and settings that JSON can keep, numbers, "
            "text and lists of them, got: "
            f"{one_line(error)}. Does its __init__ call super().__init__(config)?"
        ) from error
    expect(
        again == network.config,
        f"settings of {name} that JSON gives back as they were, got {kept!r}.",
    )
    expect(
        all(isinstance(item, str) for item in inputs),
        f"`inputs` of {name} as names of layers, got {inputs!r}.",
    )
    stride = network.stride
    expect(
        isinstance(stride, int) and stride >= 1,
        f"`stride` of {name} ≥ 1, got {stride!r}.",
    )


def try_network(network: TrainableNetwork, maps: Mapping[str, Tensor]) -> None:
    """Tries the hooks of a network that has been built on one batch, without a step.

    Args:
        network: what is to be trained.
        maps: B maps by field, its inputs and what it learns among them.

    Raises:
        ConfigError: it does not take the maps, or a hook gives what it should not.
    """
    name, outputs = type(network).__name__, None
    try:
        with torch.random.fork_rng(devices=[]):
            loss, _ = network.train().assess(maps)
            if isinstance(network, TrainableModel):
                with torch.no_grad():
                    outputs = network.eval().to_distribution(
                        in_single_precision(network(maps))
                    )
    except BenchnavError:
        raise
    except Exception as error:  # a user's code may raise anything
        raise _unfit(network, maps, error) from error
    got = (
        f"shape {list(loss.shape)}" if isinstance(loss, Tensor) else type(loss).__name__
    )
    expect(
        got == "shape []",
        f"`configure_losses` of {name} to give a loss that is one number, got {got}.",
    )
    device = maps[network.target].device
    expect(
        loss.device == device,
        f"a loss of {name} on {device}, got one on {loss.device}.",
    )
    seen = bool(maps[network.target].isfinite().any())
    hint = (
        "" if seen else " λ, NaN where it was not observed, is so in the whole batch."
    )
    expect(
        bool(loss.isfinite()),
        f"`configure_losses` of {name} to give a finite loss, got {loss.item()}.{hint}",
    )
    expect(
        loss.requires_grad,
        f"a loss of {name} that has a gradient, got one without. Use the outputs in "
        "it.",
    )
    if isinstance(network, TrainableModel):
        check_distribution(outputs, tuple(maps[network.target].shape), device, name)
    try:
        network.configure_schedule(torch.optim.AdamW(network.parameters()), 2)
        network.metrics.to(device)
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            network.eval().tally(maps)
        network.metrics.compute()
        network.metrics.reset()
    except BenchnavError:
        raise
    except Exception as error:  # a user's code may raise anything
        raise _unfit(network, maps, error) from error


def check_distribution(
    given: Any, shape: tuple[int, ...], device: torch.device, name: str
) -> None:
    """Refuses what is no distribution of λ for each cell of a batch.

    Args:
        given: what `to_distribution` gave.
        shape: (B, H, W) of the batch.
        device: of the batch.
        name: of the model's class.

    Raises:
        ConfigError: it is of another type, shape or device, or its mean is not in [0,
            1].
    """
    where = f"`to_distribution` of {name} to give"
    expect(
        isinstance(given, TraversabilityDistribution),
        f"{where} a TraversabilityDistribution, got {type(given).__name__}.",
    )
    expect(
        is_dataclass(given),
        f"{where} a frozen dataclass of maps, got {type(given).__name__}, which is "
        "none.",
    )
    expect(
        tuple(given.shape) == shape,
        f"{where} one of shape {list(shape)}, got {list(given.shape)}.",
    )
    expect(
        given.device == device, f"{where} one on {device}, got one on {given.device}."
    )
    mean = given.mean()
    expect(
        bool(((mean >= 0) & (mean <= 1)).all()),
        f"{where} means of λ in [0, 1], got values outside or not a number.",
    )
    ranks = torch.stack(
        [given.quantile(share).double() for share in (0.01, 0.2, 0.5, 0.8, 0.99)]
    )
    expect(
        bool(
            (ranks.diff(dim=0) >= -1e-6).all()
            and (ranks[0] >= 0).all()
            and (ranks[-1] <= 1).all()
        ),
        f"{where} one whose `quantile` ascends within [0, 1], got another. "
        "`benchnav.testing.check_model` tells more.",
    )
    shares = torch.stack(
        [given.cdf(value).double() for value in (0.0, 0.2, 0.5, 0.8, 1.0)]
    )
    expect(
        bool((shares.diff(dim=0) >= -1e-6).all() and (shares[-1] == 1).all()),
        f"{where} one whose `cdf` ascends to 1 at λ = 1, got another. "
        "`benchnav.testing.check_model` tells more.",
    )


def _unfit(
    network: TrainableNetwork, maps: Mapping[str, Tensor], error: Exception
) -> BenchnavError:
    """Says what a batch of maps raised: where in the file of the class, or of which
    architecture and encoder.
    """
    config, (batch, height, width) = network.config, maps[network.target].shape
    what, remedy = type(network).__name__, "Choose another."
    if hasattr(config, "architecture") and hasattr(config, "encoder"):
        what = f"{config.architecture} of {config.encoder}"
    frames = traceback.extract_tb(error.__traceback__)
    if own := [
        at
        for at in frames
        if "site-packages" not in at.filename and str(PACKAGE) not in at.filename
    ]:
        at, what = own[-1], type(network).__name__
        remedy = f"See {Path(at.filename).name}, line {at.lineno}, in `{at.name}`."
    return out_of_memory(error) or ConfigError(
        f"Expected a network that takes batches of {batch} maps of {height}×{width} "
        f"cells, got {what}, which does not: "
        f"{one_line(error).rstrip('.')}. {remedy}"
    )
