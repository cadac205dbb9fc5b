"""The weights of the best epoch, which a training keeps, restores and protects from
callbacks of a user.
"""

import hashlib
from collections.abc import Sequence
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint

from benchnav.core.errors import ConfigError

# callbacks that leave the weights as they are
_OURS = (
    "lightning.",
    "benchnav.models.training.",
)


class KeepBest(Callback):
    """A callback that keeps and restores the weights of the epoch with the lowest
    validation loss, or of the last.

    They are part of what a training goes on from. Lightning's `ModelCheckpoint` would
    put them into a second file, which a kill could leave from another epoch than the
    first, and knows only the loss of all that was measured.

    Args:
        last: keep the last epoch's whose loss is finite.
    """

    def __init__(self, last: bool = False) -> None:
        """Start with no weights."""
        self.last = last
        self.guard = WeightGuard()
        self.best: dict[str, Any] = {"loss": float("inf"), "metrics": {}, "weights": {}}
        self.validated = False

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Copy the weights where they are the best."""
        self.validated = True
        metrics = {
            name: value
            for name, value in measured(trainer).items()
            if name.startswith("valid_")
        }
        limit = float("inf") if self.last else self.best["loss"]
        if metrics["valid_loss"] < limit:
            metrics["epoch"] = trainer.current_epoch + 1
            weights = {
                name: value.detach().clone()
                for name, value in module.state_dict().items()
            }
            self.best = {
                "loss": metrics["valid_loss"],
                "metrics": metrics,
                "weights": weights,
            }

    def on_train_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Note the weights before callbacks of a user can change them."""
        self.guard.note(module)

    def on_fit_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Put the best weights back."""
        self.guard.check_module(module)
        if not self.best["weights"]:
            raise ConfigError(
                "Expected a finite validation loss, got none. Train with a lower "
                "`learning_rate`."
                if self.validated
                else "Expected `trainer` to measure the split valid, got none: "
                "training ended before the first "
                "validation. Train for longer, or validate more often."
            )
        module.load_state_dict(self.best["weights"])
        # The trainer's own metrics are what comes back from processes that it has
        # started.
        metrics = self.best["metrics"].items()
        trainer.callback_metrics.update(
            {name: torch.tensor(value) for name, value in metrics}
        )
        self.guard.note(module)

    def teardown(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, stage: str
    ) -> None:
        """Note the weights that the module leaves."""
        self.guard.note(module)

    def state_dict(self) -> dict[str, Any]:
        """Return what `load_state_dict` takes."""
        return self.best

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from an earlier state."""
        self.best = state


class WeightGuard(Checkpoint):
    """A callback that raises where another one changes weights after training.

    Lightning calls a hook of a `Checkpoint` after those of all other callbacks, and
    before the module's. So weights that differ here from those that `note` read in the
    same hook of the first callback were changed by one between them. Digests of bytes
    are compared, since a NaN does not equal itself.
    """

    def __init__(self) -> None:
        """Start with no weights."""
        self.digest = ""

    def note(self, module: torch.nn.Module) -> None:
        """Read the weights that callbacks have to leave as they are."""
        self.digest = _digest_of_weights(module)

    def on_train_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Check the weights; see the class."""
        self._check(module, "on_train_end", trainer.callbacks)  # type: ignore[attr-defined]

    def on_fit_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Check the weights; see the class."""
        self._check(module, "on_fit_end", trainer.callbacks)  # type: ignore[attr-defined]

    def teardown(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, stage: str
    ) -> None:
        """Check the weights; see the class."""
        self._check(module, "teardown", trainer.callbacks)  # type: ignore[attr-defined]

    def _check(
        self, module: torch.nn.Module, hook: str, callbacks: Sequence[Callback]
    ) -> None:
        if _digest_of_weights(module) == self.digest:
            return
        classes = [type(callback) for callback in callbacks]
        names = [
            kind.__name__
            for kind in classes
            if not getattr(kind, hook).__module__.startswith(_OURS)
        ]
        raise ConfigError(
            "Expected callbacks that leave the trained weights as they are, got "
            f"weights that `{hook}` of "
            f"{' or '.join(names) or 'a callback'} changed. What is exported are the "
            "weights of the best epoch. "
            "Leave the callback out."
        )

    def check_module(self, module: torch.nn.Module) -> None:
        """Reject weights that the module itself has changed since its callbacks ended,
        which restoring would undo.

        Raises:
            ConfigError: If it has.
        """
        if self.digest and _digest_of_weights(module) != self.digest:
            raise ConfigError(
                "Expected weights as they were trained, got weights that "
                f"`on_train_end` of {type(module).__name__} "
                "changed, which the weights of the best epoch would replace. Change "
                "them in `on_fit_end` of the model."
            )


def _digest_of_weights(module: torch.nn.Module) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        data = value.detach().cpu().contiguous().view(-1).view(torch.uint8)
        digest.update(f"{name} {value.dtype} {tuple(value.shape)} ".encode())
        digest.update(data.numpy().tobytes())
    return digest.hexdigest()


def measured(trainer: lightning.Trainer) -> dict[str, float]:
    """What was measured so far, by name."""
    return {name: float(value) for name, value in trainer.callback_metrics.items()}
