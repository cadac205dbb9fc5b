"""Training of one part with Lightning, with progress and logs; it can be resumed.

If a training has a folder, it writes after each epoch the state to resume from
(`last.ckpt`, a Lightning checkpoint) and the metrics (`metrics.csv`, and TensorBoard's
events). A resumed training ends with the same weights as an uninterrupted training, bit
for bit on a CPU, because the content of a batch depends only on seed and epoch.
"""

import inspect
import json
import os
import pickle
import signal
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
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

from benchnav.core.device import find_device
from benchnav.core.errors import (
    CheckpointError,
    ConfigError,
    expect,
    out_of_memory_error,
    quiet,
)
from benchnav.core.settings import check_known, one_line
from benchnav.core.store import MAX_JOBS, sole_writer, write_text
from benchnav.models.config import TrainOptions
from benchnav.models.training.best import KeepBest, current_metrics
from benchnav.models.training.history import AtomicCheckpointIO, History
from benchnav.models.training.trackers import described, make_callbacks, make_loggers

STATE = "last.ckpt"
SETTINGS = "settings.json"
HISTORY = "metrics.csv"

_PARTIAL = f".{STATE}.*.partial"  # files that remain if a write is killed

# Settings of Lightning's trainer that this module determines.
_FIXED = {
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
_TRACKERS = ("logger", "callbacks")  # created from text by `training.trackers`
# Settings that do not affect the result.
_WITHOUT_EFFECT = {"max_epochs", "log_every_n_steps", "detect_anomaly", "accelerator"}


@dataclass(frozen=True, kw_only=True)
class FitOptions(TrainOptions):
    """Training options that do not depend on the model.

    Args:
        folder: folder for logs and for the state to resume from, with a subfolder per
            part of a model; None to write no files.

    Raises:
        ConfigError: If `workers` is out of range, the device does not exist, or `trainer`
            has an unknown or invalid setting.
    """

    folder: Path | None = None

    def __post_init__(self) -> None:
        """Check the options and the names of the trainer's settings."""
        expect(
            0 <= self.workers <= MAX_JOBS,
            f"`workers` in 0–{MAX_JOBS}, got {self.workers}.",
        )
        requested = self.trainer or {}
        expect(
            "accelerator" not in requested,
            "no `trainer.accelerator`, got one. Set `device` instead: auto, cpu or cuda.",
        )
        options = sorted(_DEFAULTS.keys() - _FIXED)
        for name in requested:
            check_known("settings of `trainer`", name, options)
        # Reject invalid loggers and callbacks before training.
        self.make_loggers(None)
        self.make_callbacks()
        devices = requested.get("devices", 1)
        n_processors = os.cpu_count() or 1
        is_cpu_count = self.place.type == "cpu" and isinstance(devices, int)
        expect(
            not is_cpu_count or 1 <= devices <= n_processors,
            f"`trainer.devices` from 1 to {n_processors}, which is the number of "
            f"processors, got {devices}.",
        )

    @property
    def place(self) -> torch.device:
        """The device of the training."""
        return find_device(self.device)

    @property
    def trainer_settings(self) -> dict[str, Any]:
        """Settings of the trainer that affect the result of training, as plain data."""
        settings = {
            name: value
            for name, value in self.chosen().items()
            if name not in _WITHOUT_EFFECT and value != _DEFAULTS[name].default
        }
        callbacks = (self.trainer or {}).get("callbacks")
        if callbacks is not None:
            settings["callbacks"] = described(callbacks)
        return json.loads(json.dumps(settings, default=str, sort_keys=True))

    def make_loggers(self, folder: Path | None) -> list[Logger] | None:
        """Create the requested loggers, which write to `folder`; None if none is given."""
        specs = (self.trainer or {}).get("logger")
        return None if specs is None or specs is True else make_loggers(specs, folder)

    def make_callbacks(self) -> list[Callback]:
        """Create the requested callbacks."""
        specs = (self.trainer or {}).get("callbacks")
        return [] if specs is None else make_callbacks(specs)

    def chosen(self, **defaults: Any) -> dict[str, Any]:
        """Return all settings of the trainer except loggers and callbacks, by name.

        Args:
            defaults: settings to use if the options do not set them.
        """
        accelerator = self.place.type
        common = {"precision": default_precision(accelerator), "devices": 1}
        requested = {
            name: value
            for name, value in (self.trainer or {}).items()
            if name not in _TRACKERS
        }
        return {**common, **defaults, **requested, "accelerator": accelerator}


def fit(
    module: lightning.LightningModule,
    part: str,
    options: FitOptions,
    settings: Mapping[str, Any],
    callbacks: list[Callback],
    data: Mapping[str, Any],
    **defaults: Any,
) -> dict[str, float]:
    """Train a module in place.

    Args:
        module: module to train.
        part: name of the part of the model.
        options: training options.
        settings: settings that affect the result, as plain data; an interrupted training
            with other settings is not resumed.
        callbacks: callbacks in addition to those of the options.
        data: loaders or data module, as arguments of the trainer's `fit`.
        defaults: settings of Lightning's trainer to use if the options do not set them;
            the default of `precision` is `default_precision`.

    Returns:
        Values of the metrics after training, by name.

    Raises:
        CheckpointError: If the interrupted training is damaged or has other settings.
        ConfigError: If a callback changes the weights after training.
        TrainingError: If a loss is not finite.
        KeyboardInterrupt: If the user interrupts the training.
    """
    folder = options.folder / part if options.folder else None
    lease: AbstractContextManager[Any] = nullcontext()
    if folder and is_first_process():
        lease = sole_writer(folder, str(folder))
    callbacks = [*callbacks, *options.make_callbacks()]
    history_path = folder / HISTORY if folder else None
    if sys.stderr.isatty():
        callbacks.append(History(history_path, ""))
        callbacks.append(RichProgressBar(console_kwargs={"stderr": True}))
    else:
        callbacks.append(History(history_path, part))
    loggers = options.make_loggers(folder)
    trainer_settings: dict[str, Any] = {"logger": False}
    state = None
    with quietly(), lease:
        if folder:
            named = {f"trainer.{n}": v for n, v in options.trainer_settings.items()}
            state = _prepare(folder, options.resume, {**settings, **named})
            checkpoint = ModelCheckpoint(
                folder,
                Path(STATE).stem,
                save_on_train_epoch_end=True,
                enable_version_counter=False,
            )
            callbacks.append(checkpoint)
            trainer_settings["logger"] = TensorBoardLogger(folder, name="", version="")
            trainer_settings["plugins"] = [AtomicCheckpointIO()]
        if loggers is not None:
            trainer_settings["logger"] = loggers
            for logger in loggers:
                logger.log_hyperparams({"part": part, **settings})
        callbacks += [
            callback.guard for callback in callbacks if isinstance(callback, KeepBest)
        ]
        trainer_settings |= options.chosen(**defaults)
        trainer = make_trainer(callbacks, **trainer_settings)
        _run(trainer, module, data, state, options.place)
        return current_metrics(trainer)


def _run(
    trainer: lightning.Trainer,
    module: lightning.LightningModule,
    data: Mapping[str, Any],
    state: Path | None,
    device: torch.device,
) -> None:
    """Train with a trainer, and convert its exceptions."""
    handler = signal.getsignal(signal.SIGINT)
    devices = [device] if device.type == "cuda" else []
    try:
        # Training seeds the generators in each epoch.
        with torch.random.fork_rng(devices=devices):
            trainer.fit(
                module,
                **data,
                ckpt_path=state,
                weights_only=True if state else None,
            )
    except SystemExit:  # an interrupted trainer exits and ignores further interrupts
        signal.signal(signal.SIGINT, handler)
        raise KeyboardInterrupt from None
    except MisconfigurationException as error:
        raise _unusable(error) from error
    except (RuntimeError, EOFError, KeyError, pickle.UnpicklingError) as error:
        # The error of a callback that monitors a metric that is not measured.
        if "conditioned on metric" in str(error):
            raise _unusable(error) from error
        if state is None or trainer.global_step:
            raise
        raise CheckpointError(
            f"{state} is damaged: {type(error).__name__} {error}. Pass --overwrite to "
            "restart the training."
        ) from error


say = rank_zero_only(print)
"""Print a line once, even if several processes train together."""


def is_first_process() -> bool:
    """Return whether this is the first of the processes that train together."""
    return not getattr(rank_zero_only, "rank", 0)


def interrupted(options: FitOptions, parts: Sequence[str]) -> list[str]:
    """Return the parts whose training was interrupted and can be resumed."""
    return [
        part
        for part in parts
        if options.folder and (options.folder / part / STATE).exists()
    ]


def forget(options: FitOptions, part: str) -> None:
    """Remove the state from which a part's training could be resumed; keep the logs."""
    if options.folder and is_first_process():
        _drop(options.folder / part, STATE, _PARTIAL)


def differing(expected: Mapping[str, Any], stored: Mapping[str, Any]) -> str:
    """Return the settings that differ, such as "another `seed`"; empty if all are equal."""
    a = _flat(expected)
    b = _flat(stored)
    names = sorted(name for name in {**a, **b} if a.get(name) != b.get(name))
    return f"another {' and '.join(f'`{name}`' for name in names)}" if names else ""


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as plain data, with the content of `config` at the top level."""
    plain = json.loads(json.dumps(settings, default=str))
    return plain | plain.pop("config", {})


def default_precision(accelerator: str) -> str:
    """Return bf16-mixed if the device has bfloat16 arithmetic, otherwise 32-true.

    Args:
        accelerator: "cpu" or the name of a GPU accelerator, such as "cuda".
    """
    if accelerator != "cpu":
        has_bf16 = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        has_bf16 = bool(
            torch.backends.mkldnn.is_available()
            and torch.ops.mkldnn._is_mkldnn_bf16_supported()
        )
    return "bf16-mixed" if has_bf16 else "32-true"


def _prepare(folder: Path, resume: bool, settings: Mapping[str, Any]) -> Path | None:
    """Create the folder of a training, and return the state to resume from or None.

    Raises:
        CheckpointError: If the interrupted training has other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    state = folder / STATE
    if resume and state.exists():
        stored = json.loads((folder / SETTINGS).read_text())
        differences = differing(settings, stored)
        if differences:
            raise CheckpointError(
                f"Expected the settings of the interrupted training in {folder} for "
                f"--resume, got {differences}. Use the settings of that training, or "
                "pass --overwrite to restart the training."
            )
        return state
    if is_first_process():
        _drop(folder, STATE, _PARTIAL, HISTORY, "events.out.tfevents.*")
        text = json.dumps(settings, default=str, indent=1) + "\n"
        write_text(folder / SETTINGS, text)
    return None


def _drop(folder: Path, *patterns: str) -> None:
    for pattern in patterns:
        for path in folder.glob(pattern):
            path.unlink()


def make_trainer(callbacks: list[Callback], **settings: Any) -> lightning.Trainer:
    """Create Lightning's trainer.

    Raises:
        ConfigError: If Lightning does not accept the settings.
    """
    has_checkpoint = any(isinstance(c, Checkpoint) for c in callbacks)
    has_progress_bar = any(isinstance(c, ProgressBar) for c in callbacks)
    try:
        return lightning.Trainer(
            callbacks=callbacks,
            enable_checkpointing=has_checkpoint,
            enable_progress_bar=has_progress_bar,
            enable_model_summary=False,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
            **settings,
        )
    except Exception as error:  # Lightning raises errors of many types for settings
        raise out_of_memory_error(error) or _unusable(error) from error


def _unusable(error: Exception) -> ConfigError:
    return ConfigError(
        f"Expected settings of `trainer` that Lightning accepts, got: {one_line(error)}"
    )


@contextmanager
def quietly() -> Iterator[None]:
    """Suppress the messages and warnings of Lightning."""
    with quiet("lightning.pytorch", "lightning.fabric"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"lightning\..*")
        yield
