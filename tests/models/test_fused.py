from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from benchnav.core.errors import ConfigError
from benchnav.models import fused
from benchnav.models.fused import FusedModel, sharpen
from benchnav.models.slope_gp.table import SoftModes
from tests.models.support import NAMES, linear_table, make_terrain


class Linear(nn.Module):
    """A classifier whose logits are its weights times the colours."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.weight = (
            torch.randn(3, 3, generator=torch.Generator().manual_seed(seed)) / 100
        )

    def forward(self, maps: Mapping[str, Tensor]) -> Tensor:
        rgb = maps["rgb"]
        return torch.einsum("dc,bchw->bdhw", self.weight, rgb.float())


class Certain(nn.Module):
    """A classifier that is sure of the first class."""

    def forward(self, maps: Mapping[str, Tensor]) -> Tensor:
        rgb = maps["rgb"]
        return (
            torch.tensor([0.0, -1e4, -torch.inf])
            .view(1, 3, 1, 1)
            .expand(len(rgb), -1, *rgb.shape[-2:])
        )


def test_probabilities_of_members_are_averaged() -> None:
    observation = make_terrain(batch=3).observe()
    members = [Linear(seed) for seed in range(3)]
    ensemble = FusedModel(members, linear_table(), NAMES)
    alone = torch.stack(
        [
            FusedModel([one], linear_table(), NAMES).predict(observation).weights
            for one in members
        ]
    )
    torch.testing.assert_close(ensemble.predict(observation).weights, alone.mean(0))
    assert torch.equal(ensemble.member_probabilities(observation), alone)


def test_the_average_is_calibrated_as_a_whole_and_the_members_are_not() -> None:
    observation, members = (
        make_terrain(batch=3).observe(),
        [Linear(seed) for seed in range(2)],
    )
    plain = FusedModel(members, linear_table(), NAMES)
    pool = FusedModel(members, linear_table(), NAMES, pool_temperature=0.5)
    squares = plain.predict(observation).weights ** 2
    torch.testing.assert_close(
        pool.predict(observation).weights,
        squares / squares.sum(1, keepdim=True),
        rtol=1e-4,
        atol=1e-6,
    )
    assert torch.equal(
        pool.member_probabilities(observation), plain.member_probabilities(observation)
    )


SOFT = SoftModes(
    weight=torch.tensor([0.2, 0.0, 0.05]),
    mean=torch.tensor([0.1, 0.5, 0.3]),
    std=torch.tensor([0.05, 1.0, 0.1]),
)


def test_a_class_with_soft_spots_has_a_component_more() -> None:
    observation = make_terrain(batch=3).observe()
    plain = FusedModel([Linear(0)], linear_table(), NAMES).predict(observation)
    mixture = FusedModel(
        [Linear(0)], replace(linear_table(), soft=SOFT), NAMES
    ).predict(observation)
    assert plain.group == (0, 1, 2)
    assert mixture.group == (0, 1, 2, 0, 2)
    torch.testing.assert_close(mixture.class_probabilities(3), plain.weights)
    torch.testing.assert_close(mixture.weights[:, 0], 0.8 * plain.weights[:, 0])
    assert torch.equal(mixture.weights[:, 1], plain.weights[:, 1])
    torch.testing.assert_close(mixture.weights[:, 3], 0.2 * plain.weights[:, 0])
    torch.testing.assert_close(mixture.weights[:, 4], 0.05 * plain.weights[:, 2])
    assert torch.equal(mixture.means[:, :3], plain.means)
    assert torch.equal(mixture.stds[:, :3], plain.stds)
    assert [float(mixture.means[0, k, 0, 0]) for k in (3, 4)] == pytest.approx(
        [0.1, 0.3]
    )
    assert [float(mixture.stds[0, k, 0, 0]) for k in (3, 4)] == pytest.approx(
        [0.05, 0.1]
    )
    assert mixture.means.is_contiguous()


def test_the_class_that_is_read_alone_brings_its_soft_spots_along() -> None:
    observation = make_terrain().observe()
    first = FusedModel([Certain()], replace(linear_table(), soft=SOFT), NAMES).predict(
        observation
    )
    own = replace(linear_table(), soft=SOFT).predict_by_class(
        torch.zeros(2, 16, 16, dtype=torch.int64), observation.slope_deg
    )
    torch.testing.assert_close(first.most_likely().cvar(0.9), own.cvar(0.9))
    torch.testing.assert_close(first.mean(), own.mean())


def test_members_are_chunked_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    observation = make_terrain(batch=5).observe()
    model = FusedModel([Linear(0), Linear(1)], linear_table(), NAMES)
    whole = model.member_probabilities(observation)
    monkeypatch.setattr(fused, "CHUNK_CELLS", 2 * 16 * 16)
    assert torch.equal(model.member_probabilities(observation), whole)


def test_zero_probabilities_leave_finite_distributions() -> None:
    terrain = make_terrain()
    mixture = FusedModel([Certain()], linear_table(), NAMES).predict(terrain.observe())
    assert torch.equal(mixture.weights[:, 1:], torch.zeros(2, 2, 16, 16))
    alone = mixture.most_likely()
    for value in (
        mixture.cvar(0.9),
        mixture.var(0.9),
        mixture.mean(),
        mixture.log_prob(terrain.traversability),
    ):
        assert bool(value.isfinite().all())
    torch.testing.assert_close(mixture.cvar(0.9), alone.cvar(0.9))


@pytest.mark.parametrize("slope", [0.0, 89.9, 90.0, 200.0])
def test_any_slope_has_a_prediction(slope: float) -> None:
    observation = make_terrain().observe()
    steep = type(observation)(
        rgb=observation.rgb,
        elevation_m=observation.elevation_m,
        slope_deg=torch.full_like(observation.slope_deg, slope),
        grid=observation.grid,
    )
    mixture = FusedModel([Linear(0)], linear_table(), NAMES).predict(steep)
    assert bool(mixture.cvar(0.9).isfinite().all())


def test_a_classifier_of_other_classes_is_refused() -> None:
    class Two(nn.Module):
        def forward(self, maps: Mapping[str, Tensor]) -> Tensor:
            rgb = maps["rgb"]
            return rgb[:, :2].float()

    with pytest.raises(ConfigError, match="of the same shape"):
        FusedModel([Two()], linear_table(), NAMES).predict(make_terrain().observe())


def test_a_temperature_divides_the_logarithms() -> None:
    logits = torch.randn(2, 5, 3, 3, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(
        sharpen(logits.softmax(1), 0.4), (logits / 0.4).softmax(1)
    )
    probabilities = logits.softmax(1)
    assert sharpen(probabilities, 1.0) is probabilities


def test_a_class_without_probability_keeps_none() -> None:
    probabilities = torch.tensor([0.0, 0.25, 0.75]).view(1, 3, 1, 1)
    expected = torch.tensor([0.0, 0.1, 0.9])
    torch.testing.assert_close(sharpen(probabilities, 0.5).flatten(), expected)
