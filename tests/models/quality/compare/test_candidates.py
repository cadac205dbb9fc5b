import shutil
import time
from pathlib import Path

import pytest
import torch

from benchnav.core import part_lookup, registry
from benchnav.core.errors import ConfigError
from benchnav.models.fused import FusedModel
from benchnav.models.nets.ensemble import Ensemble
from benchnav.models.predictor import Clairvoyant
from benchnav.models.quality.compare.candidates import (
    count_parameters,
    find_candidates,
    prediction_ms,
)
from tests.models.stub import ColourModel
from tests.models.support import linear_table, make_terrain


@pytest.fixture(autouse=True)
def _colour_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})
    registry.register("model", "colours", ColourModel)


def test_privileged_models_join_and_stand_last(checkpoint_path: Path) -> None:
    found = find_candidates([str(checkpoint_path), "ideal", "colours"])
    assert [one.label for one in found] == ["tiny", "colours", "ideal", "oracle"]
    assert [one.privileged for one in found] == [False, False, True, True]
    assert [one.needs_truth for one in found] == [False, False, True, True]
    assert "train of tiny-v1" in found[0].trained_on.values()
    clairvoyant = find_candidates(["clairvoyant"])[0]
    assert clairvoyant.privileged
    assert not clairvoyant.needs_truth
    assert isinstance(clairvoyant.model, Clairvoyant)


def test_one_model_under_two_names_is_refused(
    checkpoint_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(checkpoint_path.parent)
    with pytest.raises(ConfigError, match="differ"):
        find_candidates([str(checkpoint_path), "tiny"])
    with pytest.raises(ConfigError, match="colours and colours"):
        find_candidates(["colours", "colours"])
    with pytest.raises(ConfigError, match="at least one model to compare"):
        find_candidates([])
    copy = shutil.copytree(checkpoint_path, tmp_path / "other" / "tiny")
    found = find_candidates([str(checkpoint_path), str(copy)])
    # one name for both says nothing
    assert [one.label for one in found[:2]] == [
        str(checkpoint_path),
        str(copy),
    ]


def test_models_of_files_are_called_by_their_class_or_checkpoint(
    tmp_path: Path,
) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "from tests.models.stub import ColourModel\n\nclass Own(ColourModel):\n    pass\n"
    )
    assert find_candidates([f"{file}:Own", "colours"])[0].label == "Own"


def test_weights_of_all_networks_are_counted_once() -> None:
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 1), torch.nn.BatchNorm2d(4))
    assert count_parameters(FusedModel([network], linear_table(), ("a",))) == 16 + 8
    assert (
        count_parameters(FusedModel([network, network], linear_table(), ("a",)))
        == 16 + 8
    )
    other = torch.nn.Conv2d(3, 4, 1)
    both = FusedModel([network, other], linear_table(), ("a",))
    assert count_parameters(both) == 16 + 8 + 16
    assert count_parameters(Ensemble([both, both])) == 16 + 8 + 16
    assert count_parameters(ColourModel()) is None


def test_the_time_is_the_median_of_repeated_predictions_after_a_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []

    class Counted(ColourModel):
        def predict(self, observation):  # type: ignore[no-untyped-def]
            asked.append(1)
            now[0] += 100.0 if len(asked) == 1 else 0.001 * len(asked)
            return super().predict(observation)

    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    taken = prediction_ms(Counted(), make_terrain(batch=1))
    assert len(asked) == 2  # the first took all the time that there is
    assert taken == pytest.approx(2.0)
    asked.append(1)
    assert prediction_ms(Counted(), make_terrain(batch=1)) == pytest.approx(
        4 + 1 + (15 + 1) / 2 - 1, abs=1.5
    )
