"""Callbacks that restore the best epoch's weights and protect them from user callbacks."""

import hashlib
from collections.abc import Sequence
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint

from benchnav.core.errors import ConfigError

# Modules whose callbacks leave the weights unchanged.
_TRUSTED = ("lightning.", "benchnav.models.training.")


class KeepBest(Callback):
    """A callback that keeps and restores the weights of the best or last epoch.

    The best epoch has the lowest validation loss. The weights and metrics are stored in the
    state from which training resumes. Lightning's `ModelCheckpoint` would write the weights
    to a second file, which could be from another epoch if training is killed.

    Args:
        last: whether to keep the last epoch with a finite loss instead of the best epoch.
    """

    def __init__(self, last: bool = False) -> None:
        """Create the callback; no weights are stored yet."""
        self.last = last
        self.guard = WeightGuard()
        self.best: dict[str, Any] = {"loss": float("inf"), "metrics": {}, "weights": {}}
        self.validated = False

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Copy the weights if the epoch is the best so far."""
        self.validated = True
        metrics = {
            name: value
            for name, value in current_metrics(trainer).items()
            if name.startswith("valid_")
        }
        loss = metrics["valid_loss"]
        limit = float("inf") if self.last else self.best["loss"]
        if loss < limit:
            metrics["epoch"] = trainer.current_epoch + 1
            weights = {
                name: value.detach().clone()
                for name, value in module.state_dict().items()
            }
            self.best = {"loss": loss, "metrics": metrics, "weights": weights}

    def on_train_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Note the weights before a user's callbacks can change them."""
        self.guard.note(module)

    def on_fit_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Restore the best weights."""
        self.guard.check_module(module)
        if not self.best["weights"]:
            raise ConfigError(
                "Expected a finite validation loss, got none in any epoch. Train with a "
                "lower `learning_rate`."
                if self.validated
                else "Expected at least one validation, got a training run that ended "
                "before the first one. Train for longer, or validate more often."
            )
        module.load_state_dict(self.best["weights"])
        # Processes that the trainer starts return only the metrics of the trainer.
        metrics = self.best["metrics"].items()
        tensors = {name: torch.tensor(value) for name, value in metrics}
        trainer.callback_metrics.update(tensors)
        self.guard.note(module)

    def teardown(
        self, trainer: lightning.Trainer, module: lightning.LightningModule, stage: str
    ) -> None:
        """Note the final weights of the module."""
        self.guard.note(module)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for `load_state_dict`."""
        return self.best

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of an interrupted training."""
        self.best = state


class WeightGuard(Checkpoint):
    """A callback that raises an error if another callback changes weights after training.

    `KeepBest`, the first callback, notes the weights in each hook. Lightning calls the
    hook of a `Checkpoint`, such as this class, after that of all other callbacks and
    before that of the module. If the weights then differ, a callback in between has
    changed them. Digests of bytes are compared, because NaN does not equal itself.
    """

    def __init__(self) -> None:
        """Create the callback; no digest of weights is stored yet."""
        self.digest = ""

    def note(self, module: torch.nn.Module) -> None:
        """Store the digest of the weights that callbacks must not change."""
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
            if not getattr(kind, hook).__module__.startswith(_TRUSTED)
        ]
        owner = " or ".join(names) or "a callback"
        raise ConfigError(
            "Expected callbacks that leave the trained weights unchanged, got weights "
            f"that `{hook}` of {owner} changed. Only the weights of the best epoch may "
            "be exported. Leave the callback out."
        )

    def check_module(self, module: torch.nn.Module) -> None:
        """Check that the module did not change its weights after the callbacks.

        Restoring the best epoch would undo such changes.

        Raises:
            ConfigError: If the module changed its weights.
        """
        if self.digest and _digest_of_weights(module) != self.digest:
            raise ConfigError(
                "Expected trained weights to stay unchanged, got weights that "
                f"`on_train_end` of {type(module).__name__} changed. Restoring the "
                "best epoch would undo this change. Change the weights in `on_fit_end` "
                "of the model."
            )


def _digest_of_weights(module: torch.nn.Module) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(module.state_dict().items()):
        data = value.detach().cpu().contiguous().view(-1).view(torch.uint8)
        digest.update(f"{name} {value.dtype} {tuple(value.shape)} ".encode())
        digest.update(data.numpy().tobytes())
    return digest.hexdigest()


def current_metrics(trainer: lightning.Trainer) -> dict[str, float]:
    """Return the latest metrics of a trainer by name."""
    return {name: float(value) for name, value in trainer.callback_metrics.items()}
