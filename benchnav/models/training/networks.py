"""Training networks, whatever they learn: one door for classifiers, mixture-density networks and those to come."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from lightning.pytorch.callbacks import EarlyStopping

from benchnav.core.errors import ConfigError
from benchnav.core.settings import one_line
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import Part, as_stored, member_names
from benchnav.models.config import ClassifierConfig, MDNConfig, NetworkConfig
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.nets.mdn import MixtureDensityNetwork
from benchnav.models.nets.temperature import fit_pool_temperature
from benchnav.models.nets.trainable import TrainableNetwork
from benchnav.models.training.callbacks import KeepBest
from benchnav.models.training.data import (
    TRAIN,
    VALID,
    MapData,
    MapDataset,
    check_maps,
    read_maps,
    training_digest,
)
from benchnav.models.training.fit import FitOptions, fit, is_first_process, make_trainer, quietly, say
from benchnav.models.training.target import Target

_DEFAULT = FitOptions()

NETWORKS: Mapping[type, type[TrainableNetwork]] = {
    ClassifierConfig: TerrainClassifier,
    MDNConfig: MixtureDensityNetwork,
}


def fit_network(
    config: NetworkConfig,
    dataset: TerrainDataset,
    seed: int = 0,
    options: FitOptions = _DEFAULT,
    part: str = "",
    half_precision: bool = False,
) -> tuple[Any, dict[str, float]]:
    """Trains a network on the split `train` until the split `valid` no longer gains, and calibrates it.

    Args:
        config: what to train.
        dataset: the maps.
        seed: root seed of weights, order and augmentation.
        options: how to train; precision is bf16-mixed where it is fast unless they say otherwise.
        part: name of the part of a model that it is, where it is not the usual one.
        half_precision: whether its kernels will be kept as float16, to which they are rounded before it is
            calibrated and measured.

    Returns:
        The network with its best weights, on the CPU, and what was measured on `valid` in the best epoch, before it
        was calibrated.
    """
    kind = NETWORKS[type(config)]
    data = MapData(
        dataset, config.batch_size, seed, config.jitter, kind.fields,
        in_memory=options.in_memory, workers=options.workers,
    )  # fmt: skip
    network = kind.untrained(config, len(dataset.recipe.classes), data, seed)
    metrics = fit(
        network,
        part or kind.part,
        options,
        {
            "config": asdict(config),
            "data": training_digest(dataset),
            "seed": seed,
            "half_precision": half_precision,
        },
        [KeepBest(), EarlyStopping("valid_loss", patience=config.patience, check_on_train_epoch_end=False)],
        {"datamodule": data},
        max_epochs=config.max_epochs,
    )
    network.to(options.place).eval()
    if half_precision:
        network.load_state_dict(as_stored(network.state_dict(), half_precision))
        metrics = {**metrics, **measure(network, data.valid)}
    network.calibrate(data.valid, seed, options.place)
    return network.cpu(), metrics


def measure(network: TrainableNetwork, maps: MapDataset) -> dict[str, float]:
    """Measures a network as training does, such as `valid_loss`.

    Args:
        network: in evaluation, on any device.
        maps: with `rgb` and the network's `fields`.
    """
    return network.measure(some for _, some in maps.chunks(network.device))


def check_network(config: NetworkConfig, dataset: TerrainDataset, options: FitOptions) -> None:
    """Refuses what could not be trained before anything is: builds the trainer and tries the network on a batch.

    Raises:
        ConfigError: Lightning or the network does not take the settings, or nothing would be trained or measured.
        DatasetError: there are too few maps, or none of their cells has what is learned.
    """
    kind = NETWORKS[type(config)]
    check_maps(dataset, kind.fields[-1])
    network = kind.untrained(config, len(dataset.recipe.classes))
    with quietly():
        chosen = options.chosen(max_epochs=config.max_epochs)
        trainer = make_trainer([], logger=False, enable_checkpointing=False, **chosen)
    every = trainer.check_val_every_n_epoch
    if every is not None and every > config.max_epochs:
        raise ConfigError(
            f"Expected `trainer.check_val_every_n_epoch` of at most {config.max_epochs}, the number of epochs, "
            f"got {every}."
        )
    for split, name in ((TRAIN, "limit_train_batches"), (VALID, "limit_val_batches")):
        maps, limit = dataset.map_count(split), getattr(trainer, name)
        batches = -(-maps // config.batch_size)
        if (batches * limit if isinstance(limit, float) else limit) < 1:
            raise ConfigError(
                f"Expected `trainer.{name}` that leaves a batch of the {batches} of split {split}, got {limit}. "
                "Leave it out to take all."
            )
    maps = dataset.map_count(TRAIN)
    together = min(2, maps // -(-maps // config.batch_size))
    batch = read_maps(dataset, TRAIN, kind.fields).read(range(together))
    try:
        with torch.no_grad():
            network.train().assess(batch)
    except (RuntimeError, ValueError, TypeError, AssertionError) as error:
        height, width = dataset.grid.shape
        raise ConfigError(
            f"Expected a network that takes batches of {together} maps of {height}×{width} cells, got "
            f"{config.architecture} of {config.encoder}, which does not: {one_line(error)} Choose another."
        ) from error


def train_parts(target: Target, config: NetworkConfig, dataset: TerrainDataset, parts: list[str]) -> None:
    """Trains the networks that a checkpoint lacks, with the seeds `seed`, `seed` + 1, …, and pools classifiers."""
    options = target.options
    for seed, part in enumerate(parts, options.seed):
        if target.holds(part, config, seed):
            continue
        network, metrics = fit_network(config, dataset, seed, options, part, options.half_precision)
        names = {"accuracy": "accuracy", "miou": "mIoU", "rmse": "RMSE", "loss": "loss"}
        shown = [
            f"{title} {metrics[f'valid_{name}']:.4f}"
            for name, title in names.items()
            if f"valid_{name}" in metrics
        ]
        calibrated = set(network.settings()) - set(asdict(config))
        shown += [f"{name} {getattr(network, name):.3f}" for name in sorted(calibrated)]
        say(f"{part}: best epoch {metrics['epoch']:.0f}, validation {', '.join(shown)}")
        trained = Part(
            config=network.settings(),
            tensors=dict(network.state_dict()),
            seed=seed,
            metrics=metrics,
            data_id=dataset.id,
            data_digest=training_digest(dataset),
            half_precision=options.half_precision,
            trainer=options.trainer_settings,
        )
        target.add(part, trained)
    if isinstance(config, ClassifierConfig):
        _calibrate_pool(target, dataset)


def _calibrate_pool(target: Target, dataset: TerrainDataset) -> None:
    """Fits the temperature of the pool of all classifiers that are there, as they are kept."""
    parts = [target.checkpoint.part(name) for name in member_names(target.checkpoint)]
    if len(parts) == 1 or not is_first_process():
        return
    classes = len(target.checkpoint.class_names)
    members = [
        TerrainClassifier.from_tensors(part.config, classes, as_stored(part.tensors, part.half_precision))
        for part in parts
    ]
    maps, options = read_maps(dataset, VALID), target.options
    temperature = fit_pool_temperature(members, maps, options.seed, options.place)
    say(f"pool of {len(members)} classifiers: temperature {temperature:.3f}")
    target.set_pool_temperature(temperature)
