"""Training speed of the classifier, compared with plain PyTorch, and of the GPs.

    python -m benchmarks.training [DATASET]

Without a dataset, paper-v1 is created in a temporary folder. Ours is an epoch of
`benchnav-train classifier` with default settings: augmentation, schedule, metrics,
logs. A whole epoch adds validation and the state from which a killed training resumes.
The plain loop trains the same network with AdamW on the same batches, without
augmentation and metrics.
"""

import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import lightning
import torch
from lightning.pytorch.callbacks import Callback

from benchmarks.timing import seconds, show
from benchnav.datagen import TerrainDataset, load_recipe
from benchnav.datagen.files.create import create
from benchnav.models.config import ClassifierConfig, LatentGPConfig
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.slope_gp.cells import sum_split
from benchnav.models.training.best import KeepBest
from benchnav.models.training.data import MapData
from benchnav.models.training.fit import FitOptions, default_precision, fit
from benchnav.models.training.gaussian_processes import fit_gps

EPOCHS = 2


class Stopwatch(Callback):
    """Callback that times the training part of every epoch, and whole epochs."""

    def __init__(self) -> None:
        self.steps: list[float] = []
        self.starts: list[float] = []
        self.ends: list[float] = []

    def on_train_epoch_start(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        self.starts.append(time.perf_counter())

    def on_train_batch_end(self, *_: object) -> None:
        self.last = time.perf_counter()

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        self.steps.append(self.last - self.starts[-1])

    def on_train_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        self.ends = [*self.starts[1:], time.perf_counter()]


def ours(
    data: MapData, config: ClassifierConfig, precision: str, classes: tuple[str, ...]
) -> tuple[float, float]:
    """Return images per second of training and of whole epochs.

    Both are those of the fastest epoch after the first.
    """
    watch = Stopwatch()
    model = TerrainClassifier(config).build(data.scale(("rgb",)), classes)
    with tempfile.TemporaryDirectory() as folder:
        options = FitOptions(folder=Path(folder), trainer={"precision": precision})
        fit(
            model,
            "bench",
            options,
            {},
            [KeepBest(), watch],
            {"datamodule": data},
            max_epochs=EPOCHS,
        )
    epochs_s = [
        end - start for start, end in zip(watch.starts, watch.ends, strict=True)
    ]
    return len(data.train) / min(watch.steps[1:]), len(data.train) / min(epochs_s[1:])


def plain(
    data: MapData, config: ClassifierConfig, classes: tuple[str, ...], autocast: bool
) -> float:
    """Return images per second of the fastest epoch of a plain loop."""
    model = TerrainClassifier(config).build(data.scale(("rgb",)), classes).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
    best = float("inf")
    for _ in range(EPOCHS):
        start = time.perf_counter()
        for batch in data.train_dataloader():
            optimizer.zero_grad()
            with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
                loss = torch.nn.functional.cross_entropy(
                    model(batch), batch["class_id"].long()
                )
            loss.backward()
            optimizer.step()
        best = min(best, time.perf_counter() - start)
    return len(data.train) / best


def time_classifier(dataset: TerrainDataset) -> None:
    """Print images per second of training the classifier."""
    classes = tuple(item.name for item in dataset.recipe.classes)
    config = ClassifierConfig(max_epochs=EPOCHS)
    data = MapData(dataset, config.batch_size, 0)
    rows = []
    for precision in ("32-true", default_precision("cpu")):
        steps, epochs = ours(data, config, precision, classes)
        base = plain(data, config, classes, precision != "32-true")
        rows.append(
            {
                "images/s": precision,
                "plain loop": base,
                "steps": steps,
                "whole epochs": epochs,
            }
        )
    show(rows)


def time_gps(dataset: TerrainDataset) -> None:
    """Print the seconds of reading all cells, and of fitting all Gaussian processes."""
    sums = sum_split(dataset, "train")
    works: dict[str, Callable[[], object]] = {
        "reading and summing all cells": lambda: sum_split(dataset, "train"),
        "fit_gps, one mode a class": lambda: fit_gps(
            LatentGPConfig(second_component=False), sums
        ),
        "fit_gps, looking for second modes": lambda: fit_gps(LatentGPConfig(), sums),
    }
    with contextlib.redirect_stderr(io.StringIO()):
        rows = [
            {"work": name, "s": median(seconds(work, 5))}
            for name, work in works.items()
        ]
    show(rows)


def main() -> None:
    """Print both tables."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(folder) / "paper-v1.h5"
        if not path.exists():
            for _ in create(load_recipe("paper-v1"), path, jobs=2):
                pass
        dataset = TerrainDataset(path)
        time_gps(dataset)
        time_classifier(dataset)


if __name__ == "__main__":
    main()
