"""Training the parts of a fused model: the classifier and the class-wise GPs."""

from dataclasses import asdict

import torch
from lightning.pytorch.callbacks import EarlyStopping
from torchmetrics.classification import MulticlassJaccardIndex

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import CLASSIFIER, GP, as_stored
from benchnav.models.config import ClassifierConfig, LatentGPConfig
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.slope_gp.gp import LatentGPs, load_batches
from benchnav.models.slope_gp.soft_modes import find_soft_modes, main_bins
from benchnav.models.slope_gp.sums import SlopeSums
from benchnav.models.training.data import TRAIN, VALID, MapData, MapDataset
from benchnav.models.training.fit import FitOptions, KeepBest, fit
from benchnav.models.training.temperature import fit_temperature, sample_logits

_DEFAULT = FitOptions()


def training_digest(dataset: TerrainDataset) -> str:
    """Content digest of what of a dataset is trained on."""
    return ",".join(f"{name}:{dataset.splits[name]['digest']}" for name in (TRAIN, VALID))


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
    settings = {"config": asdict(config), "data": training_digest(dataset), "seed": seed}
    stopping = EarlyStopping("valid_loss", patience=config.patience, check_on_train_epoch_end=False)
    metrics = fit(
        model,
        part,
        options,
        settings,
        [KeepBest(), stopping],
        {"datamodule": data},
        max_epochs=config.max_epochs,
    )
    model.cpu().eval()
    if half_precision:
        model.load_state_dict(as_stored(model.state_dict(), half_precision))
        metrics = {**metrics, **measure_classifier(model, data.valid)}
    model.temperature = fit_temperature(*sample_logits(model, data.valid, seed))
    return model, metrics


def measure_classifier(model: TerrainClassifier, maps: MapDataset) -> dict[str, float]:
    """Measures a classifier as training does: `valid_loss`, `valid_accuracy` and `valid_miou`.

    Args:
        model: in evaluation, on the CPU.
        maps: with `rgb` and `class_id`.
    """
    loss, right, miou = 0.0, 0, MulticlassJaccardIndex(model.class_count)
    with torch.inference_mode():
        for indices, some in maps.chunks():
            logits, class_id = model(some["rgb"]), some["class_id"].long()
            loss += float(model.loss(logits, class_id)) * len(indices)
            chosen = logits.argmax(1)
            right += int((chosen == class_id).sum())
            miou.update(chosen, class_id)
    return {
        "valid_loss": loss / len(maps),
        "valid_accuracy": right / (len(maps) * maps.shape[0] * maps.shape[1]),
        "valid_miou": float(miou.compute()),
    }


def fit_gps(config: LatentGPConfig, sums: SlopeSums, options: FitOptions = _DEFAULT) -> LatentGPs:
    """Trains the class-wise GPs on sums over cells, in float64 on one device; nothing is drawn.

    Args:
        config: what to train.
        sums: of the cells of all classes, from maps or from a robot's logs.
        options: how to train; of the trainer's settings the accelerator alone counts.

    Returns:
        The GPs, on the CPU.
    """
    censored = config.likelihood == "censored"
    soft, bins = None, sums.bins(censored)
    if config.second_component and censored:
        soft, share = find_soft_modes(sums)
        bins = main_bins(sums, soft, share) if soft else bins
    model = LatentGPs(config, len(sums.count), sums.steepest_deg, soft)
    accelerator = {name: value for name, value in options.trainer.items() if name == "accelerator"}
    fit(
        model,
        GP,
        FitOptions(trainer=accelerator),
        {},
        [],
        {"train_dataloaders": load_batches(config, bins)},
        max_epochs=config.epochs,
        precision="64-true",
    )
    return model.cpu().eval()
