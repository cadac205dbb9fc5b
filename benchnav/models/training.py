"""Fitting the classifier and the class-wise GPs with Lightning, quietly and leaving no files.

Progress is a bar in a terminal and a line an epoch elsewhere.
"""

import logging
import signal
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, EarlyStopping
from torch import Tensor

from benchnav.datagen.store import TerrainDataset
from benchnav.errors import ConfigError
from benchnav.models.classifier import TerrainClassifier
from benchnav.models.config import ClassifierConfig, LatentGPConfig
from benchnav.models.data import MapData, PixelTable
from benchnav.models.latent_gp import LatentGPs, load_batches

DEVICES = ("auto", "cpu", "cuda")


class KeepBest(Callback):
    """Keeps the weights of the epoch with the lowest validation loss and restores them at the end."""

    def __init__(self) -> None:
        """Starts with none."""
        self.loss = float("inf")
        self.metrics: dict[str, float] = {}
        self.weights: dict[str, Tensor] = {}

    def on_validation_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Copies the weights when they are the best so far."""
        measured = _measured(trainer)
        if measured["valid_loss"] < self.loss:
            self.loss, self.metrics = measured["valid_loss"], {**measured, "epoch": trainer.current_epoch + 1}
            self.weights = {name: value.detach().clone() for name, value in module.state_dict().items()}

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Puts the best weights back."""
        if not self.weights:
            raise ConfigError(
                "Expected a finite validation loss, got none. Train with a lower `learning_rate`."
            )
        module.load_state_dict(self.weights)


class Progress(Callback):
    """Shows how far training is.

    Args:
        what: what is trained.
    """

    def __init__(self, what: str) -> None:
        """Finds out whether there is a terminal."""
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            TaskProgressColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
        from rich.progress import Progress as Bar

        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        self.what, self.on_terminal = what, console.is_terminal
        self.bar = Bar(*columns, TimeRemainingColumn(), console=console, disable=not self.on_terminal)
        self.task = self.bar.add_task(what, total=None)

    def on_train_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Shows the bar."""
        self.bar.update(self.task, total=int(trainer.estimated_stepping_batches))
        self.bar.start()

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        module: lightning.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Moves the bar."""
        self.bar.advance(self.task)

    def on_train_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Says what the epoch brought."""
        epoch = f"{self.what}: epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"
        values = [f"{name.removeprefix('valid_')} {value:.4f}" for name, value in _measured(trainer).items()]
        if self.on_terminal:
            self.bar.update(self.task, description=f"{epoch}, {values[0]}")
        else:
            print(", ".join([epoch, *values]), file=sys.stderr, flush=True)

    def teardown(self, trainer: lightning.Trainer, module: lightning.LightningModule, stage: str) -> None:
        """Ends the bar, also when training was interrupted."""
        self.bar.stop()


def fit_classifier(
    config: ClassifierConfig,
    dataset: TerrainDataset,
    seed: int = 0,
    precision: str = "bf16-mixed",
    device: str = "auto",
) -> tuple[TerrainClassifier, dict[str, float]]:
    """Trains a classifier on the split `train` until the split `valid` no longer gains.

    Args:
        config: what to train.
        dataset: the maps.
        seed: root seed of weights, order and augmentation.
        precision: of Lightning's trainer; bf16-mixed is the fast one on CPUs that know bfloat16.
        device: auto, cpu or cuda.

    Returns:
        The classifier with its best weights, on the CPU, and what was measured on `valid` there.
    """
    data = MapData(dataset, config.batch_size, seed)
    model = TerrainClassifier(config, len(dataset.recipe.classes), *data.colour_statistics(), seed)
    best = KeepBest()
    stopping = EarlyStopping("valid_loss", patience=config.patience, check_on_train_epoch_end=False)
    with _quiet(), tempfile.TemporaryDirectory() as folder:
        trainer = _trainer(
            [best, stopping, Progress("classifier")],
            folder,
            device,
            max_epochs=config.max_epochs,
            precision=precision,
        )
        _fit(trainer, model, datamodule=data)
    return model.cpu().eval(), best.metrics


def fit_gps(config: LatentGPConfig, table: PixelTable, seed: int = 0, device: str = "auto") -> LatentGPs:
    """Trains the class-wise GPs on a table of cells.

    Args:
        config: what to train.
        table: cells by class, from maps or from a robot's logs.
        seed: root seed of the batches.
        device: auto, cpu or cuda.

    Returns:
        The GPs, on the CPU.
    """
    model = LatentGPs(config, len(table.count), float(table.slope_deg.max()))
    with _quiet(), tempfile.TemporaryDirectory() as folder:
        trainer = _trainer([Progress("gps")], folder, device, max_epochs=config.epochs, precision="64-true")
        _fit(trainer, model, train_dataloaders=load_batches(config, table, seed))
    return model.cpu().eval()


def _fit(trainer: lightning.Trainer, model: lightning.LightningModule, **data: Any) -> None:
    handler = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(model, **data)
    except SystemExit:  # so the trainer ends when interrupted, deaf to further interruptions
        signal.signal(signal.SIGINT, handler)
        raise KeyboardInterrupt from None


def _trainer(callbacks: list[Callback], folder: str, device: str, **settings: Any) -> lightning.Trainer:
    if device not in DEVICES:
        raise ConfigError(f"Expected `device` among {', '.join(DEVICES)}, got {device!r}.")
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("Expected a CUDA device for `device` cuda, got none. Use cpu or auto.")
    found = "cuda" if torch.cuda.is_available() else "cpu"  # float64 rules other devices out
    return lightning.Trainer(
        accelerator=found if device == "auto" else device,
        devices=1,
        callbacks=callbacks,
        default_root_dir=folder,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **settings,
    )


def _measured(trainer: lightning.Trainer) -> Mapping[str, float]:
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps Lightning's hints to its developers out of a user's terminal."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"lightning\..*")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
