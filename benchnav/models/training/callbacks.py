"""What happens beside a training where Lightning has no such thing: the best weights are kept, a table is written."""

import sys
from pathlib import Path
from typing import Any

import lightning
import pandas as pd
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, RichProgressBar
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.core.store import replacing, write_text


class KeepBest(Callback):
    """Keeps the weights of the epoch with the lowest validation loss and restores them at the end.

    They are part of what a training goes on from. Lightning's `ModelCheckpoint` would put them into a second file,
    which a kill could leave of another epoch than the first, and knows the loss alone of all that was measured.
    """

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

    Lightning's `CSVLogger` writes training and validation to rows of their own, and begins anew when it is resumed.

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


class EpochLines(Callback):
    """Says on standard error what each epoch brought, where there is no terminal for Lightning's bar.

    Args:
        what: what is trained.
    """

    def __init__(self, what: str) -> None:
        """Says nothing yet."""
        self.what = what

    def on_train_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Says it."""
        found = measured(trainer)
        shown = {name: value for name, value in found.items() if name.startswith("valid_")} or found
        values = [f"{name.removeprefix('valid_')} {value:.4f}" for name, value in shown.items()]
        if trainer.is_global_zero:
            epoch = f"{self.what}: epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"
            print(", ".join([epoch, *values]), file=sys.stderr, flush=True)


def progress(what: str) -> Callback:
    """Shows how far training is: Lightning's bar in a terminal, a line an epoch elsewhere."""
    if sys.stderr.isatty():
        return RichProgressBar(console_kwargs={"stderr": True})
    return EpochLines(what)


class WholeFiles(TorchCheckpointIO):
    """Writes a Lightning checkpoint whole or not at all.

    Lightning's own way moves a temporary file, which is no one step where these are on another disk.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Writes it beside its name, then renames it."""
        with replacing(Path(path), durable=False) as partial:
            torch.save(checkpoint, partial)


def measured(trainer: lightning.Trainer) -> dict[str, float]:
    """What was measured so far, by name."""
    return {name: float(value) for name, value in trainer.callback_metrics.items()}
