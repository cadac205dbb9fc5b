"""Table of the metrics of each epoch, and atomic checkpoints to resume training from."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning
import pandas as pd
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback

from benchnav.core.command import tell
from benchnav.core.errors import TrainingError
from benchnav.core.store import replacing, write_text
from benchnav.models.training.best import current_metrics

_LOSSES = ("train_loss", "valid_loss", "loss")


@dataclass(eq=False)
class History(Callback):
    """A callback that writes metrics to a table, one row per epoch, and prints them.

    Lightning's `CSVLogger` would write training and validation in separate rows, and start a
    new table when a training is resumed. The metrics are printed on standard error.

    Args:
        path: path of the table, CSV; None to write no table.
        part: name of the part to print; empty to print nothing, since terminals show
            Lightning's progress bar.
        rows: rows of the table so far, each with its metrics by name.
    """

    path: Path | None
    part: str
    rows: list[dict[str, float]] = field(default_factory=list)

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Add a row for the epoch.

        Raises:
            TrainingError: If a loss is not finite.
        """
        metrics = current_metrics(trainer)
        epoch = trainer.current_epoch + 1
        row: dict[str, float] = {
            "epoch": epoch,
            "step": trainer.global_step,
            "learning_rate": float(trainer.optimizers[0].param_groups[0]["lr"]),
        }
        self.rows.append(row | metrics)
        if self.path and trainer.is_global_zero:
            write_text(self.path, pd.DataFrame(self.rows).to_csv(index=False))
        if self.part and trainer.is_global_zero:
            text = in_words(metrics, "valid_") or in_words(metrics)
            tell(f"{self.part}: epoch {epoch}/{trainer.max_epochs}, {text}")
        for name, value in metrics.items():
            if name in _LOSSES and not math.isfinite(value):
                raise TrainingError(
                    f"Expected a finite {name}, got {value} in epoch {epoch}. This "
                    "epoch is not saved. Train with a lower `learning_rate`, or "
                    "correct the loss."
                )

    def state_dict(self) -> dict[str, Any]:
        """Return the state for `load_state_dict`."""
        return {"rows": self.rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of an interrupted training."""
        self.rows = list(state["rows"])


class AtomicCheckpointIO(TorchCheckpointIO):
    """A writer of Lightning checkpoints that replaces files atomically.

    Lightning would move a temporary file, which is not atomic if temporary files are on
    another disk.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write the checkpoint next to its path, then rename it."""
        with replacing(Path(path), durable=False) as partial:
            torch.save(checkpoint, partial)


def in_words(metrics: Mapping[str, float], prefix: str = "") -> str:
    """Return the metrics whose names start with a prefix, as text without the prefix."""
    selected = {
        name.removeprefix(prefix): value
        for name, value in metrics.items()
        if name.startswith(prefix)
    }
    return ", ".join(f"{name} {value:.4f}" for name, value in selected.items())
