from collections.abc import Iterator, Mapping

import pytest
import torch

from benchnav.core.device import CPU
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.fused import sharpen
from benchnav.models.nets.calibration import (
    fit_pool_temperature,
    fit_temperature,
    fit_width,
    sample_logits,
    sample_scores,
)
from benchnav.models.quality.scores import ReliabilityCurve, calibration_error
from benchnav.models.training.data import MapData, MapDataset


def draw(cells: int, temperature: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits whose classes were drawn after dividing them by a temperature."""
    generator = torch.Generator().manual_seed(0)
    logits = 4 * torch.randn(cells, 5, generator=generator)
    drawn = (logits / temperature).softmax(1).multinomial(1, generator=generator)
    return logits, drawn.squeeze(1)


@pytest.mark.parametrize("temperature", [0.4, 1.0, 2.5])
def test_the_temperature_that_the_classes_were_drawn_with_is_found(
    temperature: float,
) -> None:
    found = fit_temperature(*draw(50_000, temperature))
    assert found == pytest.approx(temperature, rel=0.02)


def test_no_other_temperature_is_more_likely() -> None:
    logits, class_id = draw(2_000, 1.7)
    found = fit_temperature(logits, class_id)

    def loss(temperature: float) -> float:
        return float(
            torch.nn.functional.cross_entropy(logits.double() / temperature, class_id)
        )

    assert loss(found) < min(loss(found * factor) for factor in (0.9, 0.99, 1.01, 1.1))


def test_classes_all_right_or_all_wrong_give_a_finite_temperature() -> None:
    logits, _ = draw(100, 1.0)
    assert 0.05 <= fit_temperature(logits, logits.argmax(1)) < 0.1
    assert 15 < fit_temperature(logits, logits.argmin(1)) <= 20.1


def test_sampled_logits_stay_beside_their_class(
    dataset: TerrainDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = MapData(dataset, 4, 0).valid

    class Colour(torch.nn.Module):
        def forward(self, maps: Mapping[str, torch.Tensor]) -> torch.Tensor:
            return maps["rgb"].float()

    monkeypatch.setattr("benchnav.models.nets.calibration._MAX_CELLS", 200)
    logits, class_id = sample_logits(Colour(), maps)
    assert logits.shape == (200, 3)
    stored = maps.read(range(len(maps)))
    pairs = torch.cat([stored["rgb"], stored["class_id"][:, None]], dim=1).flatten(2)
    for which in range(4):
        there = {tuple(cell) for cell in pairs[which].T.tolist()}
        part = slice(50 * which, 50 * (which + 1))
        drawn = torch.cat([logits[part].long(), class_id[part, None]], dim=1)
        assert {tuple(cell) for cell in drawn.tolist()} <= there
    again, _ = sample_logits(Colour(), maps)
    other, _ = sample_logits(Colour(), maps, seed=1)
    assert torch.equal(logits, again)
    assert not torch.equal(logits, other)


CLASSES, STRENGTH = 3, 2.5


class Witness(torch.nn.Module):
    """A classifier whose evidence is one channel of the image in three, its own errors
    in it.
    """

    def __init__(self, channel: int, boldness: float, temperature: float = 1.0) -> None:
        super().__init__()
        self.channel, self.boldness, self.temperature = channel, boldness, temperature

    def forward(self, maps: Mapping[str, torch.Tensor]) -> torch.Tensor:
        # A channel holds the evidence for each of three classes in a third of the
        # byte's levels each.
        level = maps["rgb"][:, self.channel].long()
        evidence = (
            torch.stack([level % 6, level // 6 % 6, level // 36 % 6], 1).float() - 2.5
        )
        return self.boldness * evidence / self.temperature


class Held(MapDataset):
    """Maps of no dataset."""

    def __init__(self, rgb: torch.Tensor, class_id: torch.Tensor) -> None:
        self._memory, self._maps, self.step = (
            {"rgb": rgb, "class_id": class_id},
            len(rgb),
            1,
        )
        self.output_fields, self.masks = ("rgb", "class_id"), None

    def chunks(
        self, device: torch.device = CPU
    ) -> Iterator[tuple[range, dict[str, torch.Tensor]]]:
        every = range(len(self))
        yield every, self.read(every)


def witnessed(maps: int, seed: int) -> MapDataset:
    """Maps of single cells' classes; each channel has noisy evidence of its own, in six
    steps a class.
    """
    generator = torch.Generator().manual_seed(seed)
    class_id = torch.randint(0, CLASSES, (maps, 16, 16), generator=generator)
    shown = (
        torch.nn.functional.one_hot(class_id, CLASSES)
        .movedim(-1, 1)
        .unsqueeze(1)
        .float()
    )
    noise = torch.randn(maps, 3, CLASSES, 16, 16, generator=generator)
    steps = (2 + STRENGTH * (shown - 0.2) + noise).round().clamp(0, 5).long()
    rgb = steps[:, :, 0] + 6 * steps[:, :, 1] + 36 * steps[:, :, 2]
    return Held(rgb.to(torch.uint8), class_id.to(torch.uint8))


def ece(probabilities: torch.Tensor, class_id: torch.Tensor) -> float:
    curve = ReliabilityCurve()
    curve.update(probabilities, class_id.long())
    return calibration_error(curve.compute())


def test_a_pool_that_is_calibrated_as_a_whole_is_right_as_often_as_it_says() -> None:
    maps, fresh = witnessed(100, 0), witnessed(100, 1)
    members = []
    for channel, boldness in enumerate(
        (0.5, 2.0, 6.0)
    ):  # each miscalibrated in its own way
        own = Witness(channel, boldness)
        members.append(
            Witness(channel, boldness, fit_temperature(*sample_logits(own, maps)))
        )
    stored = fresh.read(range(len(fresh)))
    class_id = stored["class_id"]
    alone = [member(stored).softmax(1) for member in members]
    assert max(ece(one, class_id) for one in alone) < 0.03
    average = torch.stack(alone).mean(0)
    temperature = fit_pool_temperature(members, maps)
    assert temperature < 0.7
    before, after = ece(average, class_id), ece(sharpen(average, temperature), class_id)
    assert before > 0.1
    assert after < 0.15 * before


def test_of_one_classifier_the_pool_temperature_is_what_its_own_leaves_over() -> None:
    maps = witnessed(50, 2)
    own = fit_temperature(*sample_logits(Witness(0, 3.0), maps))
    assert fit_pool_temperature([Witness(0, 3.0)], maps) == pytest.approx(own, rel=1e-3)
    assert fit_pool_temperature([Witness(0, 3.0, own)], maps) == pytest.approx(
        1, rel=1e-3
    )


# --- distributions of λ ---


def scores(
    temperature: float, atoms: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Normal scores of what was observed where a temperature would make predictions
    right.
    """
    z = temperature * torch.randn(
        60_000, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    if not atoms:
        return z, z
    # All below −0.5 is one atom, and all above 0.8 another: of these the interval alone
    # is known.
    low = torch.where(z < -0.5, -torch.inf, torch.where(z > 0.8, 0.8, z))
    return low, torch.where(z < -0.5, -0.5, torch.where(z > 0.8, torch.inf, z))


@pytest.mark.parametrize("atoms", [False, True])
@pytest.mark.parametrize("temperature", [0.5, 0.9, 1.6])
def test_the_temperature_of_distributions_is_found_with_and_without_atoms(
    temperature: float, atoms: bool
) -> None:
    assert fit_width(*scores(temperature, atoms)) == pytest.approx(
        temperature, rel=0.02
    )


def test_the_rounding_of_a_cdf_is_no_atom() -> None:
    z, _ = scores(1.6)
    assert fit_width(
        torch.nextafter(z, torch.full_like(z, -torch.inf)), z
    ) == fit_width(z, z)


def test_distributions_that_are_right_are_left_as_they_are() -> None:
    assert fit_width(*scores(1.0)) == 1
    assert fit_width(*scores(1.01)) == 1  # for a gain below 0.001 nats a cell


def test_an_observation_outside_a_predictions_support_leaves_a_finite_temperature() -> (
    None
):
    low, high = (values.clone() for values in scores(1.5))
    low[0] = high[0] = torch.inf
    low[1] = high[1] = -torch.inf
    assert fit_width(low, high) == pytest.approx(1.5, rel=0.02)


def test_sampled_scores_are_those_of_the_cells_that_were_observed() -> None:
    generator = torch.Generator().manual_seed(3)
    mean = torch.rand(4, 8, 8, generator=generator)
    observed = (mean + 0.2 * torch.randn(4, 8, 8, generator=generator)).clamp(0, 1)
    observed[:, ::2] = torch.nan
    held = Held(mean, mean)
    held._memory = {"slope_deg": mean, "traversability": observed}

    def predict(layers: dict[str, torch.Tensor]) -> TraversabilityMixture:
        assert set(layers) == {"slope_deg"}
        own = layers["slope_deg"].unsqueeze(1)
        return TraversabilityMixture(
            torch.ones_like(own), own, 0.2 * torch.ones_like(own)
        )

    low, high = sample_scores(predict, held, ("slope_deg",), seed=5)
    known = observed.isfinite()
    assert len(low) == int(known.sum())
    inside = (observed > 0) & (observed < 1) & known
    wanted = ((observed - mean) / 0.2)[inside]
    torch.testing.assert_close(
        high[low == high].sort().values.float(),
        wanted.sort().values,
        rtol=1e-3,
        atol=1e-3,
    )
    assert int(low.isinf().sum()) == int((observed == 0).sum())
    assert int(high.isinf().sum()) == int((observed == 1).sum())
