"""How fast the classifier trains, beside a plain PyTorch loop over the same network in the same run.

    python benchmarks/training.py [DATASET]

Without a dataset, paper-v1 is made in a temporary folder. Ours is an epoch of `benchnav-train
classifier` as it comes: augmentation, schedule, metrics, logs. The whole epoch adds validation and the
state from which a killed training goes on. The plain loop steps AdamW over the same batches, neither
turned nor measured.
"""

import sys
import tempfile
import time
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.table import Table

from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import load_recipe
from benchnav.models.config import ClassifierConfig
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.training.best import KeepBest
from benchnav.models.training.data import MapData
from benchnav.models.training.fit import FitOptions, default_precision, fit

EPOCHS = 2


class Stopwatch(Callback):
    """Times the training part of every epoch, and whole epochs."""

    def __init__(self) -> None:
        self.steps: list[float] = []
        self.starts: list[float] = []
        self.ends: list[float] = []

    def on_train_epoch_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self.starts.append(time.perf_counter())

    def on_train_batch_end(self, *_: object) -> None:
        self.last = time.perf_counter()

    def on_train_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self.steps.append(self.last - self.starts[-1])

    def on_train_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        self.ends = [*self.starts[1:], time.perf_counter()]


def ours(
    data: MapData, config: ClassifierConfig, precision: str, classes: tuple[str, ...]
) -> tuple[float, float]:
    """Images a second of training, and of whole epochs; the best of the epochs but the first."""
    watch = Stopwatch()
    model = TerrainClassifier(config).build(data.scale(("rgb",)), classes)
    with tempfile.TemporaryDirectory() as folder:
        options = FitOptions(folder=Path(folder), trainer={"precision": precision})
        fit(model, "bench", options, {}, [KeepBest(), watch], {"datamodule": data}, max_epochs=EPOCHS)
    whole = [end - start for start, end in zip(watch.starts, watch.ends, strict=True)]
    return len(data.train) / min(watch.steps[1:]), len(data.train) / min(whole[1:])


def plain(data: MapData, config: ClassifierConfig, classes: tuple[str, ...], autocast: bool) -> float:
    """Images a second of a plain loop."""
    model = TerrainClassifier(config).build(data.scale(("rgb",)), classes).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
    best = float("inf")
    for _ in range(EPOCHS):
        start = time.perf_counter()
        for batch in data.train_dataloader():
            optimizer.zero_grad()
            with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
                loss = torch.nn.functional.cross_entropy(model(batch), batch["class_id"].long())
            loss.backward()
            optimizer.step()
        best = min(best, time.perf_counter() - start)
    return len(data.train) / best


def main() -> None:
    console = Console(highlight=False, width=100)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder) / "paper-v1.h5"
        if len(sys.argv) < 2:
            for _ in create(load_recipe("paper-v1"), path, jobs=2):
                pass
        dataset = TerrainDataset(path)
        classes = tuple(item.name for item in dataset.recipe.classes)
        config = ClassifierConfig(max_epochs=EPOCHS)
        data = MapData(dataset, config.batch_size, 0)
        table = Table("training, images/s", "32-true", default_precision(), "ratio")
        threads = torch.get_num_threads()
        table.title = f"{config.architecture}, {config.encoder}, {len(data.train)} maps, {threads} threads"
        simple = [plain(data, config, classes, autocast) for autocast in (False, True)]
        for name, values in (
            ("plain loop", simple),
            *zip(
                ("benchnav-train: steps", "benchnav-train: whole epochs"),
                zip(*(ours(data, config, p, classes) for p in ("32-true", default_precision())), strict=True),
                strict=True,
            ),
        ):
            table.add_row(name, *(f"{value:.0f}" for value in values), f"{values[1] / simple[0]:.2f}")
        console.print(table)


if __name__ == "__main__":
    main()
