from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch

from benchnav.core.errors import CheckpointError, DatasetError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.ground import fit_ground
from benchnav.models.checkpoint import (
    Checkpoint,
    Part,
    load_checkpoint,
    member_names,
    save_checkpoint,
)
from benchnav.models.checkpoint_folders import find_checkpoint
from benchnav.models.config import ClassifierConfig, NetworkConfig
from benchnav.models.parts import member_name
from benchnav.models.training import target as module
from benchnav.models.training.fit import STATE, FitOptions
from benchnav.models.training.target import Target, open_target


@dataclass(frozen=True, kw_only=True)
class Config:
    width: int = 3


@dataclass(frozen=True, kw_only=True)
class NetConfig(NetworkConfig):
    width: int = 3


FRESH = Checkpoint(class_names=("a", "b"))
PART = Part(
    config={"width": 3},
    tensors={"w": torch.ones(2)},
    seed=0,
    metrics={},
    data_id="maps",
    data_digest="d",
)


def there(folder: Path, *parts: str) -> Path:
    save_checkpoint(folder, replace(FRESH, parts=dict.fromkeys(parts, PART)))
    return folder


def start(
    folder: Path,
    parts: list[str],
    resume: bool = False,
    overwrite: bool = False,
    fresh: Checkpoint = FRESH,
) -> Target:
    options = FitOptions(
        folder=folder.with_suffix(".training"), resume=resume, overwrite=overwrite
    )
    return open_target(folder, fresh, parts, "d", options)


def test_members_are_counted_from_the_plain_name() -> None:
    assert [member_name(index, "classifier") for index in range(3)] == [
        "classifier",
        "classifier-2",
        "classifier-3",
    ]
    found = replace(
        FRESH, parts=dict.fromkeys(["gp", "classifier-2", "classifier"], PART)
    )
    assert member_names(found, "classifier") == ["classifier", "classifier-2"]
    assert member_names(FRESH, "classifier") == ["classifier"]


def test_what_is_trained_is_saved_at_once_beside_what_is_there(tmp_path: Path) -> None:
    target = start(there(tmp_path / "m", "gp"), ["classifier", "classifier-2"])
    state = tmp_path / "m.training" / "classifier" / STATE
    state.parent.mkdir(parents=True)
    state.write_text("what a kill would have been gone on from")
    target.add("classifier", PART)
    assert set(load_checkpoint(tmp_path / "m").parts) == {"gp", "classifier"}
    assert not state.exists()
    target.add("classifier-2", PART)
    assert set(load_checkpoint(tmp_path / "m").parts) == {
        "gp",
        "classifier",
        "classifier-2",
    }


def test_nothing_trained_is_lost_unasked(tmp_path: Path) -> None:
    folder = there(tmp_path / "m", "gp", "classifier")
    with pytest.raises(CheckpointError, match="--overwrite to replace it, or --resume"):
        start(folder, ["gp", "classifier"])
    state = tmp_path / "m.training" / "mdn" / STATE
    state.parent.mkdir(parents=True)
    state.touch()
    with pytest.raises(CheckpointError, match="got one of mdn"):
        start(folder, ["mdn"])
    assert set(load_checkpoint(folder).parts) == {"gp", "classifier"}


def test_a_roundabout_name_of_a_checkpoint_is_that_checkpoint(tmp_path: Path) -> None:
    there(tmp_path / "m", "gp")
    with pytest.raises(CheckpointError, match="--overwrite"):
        start(tmp_path / "none" / ".." / "m", ["gp"])
    save_checkpoint(tmp_path / "none" / ".." / "new", FRESH)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m", "new"]


def test_resuming_keeps_parts_of_the_same_settings_seed_and_maps(
    tmp_path: Path,
) -> None:
    target = start(there(tmp_path / "m", "gp"), ["gp", "classifier"], resume=True)
    state = tmp_path / "m.training" / "gp" / STATE  # of a kill after the part was saved
    state.parent.mkdir(parents=True)
    state.touch()
    assert target.has_part("gp", Config(), 0)
    assert not state.exists()
    assert not target.has_part("classifier", NetConfig(), 0)
    for config, seed in ((Config(width=4), 0), (Config(), 1)):
        with pytest.raises(CheckpointError, match="Use the settings of that part"):
            target.has_part("gp", config, seed)
    target.digest = "other"
    with pytest.raises(CheckpointError, match="Use the settings of that part"):
        target.has_part("gp", Config(), 0)


def test_a_network_is_kept_if_the_trainer_and_the_precision_are_the_same(
    tmp_path: Path,
) -> None:
    trainer = {"precision": "32-true", "gradient_clip_val": 0.5}
    asked = FitOptions(device="cpu", trainer=trainer)
    kept = replace(PART, trainer={**trainer, "devices": 1}, half_precision=True)

    def holds(
        part: Part,
        half_precision: bool = True,
        kind: type = NetConfig,
        **changed: object,
    ) -> bool:
        checkpoint = replace(FRESH, parts={"classifier": part})
        options = replace(
            asked, trainer={**trainer, **changed}, half_precision=half_precision
        )
        return Target(tmp_path / "m", checkpoint, "d", options).has_part(
            "classifier", kind(), 0
        )

    assert holds(kept)
    assert holds(kept, log_every_n_steps=7)
    # of an earlier version
    assert holds(replace(kept, trainer=None), gradient_clip_val=3)
    with pytest.raises(
        CheckpointError,
        match=r"another `trainer\.gradient_clip_val`\. Use the settings of that",
    ):
        holds(kept, gradient_clip_val=0.6)
    with pytest.raises(
        CheckpointError,
        match=r"another `trainer\.limit_train_batches`\. Use the settings of that",
    ):
        holds(kept, limit_train_batches=2)
    with pytest.raises(
        CheckpointError, match=r"another `half_precision`\. Use the settings of that"
    ):
        holds(kept, half_precision=False)
    # processes, which no such trainer trains
    assert holds(kept, False, Config, gradient_clip_val=0.6)


def test_a_training_that_was_to_replace_a_part_is_gone_on_with_when_asked(
    tmp_path: Path,
) -> None:
    folder = there(tmp_path / "m", "classifier")
    with pytest.raises(
        CheckpointError, match=r"pass --overwrite instead of --resume\."
    ):
        start(folder, ["classifier"], resume=True).has_part(
            "classifier", NetConfig(width=4), 0
        )
    state = tmp_path / "m.training" / "classifier" / STATE
    state.parent.mkdir(parents=True)
    state.write_text("what a kill has left")
    with pytest.raises(
        CheckpointError, match="pass --overwrite with --resume to resume"
    ):
        start(folder, ["classifier"], resume=True).has_part(
            "classifier", NetConfig(width=4), 0
        )
    target = start(folder, ["classifier"], resume=True, overwrite=True)
    assert not target.has_part("classifier", NetConfig(width=4), 0)
    assert state.exists()


def test_replacing_a_classifier_drops_its_whole_ensemble_and_keeps_the_rest(
    tmp_path: Path,
) -> None:
    folder = there(tmp_path / "m", "gp", "classifier", "classifier-2")
    assert set(start(folder, ["classifier"], overwrite=True).checkpoint.parts) == {"gp"}
    assert set(start(folder, ["gp"], overwrite=True).checkpoint.parts) == {
        "classifier",
        "classifier-2",
    }
    assert set(load_checkpoint(folder).parts) == {"gp", "classifier", "classifier-2"}


def test_another_family_or_class_table_is_replaced_only_when_asked(
    tmp_path: Path,
) -> None:
    folder = there(tmp_path / "m", "gp")
    for fresh in (replace(FRESH, model="mdn"), replace(FRESH, class_names=("a", "c"))):
        with pytest.raises(CheckpointError, match="model of the classes a, b"):
            start(folder, ["mdn"], fresh=fresh, resume=True)
        assert start(folder, ["mdn"], fresh=fresh, overwrite=True).checkpoint == fresh


def test_a_damaged_checkpoint_is_replaced_only_when_asked(tmp_path: Path) -> None:
    folder = there(tmp_path / "m", "gp")
    (folder / "gp.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError, match="damaged"):
        start(folder, ["classifier"])
    assert start(folder, ["gp"], overwrite=True).checkpoint == FRESH


def test_processes_beside_the_first_refuse_and_write_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = there(tmp_path / "m", "gp")
    before = (folder / "config.json").read_bytes()
    monkeypatch.setattr(module, "is_first_process", lambda: False)
    # as the first process left it, which trains the rest with this one
    target = start(folder, ["gp"])
    assert not target.has_part("gp", Config(), 0)
    target.add("classifier", PART)
    assert (folder / "config.json").read_bytes() == before


def test_a_part_of_an_earlier_version_has_the_defaults_of_settings_that_came_later(
    tmp_path: Path,
) -> None:
    """The shipped model of 0.1 knows nothing of the depth of its encoder."""
    shipped = load_checkpoint(find_checkpoint("paper-v1"))
    classifier = shipped.parts["classifier"]
    target = Target(tmp_path / "mine", shipped, classifier.data_digest, FitOptions())
    assert "encoder_depth" not in classifier.config
    assert target.has_part("classifier", ClassifierConfig(), 0)
    with pytest.raises(CheckpointError, match="got a part with seed 0"):
        target.has_part("classifier", ClassifierConfig(encoder_depth=3), 0)


def test_statistics_of_the_ground_come_with_the_first_part_and_not_from_logs(
    tmp_path: Path, dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    options, asked = FitOptions(), []
    on_maps = open_target(
        tmp_path / "maps", FRESH, ["gp", "classifier"], "d", options, dataset
    )
    monkeypatch.setattr(
        module, "fit_ground", lambda maps: asked.append(maps) or fit_ground(maps)
    )
    for name in ("gp", "classifier"):
        on_maps.add(name, PART)
    assert asked == [dataset]
    assert load_checkpoint(tmp_path / "maps").ground == fit_ground(dataset)
    on_logs = open_target(tmp_path / "logs", FRESH, ["gp"], "d", options)
    on_logs.add("gp", PART)
    assert load_checkpoint(tmp_path / "logs").ground is None


def test_maps_without_observed_traversability_have_no_statistics(
    tmp_path: Path, dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_known(maps: TerrainDataset) -> None:
        raise DatasetError("Expected cells of known traversability, got none.")

    monkeypatch.setattr(module, "fit_ground", none_known)
    open_target(tmp_path / "c", FRESH, ["gp"], "d", FitOptions(), dataset).add(
        "gp", PART
    )
    assert load_checkpoint(tmp_path / "c").ground is None
