import copy
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import lightning
import numpy as np
import pandas as pd
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from torch.utils.data import DataLoader

from benchnav.core.errors import (
    BenchnavError,
    CheckpointError,
    ConfigError,
    DatasetError,
)
from benchnav.core.store import sole_writer
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models import cli
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.config import ClassifierConfig, MDNConfig, plain_config
from benchnav.models.nets.calibration import fit_temperature, sample_logits
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.training import fit as fit_module
from benchnav.models.training import networks
from benchnav.models.training.best import KeepBest
from benchnav.models.training.check import check_network
from benchnav.models.training.data import MapData
from benchnav.models.training.fit import FitOptions, default_precision, fit
from benchnav.models.training.networks import fit_network
from tests.commands import call
from tests.models.support import names, trainable

EXACT = {"precision": "32-true"}
SMALL = ClassifierConfig(encoder="mobilenet_v2", max_epochs=4, batch_size=4, jitter=0.2)


class Killed(Exception):
    pass


class KillIn(KeepBest):
    """Ends training in the middle of an epoch, as a kill would."""

    epoch = 2

    def on_train_batch_end(self, trainer, *_: object) -> None:  # type: ignore[no-untyped-def, override]
        if (trainer.current_epoch, trainer.global_step % 3) == (self.epoch, 1):
            raise Killed


def train(
    dataset: TerrainDataset, folder: Path, resume: bool = False, **trainer: object
) -> TerrainClassifier:
    options = FitOptions(
        device="cpu", folder=folder, resume=resume, trainer={**EXACT, **trainer}
    )
    return fit_network(trainable(SMALL), dataset, 1, options)[0]


@pytest.fixture(scope="module")
def whole(
    dataset: TerrainDataset, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, TerrainClassifier]:
    folder = tmp_path_factory.mktemp("whole")
    return folder, train(dataset, folder)


@pytest.fixture
def cut(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """The folder of a training that was killed in its third epoch."""
    monkeypatch.setattr(networks, "KeepBest", KillIn)
    with pytest.raises(Killed):
        train(dataset, tmp_path)
    monkeypatch.undo()
    return tmp_path


def test_a_resumed_training_ends_with_the_weights_and_the_history_of_an_unbroken_one(
    dataset: TerrainDataset, whole: tuple[Path, TerrainClassifier], cut: Path
) -> None:
    assert list(pd.read_csv(cut / "classifier/metrics.csv")["epoch"]) == [1, 2]
    again = train(dataset, cut, resume=True)
    for name, value in whole[1].state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
    assert again.temperature == whole[1].temperature
    first, second = (folder / "classifier/metrics.csv" for folder in (whole[0], cut))
    assert first.read_text() == second.read_text()


class Counting(lightning.LightningModule):
    """Its weight counts epochs, and its validation loss is as told."""

    losses = (3.0, 1.0, 2.0, 2.0)

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def training_step(self, batch: torch.Tensor, index: int) -> torch.Tensor:
        return -self.weight.sum()

    def validation_step(self, batch: torch.Tensor, index: int) -> None:
        self.log("valid_loss", self.losses[self.current_epoch])

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=1.0)


def test_the_best_epoch_before_a_kill_is_kept_when_it_is_resumed(
    tmp_path: Path,
) -> None:
    class KillInTheThird(Callback):
        def on_train_epoch_start(self, trainer, module) -> None:  # type: ignore[no-untyped-def]
            if trainer.current_epoch == 2:
                raise Killed

    loader = DataLoader(torch.zeros(1, 1))
    data = {"train_dataloaders": loader, "val_dataloaders": loader}

    def run(module: Counting, resume: bool, *callbacks: Callback) -> dict[str, float]:
        options = FitOptions(
            device="cpu", folder=tmp_path, resume=resume, trainer=EXACT
        )
        return fit(
            module, "x", options, {}, [KeepBest(), *callbacks], data, max_epochs=4
        )

    with pytest.raises(Killed):
        run(Counting(), False, KillInTheThird())
    module = Counting()
    measured = run(module, True)
    assert float(module.weight) == 2
    assert (measured["valid_loss"], measured["epoch"]) == (1, 2)
    assert list(pd.read_csv(tmp_path / "x/metrics.csv")["epoch"]) == [1, 2, 3, 4]


def test_the_temperature_is_of_the_validation_maps(
    dataset: TerrainDataset, whole: tuple[Path, TerrainClassifier]
) -> None:
    bare = copy.deepcopy(whole[1])
    bare.temperature = 1.0
    data = MapData(dataset, 4, 1)
    of_valid, of_train = (
        fit_temperature(*sample_logits(bare, maps, 1))
        for maps in (data.valid, data.train)
    )
    assert whole[1].temperature == pytest.approx(of_valid, rel=1e-6)
    assert of_train != pytest.approx(of_valid, rel=0.01)


def test_settings_of_the_optimiser_reach_it(dataset: TerrainDataset) -> None:
    seen = []

    class Watch(Callback):
        def on_train_start(self, trainer, module) -> None:  # type: ignore[no-untyped-def]
            (group,) = trainer.optimizers[0].param_groups
            seen.append((group["weight_decay"], group["max_lr"]))

    data = MapData(dataset, 4, 0)
    config = replace(SMALL, weight_decay=0.123, learning_rate=0.045)
    model = TerrainClassifier(config).build(data.scale(("rgb",)), names(10))
    options = FitOptions(device="cpu", trainer={**EXACT, "limit_train_batches": 1})
    fit(model, "x", options, {}, [Watch()], {"datamodule": data}, max_epochs=1)
    assert seen == [(0.123, 0.045)]


def test_logs_have_a_row_an_epoch_and_events_for_tensorboard(
    whole: tuple[Path, TerrainClassifier],
) -> None:
    folder = whole[0] / "classifier"
    table = pd.read_csv(folder / "metrics.csv")
    assert list(table["epoch"]) == [1, 2, 3, 4]
    assert {
        "train_loss",
        "valid_loss",
        "valid_accuracy",
        "valid_miou",
        "learning_rate",
    } <= set(table)
    assert table.notna().all(axis=None)
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    logged = [event.value for event in events.Scalars("valid_loss")]
    torch.testing.assert_close(
        torch.tensor(logged), torch.tensor(table["valid_loss"].to_numpy()).float()
    )


@pytest.mark.parametrize("other", [{"max_epochs": 5}, {"jitter": 0.0}, "seed", "half"])
def test_a_training_of_other_settings_is_not_gone_on_with(
    dataset: TerrainDataset, cut: Path, other: object
) -> None:
    config = replace(SMALL, **other) if isinstance(other, dict) else SMALL
    options = FitOptions(device="cpu", folder=cut, resume=True, trainer=EXACT)
    name = next(iter(other)) if isinstance(other, dict) else other
    with pytest.raises(CheckpointError, match=f"for --resume, got another `{name}"):
        fit_network(
            trainable(config),
            dataset,
            2 if other == "seed" else 1,
            options,
            half_precision=other == "half",
        )


OTHER_TRAINERS = {
    "precision": "bf16-mixed",
    "gradient_clip_val": 0.01,
    "accumulate_grad_batches": 2,
    "limit_train_batches": 1,
    "limit_val_batches": 1,
    "deterministic": True,
}


def test_a_training_is_not_gone_on_with_under_other_settings_of_the_trainer(
    dataset: TerrainDataset, cut: Path
) -> None:
    before = sorted(
        (path, path.read_bytes()) for path in (cut / "classifier").iterdir()
    )
    for name, value in OTHER_TRAINERS.items():
        with pytest.raises(
            CheckpointError,
            match=rf"got another `trainer\.{name}`\. Use the settings of",
        ):
            train(dataset, cut, resume=True, **{name: value})
    assert (
        sorted((path, path.read_bytes()) for path in (cut / "classifier").iterdir())
        == before
    )


def test_settings_of_the_trainer_that_change_nothing_are_neither_kept_nor_compared() -> (
    None
):
    plain, same, other = (
        FitOptions(device="cpu", trainer={**EXACT, **more}).trainer_settings
        for more in (
            {},
            {
                "log_every_n_steps": 3,
                "devices": 1,
                "gradient_clip_val": None,
                "limit_val_batches": None,
            },
            {"gradient_clip_val": 0.5},
        )
    )
    assert plain == same == {"devices": 1, "precision": "32-true"}
    assert other == {**plain, "gradient_clip_val": 0.5}


@pytest.mark.parametrize(
    ("trainer", "why"),
    [
        ({"limit_val_batches": 0}, "trainer.limit_val_batches"),
        ({"limit_val_batches": 0.5}, "trainer.limit_val_batches"),
        ({"limit_train_batches": 0}, "trainer.limit_train_batches"),
        ({"check_val_every_n_epoch": 9}, "trainer.check_val_every_n_epoch"),
        ({"gradient_clip_val": "many"}, "Lightning accepts"),
    ],
)
def test_a_trainer_that_would_learn_or_measure_nothing_is_refused_first(
    trainer: dict[str, object], why: str, dataset: TerrainDataset
) -> None:
    check_network(
        trainable(SMALL),
        dataset,
        FitOptions(device="cpu", trainer={**EXACT, "limit_train_batches": 0.5}),
    )
    with pytest.raises(ConfigError, match=why):
        check_network(
            trainable(SMALL),
            dataset,
            FitOptions(device="cpu", trainer={**EXACT, **trainer}),
        )


def test_a_training_that_ends_before_it_was_measured_does_not_blame_the_learning_rate(
    dataset: TerrainDataset,
) -> None:
    options = FitOptions(device="cpu", trainer={**EXACT, "max_time": {"seconds": 0}})
    with pytest.raises(ConfigError, match="ended before the first one") as caught:
        fit_network(trainable(SMALL), dataset, 1, options)
    assert "learning_rate" not in str(caught.value)


def test_maps_on_which_nothing_is_known_are_refused_first(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    options, read = FitOptions(device="cpu", trainer=EXACT), TerrainDataset.read

    def lacking(field: str, split: str) -> None:
        def hide(
            self: TerrainDataset, name: str, *rest: object
        ) -> dict[str, np.ndarray]:
            maps = read(self, name, *rest)  # type: ignore[arg-type]
            gone = {"class_id": UNLABELLED, "traversability": np.nan}[field]
            return (
                {**maps, field: np.full_like(maps[field], gone)}
                if name == split and field in maps
                else maps
            )

        monkeypatch.setattr(TerrainDataset, "read", hide)

    for split in ("train", "valid"):
        lacking("class_id", split)
        with pytest.raises(DatasetError, match=f"cells with a class in split {split}"):
            check_network(trainable(SMALL), dataset, options)
        check_network(trainable(MDNConfig(encoder="mobilenet_v2")), dataset, options)
        lacking("traversability", split)
        with pytest.raises(
            DatasetError, match=f"observed traversability in split {split}"
        ):
            check_network(
                trainable(MDNConfig(encoder="mobilenet_v2")), dataset, options
            )
        check_network(trainable(SMALL), dataset, options)


def test_a_network_that_does_not_take_the_maps_is_refused_first(
    dataset: TerrainDataset,
) -> None:
    config = ClassifierConfig(
        architecture="dpt", encoder="tu-vit_tiny_patch16_224", batch_size=4
    )
    with pytest.raises(ConfigError, match=r"batches of 2 maps of 32×32 cells, got dpt"):
        check_network(
            trainable(config), dataset, FitOptions(device="cpu", trainer=EXACT)
        )


def test_a_damaged_state_is_refused(dataset: TerrainDataset, cut: Path) -> None:
    state = cut / "classifier/last.ckpt"
    content = state.read_bytes()
    for damaged in (content[:100_000], b"garbage", b""):
        state.write_bytes(damaged)
        with pytest.raises(CheckpointError, match="is damaged"):
            train(dataset, cut, resume=True)


def test_one_process_at_a_time_trains_in_a_folder(
    dataset: TerrainDataset, tmp_path: Path
) -> None:
    (tmp_path / "classifier").mkdir()
    with (
        sole_writer(tmp_path / "classifier", "it"),
        pytest.raises(BenchnavError, match="Another run"),
    ):
        train(dataset, tmp_path)


def test_a_new_training_drops_what_an_old_one_left(
    dataset: TerrainDataset, cut: Path
) -> None:
    (cut / "classifier/.last.ckpt.1.partial").write_text("half")
    before = {path.name for path in (cut / "classifier").glob("events*")}
    fit_network(
        trainable(replace(SMALL, max_epochs=1)),
        dataset,
        1,
        FitOptions(device="cpu", folder=cut, trainer=EXACT),
    )
    assert list(pd.read_csv(cut / "classifier/metrics.csv")["epoch"]) == [1]
    assert not before & {path.name for path in (cut / "classifier").glob("events*")}
    assert not list((cut / "classifier").glob(".*partial"))


def test_nothing_to_resume_begins_anew(dataset: TerrainDataset, tmp_path: Path) -> None:
    options = FitOptions(device="cpu", folder=tmp_path, resume=True, trainer=EXACT)
    fit_network(trainable(replace(SMALL, max_epochs=1)), dataset, 1, options)
    assert list(pd.read_csv(tmp_path / "classifier/metrics.csv")["epoch"]) == [1]


@pytest.mark.parametrize("name", ["plugins", "profiler", "device"])
def test_settings_that_the_trainer_does_not_take_are_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"got '{name}'"):
        FitOptions(device="cpu", trainer={name: 1})


def test_settings_reach_the_trainer(dataset: TerrainDataset) -> None:
    seen: list[tuple[int, int]] = []

    class Watch(Callback):
        def on_train_end(self, trainer, module) -> None:  # type: ignore[no-untyped-def]
            seen.append((trainer.num_training_batches, trainer.accumulate_grad_batches))

    options = FitOptions(
        device="cpu",
        trainer={**EXACT, "limit_train_batches": 1, "accumulate_grad_batches": 2},
    )
    data = MapData(dataset, 4, 0)
    model = TerrainClassifier(SMALL).build(data.scale(("rgb",)), names(10))
    fit(
        model,
        "x",
        options,
        {},
        [KeepBest(), Watch()],
        {"datamodule": data},
        max_epochs=1,
    )
    assert seen == [(1, 2)]
    with pytest.raises(ConfigError, match="Lightning accepts"):
        fit(
            model,
            "x",
            FitOptions(device="cpu", trainer={"precision": "8-tiny"}),
            {},
            [],
            {},
        )


def test_bfloat16_is_chosen_where_it_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for known, precision in ((True, "bf16-mixed"), (False, "32-true")):
        monkeypatch.setattr(
            torch.cuda, "is_bf16_supported", lambda including_emulation, k=known: k
        )
        assert default_precision("cuda") == precision


def test_the_precision_is_that_of_what_is_trained_on(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(
        torch.cuda, "is_bf16_supported", lambda including_emulation: True
    )
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert default_precision("cpu") == "32-true"
    seen = []

    class Watch(Callback):
        def on_train_start(self, trainer, module) -> None:  # type: ignore[no-untyped-def]
            seen.append(trainer.precision)

    monkeypatch.undo()
    asked: list[str] = []
    monkeypatch.setattr(
        fit_module, "default_precision", lambda name: asked.append(name) or "bf16-mixed"
    )
    data = MapData(dataset, 4, 0)
    model = TerrainClassifier(SMALL).build(data.scale(("rgb",)), names(10))
    options = FitOptions(device="cpu", trainer={"limit_train_batches": 1})
    fit(model, "x", options, {}, [Watch()], {"datamodule": data}, max_epochs=1)
    assert asked == ["cpu"]
    assert seen == ["bf16-mixed"]


def test_gradients_are_clipped_under_mixed_precision(dataset: TerrainDataset) -> None:
    norms: list[float] = []

    class Watch(Callback):
        def on_train_batch_end(self, trainer, module, *given) -> None:  # type: ignore[no-untyped-def]
            gradients = [
                value.grad.norm()
                for value in module.parameters()
                if value.grad is not None
            ]
            norms.append(float(torch.stack(gradients).norm()))

    data = MapData(dataset, 4, 0)
    for settings in ({}, {"gradient_clip_val": 1e-3}):
        model = TerrainClassifier(SMALL).build(data.scale(("rgb",)), names(10))
        trainer = {
            **EXACT,
            "precision": "bf16-mixed",
            "limit_train_batches": 1,
            **settings,
        }
        fit(
            model,
            "x",
            FitOptions(device="cpu", trainer=trainer),
            {},
            [Watch()],
            {"datamodule": data},
            max_epochs=1,
        )
    free, clipped = norms
    assert free > 0.01
    assert clipped == pytest.approx(1e-3, rel=1e-3)


def test_a_command_that_is_killed_and_resumed_ends_as_if_it_had_not_been(
    dataset: TerrainDataset, whole: tuple[Path, TerrainClassifier], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    command = [
        sys.executable,
        "-c",
        "from benchnav.models.cli import main; main()",
        "classifier",
    ]
    command += [
        "--data",
        str(dataset.path),
        "--out",
        str(tmp_path / "m"),
        "--seed",
        "1",
    ]
    command += [
        "--trainer.precision",
        "32-true",
        "--device",
        "cpu",
        "--half-precision",
        "false",
    ]
    settings = json.loads(json.dumps(plain_config(SMALL)))
    command += [f"--classifier.{name}={value}" for name, value in settings.items()]
    environment = {**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads())}
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert process.stderr
    while "epoch 3/4" not in (line := process.stderr.readline()):
        assert line, "it ended before it could be killed"
    process.kill()
    process.wait()
    assert not (tmp_path / "m").exists()
    monkeypatch.setattr(sys, "argv", ["benchnav-train", *command[3:]])
    with pytest.raises(SystemExit) as refused:
        cli.main()
    assert refused.value.code == 2
    assert "--resume" in capsys.readouterr().err
    assert call("train", *command[3:], "--resume") == 0
    there = load_checkpoint(tmp_path / "m").part("classifier")
    for name, value in whole[1].state_dict().items():
        assert torch.equal(value, there.tensors[name]), name
    assert there.config["temperature"] == whole[1].temperature
    assert not (tmp_path / "m.training/classifier/last.ckpt").exists()


def test_two_processes_train_one_classifier(
    dataset: TerrainDataset, tmp_path: Path
) -> None:
    command = [
        sys.executable,
        "-c",
        "from benchnav.models.cli import main; main()",
        "classifier",
    ]
    command += [
        "--data",
        str(dataset.path),
        "--out",
        str(tmp_path / "m"),
        "--trainer.strategy",
        "ddp_fork",
    ]
    command += [
        "--device",
        "cpu",
        "--trainer.devices",
        "2",
        "--trainer.max_epochs",
        "2",
    ]
    command += [
        "--trainer.precision",
        "32-true",
        "--classifier.encoder",
        "mobilenet_v2",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert [
        line
        for line in done.stderr.splitlines()
        if line.startswith("classifier: epoch 2/2")
    ]
    assert done.stdout.count("wrote") == 1
    (row,) = (
        row
        for row in pd.read_csv(
            tmp_path / "m.training/classifier/metrics.csv"
        ).itertuples()
        if row.epoch == 2
    )
    metrics = load_checkpoint(tmp_path / "m").part("classifier").metrics
    assert metrics["epoch"] in (1, 2)
    assert row.valid_accuracy > 0.05


def test_no_more_processes_than_processors_are_started(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    FitOptions(device="cpu", trainer={"devices": os.cpu_count()})
    for devices in (0, (os.cpu_count() or 1) + 1):
        with pytest.raises(ConfigError, match=r"trainer\.devices"):
            FitOptions(device="cpu", trainer={"devices": devices})
