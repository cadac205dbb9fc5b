"""One training with Lightning: quiet, with progress and logs, and able to go on after a
kill.

A training that is given a folder leaves there, after every epoch, all that it needs to
go on (`last.ckpt`, a Lightning checkpoint) and what was measured (`metrics.csv`, and
TensorBoard's events). Gone on from there it ends with the weights that an unbroken one
would have, bit for bit on a CPU: what a batch holds depends on seed and epoch alone.
"""

import inspect
import json
import math
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning
import pandas as pd
import torch
from lightning.fabric.plugins.io import TorchCheckpointIO
from lightning.pytorch.callbacks import (
    Callback,
    Checkpoint,
    ModelCheckpoint,
    ProgressBar,
    RichProgressBar,
)
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from benchnav.core.command import tell
from benchnav.core.device import find_device
from benchnav.core.errors import (
    CheckpointError,
    ConfigError,
    TrainingError,
    expect,
    out_of_memory,
    quiet,
)
from benchnav.core.settings import check_known, one_line
from benchnav.core.store import MAX_JOBS, replacing, sole_writer, write_text
from benchnav.models.config import TrainOptions
from benchnav.models.training.best import KeepBest, measured
from benchnav.models.training.trackers import described, make_callbacks, make_loggers

STATE, SETTINGS, HISTORY = "last.ckpt", "settings.json", "metrics.csv"

_PARTIAL = f".{STATE}.*.partial"  # what a kill in the middle of writing has left

# Settings of Lightning's trainer that are made here, and those that the outcome does
# not depend on.
_OWN = {
    "self",
    "plugins",
    "default_root_dir",
    "accelerator",
    "fast_dev_run",
    "enable_checkpointing",
    "enable_progress_bar",
    "enable_model_summary",
    "enable_autolog_hparams",
    "barebones",
    "num_sanity_val_steps",
    "use_distributed_sampler",
    "inference_mode",
    "model_registry",
    "profiler",
}
_DEFAULTS = inspect.signature(lightning.Trainer.__init__).parameters
# which are made from text, see `models.training.trackers`
_TRACKERS = (
    "logger",
    "callbacks",
)
_LOSSES = ("train_loss", "valid_loss", "loss")
_OF_NO_ACCOUNT = {"max_epochs", "log_every_n_steps", "detect_anomaly", "accelerator"}


@dataclass(frozen=True, kw_only=True)
class FitOptions(TrainOptions):
    """How to train, whatever is trained.

    Args:
        folder: where logs and what is needed to go on are kept, in a folder for each
            part of a model; nothing is written when None.

    Raises:
        ConfigError: `workers` is below 0; there is no such device; the trainer has no
            such setting, or it is set here.
    """

    folder: Path | None = None

    def __post_init__(self) -> None:
        """Check the settings by name."""
        expect(
            0 <= self.workers <= MAX_JOBS,
            f"`workers` in 0–{MAX_JOBS}, got {self.workers}.",
        )
        asked = self.trainer or {}
        expect(
            "accelerator" not in asked,
            "no `trainer.accelerator`, which is now `device`: auto, cpu or cuda.",
        )
        for name in asked:
            check_known("settings of `trainer`", name, sorted(_DEFAULTS.keys() - _OWN))
        # so that what cannot be made is refused before anything is trained
        self.make_loggers(None)
        self.make_callbacks()
        devices, processors = asked.get("devices", 1), os.cpu_count() or 1
        expect(
            self.place.type != "cpu"
            or not isinstance(devices, int)
            or 1 <= devices <= processors,
            f"`trainer.devices` in 1–{processors}, as many as there are processors, "
            f"got {devices}.",
        )

    @property
    def place(self) -> torch.device:
        """The device."""
        return find_device(self.device)

    @property
    def trainer_settings(self) -> dict[str, Any]:
        """The settings of the trainer on which the outcome of a network's training
        depends, as plain data.
        """
        chosen = {
            name: value
            for name, value in self.chosen().items()
            if name not in _OF_NO_ACCOUNT and value != _DEFAULTS[name].default
        }
        if (asked := (self.trainer or {}).get("callbacks")) is not None:
            chosen["callbacks"] = described(asked)
        return json.loads(json.dumps(chosen, default=str, sort_keys=True))

    def make_loggers(self, folder: Path | None) -> list[Logger] | None:
        """Make the requested loggers, which write in a folder; None for the default."""
        asked = (self.trainer or {}).get("logger")
        return None if asked is None or asked is True else make_loggers(asked, folder)

    def make_callbacks(self) -> list[Callback]:
        """Make the requested callbacks."""
        asked = (self.trainer or {}).get("callbacks")
        return [] if asked is None else make_callbacks(asked)

    def chosen(self, **trainer: Any) -> dict[str, Any]:
        """All settings of the trainer but loggers and callbacks, of those given here
        and others, by name.
        """
        kind = self.place.type
        first = {"precision": default_precision(kind), "devices": 1}
        asked = {
            name: value
            for name, value in (self.trainer or {}).items()
            if name not in _TRACKERS
        }
        return {**first, **trainer, **asked, "accelerator": kind}


def fit(
    module: lightning.LightningModule,
    part: str,
    options: FitOptions,
    settings: Mapping[str, Any],
    callbacks: list[Callback],
    data: Mapping[str, Any],
    **usual: Any,
) -> dict[str, float]:
    """Train a module in place.

    Args:
        module: what to train.
        part: name of the part of a model that it is.
        options: how.
        settings: plain data on which the outcome depends; an interrupted training of
            others is not gone on with.
        callbacks: what else is to happen.
        data: loaders or data module, as arguments of the trainer's `fit`.
        usual: settings of Lightning's trainer, where the options say nothing; of
            `precision`, which may be left out, `default_precision`.

    Returns:
        What was measured, by name.

    Raises:
        CheckpointError: the interrupted training is damaged or has other settings.
        ConfigError: If a callback changes the weights after training.
        TrainingError: If a loss is not finite.
        KeyboardInterrupt: the user has stopped it.
    """
    folder = options.folder / part if options.folder else None
    held = (
        sole_writer(folder, str(folder))
        if folder and is_first_process()
        else nullcontext()
    )
    in_terminal, state = sys.stderr.isatty(), None
    callbacks = [
        *callbacks,
        *options.make_callbacks(),
        History(folder / HISTORY if folder else None, "" if in_terminal else part),
    ]
    if in_terminal:
        callbacks.append(RichProgressBar(console_kwargs={"stderr": True}))
    loggers = options.make_loggers(folder)
    trainer_settings: dict[str, Any] = {"logger": False}
    with quietly(), held:
        if folder:
            trainers = {
                f"trainer.{name}": value
                for name, value in options.trainer_settings.items()
            }
            state = _prepare(folder, options.resume, {**settings, **trainers})
            last = ModelCheckpoint(
                folder,
                Path(STATE).stem,
                save_on_train_epoch_end=True,
                enable_version_counter=False,
            )
            callbacks.append(last)
            events = TensorBoardLogger(folder, name="", version="")
            trainer_settings = {"logger": events, "plugins": [WholeFiles()]}
        if loggers is not None:
            trainer_settings["logger"] = loggers
            for logger in loggers:
                logger.log_hyperparams({"part": part, **settings})
        callbacks += [
            callback.guard for callback in callbacks if isinstance(callback, KeepBest)
        ]
        trainer = make_trainer(callbacks, **trainer_settings, **options.chosen(**usual))
        handler = signal.getsignal(signal.SIGINT)
        devices = [options.place] if options.place.type == "cuda" else []
        try:
            with torch.random.fork_rng(
                devices=devices
            ):  # which training seeds anew each epoch
                trainer.fit(
                    module,
                    **data,
                    ckpt_path=state,
                    weights_only=True if state else None,
                )
        except (
            SystemExit
        ):  # so the trainer ends when interrupted, deaf to further interruptions
            signal.signal(signal.SIGINT, handler)
            raise KeyboardInterrupt from None
        except MisconfigurationException as error:
            raise _unusable(error) from error
        except (RuntimeError, EOFError, KeyError, pickle.UnpicklingError) as error:
            if "conditioned on metric" in str(
                error
            ):  # of a callback that monitors what is not measured
                raise _unusable(error) from error
            if state is None or trainer.global_step:
                raise
            raise CheckpointError(
                f"{state} is damaged: {type(error).__name__} {error}. Pass "
                "--overwrite to restart."
            ) from error
        return measured(trainer)


say = rank_zero_only(print)
"""Prints a line once, also where several processes train together."""


def is_first_process() -> bool:
    """Return whether this process is the only one, or the first of those that train
    together.
    """
    return not getattr(rank_zero_only, "rank", 0)


def interrupted(options: FitOptions, parts: Sequence[str]) -> list[str]:
    """Return the parts whose training was interrupted in the folder of some options."""
    return [
        part
        for part in parts
        if options.folder and (options.folder / part / STATE).exists()
    ]


def forget(options: FitOptions, part: str) -> None:
    """Remove what a part's training would resume from; its logs stay."""
    if options.folder and is_first_process():
        _drop(options.folder / part, STATE, _PARTIAL)


def differing(expected: Mapping[str, Any], stored: Mapping[str, Any]) -> str:
    """Return the settings in which two trainings differ, such as "another `seed`";
    empty where there are none.
    """
    a, b = (
        json.loads(json.dumps(settings, default=str)) for settings in (expected, stored)
    )
    for settings in (a, b):
        settings |= settings.pop("config", {})  # those of a network, each by its name
    names = sorted(name for name in {**a, **b} if a.get(name) != b.get(name))
    return f"another {' and '.join(f'`{name}`' for name in names)}" if names else ""


def default_precision(accelerator: str) -> str:
    """bf16-mixed where what is trained on, "cpu" or a GPU, has bfloat16 arithmetic,
    32-true elsewhere.
    """
    if accelerator != "cpu":
        known = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        known = bool(
            torch.backends.mkldnn.is_available()
            and torch.ops.mkldnn._is_mkldnn_bf16_supported()
        )
    return "bf16-mixed" if known else "32-true"


def _prepare(folder: Path, resume: bool, settings: Mapping[str, Any]) -> Path | None:
    """Make the folder; return the state to resume from, if any."""
    folder.mkdir(parents=True, exist_ok=True)
    state, described = (
        folder / STATE,
        json.dumps(settings, default=str, indent=1) + "\n",
    )
    if resume and state.exists():
        if others := differing(settings, json.loads((folder / SETTINGS).read_text())):
            raise CheckpointError(
                f"Expected the settings of the interrupted training in {folder} to "
                f"resume it, got {others}. "
                "Repeat its settings, or pass --overwrite to restart."
            )
        return state
    if is_first_process():
        _drop(folder, STATE, _PARTIAL, HISTORY, "events.out.tfevents.*")
        write_text(folder / SETTINGS, described)
    return None


def _drop(folder: Path, *patterns: str) -> None:
    for pattern in patterns:
        for path in folder.glob(pattern):
            path.unlink()


def make_trainer(callbacks: list[Callback], **settings: Any) -> lightning.Trainer:
    """Make Lightning's trainer.

    Raises:
        ConfigError: it does not take the settings.
    """
    try:
        return lightning.Trainer(
            callbacks=callbacks,
            enable_checkpointing=any(
                isinstance(callback, Checkpoint) for callback in callbacks
            ),
            enable_progress_bar=any(
                isinstance(callback, ProgressBar) for callback in callbacks
            ),
            enable_model_summary=False,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
            **settings,
        )
    except Exception as error:  # Lightning raises of settings what its code meets
        raise out_of_memory(error) or _unusable(error) from error


def _unusable(error: Exception) -> ConfigError:
    return ConfigError(
        f"Expected settings of `trainer` that Lightning takes, got: {one_line(error)}"
    )


@contextmanager
def quietly() -> Iterator[None]:
    """Keep Lightning's hints to its developers out of a user's terminal."""
    with quiet("lightning.pytorch", "lightning.fabric"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"lightning\..*")
        yield


@dataclass(eq=False)
class History(Callback):
    """A callback that writes what was measured to a table, a row an epoch, and prints
    it on standard error.

    Lightning's `CSVLogger` writes training and validation to rows of their own, and
    begins anew when it is resumed.

    Args:
        path: the table, CSV; None where none is kept.
        part: what is trained; empty where nothing is said, since Lightning's bar is
            shown in a terminal.
        rows: what the table holds.
    """

    path: Path | None
    part: str
    rows: list[dict[str, float]] = field(default_factory=list)

    def on_train_epoch_end(
        self, trainer: lightning.Trainer, module: lightning.LightningModule
    ) -> None:
        """Add a row; reject a loss that is not finite."""
        measures, epoch = measured(trainer), trainer.current_epoch + 1
        rate = float(trainer.optimizers[0].param_groups[0]["lr"])
        self.rows.append(
            {
                "epoch": epoch,
                "step": trainer.global_step,
                "learning_rate": rate,
                **measures,
            }
        )
        if self.path and trainer.is_global_zero:
            write_text(self.path, pd.DataFrame(self.rows).to_csv(index=False))
        if self.part and trainer.is_global_zero:
            text = in_words(measures, "valid_") or in_words(measures)
            tell(f"{self.part}: epoch {epoch}/{trainer.max_epochs}, {text}")
        for name, value in measures.items():
            if name in _LOSSES and not math.isfinite(value):
                raise TrainingError(
                    f"{name} became {value} in epoch {epoch}. Train with a lower "
                    "`learning_rate`, or mend the loss. "
                    "Nothing was kept of this epoch."
                )

    def state_dict(self) -> dict[str, Any]:
        """Return what `load_state_dict` takes."""
        return {"rows": self.rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from an earlier state."""
        self.rows = list(state["rows"])


class WholeFiles(TorchCheckpointIO):
    """A writer of Lightning checkpoints, each whole or not at all.

    Lightning's own way moves a temporary file, which is no one step where these are on
    another disk.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write it next to its name, then rename it."""
        with replacing(Path(path), durable=False) as partial:
            torch.save(checkpoint, partial)


def in_words(metrics: Mapping[str, float], prefix: str = "") -> str:
    """Those of some measures whose names begin with a prefix, without it."""
    chosen = {
        name.removeprefix(prefix): value
        for name, value in metrics.items()
        if name.startswith(prefix)
    }
    return ", ".join(f"{name} {value:.4f}" for name, value in chosen.items())
