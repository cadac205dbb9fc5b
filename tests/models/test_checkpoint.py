import json
import os
import random
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from benchnav.core.errors import BenchnavError, CheckpointError, ConfigError
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.store import seal, unseal
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import fit_ground
from benchnav.datagen.recipe.load import load_recipe
from benchnav.models import checkpoint as module
from benchnav.models.base import predict
from benchnav.models.checkpoint import (
    Checkpoint,
    Part,
    as_stored,
    load_checkpoint,
    save_checkpoint,
)
from benchnav.models.checkpoint_folders import find_checkpoint
from benchnav.models.config import ClassifierConfig
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.predictor import load_model, open_checkpoint
from benchnav.models.slope_gp.table import SlopeTable, SoftModes
from benchnav.testing.model import check_model
from tests.commands import call
from tests.models.stub import true_table
from tests.models.support import make_terrain, names


@pytest.fixture
def folder(checkpoint_path: Path, tmp_path: Path) -> Path:
    """A copy of the checkpoint, to be spoilt."""
    return Path(shutil.copytree(checkpoint_path, tmp_path / "copy"))


def edit(folder: Path, **changes: object) -> None:
    config = unseal((folder / "config.json").read_text())
    (folder / "config.json").write_text(seal({**config, **changes}))


def full(part: Part) -> Part:
    return replace(part, half_precision=False)


def test_training_keeps_the_statistics_of_its_maps(
    folder: Path, dataset: TerrainDataset
) -> None:
    assert load_checkpoint(folder).ground == fit_ground(dataset)
    assert GroundStatistics.from_json(
        (folder / "ground.json").read_text()
    ) == fit_ground(dataset)


def test_statistics_of_the_ground_survive_a_copy_and_a_new_part(
    folder: Path, tmp_path: Path
) -> None:
    there = load_checkpoint(folder)
    save_checkpoint(tmp_path / "again", there.with_part("gp", there.part("gp")))
    assert (
        load_checkpoint(shutil.copytree(tmp_path / "again", tmp_path / "moved")).ground
        == there.ground
    )
    save_checkpoint(folder, replace(there, ground=None))
    assert not (folder / "ground.json").exists()
    assert load_checkpoint(folder).ground is None


@pytest.mark.parametrize("harm", ["edit", "drop", "swap"])
def test_statistics_of_the_ground_are_covered_by_the_checkpoints_digest(
    folder: Path, harm: str
) -> None:
    path = folder / "ground.json"
    if harm == "drop":
        path.unlink()
    elif harm == "edit":
        path.write_text(
            path.read_text().replace('"potts_strength": 0.0', '"potts_strength": 1.0')
        )
    else:
        path.write_text("{}")
    with pytest.raises(CheckpointError, match=r"ground\.json is damaged"):
        load_checkpoint(folder)


def test_a_checkpoint_of_before_may_have_statistics_put_beside_it(folder: Path) -> None:
    config = unseal((folder / "config.json").read_text())
    del config["ground"]
    (folder / "config.json").write_text(seal(config))
    text = (folder / "ground.json").read_text()
    found = load_checkpoint(folder).ground
    assert found is not None
    assert found.to_json() == text
    (folder / "ground.json").unlink()
    assert load_checkpoint(folder).ground is None
    (folder / "ground.json").write_text("{")
    with pytest.raises(CheckpointError, match=r"ground\.json is damaged"):
        load_checkpoint(folder)


def test_a_round_trip_gives_equal_predictions(folder: Path, tmp_path: Path) -> None:
    there = load_checkpoint(folder)
    save_checkpoint(
        tmp_path / "again",
        there.with_part("classifier", full(there.part("classifier"))),
    )
    terrain = make_terrain(classes=10)
    before, after = (
        predict(load_model(path), terrain) for path in (folder, tmp_path / "again")
    )
    for name in ("weights", "means", "stds"):
        assert torch.equal(getattr(before, name), getattr(after, name))
    again = load_checkpoint(tmp_path / "again")
    assert again.class_names == there.class_names
    assert again.model == there.model == "fused"
    for name in ("classifier", "gp"):
        before, after = (
            replace(c.part(name), tensors={}, half_precision=False)
            for c in (there, again)
        )
        assert before == after
    assert there.part("gp").data_id == "tiny-v1"
    assert there.part("gp").data_digest.startswith("train:")
    assert there.part("gp").versions["torch"] == torch.__version__.partition("+")[0]


def test_half_precision_is_small_and_close(folder: Path, tmp_path: Path) -> None:
    part = load_checkpoint(folder).part("classifier")
    sharp = {
        name: value + 1e-5 if value.is_floating_point() else value
        for name, value in part.tensors.items()
    }
    part = replace(part, tensors=sharp)
    for name, one in (("half", part), ("full", full(part))):
        save_checkpoint(
            tmp_path / name, load_checkpoint(folder).with_part("classifier", one)
        )
    sizes = {
        n: (tmp_path / n / "classifier.safetensors").stat().st_size
        for n in ("half", "full")
    }
    assert sizes["half"] < 0.51 * sizes["full"]
    assert sizes["half"] < 30e6
    terrain = make_terrain(classes=10)
    half, whole = (
        predict(load_model(tmp_path / name), terrain).weights
        for name in ("half", "full")
    )
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, whole, rtol=0, atol=0.02)
    assert not torch.equal(half, whole)
    (classifier,) = load_model(tmp_path / "half").classifiers  # type: ignore[union-attr]
    assert all(p.dtype == torch.float32 for p in classifier.parameters())


def test_weights_are_measured_as_they_are_read_back(
    folder: Path, tmp_path: Path
) -> None:
    part = load_checkpoint(folder).part("classifier")
    sharp = {
        name: value + 1e-5 if value.is_floating_point() else value
        for name, value in part.tensors.items()
    }
    for half in (True, False):
        kept = replace(part, tensors=sharp, half_precision=half)
        save_checkpoint(
            tmp_path / str(half), load_checkpoint(folder).with_part("classifier", kept)
        )
        read = load_checkpoint(tmp_path / str(half)).part("classifier").tensors
        stored = as_stored(sharp, half)
        assert read.keys() == stored.keys()
        assert all(torch.equal(read[name], value) for name, value in stored.items())
    assert all(
        torch.equal(value, sharp[name])
        for name, value in as_stored(sharp, False).items()
    )


def test_the_temperature_of_a_pool_is_kept_until_the_pool_is_another(
    folder: Path, tmp_path: Path
) -> None:
    there = load_checkpoint(folder)
    assert there.pool_temperature == 1
    pooled = replace(
        there.with_part("classifier-2", there.part("classifier")), pool_temperature=0.25
    )
    save_checkpoint(tmp_path / "pool", pooled)
    again = load_checkpoint(tmp_path / "pool")
    assert again.pool_temperature == 0.25
    assert load_model(tmp_path / "pool").pool_temperature == 0.25  # type: ignore[union-attr]
    assert again.with_part("gp", there.part("gp")).pool_temperature == 0.25
    assert (
        again.with_part("classifier-3", there.part("classifier")).pool_temperature == 1
    )
    assert "pool_temperature" not in json.loads((folder / "config.json").read_text())


def test_second_modes_are_kept_beside_the_tables(folder: Path, tmp_path: Path) -> None:
    there = load_checkpoint(folder)
    table = SlopeTable.from_tensors(there.part("gp").tensors)
    assert table.soft is None
    soft = SoftModes(
        weight=torch.full((10,), 0.1),
        mean=torch.linspace(0, 0.5, 10),
        std=torch.full((10,), 0.05),
    )
    part = replace(there.part("gp"), tensors=replace(table, soft=soft).to_tensors())
    save_checkpoint(tmp_path / "soft", there.with_part("gp", part))
    again = load_model(tmp_path / "soft").table.soft  # type: ignore[union-attr]
    for name in ("weight", "mean", "std"):
        assert torch.equal(getattr(again, name), getattr(soft, name))
    terrain = make_terrain(classes=10)
    assert predict(load_model(tmp_path / "soft"), terrain).weights.shape[1] == 20
    check_model(load_model(tmp_path / "soft"))


@pytest.mark.parametrize("value", [0, -1.0, "hot", None])
def test_a_temperature_that_is_none_is_refused(folder: Path, value: object) -> None:
    edit(folder, pool_temperature=value)
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(folder)


def test_a_folder_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        CheckpointError, match=r"Expected a checkpoint folder with config\.json"
    ):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("name", ["classifier", "gp"])
def test_missing_tensors_are_refused(folder: Path, name: str) -> None:
    (folder / f"{name}.safetensors").unlink()
    with pytest.raises(CheckpointError, match=f"{name}.safetensors"):
        load_checkpoint(folder)


@pytest.mark.parametrize("name", ["classifier", "gp"])
@pytest.mark.parametrize("damage", ["flip", "cut"])
def test_damaged_tensors_are_refused(folder: Path, name: str, damage: str) -> None:
    path = folder / f"{name}.safetensors"
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content if damage == "flip" else content[:-200])
    with pytest.raises(CheckpointError, match="is damaged"):
        load_checkpoint(folder)


def test_a_damaged_config_is_refused(folder: Path) -> None:
    text = (folder / "config.json").read_text()
    for spoilt in (
        text[:-30],
        "[]",
        "{}",
        '{"format": "benchnav-checkpoint", "format_version": "2.0"}',
    ):
        (folder / "config.json").write_text(spoilt)
        with pytest.raises(CheckpointError, match="is damaged"):
            load_checkpoint(folder)


@pytest.mark.parametrize(
    ("version", "remedy"),
    [("2.4", "pip install --upgrade benchnav"), ("1.0", "Train the model again")],
)
def test_another_format_is_refused(folder: Path, version: str, remedy: str) -> None:
    edit(folder, format_version=version)
    with pytest.raises(
        CheckpointError,
        match=rf"Expected format version 2\.3 .* got {version}.*{remedy}",
    ):
        load_checkpoint(folder)


def test_a_foreign_format_is_refused(folder: Path) -> None:
    edit(folder, format="other")
    with pytest.raises(CheckpointError, match="'other'"):
        load_checkpoint(folder)


def test_tensors_that_do_not_fit_their_settings_are_refused(folder: Path) -> None:
    there = load_checkpoint(folder)
    part = there.part("classifier")
    for config in (
        {**part.config, "encoder": "resnet34"},
        {**part.config, "wings": 2},
        {"max_epochs": "many"},
    ):
        with pytest.raises(CheckpointError, match="Train the model again"):
            open_checkpoint(there.with_part("classifier", replace(part, config=config)))
    fewer = replace(there, class_names=there.class_names[:3])
    with pytest.raises(CheckpointError, match="fit the settings of the"):
        open_checkpoint(fewer)


def test_no_weights_are_downloaded_for_a_pretrained_checkpoint(folder: Path) -> None:
    part = load_checkpoint(folder).part("classifier")
    model = TerrainClassifier.from_tensors(
        {**part.config, "pretrained": True}, names(10), part.tensors
    )
    assert model.config.pretrained is False


def test_a_killed_save_leaves_the_old_checkpoint(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = load_checkpoint(folder)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "write_text", killed)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(folder, replace(there, model="new"))
    monkeypatch.undo()
    assert load_checkpoint(folder).model == "fused"
    assert os.listdir(folder.parent) == [folder.name]


def test_a_save_never_replaces_what_is_no_checkpoint(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "notes.txt").write_text("keep")
    with pytest.raises(ConfigError, match=r"contains no config\.json"):
        save_checkpoint(tmp_path / "precious", load_checkpoint(folder))
    assert (tmp_path / "precious" / "notes.txt").read_text() == "keep"


def test_settings_of_the_trainer_are_kept_and_absent_of_earlier_versions(
    folder: Path, tmp_path: Path
) -> None:
    there = load_checkpoint(folder)
    assert there.part("classifier").trainer == {"devices": 1, "precision": "32-true"}
    assert there.part("gp").trainer is None
    clipped = replace(there.part("classifier"), trainer={"gradient_clip_val": 0.5})
    save_checkpoint(tmp_path / "again", there.with_part("classifier", clipped))
    assert load_checkpoint(tmp_path / "again").part("classifier").trainer == {
        "gradient_clip_val": 0.5
    }
    assert (
        load_checkpoint(find_checkpoint("paper-v1")).part("classifier").trainer is None
    )


@pytest.fixture(scope="module")
def small(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, Terrain, TraversabilityMixture]:
    """A small checkpoint of two classifiers that nobody trained, a map, and what it
    predicts of it.
    """
    classes = load_recipe("tiny-v1").classes
    config = ClassifierConfig(
        encoder="mobilenet_v2", encoder_depth=3, decoder_channels=(16, 8, 8)
    )
    members = {
        name: Part(
            config={**asdict(config), "temperature": 0.5 + seed},
            tensors=dict(
                TerrainClassifier(config)
                .build(map_classes=classes, seed=seed)
                .state_dict()
            ),
            seed=seed,
            metrics={"valid_loss": 0.5},
            data_id="tiny-v1",
            data_digest="train:00,valid:11",
            half_precision=True,
            trainer={"devices": 1},
        )
        for seed, name in enumerate(("classifier", "classifier-2"))
    }
    gp = replace(
        members["classifier"],
        config={},
        tensors=true_table(classes).to_tensors(),
        half_precision=False,
    )
    folder = tmp_path_factory.mktemp("small") / "small"
    names = tuple(item.name for item in classes)
    save_checkpoint(
        folder,
        Checkpoint(
            class_names=names, parts={**members, "gp": gp}, pool_temperature=0.8
        ),
    )
    terrain = make_terrain(batch=1, classes=10)
    return folder, terrain, predict(load_model(folder), terrain)


ODD = (
    None,
    -1,
    0,
    1,
    7,
    1e300,
    float("nan"),
    "",
    "x",
    "../x",
    True,
    [],
    [1],
    {},
    {"a": 1},
    10**30,
)


def spoil(folder: Path, generator: random.Random) -> str:
    """Changes something of a checkpoint and says what."""
    kind = generator.choice(
        [
            "value",
            "value",
            "value",
            "key",
            "text",
            "text",
            "bytes",
            "cut",
            "gone",
            "swap",
        ]
    )
    config, tensors = folder / "config.json", sorted(folder.glob("*.safetensors"))
    if kind in ("value", "key"):
        content = json.loads(config.read_text())
        place: Any = content
        while True:
            key = generator.choice(
                list(place) if isinstance(place, dict) else range(len(place))
            )
            if (
                not isinstance(place[key], dict | list)
                or not place[key]
                or generator.random() < 0.15
            ):
                break
            place = place[key]
        before = place.pop(key)
        if kind == "value":
            near = [before * 1.5, before + 1] if type(before) in (int, float) else []
            odd = generator.choice([*ODD, *near, *near])
            place.insert(key, odd) if isinstance(place, list) else place.update(
                {key: odd}
            )
        config.write_text(json.dumps(content))
        return f"{kind} {key}"
    path = config if kind == "text" else generator.choice([config, *tensors])
    content = bytearray(path.read_bytes())
    if kind in ("text", "bytes"):
        content[generator.randrange(len(content))] = generator.randrange(256)
    elif kind == "cut":
        del content[generator.randrange(len(content)) :]
    elif kind == "swap":
        content = bytearray(generator.choice(tensors).read_bytes())
    path.unlink()
    if kind != "gone":
        path.write_bytes(content)
    return f"{kind} {path.name}"


def predicted(folder: Path, terrain: Terrain) -> TraversabilityMixture | str:
    """What a checkpoint predicts, or why it is refused."""
    try:
        return predict(load_model(folder), terrain)
    except BenchnavError as error:
        return str(error)


@pytest.mark.parametrize(
    "edits",
    [range(50), pytest.param(range(50, 350), marks=pytest.mark.slow)],
    ids=["50", "300"],
)
def test_an_edited_checkpoint_is_refused_in_one_line_or_predicts_what_it_did(
    edits: range, small: tuple[Path, Terrain, TraversabilityMixture], tmp_path: Path
) -> None:
    folder, terrain, wanted = small
    refused = 0
    for number in edits:
        copy = Path(shutil.copytree(folder, tmp_path / str(number)))
        done = spoil(copy, random.Random(number))
        found = predicted(copy, terrain)
        if isinstance(found, str):
            refused += 1
            assert "\n" not in found, done
        else:
            for name in ("weights", "means", "stds"):
                assert torch.equal(getattr(found, name), getattr(wanted, name)), done
        shutil.rmtree(copy)
    assert refused > 0.8 * len(edits)


@pytest.mark.parametrize(
    "edits",
    [range(30), pytest.param(range(30, 130), marks=pytest.mark.slow)],
    ids=["30", "100"],
)
def test_an_edited_checkpoint_of_an_earlier_version_ends_in_no_traceback(
    edits: range, small: tuple[Path, Terrain, TraversabilityMixture], tmp_path: Path
) -> None:
    """Nothing tells there whether a setting was edited, so that it may be another
    model; it is a model or refused.
    """
    folder, terrain, _ = small
    for number in edits:
        copy = Path(shutil.copytree(folder, tmp_path / str(number)))
        config = unseal((copy / "config.json").read_text())
        (copy / "config.json").write_text(
            json.dumps({**config, "format_version": "2.1"})
        )
        done = spoil(copy, random.Random(1000 + number))
        found = predicted(copy, terrain)
        if not isinstance(found, str):
            assert bool(((found.mean() >= 0) & (found.mean() <= 1)).all()), done
        shutil.rmtree(copy)


@pytest.mark.parametrize("number", range(6))
def test_the_command_refuses_an_edited_checkpoint_in_one_line(
    number: int,
    small: tuple[Path, Terrain, TraversabilityMixture],
    dataset: TerrainDataset,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    copy = Path(shutil.copytree(small[0], tmp_path / "copy"))
    config = unseal((copy / "config.json").read_text())
    names, parts = config["class_names"], config["parts"]
    edited: list[dict[str, Any]] = [
        {**config, "pool_temperature": 0.5},
        {**config, "class_names": names[::-1]},
        {
            **config,
            "parts": {**parts, "classifier": {**parts["classifier"], "seed": "x"}},
        },
        {**config, "parts": {name: parts[name] for name in ("classifier", "gp")}},
        {**config, "format_version": "2.1", "class_names": ["a", "a", *names[2:]]},
        {**config, "format_version": "2.1", "parts": {**parts, "gp": 5}},
    ]
    (copy / "config.json").write_text(json.dumps(edited[number]))
    assert call("train", "evaluate", copy, "--data", dataset.path) == 2
    out, err = capfd.readouterr()
    assert (out, len(err.strip().splitlines())) == ("", 1)
    assert "is damaged" in err
