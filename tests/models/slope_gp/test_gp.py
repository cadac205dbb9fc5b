from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import gpytorch
import numpy as np
import pytest
import torch
from gpytorch.distributions import MultivariateNormal
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.stats import norm

from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.config import LatentGPConfig
from benchnav.models.slope_gp.cells import Cells, SlopeSums, cell_nll
from benchnav.models.slope_gp.gp import LatentGPs, expected_log_prob
from benchnav.models.slope_gp.table import STEP_DEG, SlopeTable, table_slopes
from benchnav.models.training.gaussian_processes import fit_gps
from tests.models.support import NOISE, latent, linear_table, make_cells, make_sums

STEEPEST = 25.0
SHIPPED = Path(__file__).parents[3] / "datasets" / "paper-v1-test.h5"


@pytest.fixture(scope="module")
def model() -> LatentGPs:
    return fit_gps(LatentGPConfig(), make_sums(10_000))


@pytest.fixture(scope="module")
def censored(model: LatentGPs) -> SlopeTable:
    return model.tabulate()


def one_class(slope_deg: torch.Tensor, traversability: torch.Tensor) -> SlopeSums:
    return of_classes([slope_deg], [traversability])


def of_classes(
    slopes: Sequence[torch.Tensor], values: Sequence[torch.Tensor]
) -> SlopeSums:
    """Sums of the cells of each class."""
    counts = torch.tensor([len(slope) for slope in slopes])
    cells = Cells(
        class_id=torch.arange(len(slopes)).repeat_interleave(counts),
        slope_deg=torch.cat(list(slopes)).float(),
        traversability=torch.cat(list(values)).float(),
    )
    return SlopeSums.of(cells, len(slopes))


def latent_std(table: SlopeTable) -> torch.Tensor:
    return (table.std**2 - table.noise_std[:, None] ** 2).clamp(min=0).sqrt()


def expected(mean: torch.Tensor, std: torch.Tensor) -> torch.Tensor:
    """E[λ] of single Gaussians clipped to [0, 1], any shape."""
    cells = mean.double().reshape(1, 1, -1)
    return TraversabilityMixture(
        torch.ones_like(cells), cells, std.double().reshape(1, 1, -1)
    ).mean()[0]


def test_expected_log_prob_agrees_with_monte_carlo() -> None:
    noise = torch.tensor([[0.01], [0.0225], [0.04]]).double()
    observed = torch.tensor([0.0, 0.4, 1.0]).double().expand(3, -1)
    sums = of_classes([torch.arange(3.0)] * 3, observed.unbind())
    mean = torch.tensor([[0.1, 0.5, 0.8], [0.5, 0.5, 0.5], [-0.2, 1.1, 1.3]]).double()
    std = torch.tensor([[0.05, 0.1, 0.2], [0.3, 0.02, 0.1], [0.1, 0.2, 0.3]]).double()
    bins = sums.bins(censored=True)
    here = [0, 4, 8]  # the bins of 0°, 1° and 2°
    full_mean, full_std = torch.zeros(3, 9).double(), torch.ones(3, 9).double()
    full_mean[:, here], full_std[:, here] = mean, std
    exact = expected_log_prob(bins, full_mean, full_std**2, noise)
    generator = torch.Generator().manual_seed(0)
    draws = mean + std * torch.randn(
        400_000, 3, 3, generator=generator, dtype=torch.float64
    )
    inside = torch.distributions.Normal(draws, noise.sqrt()).log_prob(observed)
    below = torch.special.log_ndtr(-draws / noise.sqrt())
    above = torch.special.log_ndtr((draws - 1) / noise.sqrt())
    sampled = torch.where(
        observed <= 0, below, torch.where(observed >= 1, above, inside)
    )
    error = sampled.std(0) / 400_000**0.5
    assert bool(((exact[:, here] - sampled.mean(0)).abs() < 5 * error + 1e-4).all())
    assert float(exact.sum()) == pytest.approx(float(exact[:, here].sum()))


def test_bins_hold_the_sums_of_the_cells_that_are_there() -> None:
    slopes = [torch.tensor([0.1, 0.2, 0.3, 0.3, 0.3]), torch.tensor([0.6])]
    values = [torch.tensor([0.5, 0.0, 1.0, 0.25, 0.5]), torch.tensor([1.0])]
    sums = of_classes(slopes, values)
    bins = sums.bins(censored=True)
    wanted = {
        "slope_deg": [[0.15, 0.3, 0.625], [0.125, 0.375, 0.6]],
        "zeros": [[1, 0, 0], [0, 0, 0]],
        "ones": [[0, 1, 0], [0, 0, 1]],
        "inside": [[1, 2, 0], [0, 0, 0]],
        "total": [[0.5, 0.75, 0], [0, 0, 0]],
        "squares": [[0.25, 0.3125, 0], [0, 0, 0]],
    }
    for name, values in wanted.items():
        np.testing.assert_allclose(bins[name], values, rtol=1e-6, err_msg=name)
    plain = sums.bins(censored=False)
    assert plain["inside"].tolist() == [[2, 3, 0], [0, 0, 1]]
    assert not bool((plain["zeros"] + plain["ones"]).any())
    np.testing.assert_allclose(plain["squares"], [[0.25, 1.3125, 0], [0, 0, 1]])


def test_latent_mean_and_noise_are_found(censored: SlopeTable) -> None:
    slopes = torch.linspace(0, STEEPEST, 200)
    mean, std = censored.lookup(slopes[None])
    truth = latent(slopes)
    error = (
        expected(mean, std) - expected(truth, NOISE[:, None].expand_as(truth))
    ).view(3, -1)
    assert float(error.square().mean(-1).sqrt().max()) < 0.01
    assert float((mean[:, 0] - truth)[:, 5:-5].square().mean(-1).sqrt().max()) < 0.015
    torch.testing.assert_close(censored.noise_std, NOISE, rtol=0.03, atol=0)


def test_the_bound_has_settled_at_the_end_of_training(model: LatentGPs) -> None:
    sums = make_sums(10_000)
    longer = fit_gps(LatentGPConfig(epochs=10), sums)
    bins = sums.bins(censored=True)
    with torch.no_grad():
        gain = longer.train().bound(bins) - model.train().bound(bins)
    model.eval()
    # In nats, of 10 000 cells.
    assert float(gain.max()) < 0.5


def test_the_censored_likelihood_beats_the_plain_one_where_data_are_clipped(
    censored: SlopeTable,
) -> None:
    plain = fit_gps(LatentGPConfig(likelihood="gaussian"), make_sums(10_000)).tabulate()
    fresh = make_cells(20_000, 99)

    def nll(table: SlopeTable, c: int) -> float:
        own = SlopeTable(
            mean=table.mean[[c]], std=table.std[[c]], noise_std=table.noise_std[[c]]
        )
        here = fresh.select(fresh.class_id == c)
        return cell_nll(replace(here, class_id=0 * here.class_id), own)

    gain = [nll(plain, c) - nll(censored, c) for c in range(3)]
    assert min(gain) > 0
    assert gain[0] > 0.1


class ExactGP(gpytorch.models.ExactGP):
    """GPyTorch's exact GP with a constant mean and a Matérn 5/2 kernel, over slope in
    units of 10°.
    """

    def __init__(self, slope_deg: torch.Tensor, observed: torch.Tensor) -> None:
        noise = gpytorch.likelihoods.GaussianLikelihood()
        super().__init__((slope_deg / 10)[:, None].double(), observed.double(), noise)
        self.mean = gpytorch.means.ConstantMean()
        self.kernel = gpytorch.kernels.ScaleKernel(
            gpytorch.kernels.MaternKernel(nu=2.5)
        )
        self.double()

    def forward(self, x: torch.Tensor) -> MultivariateNormal:
        return MultivariateNormal(self.mean(x), self.kernel(x))


def test_the_plain_likelihood_agrees_with_an_exact_gp_of_the_same_prior() -> None:
    points = 400
    generator = torch.Generator().manual_seed(3)
    slope = 25 * torch.rand(points, generator=generator)
    observed = (
        0.5
        + 0.2 * torch.sin(slope / 5)
        + 0.05 * torch.randn(points, generator=generator)
    )
    model = fit_gps(LatentGPConfig(likelihood="gaussian"), one_class(slope, observed))
    kernel, noise = model.gp.matern, model.likelihood.noise.detach()

    exact = ExactGP(slope, observed)
    exact.likelihood.noise = noise.flatten()
    trend = gpytorch.kernels.LinearKernel().double()
    trend.variance = 0.15**2
    exact.mean = gpytorch.means.LinearMean(1).double()
    exact.mean.weights.data.fill_(-0.3)
    exact.mean.bias.data.fill_(0.5)
    exact.kernel.outputscale = kernel.outputscale.detach()[0]
    exact.kernel.base_kernel.lengthscale = kernel.base_kernel.lengthscale.detach()[0]
    exact.kernel = exact.kernel + trend
    exact.eval()
    at = torch.linspace(0, 40, 161)
    with torch.no_grad():
        wanted, found = exact((at / 10)[:, None].double()), model(at[None])
    error_mean, error_std = (
        (wanted.mean - found.mean[0]).abs(),
        (wanted.stddev - found.stddev[0]).abs(),
    )
    assert float(error_mean[at <= 25].max()) < 0.003
    assert float(error_std[at <= 25].max()) < 0.002
    # Beyond the data all comes from the prior and the last slopes.
    assert float(error_mean.max()) < 0.03
    assert float(error_std.max()) < 0.005


def test_the_plain_likelihood_agrees_with_an_exact_gp_of_its_own_on_shipped_maps() -> (
    None
):
    maps = TerrainDataset(SHIPPED).read(
        "test/std", fields=["class_id", "slope_deg", "traversability"]
    )
    inside = (
        (maps["class_id"] == 9)
        & (maps["traversability"] > 0)
        & (maps["traversability"] < 1)
    )
    slope, observed = (
        torch.from_numpy(maps[name][inside]) for name in ("slope_deg", "traversability")
    )
    chosen = torch.randperm(len(slope), generator=torch.Generator().manual_seed(0))[
        :2000
    ]
    slope, observed = slope[chosen], observed[chosen]
    found = fit_gps(
        LatentGPConfig(likelihood="gaussian"), one_class(slope, observed)
    ).tabulate()

    exact = ExactGP(slope[:300], observed[:300])
    exact.likelihood.noise = 0.04
    evidence = gpytorch.mlls.ExactMarginalLogLikelihood(exact.likelihood, exact)
    optimizer = torch.optim.Adam(exact.parameters(), lr=0.1)
    for _ in range(60):
        optimizer.zero_grad()
        (-evidence(exact(*exact.train_inputs), exact.train_targets)).backward()
        optimizer.step()
    exact.set_train_data(
        (slope / 10)[:, None].double(), observed.double(), strict=False
    )
    exact.eval()
    at = torch.linspace(*torch.quantile(slope, torch.tensor([0.01, 0.99])), 100)
    with torch.no_grad():
        wanted = exact((at / 10)[:, None].double())
    mean, _ = found.lookup(at[None])
    spread = torch.from_numpy(np.interp(at, table_slopes(), latent_std(found)[0]))
    assert float((wanted.mean - mean[0, 0]).abs().max()) < 0.02
    assert float((wanted.mean - mean[0, 0]).square().mean().sqrt()) < 0.01
    assert float((wanted.stddev - spread).abs().max()) < 0.01
    assert float(found.noise_std) == pytest.approx(
        float(exact.likelihood.noise.detach()) ** 0.5, rel=0.1
    )


@pytest.mark.parametrize(("mean", "noise"), [(1.0, 0.1), (0.05, 0.2), (1.1, 0.15)])
def test_at_one_slope_the_censored_gp_is_tobins_maximum_likelihood(
    mean: float, noise: float
) -> None:
    points = 4000
    generator = torch.Generator().manual_seed(1)
    observed = (mean + noise * torch.randn(points, generator=generator)).clamp(0, 1)
    table = fit_gps(
        LatentGPConfig(), one_class(torch.full((points,), 10.0), observed)
    ).tabulate()

    value = observed.double().numpy()

    def loss(parameters: np.ndarray) -> float:
        m, s = parameters[0], np.exp(parameters[1])
        inside = value[(value > 0) & (value < 1)]
        at_ends = (value == 0).sum() * norm.logcdf(0, m, s) + (
            value == 1
        ).sum() * norm.logsf(1, m, s)
        return -norm.logpdf(inside, m, s).sum() - at_ends

    best = minimize(
        loss, [0.5, -2.0], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-6}
    ).x
    assert float(table.mean[0, 100]) == pytest.approx(best[0], abs=0.003)
    assert float(table.noise_std) == pytest.approx(np.exp(best[1]), rel=0.02)
    # The GP takes the noise as known: its spread is the curvature of the likelihood in
    # the mean alone.
    step = np.array([1e-3, 0])
    curvature = (loss(best + step) - 2 * loss(best) + loss(best - step)) / 1e-6
    assert float(latent_std(table)[0, 100]) == pytest.approx(curvature**-0.5, rel=0.15)


def test_beyond_its_slopes_the_gp_grows_unsure_and_not_hopeful() -> None:
    edge = 12.0
    table = fit_gps(LatentGPConfig(), make_sums(10_000, steepest_deg=edge)).tabulate()
    grid = table_slopes()
    spread, beyond = latent_std(table), grid >= edge
    assert bool((spread[:, grid < edge - 0.5] < 0.02).all())
    assert bool((spread[:, beyond].diff(dim=1) > 0).all())
    assert bool((spread[:, grid > edge + 10] > 0.15).all())
    assert bool((spread[:, grid > edge + 20] > 0.45).all())
    assert bool((table.mean[:, beyond].diff(dim=1) < 0).all())
    # The truth falls ever faster, and still stays within the spread, without being held
    # for better.
    shown = (grid > edge) & (grid <= 35)
    slopes = grid[shown].float()
    truth = latent(slopes).clamp(min=0)
    assert bool(
        ((table.mean[:, shown] - truth).abs() < 2.5 * spread[:, shown] + 0.02).all()
    )
    gap = expected(table.mean[:, shown], table.std[:, shown]) - expected(
        truth, NOISE[:, None].expand_as(truth)
    )
    assert float(gap.mean()) < 0.05


def test_each_class_is_unsure_beyond_its_own_slopes() -> None:
    full = make_cells(6000)
    cut = full.select((full.class_id != 1) | (full.slope_deg < 10))
    table = fit_gps(LatentGPConfig(), SlopeSums.of(cut, 3)).tabulate()
    at_20 = latent_std(table)[:, 200]
    assert float(at_20[1]) > 0.15
    assert float(at_20[[0, 2]].max()) < 0.03


def test_a_class_never_seen_keeps_its_prior() -> None:
    seen = make_cells(500)
    result = fit_gps(
        LatentGPConfig(), SlopeSums.of(seen.select(seen.class_id != 1), 3)
    ).tabulate()
    grid = table_slopes()
    torch.testing.assert_close(
        result.mean[1].double(), 0.5 - 0.03 * grid, rtol=0, atol=1e-5
    )
    prior = (0.5**2 + (0.015 * grid) ** 2).sqrt()
    torch.testing.assert_close(latent_std(result)[1].double(), prior, rtol=1e-4, atol=0)
    assert bool((result.std[0, :200] < 0.3).all())


@pytest.mark.parametrize(
    ("change", "mean", "spread"),
    [
        ({}, (0.5, -0.4), (0.5, 0.6727)),
        ({"prior_level": 0.8}, (0.8, -0.1), (0.5, 0.6727)),
        ({"prior_fall": 0.01}, (0.5, 0.2), (0.5, 0.6727)),
        ({"prior_fall_std": 0.04}, (0.5, -0.4), (0.5, 1.3)),
        ({"prior_std": 0.4}, (0.5, -0.4), (0.4, 0.6021)),
    ],
)
def test_the_prior_is_as_the_settings_say(
    change: dict[str, float], mean: tuple[float, float], spread: tuple[float, float]
) -> None:
    empty = SlopeSums.of(make_cells(0), 3)
    table = fit_gps(LatentGPConfig(epochs=1, epoch_steps=1, **change), empty).tabulate()  # type: ignore[arg-type]
    at = [0, 300]  # 0° and 30°
    assert table.mean[0, at].tolist() == pytest.approx(mean, abs=1e-4)
    assert latent_std(table)[0, at].tolist() == pytest.approx(spread, abs=2e-3)
    assert table.noise_std.tolist() == pytest.approx([0.2] * 3)


def test_the_prior_of_the_noise_is_as_the_settings_say() -> None:
    one = one_class(torch.tensor([10.0]), torch.tensor([0.7]))
    found = {
        name: float(fit_gps(LatentGPConfig(**change), one).tabulate().noise_std)  # type: ignore[arg-type]
        for name, change in {
            "default": {},
            "louder": {"noise_std": 0.4},
            "surer": {"noise_spread": 0.01},
            "bounded": {"noise_std": 0.245, "noise_std_range": (0.24, 0.25)},
        }.items()
    }
    assert found["louder"] > 1.5 * found["default"]
    assert found["surer"] == pytest.approx(0.2, abs=0.001)
    assert 0.24 <= found["bounded"] <= 0.25
    assert found["default"] < 0.24


def test_the_data_change_the_kernel_from_its_start_within_its_bounds() -> None:
    settings = {
        "length_deg": 3.5,
        "length_range_deg": (3.0, 4.0),
        "prior_std": 0.605,
        "prior_std_range": (0.6, 0.61),
    }
    config = LatentGPConfig(**settings)  # type: ignore[arg-type]
    sums = make_sums(2_000)
    for model, limits in (
        (
            LatentGPs(config, sums.steepest_deg),
            {"length": (3.5, 3.5), "spread": (0.605, 0.605)},
        ),
        (fit_gps(config, sums), {"length": (3.0, 4.0), "spread": (0.6, 0.61)}),
    ):
        kernel = model.gp.matern
        values = {
            "length": 10 * kernel.base_kernel.lengthscale,
            "spread": kernel.outputscale.sqrt(),
        }
        for name, (low, high) in limits.items():
            assert float(values[name].min()) > low - 1e-6
            assert float(values[name].max()) < high + 1e-6


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"prior_fall_std": 0.0}, "prior_fall_std"),
        ({"prior_level": float("nan")}, "prior_level"),
        ({"length_deg": 20.0}, "length_range_deg"),
        ({"noise_std_range": (0.5, 0.1)}, "noise_std_range"),
        ({"prior_std_range": (0.0, 1.0)}, "prior_std_range"),
    ],
)
def test_priors_that_are_none_are_refused(
    change: dict[str, object], named: str
) -> None:
    with pytest.raises(ConfigError, match=named):
        LatentGPConfig(**change)  # type: ignore[arg-type]


STEEP = torch.linspace(0, 20, 3000)
FEW = {
    "one": ([10.0], [0.7]),
    "one at 0": ([10.0], [0.0]),
    "two": ([5.0, 20.0], [0.9, 0.2]),
    "steepest of all": ([90.0], [0.1]),
    "one slope": ([10.0] * 300, torch.linspace(0.5, 0.9, 300).tolist()),
    "flat ground alone": ([0.0] * 300, [1.0] * 300),
    "all 0": (STEEP.tolist(), [0.0] * 3000),
    "all 1": (STEEP.tolist(), [1.0] * 3000),
    "all the same": (STEEP.tolist(), [0.5] * 3000),
    "all slopes": (
        torch.linspace(0, 90, 3000).tolist(),
        torch.linspace(1, 0, 3000).tolist(),
    ),
}


@pytest.mark.parametrize("kind", ["censored", "gaussian"])
def test_meagre_data_give_sane_functions(kind: str) -> None:
    slopes, values = zip(*FEW.values(), strict=True)
    sums = of_classes(
        [torch.tensor(slope) for slope in slopes],
        [torch.tensor(value) for value in values],
    )
    result = fit_gps(LatentGPConfig(likelihood=kind), sums).tabulate()  # type: ignore[arg-type]
    spread, grid = latent_std(result), table_slopes()
    for c, (slope, value) in enumerate(FEW.values()):
        steepest = max(slope)
        beyond = spread[c, grid >= steepest]
        assert bool((beyond.diff() > -1e-3).all()), list(FEW)[c]
        assert bool((spread[c, grid > steepest + 15] > 0.25).all()), list(FEW)[c]
        node = round(steepest * 10)
        mean = expected(result.mean[c, [node]], result.std[c, [node]])
        assert abs(float(mean) - value[-1]) < (
            0.3 if len(value) < 3 else 0.25 if len(set(slope)) == 1 else 0.1
        )
    # One observation says little about the noise.
    assert bool((result.noise_std[:4] > 0.1).all())


def test_training_draws_nothing() -> None:
    config, sums = LatentGPConfig(epochs=1, epoch_steps=5), make_sums(100)
    before = torch.random.get_rng_state()
    first, second = (fit_gps(config, sums).tabulate() for _ in range(2))
    assert torch.equal(first.mean, second.mean)
    assert torch.equal(before, torch.random.get_rng_state())


def test_the_trainer_counts_every_step_once() -> None:
    # Its count moves the progress bar.
    model = fit_gps(LatentGPConfig(epochs=2, epoch_steps=5), make_sums(50))
    assert model.trainer.global_step == 10


def test_each_epoch_is_told_with_its_loss(capfd: pytest.CaptureFixture[str]) -> None:
    fit_gps(LatentGPConfig(epochs=2, epoch_steps=5), make_sums(50))
    lines = capfd.readouterr().err.splitlines()
    losses = [
        float(line.partition(f"gp: epoch {epoch}/2, loss ")[2])
        for epoch, line in enumerate(lines, 1)
    ]
    assert len(losses) == 2
    assert losses[1] < losses[0]


def test_gps_that_know_each_class_own_reach_lay_their_points_there() -> None:
    cells = make_cells(200)
    model = LatentGPs(
        LatentGPConfig(inducing_points=3), torch.tensor([20.0, 1.0, 90.0])
    )
    points = 10 * model.gp.variational_strategy.inducing_points[..., 0]
    assert points.tolist() == [[0, 10, 20], [0, 2.5, 5], [0, 45, 90]]
    assert model.steepest_deg == [20, 1, 90]
    steepest = SlopeSums.of(cells.select(cells.class_id > 0), 3).steepest_deg
    assert steepest.tolist() == [
        0,
        *(float(cells.slope_deg[cells.class_id == c].max()) for c in (1, 2)),
    ]


def test_the_parameters_in_a_checkpoint_give_the_same_functions(
    model: LatentGPs,
) -> None:
    rebuilt = LatentGPs(model.config, torch.tensor(model.steepest_deg), model.soft)
    kept = {
        n.removeprefix("state."): v
        for n, v in model.to_tensors().items()
        if n.startswith("state.")
    }
    rebuilt.load_state_dict(kept)
    assert torch.equal(rebuilt.tabulate().mean, model.tabulate().mean)
    assert torch.equal(rebuilt.tabulate().std, model.tabulate().std)


def test_lookup_is_linear_between_nodes_and_constant_beyond() -> None:
    mean, std = linear_table().lookup(torch.tensor([[[0.0, 45.03, 90.0, 120.0]]]))
    assert mean.shape == std.shape == (1, 3, 1, 4)
    wanted = torch.tensor([1, 1 - 45.03 / 90, 0, 0])
    torch.testing.assert_close(mean[0, 0, 0], wanted)
    torch.testing.assert_close(std[0, :, 0, 1], torch.tensor([0.1, 0.2, 0.3]))


@torch.no_grad()
def tabulation_error(model: LatentGPs) -> tuple[torch.Tensor, torch.Tensor]:
    """Bounds how far linear interpolation in the table is off these GPs, at any slope.

    On the step h interpolation of g errs by at most h²/8·max|g''|. In the space H of
    the kernel k of a class, with features φ(x), f''(x) has the prior standard deviation
    ‖φ''‖ = 5A/ℓ² and f'(x) the variance ‖φ'‖² = 5A²/(3ℓ²) + τ², for a Matérn 5/2
    process of amplitude A and length scale ℓ and a trend of spread τ. Let K = LLᵀ be
    the prior covariance of the inducing values, m and S mean and covariance of their
    posterior, μ their prior mean.

    - The posterior mean is linear plus an element of H of norm ‖v‖, v = L⁻¹(m − μ):
      |mean''| ≤ ‖v‖·‖φ''‖.
    - The variance is ‖u(x)‖² for a curve u = (σ, Rφ(x)), σ² that of the noise, and ‖R‖
      ≤ r with r² = max(1, ‖L⁻¹SL⁻ᵀ‖). From ‖u‖·‖u‖'' + ‖u‖'² = ‖u'‖² + ⟨u, u''⟩ follows
      |std''| ≤ r²‖φ'‖²/σ + r‖φ''‖.

    Returns:
        Bounds of mean and standard deviation, float64, each of shape [C], rounding to
        float32 aside.
    """
    mean, covariance = model.gp.prior()
    root = torch.linalg.cholesky(covariance)
    posterior = model.gp.variational_strategy.variational_distribution
    shift = (posterior.mean - mean).unsqueeze(-1)
    norm = (
        torch.linalg.solve_triangular(root, shift, upper=False).squeeze(-1).norm(dim=-1)
    )
    half = torch.linalg.solve_triangular(root, posterior.covariance_matrix, upper=False)
    white = torch.linalg.solve_triangular(root, half.mT, upper=False)
    stretch = torch.linalg.matrix_norm(white, 2).clamp(min=1)
    amplitude = model.gp.matern.outputscale.sqrt()
    reach = model.gp.matern.base_kernel.lengthscale.flatten() * 10.0
    bend = 5 * amplitude / reach**2
    slope = 5 / 3 * (amplitude / reach) ** 2 + model.config.prior_fall_std**2
    noise = model.likelihood.noise.sqrt().flatten()
    share = STEP_DEG**2 / 8
    return share * norm * bend, share * (
        stretch * slope / noise + stretch.sqrt() * bend
    )


def errors_of_lookup(
    model: LatentGPs, slopes: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Largest errors of the table's mean and standard deviation at some slopes, each of
    shape [C].
    """
    mean, std = model.tabulate().lookup(slopes[None].double())
    with torch.no_grad():
        exact = model(slopes.expand(len(model.steepest_deg), -1))
        total = (exact.variance + model.likelihood.noise).sqrt()
    return (mean[:, 0] - exact.mean).abs().amax(-1), (std[:, 0] - total).abs().amax(-1)


def test_lookup_of_fitted_tables_is_within_the_bound_of_its_error(
    model: LatentGPs,
) -> None:
    bounds = tabulation_error(model)
    for error, bound in zip(
        errors_of_lookup(model, torch.linspace(0.013, 40, 1501)), bounds, strict=True
    ):
        assert bool((error < bound + 1e-6).all())
        assert bool((bound < 1e-4).all())


def test_the_bound_of_the_tables_error_holds_for_the_worst_gps_and_is_not_idle() -> (
    None
):
    # Inducing points far closer than the length scale, so that the posterior can be
    # made to bend at will.
    model = LatentGPs(LatentGPConfig(inducing_points=40), torch.full((3,), 10.0))
    model.gp.matern.base_kernel.lengthscale = 0.2
    model.gp.matern.outputscale = torch.tensor([1.0, 0.2, 1.0])
    model.likelihood.noise = torch.tensor([[0.2], [0.05], [0.05]]) ** 2
    prior_mean, covariance = (value.detach() for value in model.gp.prior())
    root = torch.linalg.cholesky(covariance)
    points = model.gp.variational_strategy.inducing_points
    x = torch.full((3, 1, 1), 0.505, dtype=torch.float64, requires_grad=True)
    features = torch.linalg.solve_triangular(
        root,
        model.gp.matern(points, x).to_dense() + model.gp.trend(points, x).to_dense(),
        upper=False,
    )
    units = torch.eye(40, dtype=torch.float64)
    slopes = [
        torch.autograd.grad(features[:, i].sum(), x, create_graph=True)[0].flatten()
        for i in range(40)
    ]
    bends = [
        torch.autograd.grad(slope.sum(), x, retain_graph=True)[0].flatten()
        for slope in slopes
    ]
    slope, bend, here = (
        torch.stack(slopes, 1).detach(),
        torch.stack(bends, 1),
        features[..., 0].detach(),
    )
    generator = torch.Generator().manual_seed(0)
    # The mean bends as hard as it can in the first; the last is sure at x and unsure
    # beside it.
    v = torch.stack(
        [
            bend[0] / bend[0].norm(),
            torch.randn(40, generator=generator).double(),
            0 * bend[0],
        ]
    )
    across = slope[2] - here[2] * (slope[2] @ here[2]) / here[2].square().sum()
    across = across / across.norm()
    mixing = torch.randn(40, 40, generator=generator).double() / 8
    white = torch.stack(
        [
            0.01 * units,
            mixing @ mixing.T + 0.01 * units,
            torch.outer(across, across) + 1e-6 * units,
        ]
    )
    posterior = root @ white @ root.mT
    precision = torch.linalg.inv(posterior)
    mean = prior_mean + (root @ v.unsqueeze(-1)).squeeze(-1)
    q = model.gp.variational_strategy._variational_distribution
    q.natural_mat.data = -0.5 * (precision + precision.mT) / 2
    q.natural_vec.data = (precision @ mean.unsqueeze(-1)).squeeze(-1)

    bound_mean, bound_std = tabulation_error(model)
    error_mean, error_std = errors_of_lookup(
        model, torch.linspace(0, 12, 12 * 80 + 1).double()
    )
    assert bool((error_mean < bound_mean + 1e-6).all())
    assert bool((error_std < bound_std + 1e-6).all())
    assert float(error_mean[0] / bound_mean[0]) > 0.7
    assert float(error_std[2] / bound_std[2]) > 0.3
    # By hand: h²/8 · 5A/ℓ² at h = 0.1°, A = 1, ℓ = 2°, ‖v‖ = 1.
    assert float(bound_mean[0]) == pytest.approx(0.1**2 / 8 * 5 / 4, rel=1e-4)


@pytest.mark.parametrize("mean", [0.02, 0.3, 0.7, 0.98])
@pytest.mark.parametrize("spread", [0.01, 0.05, 0.15])
@pytest.mark.parametrize("noise_std", [0.1, 0.2])
def test_it_is_the_integral_over_the_latent(
    mean: float, spread: float, noise_std: float
) -> None:
    observed = np.array([0.0, 0.0, 0.2, 0.55, 0.9, 1.0, 1.0, 1.0])
    inside = observed[(observed > 0) & (observed < 1)]
    bins = {
        "inside": len(inside), "total": inside.sum(), "squares": (inside**2).sum(),
        "zeros": (observed == 0).sum(), "ones": (observed == 1).sum(),
    }  # fmt: skip
    numbers = {
        name: torch.tensor([[float(value)]], dtype=torch.float64)
        for name, value in bins.items()
    }

    def log_prob(latent: float) -> float:
        density = norm.logpdf(inside, latent, noise_std).sum()
        below, above = (
            norm.logcdf(-latent / noise_std),
            norm.logcdf((latent - 1) / noise_std),
        )
        return float(density + 2 * below + 3 * above)

    expected, _ = quad(
        lambda latent: log_prob(latent) * norm.pdf(latent, mean, spread),
        mean - 10 * spread, mean + 10 * spread, epsabs=1e-10, epsrel=1e-10,
    )  # fmt: skip
    given = (
        torch.tensor([[value]], dtype=torch.float64)
        for value in (mean, spread**2, noise_std**2)
    )
    assert float(expected_log_prob(numbers, *given)) == pytest.approx(
        expected, rel=1e-7
    )
