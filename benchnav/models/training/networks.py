"""Training networks, whatever they learn: one door for classifiers, trainable models of
ours and a user's own.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import EarlyStopping

from benchnav.core import registry
from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory
from benchnav.core.settings import config_class, of, one_line, read
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import layer_means
from benchnav.models.checkpoint import (
    CLASSIFIER,
    FUSED,
    GP,
    Part,
    as_stored,
    member_name,
    member_names,
    training_folder,
)
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
from benchnav.models.nets.trainable import TrainableModel
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
    stopping_every,
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
from benchnav.models.training.fit import (
    FitOptions,
    fit,
    in_words,
    interrupted,
    is_first_process,
    say,
)
from benchnav.models.training.gaussian_processes import train_gps_on_maps
from benchnav.models.training.masks import RandomMasks
from benchnav.models.training.target import Target, fresh_checkpoint, open_target

MAX_MEMBERS = 1000  # of an ensemble
_FEW_MAPS = 19  # with which 1 / (n + 1) is 0.05


def find_trainable(source: str, settings: dict[str, Any]) -> Trainable:
    """Finds a trainable model by name, file or module.

    Raises:
        ConfigError: there is none of that name, it cannot be trained, or has no such
            settings.
    """
    found = find_kind(source)
    kind = found.target
    if not (isinstance(kind, type) and issubclass(kind, TrainableModel)):
        raise ConfigError(
            f"Expected a model that can be trained, {', '.join(_trainable_names())} "
            "or FILE.py:Class with a "
            f"benchnav.models.TrainableModel, got {source!r}, which is none."
        )
    owner, config_kind = f"model {source!r}", config_class(kind)
    if config_kind is None or not issubclass(config_kind, TrainingConfig):
        raise ConfigError(
            f"Expected {owner} to be made with one parameter `config`, a "
            "benchnav.models.TrainingConfig, got another. "
            "Write def __init__(self, config: MyConfig = MyConfig()), where MyConfig "
            "is a subclass of it."
        )
    config = read(config_kind, settings, of(owner))
    name, known = kind.__name__, registry.names("model")
    if source in known:
        name = source
    elif name in (CLASSIFIER, GP) or (
        name in known and registry.find("model", name).target is not kind
    ):
        raise ConfigError(
            "Expected a class with a name of its own, which its checkpoints bear, "
            f"got {name!r}, which is one of this "
            "package's. Rename it."
        )
    code = "" if found.shipped else found.digest
    return Trainable(kind=kind, config=config, name=name, family=name, code=code)


def find_kind(source: str) -> registry.Found:
    """Finds the class of a model, by a name only among those that can be trained.

    Raises:
        ConfigError: there is none, or it cannot be imported.
    """
    is_name = not (
        ":" in source or source.endswith(".py") or Path(f"{source}.py").is_file()
    )
    if is_name and source not in registry.names("model"):
        names = _trainable_names()
        raise ConfigError(
            f"Expected a model that can be trained, {', '.join(names)} or "
            f"FILE.py:Class, got {source!r}." + registry.hint(source, names)
        )
    return registry.find("model", source)


def _trainable_names() -> list[str]:
    return [FUSED, *(name for name in registry.names("model") if is_trainable(name))]


def is_trainable(name: str) -> bool:
    """Return whether a registered model can be trained; one that cannot be imported
    cannot.
    """
    try:
        kind = registry.find("model", name).target
    except ConfigError:
        return False
    return isinstance(kind, type) and issubclass(kind, TrainableModel)


def fit_model(
    how: TrainOptions,
    model: str,
    data: str,
    out: str,
    settings: dict[str, Any],
    members: int = 1,
) -> None:
    """Trains any model: the fused one in its two stages, every other in one.

    Args:
        how: how to train.
        model: registered name, package.module:Class or path/to/file.py:Class.
        data: path or id of a dataset.
        out: folder of the checkpoint.
        settings: of the model, plain data by name; of the fused one those of its
            stages, `classifier` and `gp`.
        members: how many networks there are to be.
    """
    if find_kind(model).target is FusedModel:
        kinds = {CLASSIFIER: ClassifierConfig, GP: LatentGPConfig}
        unknown = [name for name in settings if name not in kinds]
        expect(
            not unknown,
            f"`settings` of {model!r} among {', '.join(kinds)}, got "
            f"{', '.join(unknown)}.",
        )
        read_settings: Any = {
            name: read(kind, settings.get(name, {}), of(name))
            for name, kind in kinds.items()
        }
        train_networks(
            how,
            data,
            out,
            classifier_of(read_settings[CLASSIFIER]),
            read_settings[GP],
            members,
        )
        return
    train_networks(how, data, out, find_trainable(model, settings), members=members)


def classifier_of(config: ClassifierConfig) -> Trainable:
    """The classifier of a fused model."""
    return Trainable(
        kind=TerrainClassifier, config=config, name=CLASSIFIER, family=FUSED
    )


def train_networks(
    how: TrainOptions,
    data: str,
    out: str,
    trainable: Trainable,
    gp: LatentGPConfig | None = None,
    members: int = 1,
) -> None:
    """Trains what a checkpoint lacks of a model: the class-wise GPs where they are
    asked for, then networks.

    Args:
        how: how to train.
        data: path or id of a dataset.
        out: folder of the checkpoint.
        trainable: the networks.
        gp: of the GPs, if any.
        members: how many networks there are to be.
    """
    expect(1 <= members <= MAX_MEMBERS, f"`members` in 1–{MAX_MEMBERS}, got {members}.")
    check_seed(how.seed, members)
    dataset, trainer = open_dataset(data), dict(how.trainer or {})
    # These are the network's own settings, wherever they are said.
    config = replace(
        trainable.config,
        max_epochs=trainer.pop("max_epochs", trainable.config.max_epochs),
        symmetries=_is_turned(how, trainable.config, dataset),
        crop=how.crop or trainable.config.crop,
    )
    trainable = replace(trainable, config=config)
    options = FitOptions(
        **{**vars(how), "trainer": trainer, "folder": training_folder(out)}
    )
    check_network(trainable, dataset, options)
    if how.conformal:
        check_valid(dataset)
    parts = [member_name(index, trainable.name) for index in range(members)]
    trained = [GP] * bool(gp) + parts
    fresh = fresh_checkpoint(dataset, trainable.family, trainable.code)
    target = open_target(
        out, fresh, trained, training_digest(dataset), options, dataset
    )
    expect(
        not how.conformal
        or bool(gp)
        or trainable.family != FUSED
        or GP in target.checkpoint.parts,
        f"a whole model for `conformal`, got {trainable.name} alone. Train the GPs "
        f"into {out} first, or take "
        "`benchnav-train all`.",
    )
    try:
        if gp and not target.holds(GP, gp, how.seed):
            target.add(GP, train_gps_on_maps(gp, dataset, options))
        train_parts(target, trainable, dataset, parts)
        if how.conformal and is_first_process():
            calibrate_whole(target, trainable, dataset)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(_kept(target, trained, options)) from None
    if not target.changed and is_first_process():
        print(
            f"{out} was finished already and holds "
            f"{' and '.join(sorted(target.checkpoint.parts))}"
        )


def _is_turned(
    how: TrainOptions, config: TrainingConfig, dataset: TerrainDataset
) -> bool:
    """Return whether training maps are turned and mirrored: those with a photo only
    where the user asks for it.
    """
    is_lit = "rgb" in config.inputs and dataset.has_photo(TRAIN)
    if how.symmetries is None and is_lit and config.symmetries:
        say(
            "note: maps with a photo are not turned or mirrored; pass --symmetries "
            "true to do so"
        )
    return config.symmetries and (
        not is_lit if how.symmetries is None else how.symmetries
    )


def _kept(target: Target, trained: Sequence[str], options: FitOptions) -> str:
    """Says what an interrupted training has kept, and how to go on with it."""
    kept = [name for name in trained if name in target.checkpoint.parts]
    kept += [
        f"the finished epochs of {name}"
        for name in interrupted(options, trained)
        if name not in kept
    ]
    if not kept:
        return "nothing was finished; give the same command again"
    instead = " in place of --overwrite" if options.overwrite else ""
    return (
        f"{' and '.join(kept)} kept; to go on, give the same command with "
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
    """Trains a network on the split `train` until the split `valid` no longer gains,
    and calibrates it.

    Args:
        trainable: what to train.
        dataset: the maps.
        seed: root seed of weights, order and augmentation.
        options: how to train; precision is bf16-mixed where it is fast unless they say
            otherwise.
        part: name of the part of a model that it is, where it is not the usual one.
        half_precision: whether its kernels will be kept as float16, to which they are
            rounded before it is calibrated and measured.

    Returns:
        The network with the weights that are kept, on the CPU, and what was measured of
        them on `valid`, before it was calibrated.
    """
    config, network = trainable.config, trainable.kind(trainable.config)
    augmentation = Augmentation(jitter=config.jitter, symmetries=config.symmetries)
    loading = Loading(
        in_memory=options.in_memory,
        workers=options.workers,
        valid_every=stopping_every(options.conformal),
    )
    masks = masks_of(config, dataset)
    data = MapData(
        dataset,
        config.batch_size,
        seed,
        fields_of(network),
        augmentation,
        config.crop,
        loading,
        masks,
    )
    network.build(data.scale(network.inputs), class_names(dataset), seed)
    early = [
        EarlyStopping(
            "valid_loss", patience=config.patience, check_on_train_epoch_end=False
        )
    ]
    metrics = fit(
        network,
        part or trainable.name,
        options,
        {
            "config": plain_config(config),
            "data": training_digest(dataset),
            "seed": seed,
            "half_precision": half_precision,
            **({"code": trainable.code} if trainable.code else {}),
            **({"conformal": True} if options.conformal else {}),
        },
        [
            KeepBest(last=not network.stops_early),
            *(early if network.stops_early else []),
        ],
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
    except Exception as error:  # a user's code may raise anything
        raise out_of_memory(error) or ConfigError(
            f"Expected `calibrate` of {type(network).__name__} to succeed, got: "
            f"{one_line(error)} "
            "Mend it, and train again with --overwrite."
        ) from error
    return network.cpu(), metrics


def masks_of(config: TrainingConfig, dataset: TerrainDataset) -> RandomMasks | None:
    """What masks the maps of a training; None where all of them is seen."""
    if not config.masking.share:
        return None
    return RandomMasks(
        law=config.masking,
        means=layer_means(dataset),
        resolution_m=dataset.grid.resolution_m,
    )


def train_parts(
    target: Target, trainable: Trainable, dataset: TerrainDataset, parts: list[str]
) -> None:
    """Trains the networks that a checkpoint lacks, with the seeds `seed`, `seed` + 1,
    …, and calibrates their pool.
    """
    options, config = target.options, trainable.config
    for seed, part in enumerate(parts, options.seed):
        if target.holds(part, config, seed):
            continue
        network, metrics = fit_network(
            trainable, dataset, seed, options, part, options.half_precision
        )
        calibrated = (
            {} if network.temperature == 1 else {"temperature": network.temperature}
        )
        shown = filter(None, [in_words(metrics, "valid_"), in_words(calibrated)])
        kept = "best" if network.stops_early else "last"
        say(
            f"{part}: {kept} epoch {metrics['epoch']:.0f}, validation "
            f"{', '.join(shown)}"
        )
        trained = Part(
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
        target.add(part, trained)
    names = member_names(target.checkpoint, trainable.name)
    if len(names) == 1 or not is_first_process():
        return
    found = [target.checkpoint.part(name) for name in names]
    classes = target.checkpoint.class_names
    members = [
        trainable.kind.from_tensors(part.config, classes, part.tensors)
        for part in found
    ]
    maps = MapDataset(
        dataset.path,
        VALID,
        fields_of(members[0]),
        crop=config.crop,
        seed=options.seed,
        every=stopping_every(options.conformal),
        masks=masks_of(config, dataset),
    )
    temperature = trainable.kind.fit_pool(members, maps, options.seed, options.place)
    say(f"pool of {len(members)} networks: temperature {temperature:.3f}")
    target.set_pool_temperature(temperature)


def calibrate_whole(
    target: Target, trainable: Trainable, dataset: TerrainDataset
) -> None:
    """Recalibrates a trained model on the maps of `valid` that its parts have not seen,
    unless it has been.
    """
    if target.checkpoint.conformal:
        return
    family: type[Any] = FusedModel if trainable.family == FUSED else trainable.kind
    model, options = family.from_checkpoint(target.checkpoint), target.options
    table = conformal_table(model, dataset, options.seed, options.place)
    fifth = table.values[table.levels.index(0.2)]
    say(
        f"conformal: by {table.maps} maps of {VALID}, the lower fifth is read at "
        f"level {fifth:.3f}"
    )
    if table.maps < _FEW_MAPS:
        least = 1 / (table.maps + 1)
        say(
            f"note: levels under 1 / {table.maps + 1} = {least:.2f} give the lowest "
            f"λ; give {VALID} more maps"
        )
    target.set_conformal(table.plain())
