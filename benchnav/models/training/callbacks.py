"""What happens beside a training: the best weights are kept, what is measured is written, progress is shown."""

import sys
from pathlib import Path
from typing import Any

import lightning
import pandas as pd
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.core.store import replacing, write_text


class KeepBest(Callback):
    """Keeps the weights of the epoch with the lowest validation loss and restores them at the end."""

    def __init__(self) -> None:
        """Starts with none."""
        self.loss, self.validated = float("inf"), False
        self.metrics: dict[str, float] = {}
        self.weights: dict[str, Tensor] = {}

    def on_validation_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Copies the weights when they are the best so far."""
        self.validated = True
        found = {name: value for name, value in measured(trainer).items() if name.startswith("valid_")}
        if found["valid_loss"] < self.loss:
            self.loss, self.metrics = found["valid_loss"], {**found, "epoch": trainer.current_epoch + 1}
            self.weights = {name: value.detach().clone() for name, value in module.state_dict().items()}

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Puts the best weights back."""
        if not self.weights and not self.validated:
            raise ConfigError(
                "Expected settings of `trainer` under which the split valid is measured, got an end of training before "
                "it ever was. Train for longer, or validate more often."
            )
        if not self.weights:
            raise ConfigError(
                "Expected a finite validation loss, got none. Train with a lower `learning_rate`."
            )
        module.load_state_dict(self.weights)
        # The trainer's own metrics are what comes back from processes that it has started.
        trainer.callback_metrics.update({name: torch.tensor(value) for name, value in self.metrics.items()})

    def state_dict(self) -> dict[str, Any]:
        """Gives what `load_state_dict` takes."""
        return {"loss": self.loss, "metrics": self.metrics, "weights": self.weights}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from an earlier state."""
        self.loss, self.metrics, self.weights = state["loss"], state["metrics"], state["weights"]


class History(Callback):
    """Writes what was measured to a table, a row an epoch.

    Args:
        path: the table, CSV.
    """

    def __init__(self, path: Path) -> None:
        """Starts with no rows."""
        self.path, self.rows = path, list[dict[str, float]]()

    def on_train_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Adds a row."""
        rate = float(trainer.optimizers[0].param_groups[0]["lr"])
        row = {"epoch": trainer.current_epoch + 1, "step": trainer.global_step, "learning_rate": rate}
        self.rows.append({**row, **measured(trainer)})
        if trainer.is_global_zero:
            write_text(self.path, pd.DataFrame(self.rows).to_csv(index=False))

    def state_dict(self) -> dict[str, Any]:
        """Gives what `load_state_dict` takes."""
        return {"rows": self.rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from an earlier state."""
        self.rows = list(state["rows"])


class Progress(Callback):
    """Shows how far training is: a bar in a terminal, a line an epoch elsewhere.

    Args:
        what: what is trained.
    """

    def __init__(self, what: str) -> None:
        """Shows nothing yet."""
        self.what = what
        self.bar: Bar | None = None

    def on_train_start(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Shows the bar where there is a terminal."""
        console = Console(stderr=True)
        if console.is_terminal and trainer.is_global_zero:
            columns = (BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TimeRemainingColumn())
            self.bar = Bar(TextColumn("{task.description}"), *columns, console=console)
            total = int(trainer.estimated_stepping_batches)
            self.task = self.bar.add_task(self.what, total=total, completed=trainer.global_step)
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
        if self.bar:
            self.bar.update(self.task, completed=trainer.global_step)

    def on_train_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Says what the epoch brought."""
        epoch = f"{self.what}: epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"
        found = {name: value for name, value in measured(trainer).items() if name.startswith("valid_")}
        shown = found or measured(trainer)
        values = [f"{name.removeprefix('valid_')} {value:.4f}" for name, value in shown.items()]
        if self.bar:
            self.bar.update(self.task, description=f"{epoch}, {values[0]}")
        elif trainer.is_global_zero:
            print(", ".join([epoch, *values]), file=sys.stderr, flush=True)

    def teardown(self, trainer: lightning.Trainer, module: lightning.LightningModule, stage: str) -> None:
        """Ends the bar, also when training was interrupted."""
        if self.bar:
            self.bar.stop()


class WholeFiles(TorchCheckpointIO):
    """Writes a Lightning checkpoint whole or not at all, also where temporary files are on another disk."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Writes it beside its name, then renames it."""
        with replacing(Path(path), durable=False) as partial:
            torch.save(checkpoint, partial)


def measured(trainer: lightning.Trainer) -> dict[str, float]:
    """What was measured so far, by name."""
    return {name: float(value) for name, value in trainer.callback_metrics.items()}
