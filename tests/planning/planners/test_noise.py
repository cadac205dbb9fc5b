import pytest
import torch

from benchnav.planning.planners.noise import NoiseBank, draw_bank

SCALE = torch.tensor([0.2, 0.7])


def bank(seed: int = 5, horizon: int = 12, samples: int = 4000) -> NoiseBank:
    return draw_bank(seed, horizon, samples, SCALE)


def test_each_action_has_its_own_scale_and_shape() -> None:
    noise = bank().at(3)
    assert noise.shape == (12, 2, 4000)
    torch.testing.assert_close(noise.std(dim=(0, 2)), SCALE, atol=0.01, rtol=0)
    assert noise.mean(dim=(0, 2)).abs().max() < 0.01
    # Normal: a twentieth lies beyond 1.96 standard deviations, and three in a thousand beyond 3.
    far = (noise / SCALE[:, None]).abs()
    assert (far > 1.96).double().mean().item() == pytest.approx(0.05, abs=0.004)
    assert (far > 3).double().mean().item() == pytest.approx(0.0027, abs=0.001)


def test_numbers_of_a_sample_are_independent_within_a_step() -> None:
    noise = (bank().at(7) / SCALE[:, None]).flatten(0, 1)
    together = noise @ noise.T / noise.shape[1]
    others = together - torch.diag(together.diagonal())
    assert others.abs().max() < 5 / noise.shape[1] ** 0.5


def test_steps_and_seeds_have_noise_of_their_own() -> None:
    one = bank()
    steps = torch.stack([one.at(step) for step in (0, 1, 2, 50)])
    for place in range(1, 4):
        assert (steps[0] * steps[place]).mean().abs() < 0.01
        assert not torch.equal(steps[0], steps[place])
    # Seeds in a row, and such as are alike in 32 bits, which is all that PyTorch's generator looks at.
    for seed in (6, 5 + 2**32):
        assert not torch.equal(bank(seed).at(0), one.at(0))
        assert not torch.equal(bank(seed).at(0), one.at(1))


def test_noise_is_a_function_of_seed_and_step_alone() -> None:
    late = bank().at(40)
    again = bank()
    again.at(3)
    assert torch.equal(again.at(40), late)
    assert torch.equal(bank().at(10**6), bank().at(10**6))  # far beyond any episode


def test_no_run_leaves_its_action_or_the_bank() -> None:
    one = bank(horizon=2, samples=50)
    numbers = one.values.shape[1]
    places = torch.arange(numbers).float()
    marked = NoiseBank(
        values=torch.stack((places, 10_000 + places)), place=one.place, stride=one.stride, samples=50
    )
    for step in range(300):
        noise = marked.at(step)
        assert bool((noise.diff(dim=2) == 1).all())
        assert bool((noise[:, 0] < numbers).all())
        assert bool((noise[:, 1] >= 10_000).all())
    # Runs begin everywhere.
    begin = torch.stack([marked.at(step)[:, 0, 0] for step in range(300)])
    assert begin.min() < 0.05 * numbers
    assert begin.max() > 0.8 * (numbers - 50)
