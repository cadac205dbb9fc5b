import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from benchnav.errors import CheckpointError, ConfigError
from benchnav.mixture import TraversabilityMixture
from benchnav.models import fused, predictor
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.fused import FusedModel
from benchnav.models.predictor import Oracle, load_model, open_checkpoint, predict, register_model
from benchnav.terrain import Observation, Terrain

from .support import NAMES, linear_table, make_terrain


class Fixed(nn.Module):
    """A classifier that gives the same probabilities everywhere."""

    def __init__(self, *probabilities: float) -> None:
        super().__init__()
        self.logits = torch.tensor(probabilities).log().view(1, -1, 1, 1)

    def forward(self, rgb: Tensor) -> Tensor:
        return self.logits.expand(len(rgb), -1, *rgb.shape[-2:])


class Spy:
    """A user's own model; remembers what it was given."""

    def __init__(self) -> None:
        self.given: list[object] = []

    def predict(self, observation: Observation) -> TraversabilityMixture:
        self.given.append(observation)
        ones = torch.ones(len(observation.rgb), 1, *observation.grid.shape)
        return TraversabilityMixture(ones, 0.5 * ones, 0.1 * ones)


def test_one_hot_probabilities_give_the_gp_of_that_class() -> None:
    terrain = make_terrain()
    model = FusedModel([Fixed(1.0, 1e-30, 1e-30)], linear_table(), NAMES)
    mixture = model.predict(terrain.observe())
    expected = TraversabilityMixture(
        torch.ones(2, 1, 16, 16), (1 - terrain.slope_deg / 90)[:, None], torch.full((2, 1, 16, 16), 0.1)
    )
    for level in (0.0, 0.9):
        torch.testing.assert_close(mixture.cvar(level), expected.cvar(level), rtol=0, atol=1e-5)


def test_the_mixture_is_equation_one() -> None:
    terrain = make_terrain()
    mixture = FusedModel([Fixed(0.5, 0.3, 0.2)], linear_table(), NAMES).predict(terrain.observe())
    share = terrain.slope_deg / 90
    parts = [(0.5, 1 - share, 0.1), (0.3, torch.full_like(share, 0.5), 0.2), (0.2, share, 0.3)]
    for value in (0.2, 0.7):
        by_hand = sum(p * torch.special.ndtr((value - m) / s) for p, m, s in parts)
        torch.testing.assert_close(mixture.cdf(value), by_hand, rtol=0, atol=1e-5)
    assert all(t.dtype == torch.float32 for t in (mixture.weights, mixture.means, mixture.stds))


def test_single_class_is_the_gp_of_the_most_likely_class() -> None:
    mixture = FusedModel([Fixed(0.3, 0.5, 0.2)], linear_table(), NAMES).predict(make_terrain().observe())
    single = mixture.most_likely()
    torch.testing.assert_close(single.means, torch.full((2, 1, 16, 16), 0.5))
    torch.testing.assert_close(single.stds, torch.full((2, 1, 16, 16), 0.2))


def test_chunks_change_nothing_and_the_result_is_no_inference_tensor(monkeypatch: pytest.MonkeyPatch) -> None:
    class Bright(nn.Module):
        def forward(self, rgb: Tensor) -> Tensor:
            return rgb.float() / 100

    terrain = make_terrain(batch=5)
    model = FusedModel([Bright()], linear_table(), NAMES)
    whole = model.predict(terrain.observe())
    monkeypatch.setattr(fused, "CHUNK_CELLS", 2 * 16 * 16)
    pieces = model.predict(terrain.observe())
    assert torch.equal(whole.weights, pieces.weights)
    assert not any(t.is_inference() for t in (pieces.weights, pieces.means, pieces.stds))


def test_a_model_is_given_an_observation_and_the_oracle_alone_the_terrain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terrain, spy = make_terrain(), Spy()
    predict(spy, terrain)
    assert [type(given) for given in spy.given] == [Observation]

    given: list[object] = []
    answer = Oracle.predict_terrain

    def remember(self: Oracle, terrain: Terrain) -> TraversabilityMixture:
        given.append(terrain)
        return answer(self, terrain)

    monkeypatch.setattr(Oracle, "predict_terrain", remember)
    mixture = predict(load_model("oracle"), terrain)
    assert given == [terrain]
    assert torch.equal(mixture.means[:, 0], terrain.traversability_mean)
    assert torch.equal(mixture.stds[:, 0], terrain.traversability_std)
    assert torch.equal(mixture.weights, torch.ones_like(mixture.weights))


def test_a_prediction_that_does_not_fit_the_maps_is_refused() -> None:
    class Small(Spy):
        def predict(self, observation: Observation) -> TraversabilityMixture:
            ones = torch.ones(1, 1, 4, 4)
            return TraversabilityMixture(ones, ones, ones)

    with pytest.raises(ConfigError, match=r"\[2, K, 16, 16\]"):
        predict(Small(), make_terrain())


def test_a_registered_model_is_found_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictor, "_REGISTERED", {})
    register_model("mine", Spy)
    assert isinstance(load_model("mine"), Spy)


def test_an_unknown_name_gets_a_hint() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'oracle'"):
        load_model("oracel")


def test_a_checkpoint_is_found_by_path_and_by_name(
    checkpoint_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "mine").symlink_to(checkpoint_path)
    monkeypatch.chdir(tmp_path)
    terrain = make_terrain(classes=10)
    by_path, by_name = (predict(load_model(source), terrain) for source in (checkpoint_path, "mine"))
    assert torch.equal(by_path.weights, by_name.weights)
    assert by_path.weights.shape == (2, 10, 16, 16)


def test_a_checkpoint_with_one_half_says_how_to_train_the_other(checkpoint_path: Path) -> None:
    whole = load_checkpoint(checkpoint_path)
    half = replace(whole, parts={"gp": whole.part("gp")})
    with pytest.raises(CheckpointError, match="benchnav-train classifier"):
        open_checkpoint(half)


def test_the_oracle_loads_no_heavy_library() -> None:
    code = (
        "import sys; from benchnav.models.predictor import load_model; load_model('oracle'); "
        "print([m for m in ('lightning', 'gpytorch', 'segmentation_models_pytorch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_family_is_no_model_and_a_checkpoint_of_an_unknown_one_says_so(checkpoint_path: Path) -> None:
    with pytest.raises(ConfigError, match="'mdn', which is a family of models"):
        load_model("mdn")
    foreign = replace(load_checkpoint(checkpoint_path), model="theirs")
    with pytest.raises(CheckpointError, match=r"got one of 'theirs'. Install the package"):
        open_checkpoint(foreign)
