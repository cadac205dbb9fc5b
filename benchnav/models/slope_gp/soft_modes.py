"""Detection of soft spots: a second mode of a class's λ that is independent of slope.

With probability 1 − p, λ of a cell has the distribution N(f(ψ), σ²), where f is the
class's function of slope ψ; otherwise it has the distribution N(m, s²), at any slope.
Observations are clipped to [0, 1]. Expectation maximisation fits the parameters to counts
of cells by slope and by λ; the hidden variables are each cell's mode and its value before
clipping. Here f is any function with small second differences; the GP is fitted
afterwards to the cells of the main mode.

A second mode is accepted if there are at least 100 cells, its weight exceeds 1 %, BIC
very strongly prefers it, and the mean log-likelihood increases by 0.002 nats per cell.
The last condition rejects modes that only correct the shape of the main mode, which BIC
would accept for large numbers of cells. Sources: Dempster, Laird and Rubin (1977),
"Maximum likelihood from incomplete data via the EM algorithm"; Tobin (1958),
"Estimation of relationships for limited dependent variables"; Schwarz (1978),
"Estimating the dimension of a model"; Kass and Raftery (1995), "Bayes factors". Letters
in shapes: S starts, B bins of slope, V bins of λ, C classes.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.models.slope_gp.cells import INSIDE_BINS, SlopeSums, levels
from benchnav.models.slope_gp.table import SoftModes

MIN_CELLS = 100
MIN_WEIGHT = 0.01
MIN_GAIN = 2e-3  # nats per cell

_INSIDE = levels()[1:-1]  # λ of the bins inside (0, 1)
_FREE_PARAMETERS = 3  # number of parameters of a second mode
_STRONG = 10.0  # difference of BIC above which evidence is called very strong
_INITIAL_MEANS = (0.05, 0.35, 0.65, 0.95)  # means of the second mode, one per start
_INITIAL_WEIGHT = 0.1
_INITIAL_STD = 0.1
_MAX_WEIGHT = 0.5
_MIN_STD = 0.01
_BEND_STD = 0.005  # prior standard deviation of the second differences of f
_TRIAL_STEPS = 40  # steps of EM from each start
_MAX_STEPS = 300  # steps of EM from the best start
_MAX_LOG_ODDS = 200.0  # larger values make responsibilities subnormal, which is slow
_TOLERANCE = 1e-8  # minimum gain of a step in nats per cell
_LEVEL_PRECISION = 1e-3  # precision of a weak prior on f
_TWO_PI_ROOT = math.sqrt(2 * math.pi)


class _Modes(NamedTuple):
    """Parameters of S fits.

    `main` is f, shape [S, B]. `main_std` is σ, `weight` is p, `mean` is m and `std` is s,
    each of shape [S, 1]. If there is only one mode, the weight is 0.
    """

    main: Tensor
    main_std: Tensor
    weight: Tensor
    mean: Tensor
    std: Tensor


def find_soft_modes(sums: SlopeSums) -> tuple[SoftModes | None, dict[str, Tensor]]:
    """Search for a second mode of each class.

    Args:
        sums: sums over the observed cells of C classes.

    Returns:
        The second modes, None if no class has one; and the sums over the cells of the
        main modes for the censored likelihood, with the keys of `SlopeSums.bins`. If a
        class has no second mode, its sums are those of all cells.
    """
    n_classes = len(sums.cells)
    bins = sums.bins(censored=True)
    weight = torch.zeros(n_classes)
    mean = torch.zeros(n_classes)
    std = torch.ones(n_classes)
    main_fraction = torch.ones(sums.cells.shape, dtype=torch.float64)
    for class_id, counts in enumerate(sums.cells):
        modes = _find_in_class(counts)
        if modes is None:
            continue
        _, soft_fraction = _responsibility(modes)
        main_fraction[class_id, : modes.main.shape[1]] -= soft_fraction[0]
        weight[class_id] = modes.weight
        mean[class_id] = modes.mean
        std[class_id] = modes.std
    has_two = weight > 0
    if not bool(has_two.any()):
        return None, bins
    n_bins = bins["zeros"].shape[1]
    main_cells = (sums.cells[has_two] * main_fraction[has_two])[:, :n_bins]
    inside = main_cells[..., 1:-1]
    bins["zeros"][has_two] = main_cells[..., 0]
    bins["ones"][has_two] = main_cells[..., -1]
    bins["inside"][has_two] = inside.sum(-1)
    bins["total"][has_two] = inside @ _INSIDE
    bins["squares"][has_two] = inside @ _INSIDE**2
    return SoftModes(weight, mean, std), bins


def _find_in_class(counts: Tensor) -> _Modes | None:
    """Return the two modes of a class; None if it has one mode.

    Returns:
        Parameters of one fit, with bins up to the steepest non-empty bin.
    """
    n_cells = int(counts.sum())
    if n_cells < MIN_CELLS:
        return None
    n_bins = int(counts.sum(1).nonzero().max()) + 1
    cells = counts[:n_bins].double()
    one_mode, fit_of_one = _maximise(cells, _flat_mode(cells), _MAX_STEPS)
    # Add a small second mode, with several initial means.
    initial_means = torch.tensor(_INITIAL_MEANS, dtype=torch.float64).unsqueeze(1)
    with_second = one_mode._replace(
        weight=torch.full_like(initial_means, _INITIAL_WEIGHT),
        mean=initial_means,
        std=torch.full_like(initial_means, _INITIAL_STD),
    )
    starts, fits = _maximise(cells, with_second, _TRIAL_STEPS)
    best_index = fits.argmax()
    best = _Modes(*(values[best_index].unsqueeze(0) for values in starts))
    two_modes, fit_of_two = _maximise(cells, best, _MAX_STEPS)
    bic_gain = (_FREE_PARAMETERS * math.log(n_cells) + _STRONG) / 2
    min_gain = max(MIN_GAIN * n_cells, bic_gain)
    is_accepted = two_modes.weight > MIN_WEIGHT and fit_of_two - fit_of_one > min_gain
    return two_modes if is_accepted else None


def _flat_mode(cells: Tensor) -> _Modes:
    """Return one mode, whose f is the mean λ of all cells at every slope."""
    level = levels()
    counts = cells.sum(0)
    mean = (counts * level).sum() / counts.sum()
    variance = (counts * (level - mean) ** 2).sum() / counts.sum()
    std = variance.sqrt().clamp(min=_INITIAL_STD)
    zero = torch.zeros(1, 1, dtype=torch.float64)
    return _Modes(
        main=mean.expand(1, len(cells)),
        main_std=std.view(1, 1),
        weight=zero,
        mean=zero,
        std=zero + _INITIAL_STD,
    )


def _maximise(cells: Tensor, modes: _Modes, max_steps: int) -> tuple[_Modes, Tensor]:
    """Run EM from S starts at once, and return the parameters and log-likelihoods [S]."""
    previous_fit = torch.tensor(-math.inf, dtype=torch.float64)
    tolerance = _TOLERANCE * cells.sum()
    for _ in range(max_steps):
        log_prob, responsibility = _responsibility(modes)
        fit = (cells * log_prob).sum((1, 2))
        if bool((fit - previous_fit < tolerance).all()):
            break
        previous_fit = fit
        modes = _improve(cells, modes, responsibility)
    log_prob, _ = _responsibility(modes)
    return modes, (cells * log_prob).sum((1, 2))


def _responsibility(modes: _Modes) -> tuple[Tensor, Tensor]:
    """Return log probabilities of the λ bins and responsibilities of the second mode.

    Returns:
        Two tensors of shape [S, B, V].
    """
    log_main_weight = torch.log1p(-modes.weight).unsqueeze(-1)
    log_soft_weight = modes.weight.log().unsqueeze(-1)
    main = _log_prob(modes.main, modes.main_std) + log_main_weight
    soft = _log_prob(modes.mean, modes.std) + log_soft_weight
    log_odds = (soft - main).clamp(-_MAX_LOG_ODDS, _MAX_LOG_ODDS)
    return main + torch.nn.functional.softplus(log_odds), log_odds.sigmoid()


def _log_prob(mean: Tensor, std: Tensor) -> Tensor:
    """Return log probabilities of the λ bins under clipped normal distributions.

    Args:
        mean: mean before clipping, shape [S, B].
        std: standard deviation before clipping, shape [S, 1].

    Returns:
        Log probabilities, shape [S, B, V].
    """
    z = (_INSIDE - mean.unsqueeze(-1)) / std.unsqueeze(-1)
    log_scale = (std * _TWO_PI_ROOT * INSIDE_BINS).log().unsqueeze(-1)
    inside = -0.5 * z**2 - log_scale
    at_0 = torch.special.log_ndtr(-mean / std)
    at_1 = torch.special.log_ndtr((mean - 1) / std)
    return torch.cat([at_0.unsqueeze(-1), inside, at_1.unsqueeze(-1)], -1)


def _improve(cells: Tensor, modes: _Modes, responsibility: Tensor) -> _Modes:
    """Return the parameters that maximise the expected log-likelihood (M step).

    Args:
        cells: counts by bins of slope and of λ, shape [B, V].
        modes: parameters of the E step.
        responsibility: responsibility of the second mode, shape [S, B, V].
    """
    soft = cells * responsibility
    count, total, squares = _moments(cells - soft, modes.main, modes.main_std)
    main = _smooth(count, total, modes.main_std)
    residual = squares - 2 * main * total + main**2 * count
    main_variance = residual.sum(1, keepdim=True) / count.sum(1, keepdim=True)
    main_std = _bounded_std(main_variance)
    if not bool(modes.weight.any()):
        return modes._replace(main=main, main_std=main_std)
    soft_cells = soft.sum(1, keepdim=True)
    count, total, squares = _moments(soft_cells, modes.mean, modes.std)
    positive_count = count.clamp(min=1e-9)
    mean = total / positive_count
    std = _bounded_std(squares / positive_count - mean**2)
    weight = (count / cells.sum()).clamp(max=_MAX_WEIGHT)
    return _Modes(main, main_std, weight, mean, std)


def _bounded_std(variance: Tensor) -> Tensor:
    return variance.clamp(min=_MIN_STD**2).sqrt()


def _moments(cells: Tensor, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return counts and the expected sums of λ and λ² before clipping.

    Args:
        cells: counts by bins of slope and of λ, shape [S, B, V].
        mean: mean of the normal distribution, shape [S, B].
        std: standard deviation of the normal distribution, shape [S, 1].

    Returns:
        Three tensors of shape [S, B].
    """
    inside = cells[..., 1:-1]
    total = inside @ _INSIDE
    squares = inside @ _INSIDE**2
    at_0 = (cells[..., 0], -mean / std, -1)
    at_1 = (cells[..., -1], (mean - 1) / std, 1)
    for clipped, edge, sign in (at_0, at_1):
        # Given that it is beyond 0 or 1, a normal variable has mean m ± s·h and variance
        # s²(1 − e·h − h²), with e the `edge` and h = φ(e) / Φ(e) (Tobin).
        hazard = torch.exp(-0.5 * edge**2 - torch.special.log_ndtr(edge)) / _TWO_PI_ROOT
        mean_beyond = mean + sign * std * hazard
        variance = std**2 * (1 - edge * hazard - hazard**2).clamp(min=0)
        total = total + clipped * mean_beyond
        squares = squares + clipped * (mean_beyond**2 + variance)
    return cells.sum(-1), total, squares


def _smooth(count: Tensor, total: Tensor, std: Tensor) -> Tensor:
    """Return the least-squares f with small second differences, shape [S, B].

    Args:
        count: number of cells by bins of slope, shape [S, B].
        total: sum of λ by bins of slope, shape [S, B].
        std: standard deviation of the main mode, shape [S, 1].
    """
    bends = torch.eye(count.shape[1], dtype=torch.float64).diff(n=2, dim=0) / _BEND_STD
    variance = std**2
    # A weak prior, with the mean of all cells, determines f where there are no data.
    level = (total.sum(1) / count.sum(1)).unsqueeze(1)
    precision = torch.diag_embed(count / variance + _LEVEL_PRECISION) + bends.T @ bends
    weighted = total / variance + _LEVEL_PRECISION * level
    return torch.linalg.solve(precision, weighted.unsqueeze(-1)).squeeze(-1)
