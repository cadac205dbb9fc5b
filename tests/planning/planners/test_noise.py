import pytest
import torch

from benchnav.planning.planners.mppi import NoiseBank, draw_bank

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


def marked(horizon: int, samples: int) -> NoiseBank:
    """A bank whose numbers tell their places."""
    one = bank(horizon=horizon, samples=samples)
    places = torch.arange(one.values.numel(), dtype=torch.float32).view(one.values.shape)
    return NoiseBank(scale=SCALE, values=places, place=one.place, stride=one.stride, samples=samples)


@pytest.mark.parametrize(("horizon", "samples"), [(2, 50), (50, 40), (7, 1)])
def test_runs_keep_to_their_parts_and_no_number_serves_a_sample_twice(horizon: int, samples: int) -> None:
    one = marked(horizon, samples)
    part = 4 * samples
    for step in range(300):
        noise = one.at(step)
        assert bool((noise.diff(dim=2) == 1).all())
        owner = (noise // part).long()
        assert torch.equal(owner[..., 0], owner[..., -1])
        assert len(owner[..., 0].unique()) == 2 * horizon
        assert bool((owner[:, 1] >= horizon).all())
        assert bool((owner[:, 0] < horizon).all())


def test_runs_begin_everywhere_and_parts_change_hands() -> None:
    one = marked(5, 50)
    begin = torch.stack([one.at(step)[2, 0, 0] for step in range(600)]).long()
    assert set((begin // 200).tolist()) == set(range(5))
    # Also those of one moment, which is a time step less at each step.
    moment = torch.stack([one.at(step)[4 - step, 0, 0] for step in range(5)]).long()
    assert len((moment // 200).unique()) == 5
    assert (begin % 200).min() < 10
    assert (begin % 200).max() > 140
