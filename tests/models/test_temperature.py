import pytest
import torch

from benchnav.datagen.store import TerrainDataset
from benchnav.models.data import MapData
from benchnav.models.temperature import fit_temperature, sample_logits


def draw(cells: int, temperature: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits whose classes were drawn after dividing them by a temperature."""
    generator = torch.Generator().manual_seed(0)
    logits = 4 * torch.randn(cells, 5, generator=generator)
    drawn = (logits / temperature).softmax(1).multinomial(1, generator=generator)
    return logits, drawn.squeeze(1)


@pytest.mark.parametrize("temperature", [0.4, 1.0, 2.5])
def test_the_temperature_that_the_classes_were_drawn_with_is_found(temperature: float) -> None:
    found = fit_temperature(*draw(50_000, temperature))
    assert found == pytest.approx(temperature, rel=0.02)


def test_no_other_temperature_is_more_likely() -> None:
    logits, class_id = draw(2_000, 1.7)
    found = fit_temperature(logits, class_id)

    def loss(temperature: float) -> float:
        return float(torch.nn.functional.cross_entropy(logits.double() / temperature, class_id))

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
        def forward(self, rgb: torch.Tensor) -> torch.Tensor:
            return rgb.float()

    monkeypatch.setattr("benchnav.models.temperature._MOST_CELLS", 200)
    logits, class_id = sample_logits(Colour(), maps)
    assert logits.shape == (200, 3)
    pairs = torch.cat([maps.fields["rgb"], maps.fields["class_id"][:, None]], dim=1).flatten(2)
    for which in range(4):
        there = {tuple(cell) for cell in pairs[which].T.tolist()}
        part = slice(50 * which, 50 * (which + 1))
        drawn = torch.cat([logits[part].long(), class_id[part, None]], dim=1)
        assert {tuple(cell) for cell in drawn.tolist()} <= there
    again, _ = sample_logits(Colour(), maps)
    other, _ = sample_logits(Colour(), maps, seed=1)
    assert torch.equal(logits, again)
    assert not torch.equal(logits, other)
