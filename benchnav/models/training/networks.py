"""Training networks, whatever they learn: one door for classifiers, mixture-density networks and those to come."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import torch
from lightning.pytorch.callbacks import EarlyStopping

from benchnav.core.errors import ConfigError, expect
from benchnav.core.settings import one_line
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import (
    CLASSIFIER,
    FUSED,
    GP,
    Part,
    as_stored,
    member_name,
    training_folder,
)
from benchnav.models.config import ClassifierConfig, LatentGPConfig, NetworkConfig, TrainOptions, check_seed
from benchnav.models.nets.classifier import TerrainClassifier, classifiers_of, fit_pool_temperature
from benchnav.models.nets.mdn import MixtureDensityNetwork
from benchnav.models.training.data import (
    TRAIN,
    VALID,
    MapData,
    MapDataset,
    check_maps,
    open_dataset,
    training_digest,
)
from benchnav.models.training.fit import (
    FitOptions,
    KeepBest,
    fit,
    in_words,
    is_first_process,
    make_trainer,
    quietly,
    say,
)
from benchnav.models.training.gaussian_processes import train_gps_on_maps
from benchnav.models.training.target import Target, fresh_checkpoint, open_target

NETWORKS: Mapping[type, Any] = {
    network.kind: network for network in (TerrainClassifier, MixtureDensityNetwork)
}


def train_networks(
    how: TrainOptions,
    data: str,
    out: str,
    config: NetworkConfig,
    gp: LatentGPConfig | None = None,
    members: int = 1,
) -> None:
    """Trains what a checkpoint lacks of a model: the class-wise GPs where they are asked for, then networks.

    Args:
        how: how to train.
        data: path or id of a dataset.
        out: folder of the checkpoint.
        config: of the networks.
        gp: of the GPs, if any.
        members: how many classifiers there are to be.
    """
    expect(members >= 1, f"`members` ≥ 1, got {members}.")
    check_seed(how.seed, members)
    dataset, trainer = open_dataset(data), dict(how.trainer or {})
    # The length of training is the network's own setting, wherever it is said.
    config = replace(config, max_epochs=trainer.pop("max_epochs", config.max_epochs))
    options = FitOptions(**{**vars(how), "trainer": trainer, "folder": training_folder(out)})
    check_network(config, dataset, options)
    part = NETWORKS[type(config)].part
    parts, model = [part], part
    if part == CLASSIFIER:
        parts, model = [member_name(index) for index in range(members)], FUSED
    trained = [GP] * bool(gp) + parts
    target = open_target(out, fresh_checkpoint(dataset, model), trained, training_digest(dataset), options)
    if gp and not target.holds(GP, gp, how.seed):
        target.add(GP, train_gps_on_maps(gp, dataset, options))
    train_parts(target, config, dataset, parts)
    if not target.changed:
        print(f"{out} was finished already, with {' and '.join(sorted(target.checkpoint.parts))}")


def fit_network(
    config: NetworkConfig,
    dataset: TerrainDataset,
    seed: int,
    options: FitOptions,
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
    network = kind(config, len(dataset.recipe.classes), data.scale(), seed)
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
        metrics = {**metrics, **network.measure(data.valid)}
    network.calibrate(data.valid, seed, options.place)
    return network.cpu(), metrics


def check_network(config: NetworkConfig, dataset: TerrainDataset, options: FitOptions) -> None:
    """Refuses what could not be trained before anything is: builds the trainer and tries the network on a batch.

    Raises:
        ConfigError: Lightning or the network does not take the settings, or nothing would be trained or measured.
        DatasetError: there are too few maps, or none of their cells has what is learned.
    """
    kind = NETWORKS[type(config)]
    check_maps(dataset, kind.fields[-1])
    network = kind(config, len(dataset.recipe.classes))
    with quietly():
        chosen = options.chosen(max_epochs=config.max_epochs)
        trainer = make_trainer([], logger=False, enable_checkpointing=False, **chosen)
    every = trainer.check_val_every_n_epoch or 0
    expect(
        every <= config.max_epochs,
        f"`trainer.check_val_every_n_epoch` of at most {config.max_epochs}, the number of epochs, got {every}.",
    )
    for split, name in ((TRAIN, "limit_train_batches"), (VALID, "limit_val_batches")):
        limit, batches = getattr(trainer, name), -(-dataset.map_count(split) // config.batch_size)
        expect(
            (batches * limit if isinstance(limit, float) else limit) >= 1,
            f"`trainer.{name}` that leaves a batch of the {batches} of split {split}, got {limit}. "
            "Leave it out to take all.",
        )
    maps = dataset.map_count(TRAIN)
    together = min(2, maps // -(-maps // config.batch_size))
    batch = MapDataset(dataset.path, TRAIN, ("rgb", *kind.fields)).read(range(together))
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
        calibrated = {name: value for name, value in network.settings().items() if name not in vars(config)}
        shown = filter(None, [in_words(metrics, "valid_"), in_words(calibrated)])
        say(f"{part}: best epoch {metrics['epoch']:.0f}, validation {', '.join(shown)}")
        trained = Part(
            config=network.settings(),
            tensors=dict(network.state_dict()),
            seed=seed,
            metrics=metrics,
            data_id=dataset.id,
            data_digest=target.digest,
            half_precision=options.half_precision,
            trainer=options.trainer_settings,
        )
        target.add(part, trained)
    if not isinstance(config, ClassifierConfig) or not is_first_process():
        return
    members = classifiers_of(target.checkpoint)
    if len(members) == 1:
        return
    temperature = fit_pool_temperature(members, MapDataset(dataset.path, VALID), options.seed, options.place)
    say(f"pool of {len(members)} classifiers: temperature {temperature:.3f}")
    target.set_pool_temperature(temperature)
