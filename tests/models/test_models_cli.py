import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import huggingface_hub
import pytest

from benchnav.core.store import seal
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.checkpoint import load_checkpoint, save_checkpoint
from benchnav.models.fused import FusedModel
from benchnav.models.nets.calibration import (
    fit_pool_temperature,
    fit_temperature,
    sample_logits,
)
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.predictor import load_model
from benchnav.models.training import networks
from benchnav.models.training.data import Loading, MapDataset
from benchnav.models.training.fit import STATE, FitOptions
from tests.commands import call
from tests.models.support import make_dataset, names

QUICK_GP = ["--gp.epochs", "1", "--gp.epoch_steps", "5"]
QUICK_CLASSIFIER = [
    "--classifier.max_epochs",
    "1",
    "--classifier.batch_size",
    "5",
    "--trainer.precision",
    "32-true",
]


NETWORKS = {"all": "classifier", "classifier": "classifier", "mdn": "mdn"}


def refuses(capfd: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Runs a command that must end with status 2 and one line; returns the line."""
    capfd.readouterr()
    assert call("train", *arguments) == 2
    lines = capfd.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("benchnav-train: error: ")
    return lines[0]


def test_halves_are_trained_into_one_checkpoint(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    where = ["--data", dataset.path, "--out", "new/mine"]
    assert call("train", "gp", *where, *QUICK_GP, "--seed", 7) == 0
    assert call("train", "classifier", *where, *QUICK_CLASSIFIER) == 0
    out, err = capfd.readouterr()
    assert "validation RMSE of the latent mean" in out
    assert re.search(
        r"best epoch 1, validation loss [\d.]+, accuracy [\d.]+, miou [\d.]+, temperature",
        out,
    )
    assert "wrote new/mine with classifier and gp" in out
    assert re.search(r"wrote new/mine with gp \(\d+\.\d kB\)", out)
    assert [line.split(":")[0] for line in err.strip().splitlines()] == [
        "gp",
        "classifier",
    ], err
    there = load_checkpoint("new/mine")
    assert set(there.parts) == {"classifier", "gp"}
    assert there.part("gp").seed == 7
    assert there.part("gp").config["epoch_steps"] == 5
    assert 0 < there.part("classifier").metrics["valid_accuracy"] < 1
    assert there.part("gp").data_id == "tiny-v1"
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "mine",
        "mine.training",
    ]

    again = refuses(capfd, "gp", *where, *QUICK_GP)
    assert "--overwrite" in again
    assert (
        call(
            "train",
            "gp",
            *where,
            *QUICK_GP,
            "--overwrite",
            "true",
            "--gp.likelihood",
            "gaussian",
        )
        == 0
    )
    after = load_checkpoint("new/mine")
    assert after.part("gp").config["likelihood"] == "gaussian"
    assert after.part("classifier").metrics == there.part("classifier").metrics


def test_a_checkpoint_of_other_classes_is_refused_and_both_are_named(
    checkpoint_path: Path,
    dataset: TerrainDataset,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    copy = shutil.copytree(checkpoint_path, tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    config["class_names"][0] = "lava"
    del config["manifest_digest"]
    (copy / "config.json").write_text(seal(config))
    where = ["--data", dataset.path, "--out", copy]
    message = refuses(capfd, "classifier", *where, *QUICK_CLASSIFIER)
    assert "classes lava" in message
    assert f"classes {dataset.recipe.classes[0].name}" in message


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["evaluate", "oracel", "--data", "DATA"], "Did you mean 'oracle'"),
        (["all", "--data", "DATA"], "out"),
        (
            ["all", "--data", "DATA", "--out", "x", "--classifier.max_epochs", "0"],
            "max_epochs",
        ),
        (
            ["all", "--data", "DATA", "--out", "x", "--gp.likelihood", "cauchy"],
            "likelihood",
        ),
        (
            [
                "classifier",
                "--data",
                "DATA",
                "--out",
                "x",
                "--classifier.encoder",
                "resnet19",
            ],
            "resnet19",
        ),
        (["gp", "--data", "DATA", "--out", "x", "--gp.max_points", "9"], "max_points"),
        (["gp", "--data", "TEST", "--out", "x"], "the splits `train` and `valid`"),
        (["gp", "--data", "DATA", "--out", "."], "contains no config.json"),
        *(
            ([kind, "--data", "DATA", "--out", "x/y", *setting], expected)
            for kind in ("all", "mdn", "classifier")
            for setting, expected in (
                (
                    [f"--{NETWORKS[kind]}.encoder", "tu-resnet81"],
                    "got 'tu-resnet81'. Did you mean 'tu-resnet18'?",
                ),
                (
                    [f"--{NETWORKS[kind]}.architecture", "DeepLabV3+"],
                    "Did you mean 'deeplabv3plus'?",
                ),
                (
                    ["--trainer.limit_val_batches", "0"],
                    "`trainer.limit_val_batches` to select at least one",
                ),
                (
                    ["--trainer.gradient_clip_val", "many"],
                    "`gradient_clip_val` should be",
                ),
                (["--seed", "99999999999999999999999"], "at most 64 bits"),
                (["--seed", "-1"], "got -1."),
            )
        ),
        (
            ["gp", "--data", "DATA", "--out", "x/y", "--seed", "-1"],
            "Expected `seed` in 0–",
        ),
        (
            [
                "classifier",
                "--data",
                "DATA",
                "--out",
                "x/y",
                "--classifier.decoder_channels",
                "many",
            ],
            "Expected --classifier.decoder_channels as a list, each a whole number, got 'many'.",
        ),
        (
            [
                "all",
                "--data",
                "DATA",
                "--out",
                "x/y",
                "--members",
                "2",
                "--seed",
                str(2**63 - 1),
            ],
            "`seed`",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line(
    arguments: list[str],
    expected: str,
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    paths = {"DATA": dataset.path}
    if "TEST" in arguments:
        paths["TEST"] = make_dataset(tmp_path / "test.h5", test_std=1).path
    message = refuses(capfd, *(paths.get(item, item) for item in arguments))
    assert expected in message
    assert {path.name for path in tmp_path.iterdir()} <= {"test.h5"}


def test_pretrained_weights_that_cannot_be_had_are_told_with_the_flag_before_anything_is_trained(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(
        huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache")
    )
    monkeypatch.chdir(tmp_path)
    for encoder in ("resnet18", "tu-resnet18"):
        asked = ("--classifier.pretrained", "--classifier.encoder", encoder)
        message = refuses(capfd, "all", "--data", dataset.path, "--out", "x/y", *asked)
        assert f"download of the ImageNet weights of {encoder}" in message
        assert "(--classifier.pretrained or --mdn.pretrained)" in message
    assert not (tmp_path / "x").exists()


def test_an_interrupted_training_goes_on_from_its_gps(
    dataset: TerrainDataset,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    where = ["--data", dataset.path, "--out", tmp_path / "c"]
    assert call("train", "gp", *where, *QUICK_GP) == 0
    kept = (tmp_path / "c" / "gp.safetensors").read_bytes()
    capfd.readouterr()
    assert call("train", "all", *where, *QUICK_GP, *QUICK_CLASSIFIER, "--resume") == 0
    assert "gp:" not in capfd.readouterr().err
    assert (tmp_path / "c" / "gp.safetensors").read_bytes() == kept
    assert set(load_checkpoint(tmp_path / "c").parts) == {"classifier", "gp"}
    assert "--overwrite" in refuses(capfd, "all", *where)


def test_a_log_with_few_rows_of_a_class_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    many = "".join(f"rock,{slope},{0.9 - 0.01 * slope:.2f}\n" for slope in range(12))
    header = "class,slope_deg,traversability\n"
    for name, rows in (("few", "mud,3,0.4\nsand,2,0.5\n"), ("enough", "")):
        Path(f"{name}.csv").write_text(header + many + rows)
        assert (
            call("train", "gp", "--data", f"{name}.csv", "--out", name, *QUICK_GP) == 0
        )
        told = [
            line for line in capfd.readouterr().err.splitlines() if "warning" in line
        ]
        assert len(told) == (name == "few")
        if told:
            assert (
                "few.csv has fewer than 10 rows of 2 of 3 classes (mud 1, sand 1)"
                in told[0]
            )


def test_gps_are_measured_on_whole_drives_of_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = [f"rock,{row % 9},0.{5 + row % 3},{row // 10 % 10}\n" for row in range(200)]
    for name, header, own in (
        ("drives", "class,slope_deg,traversability,drive\n", rows),
        (
            "one",
            "class,slope_deg,traversability,drive\n",
            [row[: row.rindex(",")] + ",a\n" for row in rows],
        ),
        (
            "none",
            "class,slope_deg,traversability\n",
            [row[: row.rindex(",")] + "\n" for row in rows],
        ),
    ):
        Path(f"{name}.csv").write_text(header + "".join(own))
        assert (
            call("train", "gp", "--data", f"{name}.csv", "--out", name, *QUICK_GP) == 0
        )
        (said,) = [
            line for line in capfd.readouterr().out.splitlines() if "held-out" in line
        ]
        whose = (
            "all of 1 of 10 drives"
            if name == "drives"
            else "which follow one another in each class"
        )
        assert re.search(rf"gp: NLL \S+ on 20 held-out rows, {whose}; ", said)
    measured = {
        name: load_checkpoint(name).part("gp").metrics["held_out_nll"]
        for name in ("one", "none")
    }
    assert measured["one"] == measured["none"]
    for seed in range(1, 4):
        where = ("--data", "drives.csv", "--out", f"drives-{seed}", "--seed", seed)
        assert call("train", "gp", *where, *QUICK_GP) == 0
        measured[f"{seed}"] = (
            load_checkpoint(f"drives-{seed}").part("gp").metrics["held_out_nll"]
        )
    assert len({measured[f"{seed}"] for seed in range(1, 4)}) > 1


def test_a_damaged_checkpoint_is_replaced_by_gps_of_a_log_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rows = "".join(f"rock,{slope},0.8\n" for slope in range(12))
    Path("logs.csv").write_text("class,slope_deg,traversability\n" + rows)
    Path("mine").mkdir()
    Path("mine/config.json").write_text("{")
    command = ["gp", "--data", "logs.csv", "--out", "mine", *QUICK_GP]
    assert "damaged" in refuses(capfd, *command)
    assert call("train", *command, "--overwrite") == 0
    assert load_checkpoint("mine").class_names == ("rock",)


def test_classes_without_rows_are_told_before_what_was_learned_of_them_is_dropped(
    checkpoint_path: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder = shutil.copytree(checkpoint_path, tmp_path / "mine")
    names = load_checkpoint(folder).class_names
    rows = "".join(f"{name},{slope},0.8\n" for name in names[2:] for slope in range(12))
    Path(tmp_path, "logs.csv").write_text("class,slope_deg,traversability\n" + rows)
    command = ["gp", "--data", tmp_path / "logs.csv", "--out", folder, *QUICK_GP]
    assert call("train", *command, "--overwrite") == 0
    first, *rest = capfd.readouterr().err.splitlines()
    assert (
        f"fewer than 10 rows of 2 of 10 classes ({names[0]} 0, {names[1]} 0); their GPs"
        in first
    )
    assert f"The GPs of these classes in {folder} are replaced" in first
    assert not any("warning" in line for line in rest)

    there = load_checkpoint(folder)
    save_checkpoint(
        tmp_path / "alone",
        replace(there, parts={"classifier": there.part("classifier")}),
    )
    assert call("train", *command[:4], tmp_path / "alone", *QUICK_GP) == 0
    err = capfd.readouterr().err
    assert "rows of 2 of 10 classes" in err
    assert "dropped" not in err


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (["all", *QUICK_GP], "gp kept; to resume, run the same command with --resume"),
        (
            ["all", "--overwrite", *QUICK_GP],
            "gp kept; to resume, run the same command with --resume instead of --overwrite",
        ),
        (["mdn"], "nothing was finished; run the same command again"),
        (
            ["classifier", "--overwrite"],
            "nothing was finished; run the same command again",
        ),
    ],
)
def test_an_interruption_says_what_is_kept_and_how_to_go_on(
    command: list[str],
    expected: str,
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(networks, "MapData", interrupt)
    out = tmp_path / "c"
    assert call("train", *command, "--data", dataset.path, "--out", out) == 130
    assert (
        capfd.readouterr().err.splitlines()[-1]
        == f"benchnav-train: interrupted; {expected}"
    )
    assert Path(out, "gp.safetensors").exists() == expected.startswith("gp")


def test_epochs_that_were_finished_are_said_to_be_kept(tmp_path: Path) -> None:
    (tmp_path / "classifier").mkdir()
    (tmp_path / "classifier" / STATE).touch()
    target: Any = SimpleNamespace(checkpoint=SimpleNamespace(parts={"gp": None}))
    said = networks._resume_hint(
        target, ["gp", "classifier", "classifier-2"], FitOptions(folder=tmp_path)
    )
    assert said == (
        "gp and the finished epochs of classifier kept; to resume, run the same command with --resume"
    )


def test_a_model_is_measured_by_its_file_and_a_folder_without_rights_is_named(
    dataset: TerrainDataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "import torch\n\nfrom benchnav.core.mixture import TraversabilityMixture\n"
        "from benchnav.models import TraversabilityModel\n\n\n"
        "class Mine(TraversabilityModel):\n"
        "    def __init__(self, mean: float = 0.5) -> None:\n        self.mean = mean\n\n"
        "    def predict(self, observation):\n        ones = torch.ones_like(observation.slope_deg)[:, None]\n"
        "        return TraversabilityMixture(ones, self.mean * ones, 0.2 * ones)\n"
    )
    reports = []
    for source in ("./mine.py:Mine:0.1", "./mine.py:Mine:0.7"):
        assert (
            call(
                "train",
                "evaluate",
                source,
                "--data",
                dataset.path,
                "--json",
                "report.json",
            )
            == 0
        )
        reports.append(json.loads(Path("report.json").read_text()))
    assert [report["model"] for report in reports] == [
        "./mine.py:Mine:0.1",
        "./mine.py:Mine:0.7",
    ]
    assert reports[0]["splits"] != reports[1]["splits"]

    def locked(*arguments: object, **_: object) -> object:
        raise PermissionError(13, "Permission denied", "/tmp/a-name-of-ours")

    monkeypatch.setattr("tempfile.TemporaryFile", locked)
    message = refuses(
        capfd, "evaluate", "oracle", "--data", dataset.path, "--out", "locked/new"
    )
    assert (
        f"could not use {tmp_path}/locked/new/quality.json: Permission denied"
        in message
    )
    assert (
        f"Choose another path with --out, or change the permissions of {tmp_path}."
        in message
    )


def members_of(folder: Path) -> list[TerrainClassifier]:
    model = load_model(str(folder))
    assert isinstance(model, FusedModel)
    return [
        member for member in model.classifiers if isinstance(member, TerrainClassifier)
    ]


def test_an_ensemble_is_calibrated_as_a_whole_and_again_when_a_member_joins(
    dataset: TerrainDataset,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    folder, valid = tmp_path / "c", MapDataset(dataset.path, "valid")
    small = [
        "--classifier.encoder_depth",
        "3",
        "--classifier.decoder_channels",
        "[16, 16, 8]",
        "--seed",
        "4",
    ]
    command = [
        "all",
        "--data",
        dataset.path,
        "--out",
        folder,
        *QUICK_GP,
        *QUICK_CLASSIFIER,
        *small,
    ]
    found = []
    for members in (1, 2, 3):
        assert call("train", *command, "--members", members, "--resume") == 0
        classifiers = members_of(folder)
        assert len(classifiers) == members
        found.append(load_checkpoint(folder).pool_temperature)
        if members > 1:
            assert found[-1] == fit_pool_temperature(classifiers, valid, 4)
            assert (
                f"pool of {members} networks: temperature {found[-1]:.3f}"
                in capfd.readouterr().out
            )
    assert found[0] == 1
    assert len(set(found)) == 3
    # A member alone is what its own seed alone would have given.
    first = members_of(folder)[0]
    assert first.config.decoder_channels == (16, 16, 8)
    assert (
        first.temperature
        == load_checkpoint(folder).part("classifier").config["temperature"]
    )
    assert call("train", *command, "--members", 1, "--overwrite") == 0
    assert load_checkpoint(folder).pool_temperature == 1
    alone = members_of(folder)[0]
    assert alone.temperature == first.temperature


@pytest.mark.parametrize("half_precision", [True, False])
def test_what_is_stored_is_what_was_measured_and_calibrated(
    half_precision: bool, dataset: TerrainDataset, tmp_path: Path
) -> None:
    where = ["--data", dataset.path, "--out", tmp_path / "c"]
    small = [
        "--classifier.encoder_depth",
        "3",
        "--half_precision",
        str(half_precision).lower(),
    ]
    assert call("train", "classifier", *where, *QUICK_CLASSIFIER, *small) == 0
    part, valid = (
        load_checkpoint(tmp_path / "c").part("classifier"),
        MapDataset(dataset.path, "valid"),
    )
    assert part.half_precision == half_precision
    plain = TerrainClassifier.from_tensors(
        {**part.config, "temperature": 1.0}, names(10), part.tensors
    )
    assert part.config["temperature"] == fit_temperature(*sample_logits(plain, valid))
    for name, value in plain.measure(valid).items():
        assert part.metrics[name] == pytest.approx(
            value, rel=0 if half_precision else 1e-3, abs=1e-12
        ), name


@pytest.mark.parametrize("kind", ["classifier", "all", "mdn"])
def test_how_maps_are_read_reaches_the_training(
    kind: str, dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def opened(*given: object) -> None:
        (loading,) = (value for value in given if isinstance(value, Loading))
        seen.append((loading.in_memory, loading.workers))
        raise KeyboardInterrupt

    monkeypatch.setattr(networks, "MapData", opened)
    quick = QUICK_GP if kind == "all" else []
    where = ["--data", dataset.path, "--out", tmp_path / "m", "--resume"]
    for how in ([], ["--workers", 2], ["--in_memory", "true"]):
        assert call("train", kind, *where, *quick, *how) == 130
    assert seen == [(False, 0), (False, 2), (True, 0)]
