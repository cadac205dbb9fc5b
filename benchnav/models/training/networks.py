"""Training of networks: classifiers and trainable models, including custom models."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from lightning.pytorch.callbacks import Callback, EarlyStopping

from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory_error
from benchnav.core.settings import of, one_line, read
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import layer_means
from benchnav.models.checkpoint import FUSED, Part, as_stored, member_names
from benchnav.models.config import (
    ClassifierConfig,
    LatentGPConfig,
    TrainingConfig,
    TrainOptions,
    check_seed,
    plain_config,
)
from benchnav.models.fused import FusedModel
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.parts import CLASSIFIER, GP, member_name, training_folder
from benchnav.models.training.best import KeepBest
from benchnav.models.training.check import (
    Trainable,
    check_network,
    class_names,
    fields_of,
)
from benchnav.models.training.conformal import (
    check_valid,
    conformal_table,
    stopping_step,
)
from benchnav.models.training.data import (
    TRAIN,
    VALID,
    Augmentation,
    Loading,
    MapData,
    MapDataset,
    open_dataset,
    training_digest,
)
from benchnav.models.training.find import find_kind, find_trainable
from benchnav.models.training.fit import (
    FitOptions,
    fit,
    interrupted,
    is_first_process,
    say,
)
from benchnav.models.training.gaussian_processes import train_gps_on_maps
from benchnav.models.training.history import in_words
from benchnav.models.training.masks import RandomMasks
from benchnav.models.training.target import Target, fresh_checkpoint, open_target

MAX_MEMBERS = 1000  # maximum number of members of an ensemble
_MIN_SCORED_MAPS = 19  # number n of maps for which the lowest level 1 / (n + 1) is 0.05


def fit_model(
    how: TrainOptions,
    model: str,
    data: str,
    out: str,
    settings: dict[str, Any],
    members: int = 1,
) -> None:
    """Train a model of any kind and save it as a checkpoint.

    Args:
        how: training options.
        model: registered name, package.module:Class or path/to/file.py:Class.
        data: path or id of a dataset.
        out: folder of the checkpoint.
        settings: settings of the model as plain data by name; for the fused model, the
            settings of its stages under `classifier` and `gp`.
        members: number of networks of an ensemble, 1–1000.
    """
    if find_kind(model).target is not FusedModel:
        trainable = find_trainable(model, settings)
        train_networks(how, data, out, trainable, members=members)
        return
    unknown = [name for name in settings if name not in (CLASSIFIER, GP)]
    expect(
        not unknown,
        f"`settings` of {model!r} to be among {CLASSIFIER} and {GP}, got "
        f"{', '.join(unknown)}.",
    )
    classifier = read(ClassifierConfig, settings.get(CLASSIFIER, {}), of(CLASSIFIER))
    gp = read(LatentGPConfig, settings.get(GP, {}), of(GP))
    train_networks(how, data, out, classifier_of(classifier), gp, members)


def classifier_of(config: ClassifierConfig) -> Trainable:
    """Return the classifier of a fused model as a trainable network."""
    return Trainable(
        kind=TerrainClassifier, config=config, name=CLASSIFIER, family=FUSED
    )


def train_networks(
    train_options: TrainOptions,
    data: str,
    out: str,
    trainable: Trainable,
    gp: LatentGPConfig | None = None,
    members: int = 1,
) -> None:
    """Train the missing parts of a checkpoint: the class-wise GPs, then networks.

    Args:
        train_options: training options.
        data: path or id of a dataset.
        out: folder of the checkpoint.
        trainable: network to train.
        gp: settings of the GPs; None to train no GPs.
        members: number of networks of an ensemble, 1–1000.
    """
    expect(1 <= members <= MAX_MEMBERS, f"`members` in 1–{MAX_MEMBERS}, got {members}.")
    check_seed(train_options.seed, members)
    dataset = open_dataset(data)
    trainer = dict(train_options.trainer or {})
    config = trainable.config
    # Training options take precedence over settings of the network.
    config = replace(
        config,
        max_epochs=trainer.pop("max_epochs", config.max_epochs),
        symmetries=_has_symmetries(train_options, config, dataset),
        crop=train_options.crop or config.crop,
    )
    trainable = replace(trainable, config=config)
    folder = training_folder(out)
    options = FitOptions(
        **{**vars(train_options), "trainer": trainer, "folder": folder}
    )
    check_network(trainable, dataset, options)
    if options.conformal:
        check_valid(dataset)
    parts = [member_name(index, trainable.name) for index in range(members)]
    all_parts = [GP, *parts] if gp else parts
    fresh = fresh_checkpoint(dataset, trainable.family, trainable.code)
    digest = training_digest(dataset)
    target = open_target(out, fresh, all_parts, digest, options, dataset)
    is_complete = bool(gp) or trainable.family != FUSED or GP in target.checkpoint.parts
    expect(
        not options.conformal or is_complete,
        f"a complete model for `conformal`, got {trainable.name} without GPs. Train "
        f"the GPs into {out} first, or use `benchnav-train all`.",
    )
    try:
        if gp and not target.has_part(GP, gp, options.seed):
            target.add(GP, train_gps_on_maps(gp, dataset, options))
        train_parts(target, trainable, dataset, parts)
        if options.conformal and is_first_process():
            calibrate_conformal(target, trainable, dataset)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(_resume_hint(target, all_parts, options)) from None
    if not target.changed and is_first_process():
        finished = " and ".join(sorted(target.checkpoint.parts))
        print(f"{out} was finished already and contains {finished}")


def _has_symmetries(
    options: TrainOptions, config: TrainingConfig, dataset: TerrainDataset
) -> bool:
    """Return whether to rotate and mirror training maps; by default not maps of a photo."""
    if not config.symmetries:
        return False
    if options.symmetries is not None:
        return options.symmetries
    has_photo = "rgb" in config.inputs and dataset.has_photo(TRAIN)
    if has_photo:
        say(
            "note: maps with a photo are not rotated and mirrored; pass --symmetries true "
            "to rotate and mirror them"
        )
    return not has_photo


def _resume_hint(target: Target, parts: Sequence[str], options: FitOptions) -> str:
    """Return the finished parts and epochs of an interrupted training, and a remedy."""
    finished = [name for name in parts if name in target.checkpoint.parts]
    finished += [
        f"the finished epochs of {name}"
        for name in interrupted(options, parts)
        if name not in finished
    ]
    if not finished:
        return "nothing was finished; run the same command again"
    instead = " instead of --overwrite" if options.overwrite else ""
    return (
        f"{' and '.join(finished)} kept; to resume, run the same command with "
        f"--resume{instead}"
    )


def fit_network(
    trainable: Trainable,
    dataset: TerrainDataset,
    seed: int,
    options: FitOptions,
    part: str = "",
    half_precision: bool = False,
) -> tuple[Any, dict[str, float]]:
    """Train a network on `train` until `valid` no longer improves, and calibrate it.

    Args:
        trainable: network to train.
        dataset: dataset of the maps.
        seed: root seed of weights, map order and augmentation.
        options: training options; the default of precision is `default_precision`.
        part: name of the part of the model; if empty, that of `trainable`.
        half_precision: whether the kernels will be stored as float16; if so, they are
            rounded before the network is calibrated and measured.

    Returns:
        The network with the selected weights, on the CPU, and its metrics on `valid`
        before calibration.
    """
    config = trainable.config
    network = trainable.kind(config)
    data = MapData(
        dataset,
        config.batch_size,
        seed,
        fields_of(network),
        Augmentation(jitter=config.jitter, symmetries=config.symmetries),
        config.crop,
        Loading(
            in_memory=options.in_memory,
            workers=options.workers,
            valid_every=stopping_step(options.conformal),
        ),
        masks_of(config, dataset),
    )
    network.build(data.scale(network.inputs), class_names(dataset), seed)
    settings = {
        "config": plain_config(config),
        "data": training_digest(dataset),
        "seed": seed,
        "half_precision": half_precision,
    }
    if trainable.code:
        settings["code"] = trainable.code
    if options.conformal:
        settings["conformal"] = True
    callbacks: list[Callback] = [KeepBest(last=not network.stops_early)]
    if network.stops_early:
        early_stopping = EarlyStopping(
            "valid_loss", patience=config.patience, check_on_train_epoch_end=False
        )
        callbacks.append(early_stopping)
    metrics = fit(
        network,
        part or trainable.name,
        options,
        settings,
        callbacks,
        {"datamodule": data},
        max_epochs=config.max_epochs,
    )
    network.to(options.place).eval()
    if half_precision:
        network.load_state_dict(as_stored(network.state_dict(), half_precision))
    if half_precision or not network.stops_early:
        metrics = {**metrics, **network.measure(data.valid)}
    try:
        network.calibrate(data.valid, options.place)
    except BenchnavError:
        raise
    except Exception as error:  # custom code may raise any error
        raise out_of_memory_error(error) or ConfigError(
            f"Expected `calibrate` of {type(network).__name__} to succeed, got: "
            f"{one_line(error).rstrip('.')}. Correct it, and train again with "
            "--overwrite."
        ) from error
    return network.cpu(), metrics


def masks_of(config: TrainingConfig, dataset: TerrainDataset) -> RandomMasks | None:
    """Return the random masks of a training; None if no map is masked."""
    if not config.masking.share:
        return None
    return RandomMasks(
        masking=config.masking,
        means=layer_means(dataset),
        resolution_m=dataset.grid.resolution_m,
    )


def train_parts(
    target: Target, trainable: Trainable, dataset: TerrainDataset, parts: list[str]
) -> None:
    """Train the missing networks of a checkpoint, and calibrate their average.

    The networks have the seeds `seed`, `seed` + 1, ….
    """
    options = target.options
    for seed, part in enumerate(parts, options.seed):
        if not target.has_part(part, trainable.config, seed):
            _train_part(target, trainable, dataset, part, seed)
    names = member_names(target.checkpoint, trainable.name)
    if len(names) == 1 or not is_first_process():
        return
    class_table = target.checkpoint.class_names
    members = []
    for name in names:
        stored = target.checkpoint.part(name)
        member = trainable.kind.from_tensors(stored.config, class_table, stored.tensors)
        members.append(member)
    maps = MapDataset(
        dataset.path,
        VALID,
        fields_of(members[0]),
        crop=trainable.config.crop,
        seed=options.seed,
        step=stopping_step(options.conformal),
        masks=masks_of(trainable.config, dataset),
    )
    temperature = trainable.kind.fit_pool(members, maps, options.seed, options.place)
    say(f"pool of {len(members)} networks: temperature {temperature:.3f}")
    target.set_pool_temperature(temperature)


def _train_part(
    target: Target, trainable: Trainable, dataset: TerrainDataset, name: str, seed: int
) -> None:
    """Train one network, print its metrics, and add it to a checkpoint."""
    options = target.options
    network, metrics = fit_network(
        trainable, dataset, seed, options, name, options.half_precision
    )
    shown = [in_words(metrics, "valid_")]
    if network.temperature != 1:
        shown.append(in_words({"temperature": network.temperature}))
    selected = "best" if network.stops_early else "last"
    say(
        f"{name}: {selected} epoch {metrics['epoch']:.0f}, validation "
        f"{', '.join(filter(None, shown))}"
    )
    part = Part(
        config=network.settings(),
        tensors=dict(network.state_dict()),
        seed=seed,
        metrics=metrics,
        data_id=dataset.id,
        data_digest=target.digest,
        half_precision=options.half_precision,
        trainer=options.trainer_settings,
        conformal=options.conformal,
    )
    target.add(name, part)


def calibrate_conformal(
    target: Target, trainable: Trainable, dataset: TerrainDataset
) -> None:
    """Recalibrate a model on the maps of `valid` that its training has not used.

    A model that is already recalibrated does not change.
    """
    if target.checkpoint.conformal:
        return
    family: type[Any] = FusedModel if trainable.family == FUSED else trainable.kind
    model = family.from_checkpoint(target.checkpoint)
    options = target.options
    table = conformal_table(model, dataset, options.seed, options.place)
    level = table.values[table.levels.index(0.2)]
    say(
        f"conformal: with {table.maps} maps of {VALID}, the guaranteed quantile at level "
        f"0.2 is the model's quantile at level {level:.3f}"
    )
    if table.maps < _MIN_SCORED_MAPS:
        min_level = 1 / (table.maps + 1)
        say(
            f"note: quantiles at levels below 1 / {table.maps + 1} = {min_level:.2f} are "
            f"the lowest λ; add maps to {VALID} for lower levels"
        )
    target.set_conformal(table.plain())
