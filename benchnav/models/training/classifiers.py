"""Training the classifiers of a fused model."""

from dataclasses import asdict

import torch

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.checkpoint import CLASSIFIER, Part, as_stored, member_name, member_names
from benchnav.models.config import ClassifierConfig
from benchnav.models.nets.classifier import MeanIoU, TerrainClassifier
from benchnav.models.training.data import VALID, MapData, MapDataset, check_known, read_maps, training_digest
from benchnav.models.training.fit import FitOptions, check_network, fit_network, is_first_process, say
from benchnav.models.training.target import Target
from benchnav.models.training.temperature import fit_pool_temperature, fit_temperature, sample_logits

_DEFAULT = FitOptions()


def fit_classifier(
    config: ClassifierConfig,
    dataset: TerrainDataset,
    seed: int = 0,
    options: FitOptions = _DEFAULT,
    part: str = CLASSIFIER,
    half_precision: bool = False,
) -> tuple[TerrainClassifier, dict[str, float]]:
    """Trains a classifier on the split `train` until the split `valid` no longer gains.

    Args:
        config: what to train.
        dataset: the maps.
        seed: root seed of weights, order and augmentation.
        options: how to train; precision is bf16-mixed where it is fast unless they say otherwise.
        part: name that it will bear.
        half_precision: whether its kernels will be kept as float16, to which they are rounded before its
            temperature is fitted and it is measured.

    Returns:
        The classifier with its best weights and its temperature, on the CPU, and what was measured on
        `valid`, the loss before the temperature.
    """
    data = MapData(
        dataset, config.batch_size, seed, config.jitter, in_memory=options.in_memory, workers=options.workers
    )
    model = TerrainClassifier(config, len(dataset.recipe.classes), *data.colour_statistics(), seed)
    metrics = fit_network(model, part, config, data, seed, options, half_precision, measure_classifier)
    model.temperature = fit_temperature(*sample_logits(model, data.valid, seed, options.place))
    return model.cpu(), metrics


def check_classifier(config: ClassifierConfig, dataset: TerrainDataset, options: FitOptions) -> None:
    """Refuses a classifier that could not be trained, before anything is.

    Raises:
        ConfigError: its settings or those of the trainer do not fit.
        DatasetError: the maps are too few, or none of their cells has a class.
    """
    check_known(dataset, "class_id")
    network = TerrainClassifier(config, len(dataset.recipe.classes), torch.zeros(3), torch.ones(3))
    image = torch.zeros(1, 3, *dataset.grid.shape, dtype=torch.uint8)
    check_network(network, [image], config, dataset, options)


def measure_classifier(model: TerrainClassifier, maps: MapDataset) -> dict[str, float]:
    """Measures a classifier as training does: `valid_loss`, `valid_accuracy` and `valid_miou`.

    Args:
        model: in evaluation, on any device.
        maps: with `rgb` and `class_id`.
    """
    device, loss, right, cells = model.device, 0.0, 0, 0
    miou = MeanIoU(model.class_count, ignore_index=UNLABELLED).to(device)
    with torch.inference_mode():
        for _, some in maps.chunks(device):
            logits, class_id = model(some["rgb"]), some["class_id"].long()
            labelled = int((class_id != UNLABELLED).sum())
            loss += float(model.loss(logits, class_id)) * labelled
            chosen = logits.argmax(1)
            right += int((chosen == class_id).sum())
            cells += labelled
            miou.update(chosen, class_id)
    return {
        "valid_loss": loss / max(1, cells),
        "valid_accuracy": right / max(1, cells),
        "valid_miou": float(miou.compute()),
    }


def train_members(
    target: Target,
    config: ClassifierConfig,
    dataset: TerrainDataset,
    members: int,
    seed: int,
    options: FitOptions,
    half_precision: bool,
) -> None:
    """Trains the classifiers that a checkpoint lacks, with the seeds `seed`, `seed` + 1, …, and pools them all."""
    for index in range(members):
        part = member_name(index)
        if not target.holds(part, asdict(config), seed + index, asdict(ClassifierConfig()), half_precision):
            target.add(part, _train_member(config, dataset, seed + index, options, part, half_precision))
    _calibrate_pool(target, dataset, seed, options.place)


def _train_member(
    config: ClassifierConfig,
    dataset: TerrainDataset,
    seed: int,
    options: FitOptions,
    part: str,
    half_precision: bool,
) -> Part:
    model, metrics = fit_classifier(config, dataset, seed, options, part, half_precision)
    say(
        f"{part}: best epoch {metrics['epoch']:.0f}, validation accuracy {metrics['valid_accuracy']:.4f}, "
        f"mIoU {metrics['valid_miou']:.4f}, loss {metrics['valid_loss']:.4f}, "
        f"temperature {model.temperature:.3f}"
    )
    return Part(
        config={**asdict(config), "temperature": model.temperature},
        tensors=dict(model.state_dict()),
        seed=seed,
        metrics=metrics,
        data_id=dataset.id,
        data_digest=training_digest(dataset),
        half_precision=half_precision,
        trainer=options.trainer_settings,
    )


def _calibrate_pool(target: Target, dataset: TerrainDataset, seed: int, device: torch.device) -> None:
    """Fits the temperature of the pool of all classifiers that are there, as they are kept."""
    there = target.checkpoint
    parts = [there.part(name) for name in member_names(there)]
    if len(parts) == 1 or not is_first_process():
        return
    classes = len(there.class_names)
    members = [
        TerrainClassifier.from_tensors(part.config, classes, as_stored(part.tensors, part.half_precision))
        for part in parts
    ]
    temperature = fit_pool_temperature(members, read_maps(dataset, VALID), seed, device)
    say(f"pool of {len(members)} classifiers: temperature {temperature:.3f}")
    target.set_pool_temperature(temperature)
