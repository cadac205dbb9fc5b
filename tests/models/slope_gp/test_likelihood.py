import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm

from benchnav.models.slope_gp.likelihood import expected_log_prob


@pytest.mark.parametrize("mean", [0.02, 0.3, 0.7, 0.98])
@pytest.mark.parametrize("spread", [0.01, 0.05, 0.15])
@pytest.mark.parametrize("noise_std", [0.1, 0.2])
def test_it_is_the_integral_over_the_latent(mean: float, spread: float, noise_std: float) -> None:
    observed = np.array([0.0, 0.0, 0.2, 0.55, 0.9, 1.0, 1.0, 1.0])
    inside = observed[(observed > 0) & (observed < 1)]
    bins = {
        "inside": len(inside), "total": inside.sum(), "squares": (inside**2).sum(),
        "zeros": (observed == 0).sum(), "ones": (observed == 1).sum(),
    }  # fmt: skip
    numbers = {name: torch.tensor([[float(value)]], dtype=torch.float64) for name, value in bins.items()}

    def log_prob(latent: float) -> float:
        density = norm.logpdf(inside, latent, noise_std).sum()
        below, above = norm.logcdf(-latent / noise_std), norm.logcdf((latent - 1) / noise_std)
        return float(density + 2 * below + 3 * above)

    expected, _ = quad(
        lambda latent: log_prob(latent) * norm.pdf(latent, mean, spread),
        mean - 10 * spread, mean + 10 * spread, epsabs=1e-10, epsrel=1e-10,
    )  # fmt: skip
    given = (torch.tensor([[value]], dtype=torch.float64) for value in (mean, spread**2, noise_std**2))
    assert float(expected_log_prob(numbers, *given)) == pytest.approx(expected, rel=1e-7)
