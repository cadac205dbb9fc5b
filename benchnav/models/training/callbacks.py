"""What happens beside a training where Lightning has no such thing: the best weights are kept, a table is written."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning
import pandas as pd
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import Callback, RichProgressBar

from benchnav.core.command import tell
from benchnav.core.errors import ConfigError
from benchnav.core.store import replacing, write_text


class KeepBest(Callback):
    """Keeps the weights of the epoch with the lowest validation loss and restores them at the end.

    They are part of what a training goes on from. Lightning's `ModelCheckpoint` would put them into a second file,
    which a kill could leave of another epoch than the first, and knows the loss alone of all that was measured.
    """

    def __init__(self) -> None:
        """Starts with none."""
        self.best: dict[str, Any] = {"loss": float("inf"), "metrics": {}, "weights": {}}
        self.validated = False

    def on_validation_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Copies the weights when they are the best so far."""
        self.validated = True
        metrics = {name: value for name, value in measured(trainer).items() if name.startswith("valid_")}
        if metrics["valid_loss"] < self.best["loss"]:
            weights = {name: value.detach().clone() for name, value in module.state_dict().items()}
            metrics["epoch"] = trainer.current_epoch + 1
            self.best = {"loss": metrics["valid_loss"], "metrics": metrics, "weights": weights}

    def on_fit_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Puts the best weights back."""
        if not self.best["weights"]:
            raise ConfigError(
                "Expected a finite validation loss, got none. Train with a lower `learning_rate`."
                if self.validated
                else "Expected settings of `trainer` under which the split valid is measured, got an end of training "
                "before it ever was. Train for longer, or validate more often."
            )
        module.load_state_dict(self.best["weights"])
        # The trainer's own metrics are what comes back from processes that it has started.
        metrics = self.best["metrics"].items()
        trainer.callback_metrics.update({name: torch.tensor(value) for name, value in metrics})

    def state_dict(self) -> dict[str, Any]:
        """Gives what `load_state_dict` takes."""
        return self.best

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from an earlier state."""
        self.best = state


@dataclass(eq=False)
class History(Callback):
    """Writes what was measured to a table, a row an epoch.

    Lightning's `CSVLogger` writes training and validation to rows of their own, and begins anew when it is resumed.

    Args:
        path: the table, CSV.
        rows: what it holds.
    """

    path: Path
    rows: list[dict[str, float]] = field(default_factory=list)

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


@dataclass(eq=False)
class EpochLines(Callback):
    """Says on standard error what each epoch brought, where there is no terminal for Lightning's bar.

    Args:
        what: what is trained.
    """

    what: str

    def on_train_epoch_end(self, trainer: lightning.Trainer, module: lightning.LightningModule) -> None:
        """Says it."""
        found = measured(trainer)
        shown = {name: value for name, value in found.items() if name.startswith("valid_")} or found
        values = [f"{name.removeprefix('valid_')} {value:.4f}" for name, value in shown.items()]
        if trainer.is_global_zero:
            epoch = f"{self.what}: epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"
            tell(", ".join([epoch, *values]))


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
