import gpytorch
import pytest
import torch
from gpytorch.distributions import MultivariateNormal

from benchnav.mixture import TraversabilityMixture
from benchnav.models.config import LatentGPConfig
from benchnav.models.data import PixelTable
from benchnav.models.latent_gp import LatentGPs, PixelSampler
from benchnav.models.likelihood import CensoredGaussianLikelihood
from benchnav.models.slope_table import SlopeTable, table_slopes
from benchnav.models.training import fit_gps

from .support import NOISE, latent, linear_table, make_table

STEEPEST = 25.0


@pytest.fixture(scope="module")
def censored() -> SlopeTable:
    return fit_gps(LatentGPConfig(), make_table(10_000), device="cpu").tabulate()


@pytest.fixture(scope="module")
def gaussian() -> SlopeTable:
    return fit_gps(LatentGPConfig(likelihood="gaussian"), make_table(10_000), device="cpu").tabulate()


def nll(table: SlopeTable, seed: int = 99) -> torch.Tensor:
    """Negative log likelihood of fresh observations, a class."""
    fresh = make_table(20_000, seed)
    mean, std = table.lookup(fresh.slope_deg)
    own = torch.arange(3)
    mixture = TraversabilityMixture(
        torch.ones(3, 1, 1, 20_000), mean[own, own][:, None, None], std[own, own][:, None, None]
    )
    return -mixture.log_prob(fresh.traversability[:, None]).mean((1, 2))


def test_expected_log_prob_agrees_with_monte_carlo() -> None:
    likelihood = CensoredGaussianLikelihood(batch_shape=torch.Size([3])).double()
    likelihood.noise = torch.tensor([[0.01], [0.0225], [0.04]])
    observed = torch.tensor([[0.0, 0.4, 1.0]]).double().expand(3, -1)
    mean = torch.tensor([[0.1, 0.5, 0.8], [0.5, 0.5, 0.5], [-0.2, 1.1, 1.3]]).double()
    std = torch.tensor([[0.05, 0.1, 0.2], [0.3, 0.02, 0.1], [0.1, 0.2, 0.3]]).double()
    function = MultivariateNormal(mean, torch.diag_embed(std**2))
    exact = likelihood.expected_log_prob(observed, function)
    generator = torch.Generator().manual_seed(0)
    draws = mean + std * torch.randn(1_000_000, 3, 3, generator=generator, dtype=torch.float64)
    noise = likelihood.noise.sqrt()
    inside = torch.distributions.Normal(draws, noise).log_prob(observed)
    below = torch.special.log_ndtr(-draws / noise)
    above = torch.special.log_ndtr((draws - 1) / noise)
    sampled = torch.where(observed <= 0, below, torch.where(observed >= 1, above, inside))
    error = sampled.std(0) / 1000
    assert bool(((exact - sampled.mean(0)).abs() < 5 * error + 1e-4).all())


def test_latent_mean_and_noise_are_found(censored: SlopeTable) -> None:
    slopes = torch.linspace(1, STEEPEST - 1, 200)
    mean, _ = censored.lookup(slopes[None])
    error = (mean[:, 0] - latent(slopes)).square().mean(-1).sqrt()
    assert bool((error < 0.015).all()), error
    torch.testing.assert_close(censored.noise_std, NOISE, rtol=0.05, atol=0)


def test_the_censored_likelihood_beats_the_plain_one_where_data_are_clipped(
    censored: SlopeTable, gaussian: SlopeTable
) -> None:
    gain = nll(gaussian) - nll(censored)
    assert bool((gain > 0).all()), gain
    assert float(gain[0]) > 0.1, gain


def test_the_plain_likelihood_agrees_with_an_exact_gp_on_data_inside_the_bounds() -> None:
    points = 400
    generator = torch.Generator().manual_seed(3)
    slope = 25 * torch.rand(points, generator=generator)
    observed = 0.5 + 0.2 * torch.sin(slope / 5) + 0.05 * torch.randn(points, generator=generator)
    table = PixelTable(slope_deg=slope[None], traversability=observed[None], count=torch.tensor([points]))
    config = LatentGPConfig(likelihood="gaussian", batch_size=points, epochs=20)
    model = fit_gps(config, table, device="cpu")

    class Exact(gpytorch.models.ExactGP):
        def forward(self, x: torch.Tensor) -> MultivariateNormal:
            return MultivariateNormal(torch.full_like(x[..., 0], 0.5), self.kernel(x))

    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    likelihood.noise = model.likelihood.noise.detach().flatten()
    exact = Exact((slope[:, None] / 10).double(), observed.double(), likelihood)
    exact.kernel = gpytorch.kernels.ScaleKernel(gpytorch.kernels.MaternKernel(nu=2.5)).double()
    exact.kernel.outputscale = model.gp.kernel.outputscale.detach()[0]
    exact.kernel.base_kernel.lengthscale = model.gp.kernel.base_kernel.lengthscale.detach()[0]
    exact.eval()
    at = torch.linspace(0, 25, 101)
    with torch.no_grad():
        wanted = exact((at[:, None] / 10).double())
        found = model(at[None])
    assert float((wanted.mean - found.mean[0]).abs().max()) < 0.01
    assert float((wanted.stddev - found.stddev[0]).abs().max()) < 0.01


def test_nothing_is_known_beyond_the_slopes_seen(censored: SlopeTable) -> None:
    grid = table_slopes()
    latent_std = (censored.std**2 - censored.noise_std[:, None] ** 2).clamp(min=0).sqrt()
    assert bool((latent_std[:, grid < STEEPEST - 1] < 0.05).all())
    assert bool((latent_std[:, grid > STEEPEST + 40] > 0.25).all())
    beyond = latent_std[:, grid > STEEPEST]
    assert bool((beyond.diff(dim=1) > -1e-4).all())


def test_a_class_never_seen_keeps_its_prior() -> None:
    seen = make_table(500)
    count = torch.tensor([500, 0, 500])
    table = PixelTable(slope_deg=seen.slope_deg, traversability=seen.traversability, count=count)
    result = fit_gps(LatentGPConfig(epochs=3), table, device="cpu").tabulate()
    torch.testing.assert_close(result.mean[1], torch.full_like(result.mean[1], 0.5), rtol=0, atol=1e-6)
    assert bool((result.std[1] > 0.5).all())
    assert bool((result.std[0, :200] < 0.3).all())


def test_training_is_a_function_of_its_seed_alone() -> None:
    config, table = LatentGPConfig(epochs=1, epoch_steps=5), make_table(100)
    before = torch.random.get_rng_state()
    first, second, other = (fit_gps(config, table, seed, device="cpu").tabulate() for seed in (0, 0, 1))
    assert torch.equal(first.mean, second.mean)
    assert not torch.equal(first.mean, other.mean)
    assert torch.equal(before, torch.random.get_rng_state())


def test_draws_stay_within_each_class() -> None:
    count = torch.tensor([3, 0, 1000])
    sampler = PixelSampler(count, batch_size=500, steps=2, seed=0)
    for index in sampler:
        assert index[0].unique().tolist() == [0, 1, 2]
        assert index[1].unique().tolist() == [0]
        assert 900 < int(index[2].max()) < 1000


def test_rebuilt_gps_give_the_same_functions() -> None:
    model = fit_gps(LatentGPConfig(epochs=1, epoch_steps=5), make_table(100), device="cpu")
    config = {"epochs": 1, "epoch_steps": 5, "steepest_deg": model.steepest_deg}
    rebuilt = LatentGPs.from_tensors(config, 3, model.to_tensors())
    assert torch.equal(rebuilt.tabulate().mean, model.tabulate().mean)


def test_lookup_is_linear_between_nodes_and_constant_beyond() -> None:
    mean, std = linear_table().lookup(torch.tensor([[[0.0, 45.03, 90.0, 120.0]]]))
    assert mean.shape == std.shape == (1, 3, 1, 4)
    expected = torch.tensor([1, 1 - 45.03 / 90, 0, 0])
    torch.testing.assert_close(mean[0, 0, 0], expected)
    torch.testing.assert_close(std[0, :, 0, 1], torch.tensor([0.1, 0.2, 0.3]))


def test_lookup_of_the_fitted_tables_is_close_to_the_gps() -> None:
    model = fit_gps(LatentGPConfig(epochs=2), make_table(500), device="cpu")
    slopes = torch.linspace(0.013, 40, 777)
    mean, std = model.tabulate().lookup(slopes[None])
    with torch.no_grad():
        exact = model(slopes.expand(3, -1))
    torch.testing.assert_close(mean[:, 0].double(), exact.mean, rtol=0, atol=1e-4)
    total = (exact.variance + model.likelihood.noise.detach()).sqrt()
    torch.testing.assert_close(std[:, 0].double(), total, rtol=0, atol=1e-4)
