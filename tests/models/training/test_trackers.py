"""A user's loggers and callbacks are made from text, write where they should, and
callbacks are recorded.
"""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.config import TrainOptions
from benchnav.models.training.fit import FitOptions
from benchnav.models.training.networks import fit_model

OWN = Path(__file__).parents[3] / "examples" / "own_model.py"
CALLBACK = """
from pathlib import Path
from lightning.pytorch.callbacks import Callback


class Note(Callback):
    def __init__(self, path: str, word: str = "epoch") -> None:
        self.path, self.word = path, word

    def on_train_epoch_end(self, trainer, module):
        with open(self.path, "a") as file:
            file.write(f"{self.word} {trainer.current_epoch}\\n")
"""


def train(dataset: TerrainDataset, out: Path, file: Path = OWN, **trainer: Any) -> None:
    options = TrainOptions(
        device="cpu", trainer={"max_epochs": 2, "precision": "32-true", **trainer}
    )
    fit_model(
        options,
        f"{file}:CellModel",
        str(dataset.path),
        str(out),
        {"batch_size": 5, "hidden": 4},
    )


def test_loggers_write_what_is_measured_and_change_nothing(
    dataset: TerrainDataset, tmp_path: Path
) -> None:
    train(dataset, tmp_path / "plain")
    train(
        dataset,
        tmp_path / "logged",
        logger=["CSVLogger", {"class_path": "TensorBoardLogger"}],
    )
    logs = tmp_path / "logged.training" / "CellModel"
    table = pd.read_csv(logs / "lightning_logs" / "version_0" / "metrics.csv")
    own = pd.read_csv(logs / "metrics.csv")  # ours is there as ever
    assert table["valid_loss"].dropna().tolist() == pytest.approx(
        own["valid_loss"].tolist()
    )
    told = (logs / "lightning_logs" / "version_0" / "hparams.yaml").read_text()
    assert "hidden: 4" in told
    assert "seed: 0" in told
    assert list(logs.glob("lightning_logs/version_*/events.out.tfevents.*"))
    # where loggers are named, these alone write
    assert not list(logs.glob("events.out.tfevents.*"))
    assert list(
        (tmp_path / "plain.training" / "CellModel").glob("events.out.tfevents.*")
    )
    first, second = (
        load_checkpoint(tmp_path / name).parts["CellModel"]
        for name in ("plain", "logged")
    )
    assert all(
        (first.tensors[name] == second.tensors[name]).all() for name in first.tensors
    )
    assert first.trainer == second.trainer


def test_a_callback_of_a_file_is_called_and_recorded(
    dataset: TerrainDataset, tmp_path: Path
) -> None:
    file, log = tmp_path / "note.py", tmp_path / "log.txt"
    file.write_text(CALLBACK)
    given = {
        "class_path": f"{file}:Note",
        "init_args": {"path": str(log), "word": "after"},
    }
    train(
        dataset,
        tmp_path / "out",
        callbacks=[given, "DeviceStatsMonitor"],
        logger="CSVLogger",
    )
    assert log.read_text() == "after 0\nafter 1\n"
    (note, stats) = (
        load_checkpoint(tmp_path / "out").parts["CellModel"].trainer["callbacks"]
    )
    assert note["init_args"]["word"] == "after"
    assert stats == {"class_path": "DeviceStatsMonitor"}
    before = note["digest"]
    file.write_text(CALLBACK.replace("current_epoch", "current_epoch + 1"))
    options = FitOptions(device="cpu", trainer={"callbacks": given})
    assert options.trainer_settings["callbacks"][0]["digest"] != before
    json.dumps(options.trainer_settings)
    with pytest.raises(CheckpointError, match=r"another .*trainer\.callbacks"):
        fit_model(
            TrainOptions(device="cpu", trainer={"max_epochs": 2, "precision": "32-true"}, resume=True),
            f"{OWN}:CellModel", str(dataset.path), str(tmp_path / "out"), {"batch_size": 5, "hidden": 4},
        )  # fmt: skip


@pytest.mark.parametrize(
    ("trainer", "said"),
    [
        ({"logger": "CVSLogger"}, "CSVLogger"),
        ({"logger": "EarlyStopping"}, "`trainer.logger` among"),
        ({"logger": {"class": "CSVLogger"}}, "{class_path: CLASS, init_args: {…}}"),
        (
            {"logger": {"class_path": "CSVLogger", "init_args": {"colour": 1}}},
            "arguments that CSVLogger accepts",
        ),
        ({"callbacks": "nowhere.py:Note"}, "a file that can be read"),
        ({"callbacks": "no_such_module.Note"}, "no_such_module"),
        ({"callbacks": "pathlib.Path"}, "lightning's Callback"),
    ],
)
def test_what_cannot_be_made_is_refused_before_training(
    trainer: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError) as refused:
        FitOptions(device="cpu", trainer=trainer)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_metric_that_is_not_measured_is_named_with_those_that_are(
    dataset: TerrainDataset, tmp_path: Path
) -> None:
    for kind in ("EarlyStopping", "ModelCheckpoint"):
        stop = {"class_path": kind, "init_args": {"monitor": "valid/loss"}}
        with pytest.raises(ConfigError, match=r"valid/loss.*valid_loss") as refused:
            train(dataset, tmp_path / kind, callbacks=[stop])
        assert "\n" not in str(refused.value)


def test_a_missing_package_is_named_with_its_command() -> None:
    mlflow = pytest.importorskip("lightning.pytorch.loggers.mlflow")
    if mlflow._MLFLOW_AVAILABLE:
        pytest.skip("mlflow is installed")
    with pytest.raises(ConfigError, match="pip install mlflow"):
        FitOptions(
            device="cpu", trainer={"logger": "lightning.pytorch.loggers.MLFlowLogger"}
        )


@pytest.mark.parametrize(
    ("name", "init_args", "remedy"),
    [
        ("StochasticWeightAveraging", {"swa_lrs": 1e-2}, "fit swag"),
        ("WeightAveraging", {}, "fit swag"),
        ("EMAWeightAveraging", {}, "fit swag"),
        ("ModelPruning", {"pruning_fn": "l1_unstructured"}, "Leave it out"),
        ("LearningRateFinder", {}, "Set `learning_rate`"),
        ("BatchSizeFinder", {}, "Set `batch_size`"),
    ],
)
def test_callbacks_whose_effect_would_be_undone_are_refused_by_name(
    name: str, init_args: dict[str, Any], remedy: str
) -> None:
    with pytest.raises(
        ConfigError, match=rf"got {name}\. Its effect would be undone\. .*{remedy}"
    ):
        FitOptions(
            device="cpu",
            trainer={"callbacks": {"class_path": name, "init_args": init_args}},
        )


CHANGE = """
from lightning.pytorch.callbacks import Callback, Checkpoint


class Change({base}):
    def {hook}(self, trainer, module, *_, **__):
        for value in module.parameters():
            value.data.mul_(0.5)
"""


@pytest.mark.parametrize(
    ("hook", "base", "is_allowed"),
    [
        ("setup", "Callback", True),
        ("on_train_epoch_start", "Callback", True),
        ("on_train_end", "Callback", False),
        ("on_fit_end", "Callback", False),
        ("on_fit_end", "Checkpoint", False),  # which Lightning calls after others
        ("teardown", "Callback", False),
    ],
)
def test_a_callback_that_changes_the_trained_weights_is_refused_by_name(
    hook: str, base: str, is_allowed: bool, dataset: TerrainDataset, tmp_path: Path
) -> None:
    file = tmp_path / "change.py"
    file.write_text(CHANGE.format(base=base, hook=hook))
    if is_allowed:
        train(dataset, tmp_path / "out", callbacks=f"{file}:Change")
        return
    with pytest.raises(
        ConfigError, match=f"weights that `{hook}` of Change changed.*callback out"
    ):
        train(dataset, tmp_path / "out", callbacks=f"{file}:Change")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("hook", ["on_fit_end", "on_train_end", "teardown"])
def test_a_model_may_change_its_weights_after_the_best_are_back(
    hook: str, dataset: TerrainDataset, tmp_path: Path
) -> None:
    """It also has a buffer of NaN, which differs from itself."""
    file, where = tmp_path / "own.py", "        super().__init__(config)\n"
    added = f"""        self.register_buffer("empty", torch.full((2,), math.nan))

    def {hook}(self, *_, **__):
        for value in self.parameters():
            value.data.fill_(0.25)
"""
    file.write_text(OWN.read_text().replace(where, where + added))
    if hook == "on_train_end":
        with pytest.raises(
            ConfigError,
            match=r"`on_train_end` of CellModel changed.*in `on_fit_end` of the model",
        ):
            train(dataset, tmp_path / "out", file)
        return
    train(dataset, tmp_path / "out", file)
    tensors = load_checkpoint(tmp_path / "out").parts["CellModel"].tensors
    assert tensors["network.0.weight"].eq(0.25).all()
