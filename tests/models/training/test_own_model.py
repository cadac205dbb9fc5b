"""A user's own model goes the whole way: trained by the command, calibrated, killed and
resumed, loaded, refused.
"""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest
import torch

from benchnav.core import part_lookup, registry
from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.sources import load_file
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import load_checkpoint, save_checkpoint
from benchnav.models.cli import main
from benchnav.models.nets.ensemble import Ensemble
from benchnav.models.predictor import load_model
from benchnav.models.training import networks
from benchnav.models.training.best import KeepBest
from benchnav.models.training.data import MapDataset
from benchnav.testing import check_model
from tests.commands import call
from tests.models.training.conftest import EXAMPLE

QUICK = (
    "--trainer.precision",
    "32-true",
    "--trainer.max_epochs",
    "3",
    "--settings.batch_size",
    "5",
)


@pytest.fixture(scope="module")
def trained(dataset: TerrainDataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the example and an ensemble of two of its models."""
    folder = tmp_path_factory.mktemp("own")
    shutil.copy(EXAMPLE, folder / "own.py")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        settings = (
            "--settings.hidden",
            8,
            "--settings.inputs",
            "[rgb, slope_deg, elevation_m]",
            "--seed",
            4,
        )
        where = ("fit", "own.py:CellModel", "--data", dataset.path, "--out", "c")
        assert call("train", *where, *QUICK, *settings, "--members", 2) == 0
    return folder


def test_it_is_trained_calibrated_and_kept_as_data(
    trained: Path, dataset: TerrainDataset
) -> None:
    kept = load_checkpoint(trained / "c")
    assert (kept.model, set(kept.parts)) == ("CellModel", {"CellModel", "CellModel-2"})
    assert len(kept.code) == 64
    assert [part.seed for part in kept.parts.values()] == [4, 5]
    first = kept.part("CellModel")
    assert (
        first.config["hidden"],
        first.config["max_epochs"],
        first.config["batch_size"],
    ) == (8, 3, 5)
    assert first.config["inputs"] == ["rgb", "slope_deg", "elevation_m"]
    assert first.tensors["network.0.weight"].shape == (8, 5, 1, 1)
    text = (trained / "c" / "config.json").read_text()
    assert "own.py" not in text  # what is kept names no file to import
    card = (trained / "c" / "README.md").read_text()
    assert "path/to/file.py:CellModel@c" in card
    assert "| inputs | ['rgb', 'slope_deg', 'elevation_m'] |" in card
    assert "SHA-256 of its code was" in card
    assert "Loading runs that file." in card
    assert "It is an ensemble: the predictions of its 2 networks are averaged" in card
    assert ("calibrated by the temperature" in card) == (kept.pool_temperature != 1)


def test_layers_are_scaled_by_the_training_maps(
    trained: Path, dataset: TerrainDataset
) -> None:
    tensors = load_checkpoint(trained / "c").part("CellModel").tensors
    for channel, name in ((3, "slope_deg"), (4, "elevation_m")):
        values = torch.from_numpy(dataset.read("train", fields=[name])[name]).double()
        torch.testing.assert_close(
            float(tensors["stack.mean"][channel]),
            float(values.mean()),
            rtol=1e-4,
            atol=1e-5,
        )
        torch.testing.assert_close(
            float(tensors["stack.std"][channel]),
            float(values.std(correction=0)),
            rtol=1e-4,
            atol=1e-5,
        )


def test_it_is_loaded_by_its_class_and_checkpoint(
    trained: Path, dataset: TerrainDataset
) -> None:
    source = f"{trained / 'own.py'}:CellModel@{trained / 'c'}"
    model = load_model(source)
    assert isinstance(model, Ensemble)
    kept, seen = load_checkpoint(trained / "c"), dataset.terrain("test/std").observe()
    assert model.temperature == kept.pool_temperature
    for member, part in zip(model.members, kept.parts.values(), strict=True):
        assert member.temperature == part.config["temperature"]
    # The average of the members' distribution functions, before the pool's temperature.
    model.temperature = 1.0
    average = torch.stack(
        [member.predict(seen).cdf(0.4) for member in model.members]
    ).mean(0)
    torch.testing.assert_close(model.predict(seen).cdf(0.4), average, rtol=0, atol=1e-5)
    check_model(source)


def test_the_temperatures_are_the_likeliest_on_the_validation_maps(
    trained: Path, dataset: TerrainDataset
) -> None:
    source = f"{trained / 'own.py'}:CellModel@{trained / 'c'}"
    valid = dataset.terrain("valid")

    def nll(temperature: float) -> float:
        model = load_model(source)
        model.temperature = temperature  # type: ignore[attr-defined]
        return -float(
            model.predict(valid.observe())
            .log_prob(valid.traversability)
            .double()
            .mean()
        )

    found = load_model(source).temperature  # type: ignore[attr-defined]
    others = [nll(found * factor) for factor in (0.8, 0.9, 1.1, 1.25)]
    assert nll(found) < min(others) + (0.001 if found == 1 else 0)


def test_temperatures_widen_what_one_model_and_an_ensemble_predict(
    trained: Path, dataset: TerrainDataset
) -> None:
    seen, ensemble = (
        dataset.terrain("test/std").observe(),
        load_model(f"{trained / 'own.py'}:CellModel@{trained / 'c'}"),
    )
    assert isinstance(ensemble, Ensemble)
    for model in (ensemble, ensemble.members[0]):
        model.temperature = 1.0
        plain = model.predict(seen).cdf(0.4).double()
        model.temperature = 1.7
        wider = model.predict(seen).cdf(0.4).double()
        # Φ(Φ⁻¹(F(λ)) / T)
        expected = torch.special.ndtr(torch.special.ndtri(plain) / 1.7)
        torch.testing.assert_close(wider, expected, rtol=0, atol=2e-5)


def test_a_kill_in_any_epoch_changes_nothing(
    trained: Path, own: Path, dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = (
        "--settings.hidden",
        8,
        "--settings.inputs",
        "[rgb, slope_deg, elevation_m]",
        "--seed",
        4,
    )
    command = ("fit", "own.py:CellModel", "--data", dataset.path, *QUICK, *settings)
    for epoch in range(3):

        class Killed(Exception):
            pass

        class Kill(KeepBest):
            def on_train_batch_end(
                self, trainer, *_: object, epoch: int = epoch
            ) -> None:  # type: ignore[no-untyped-def, override]
                if trainer.current_epoch == epoch:
                    raise Killed

        out = f"c{epoch}"
        with monkeypatch.context() as patch:
            patch.setattr(networks, "KeepBest", Kill)
            patch.setattr(
                sys, "argv", ["benchnav-train", *map(str, command), "--out", out]
            )
            with pytest.raises(Killed):
                main()
        assert call("train", *command, "--out", out, "--resume") == 0
        found, wanted = (
            load_checkpoint(folder).part("CellModel") for folder in (out, trained / "c")
        )
        assert found.config == wanted.config
        for name, value in wanted.tensors.items():
            assert torch.equal(found.tensors[name], value), name


def test_other_code_is_told_and_not_gone_on_with(
    trained: Path,
    own: Path,
    dataset: TerrainDataset,
    capfd: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(trained / "c", "c")
    load_model("own.py:CellModel@c")
    assert capfd.readouterr().err == ""
    Path("own.py").write_text(EXAMPLE.read_text() + "\n\nMORE = 1\n")
    load_model("own.py:CellModel@c")
    (line,) = capfd.readouterr().err.splitlines()
    assert (
        "CellModel in file own.py has changed since it trained the checkpoint" in line
    )
    command = (
        "fit",
        "own.py:CellModel",
        "--data",
        dataset.path,
        "--out",
        "c",
        *QUICK,
        "--resume",
    )
    assert call("train", *command) == 2
    assert "got a checkpoint of other code" in capfd.readouterr().err


def test_an_installed_class_is_loaded_by_its_name_and_its_code_compared_too(
    trained: Path,
    own: Path,
    dataset: TerrainDataset,
    module: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})
    registry.register("model", "cells", module.CellModel)
    assert (
        call("train", "fit", "cells", "--data", dataset.path, "--out", "c", *QUICK) == 0
    )
    kept = load_checkpoint("c")
    assert (kept.model, list(kept.parts)) == ("cells", ["cells"])
    assert "benchnav-train evaluate c --data" in Path("c/README.md").read_text()
    capfd.readouterr()
    load_model("c")
    assert capfd.readouterr().err == ""
    save_checkpoint("c", replace(kept, code="0" * 64))
    load_model("c")
    assert (
        "cells in this process has changed since it trained the checkpoint"
        in capfd.readouterr().err
    )


def test_a_class_that_raises_while_it_is_rebuilt_ends_in_one_line(
    trained: Path, own: Path
) -> None:
    text = EXAMPLE.read_text().replace(
        "hidden = self.config.hidden", "hidden = [][self.config.hidden]"
    )
    Path("own.py").write_text(text)
    with pytest.raises(CheckpointError, match="list index out of range"):
        load_model(f"own.py:CellModel@{trained / 'c'}")


def test_a_checkpoint_of_a_users_class_needs_the_class(trained: Path) -> None:
    with pytest.raises(CheckpointError, match=r"path/to/file\.py:CellModel@CHECKPOINT"):
        load_model(trained / "c")
    (trained / "other.py").write_text(
        EXAMPLE.read_text().replace("class CellModel", "class Other")
    )
    with pytest.raises(
        CheckpointError,
        match=r"of the class Other, got .* which is of the class 'CellModel'",
    ):
        load_model(f"{trained / 'other.py'}:Other@{trained / 'c'}")
    with pytest.raises(
        ConfigError,
        match=r"to be a subclass of benchnav\.models\.TrainableModel or ModelFamily",
    ):
        load_model(f"{trained / 'own.py'}:CellConfig@{trained / 'c'}")


@pytest.mark.parametrize("where", ["model", "code", "config", "parts"])
def test_a_hostile_checkpoint_imports_nothing(
    trained: Path, tmp_path: Path, where: str
) -> None:
    """Whatever a checkpoint says of itself, no file or module that it names is imported
    or run.
    """
    trap, sprung = tmp_path / "trap.py", tmp_path / "sprung"
    trap.write_text(
        f"from pathlib import Path\nPath({str(sprung)!r}).touch()\nclass Trap: pass\n"
    )
    kept, name = load_checkpoint(trained / "c"), f"{trap}:Trap"
    part = kept.part("CellModel")
    hostile = {
        "model": replace(kept, model=name),
        "code": replace(kept, code=name),
        "config": kept.with_part(
            "CellModel",
            replace(part, config={**part.config, "model": name, "inputs": [name]}),
        ),
        "parts": replace(
            kept,
            parts={
                **kept.parts,
                "CellModel-2": replace(part, config={"class_path": name}),
            },
        ),
    }[where]
    save_checkpoint(tmp_path / "h", hostile)
    sys.path.insert(0, str(tmp_path))
    try:
        for source in (
            tmp_path / "h",
            f"{trained / 'own.py'}:CellModel@{tmp_path / 'h'}",
        ):
            try:
                load_model(source)
            except (CheckpointError, ConfigError):
                continue
    finally:
        sys.path.remove(str(tmp_path))
    assert not sprung.exists()
    assert "trap" not in sys.modules


def test_how_maps_are_cut_and_turned_reaches_the_training_and_the_checkpoint(
    own: Path, dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[torch.Size, bool]] = []
    give = MapDataset.__getitem__

    def watch(self: MapDataset, key):  # type: ignore[no-untyped-def]
        batch = give(self, key)
        seen.append((batch["rgb"].shape, bool(key.symmetry.any())))
        return batch

    monkeypatch.setattr(MapDataset, "__getitem__", watch)
    where = ("fit", "own.py:CellModel", "--data", dataset.path, *QUICK)
    assert (
        call("train", *where, "--out", "a", "--crop", 24, "--symmetries", "false") == 0
    )
    assert {shape[-2:] for shape, _ in seen} == {(24, 24)}
    assert not any(turned for _, turned in seen)
    config = load_checkpoint("a").part("CellModel").config
    assert (config["crop"], config["symmetries"]) == (24, False)
    settings = json.loads(Path("a.training/CellModel/settings.json").read_text())
    assert (settings["config"]["crop"], settings["config"]["symmetries"]) == (24, False)
    seen.clear()
    assert call("train", *where, "--out", "b") == 0
    assert {shape[-2:] for shape, _ in seen} == {torch.Size((32, 32))}
    assert any(turned for _, turned in seen)


@pytest.mark.parametrize(
    ("words", "turned"),
    [
        ((), False),
        (("--symmetries",), True),
        (("--settings.symmetries", "true"), False),
        (("--symmetries", "true", "--settings.symmetries", "false"), False),
        (("--settings.inputs", "[slope_deg]"), True),
    ],
)
def test_photos_are_turned_only_where_the_user_asks_for_it(
    own: Path,
    dataset: TerrainDataset,
    words: tuple[str, ...],
    turned: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(
        TerrainDataset, "has_photo", lambda self, split: split == "train"
    )
    command = (
        "fit",
        "own.py:CellModel",
        "--data",
        dataset.path,
        *QUICK,
        "--trainer.max_epochs",
        1,
        "--out",
        "a",
    )
    assert call("train", *command, *words) == 0
    assert load_checkpoint("a").part("CellModel").config["symmetries"] == turned
    assert ("pass --symmetries true" in capsys.readouterr().out) == (
        "--symmetries" not in words and not turned
    )


def test_a_loss_that_is_no_number_ends_training_and_says_the_epoch(
    own: Path, dataset: TerrainDataset, capsys: pytest.CaptureFixture[str]
) -> None:
    """It turns NaN in the second epoch, of training or of validation alone; resumed it
    ends there again.
    """
    text = EXAMPLE.read_text()
    broken = "            if self._trainer and self.training is {mode} and self.trainer.current_epoch == 1:\n"
    broken += (
        "                return observed.new_tensor(math.nan, requires_grad=True)\n"
    )
    at = "            mean, std = self.gaussian(outputs)\n            seen"
    for mode, name in ((True, "train_loss"), (False, "valid_loss")):
        Path("broken.py").write_text(text.replace(at, broken.format(mode=mode) + at))
        command = (
            "fit",
            "broken.py:CellModel",
            "--data",
            dataset.path,
            *QUICK,
            "--out",
            name,
        )
        for words in ((), ("--resume",)):
            assert call("train", *command, *words) == 1
            assert (
                f"Expected a finite {name}, got nan in epoch 2."
                in capsys.readouterr().err
            )
            assert not Path(name).exists()
        table = pd.read_csv(f"{name}.training/CellModel/metrics.csv")
        assert table["epoch"].tolist() == [1, 2]
        assert table[name].isna().tolist() == [False, True]


@pytest.fixture(scope="module")
def module() -> ModuleType:
    return load_file(EXAMPLE, EXAMPLE.read_bytes())


def test_a_class_that_keeps_the_contract_passes_and_one_that_does_not_is_told(
    module: ModuleType,
) -> None:
    check_model(module.CellModel)
    check_model(f"{EXAMPLE}:CellModel")

    class Deaf(module.CellModel):  # type: ignore[name-defined, misc]
        """Counts cells whose λ was not observed."""

        def configure_losses(self):  # type: ignore[no-untyped-def]
            return lambda outputs, observed: (outputs[:, 0] - observed).square().mean()

    with pytest.raises(
        ConfigError, match="finite loss if λ of some cells is unobserved"
    ):
        check_model(Deaf)

    class Forgetful(module.CellModel):  # type: ignore[name-defined, misc]
        """Keeps what it learned where no checkpoint looks."""

        def build(self, *arguments, **named):  # type: ignore[no-untyped-def]
            super().build(*arguments, **named)
            self.shift = [float(torch.rand(()))]
            return self

        def to_distribution(self, outputs):  # type: ignore[no-untyped-def]
            return super().to_distribution(outputs + self.shift[0])

    with pytest.raises(
        ConfigError, match="same prediction from a model restored from its settings"
    ):
        check_model(Forgetful)


def test_fit_of_the_fused_model_is_all_and_its_classifier_takes_layers(
    own: Path, dataset: TerrainDataset
) -> None:
    common = (
        "--data",
        dataset.path,
        "--trainer.precision",
        "32-true",
        "--trainer.max_epochs",
        1,
    )
    stages = {
        "classifier.encoder": "mobilenet_v2",
        "classifier.batch_size": 5,
        "classifier.inputs": "[elevation_m, rgb]",
        "gp.inducing_points": 4,
    }
    settings = [(f"--settings.{name}", value) for name, value in stages.items()]
    flags = [(f"--{name}", value) for name, value in stages.items()]
    assert (
        call(
            "train",
            "fit",
            "fused",
            *common,
            "--out",
            "a",
            *(word for pair in settings for word in pair),
        )
        == 0
    )
    assert (
        call(
            "train",
            "all",
            *common,
            "--out",
            "b",
            *(word for pair in flags for word in pair),
        )
        == 0
    )
    first, second = load_checkpoint("a"), load_checkpoint("b")
    assert (first.model, set(first.parts)) == ("fused", {"gp", "classifier"})
    for name, part in first.parts.items():
        assert part.config == second.part(name).config
        assert all(
            torch.equal(value, second.part(name).tensors[tensor])
            for tensor, value in part.tensors.items()
        )
    assert first.part("gp").config["inducing_points"] == 4
    assert first.part("classifier").config["inputs"] == ["elevation_m", "rgb"]
    model, seen = load_model("a"), dataset.terrain("test/std").observe()
    before = model.predict(seen).mean()
    higher = replace(
        seen, elevation_m=seen.elevation_m + torch.rand(seen.elevation_m.shape)
    )
    assert not torch.equal(model.predict(higher).mean(), before)


def test_maps_without_a_layer_that_the_model_was_trained_on_are_refused(
    module: ModuleType, dataset: TerrainDataset
) -> None:
    model = module.CellModel(module.CellConfig(inputs=("rgb", "vegetation_m"))).build()
    with pytest.raises(
        ConfigError,
        match=r"layers vegetation_m, got maps with rgb, elevation_m, slope_deg",
    ):
        model.predict(dataset.terrain("test/std").observe())
