"""Finding a second mode of a class's traversability, one that slope does not explain:
soft spots.

A cell of the class is, with probability 1 − p, from a normal distribution about the
class's function of slope f(ψ) with standard deviation σ, and else from N(m, s²), the
same at any slope; what is observed is clipped to [0, 1]. The parameters are found by
expectation maximisation over counts of cells by slope and by λ, in which a cell's share
in each mode, and what lies beyond the clip, are the unknowns. Here f is any function of
small bends; the GP is fitted afterwards to the cells of the main mode.

A second mode is kept where there are 100 cells or more, it holds over 1 % of them, BIC
very strongly prefers it, and every cell is told better by 0.002 nats on average. The
last keeps away modes that only mend how the main one is drawn, which BIC would keep
once there are cells enough. Sources: Dempster, Laird and Rubin (1977), "Maximum
likelihood from incomplete data via the EM algorithm"; Tobin (1958), "Estimation of
relationships for limited dependent variables"; Schwarz (1978), "Estimating the
dimension of a model"; Kass and Raftery (1995), "Bayes factors". Letters in shapes: S
starts, B bins of slope, V bins of λ, C classes.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.models.slope_gp.cells import INSIDE_BINS, SlopeSums, levels
from benchnav.models.slope_gp.table import SoftModes

LEAST_CELLS, LEAST_WEIGHT, LEAST_GAIN = 100, 0.01, 2e-3

_INSIDE = levels()[1:-1]  # λ of the bins inside (0, 1)
_FREE_PARAMETERS = 3  # that a second mode adds
_STRONG = 10.0  # difference of BIC from which evidence is called very strong
_STARTS = (0.05, 0.35, 0.65, 0.95)  # means that a second mode is looked for from
_FIRST_WEIGHT, _FIRST_STD = 0.1, 0.1
_MOST_WEIGHT, _LEAST_STD = 0.5, 0.01
_BEND_STD = 0.005  # of the second differences of f from bin to bin
_FIRST_STEPS, _MOST_STEPS = 40, 300
_MOST_ODDS = 200.0  # beyond, shares would be too small for quick arithmetic
_SETTLED = 1e-8  # nats a cell and step


class _Modes(NamedTuple):
    """Parameters of S fits: f of shape [S, B], all others of shape [S, 1]; weight 0 for
    a single mode.
    """

    main: Tensor
    main_std: Tensor
    weight: Tensor
    mean: Tensor
    std: Tensor


def find_soft_modes(sums: SlopeSums) -> tuple[SoftModes | None, dict[str, Tensor]]:
    """Looks for a second mode of each class.

    Args:
        sums: of the observed cells of C classes.

    Returns:
        The second modes, None where no class has one; and the sums that the censored
        likelihood takes, over the
        cells of the main modes: as `SlopeSums.bins`, and what that gives for a class
            without a second mode.
    """
    classes, bins = len(sums.cells), sums.bins(censored=True)
    weight, mean, std = torch.zeros(classes), torch.zeros(classes), torch.ones(classes)
    share = torch.ones(sums.cells.shape, dtype=torch.float64)
    for c, counts in enumerate(sums.cells):
        if modes := _find_in_class(counts):
            share[c, : modes.main.shape[1]] -= _soft_share(modes)[1][0]
            weight[c], mean[c], std[c] = modes.weight, modes.mean, modes.std
    has_two, size = weight > 0, bins["zeros"].shape[1]
    if not bool(has_two.any()):
        return None, bins
    kept = (sums.cells[has_two] * share[has_two])[:, :size]
    inside = kept[..., 1:-1]
    bins["zeros"][has_two], bins["ones"][has_two] = kept[..., 0], kept[..., -1]
    bins["inside"][has_two] = inside.sum(-1)
    bins["total"][has_two], bins["squares"][has_two] = (
        inside @ _INSIDE,
        inside @ _INSIDE**2,
    )
    return SoftModes(weight, mean, std), bins


def _find_in_class(counts: Tensor) -> _Modes | None:
    """The two modes of a class, up to its steepest bin with cells; None where it has
    one mode.
    """
    total = int(counts.sum())
    if total < LEAST_CELLS:
        return None
    size = int(counts.sum(1).nonzero().max()) + 1
    cells = counts[:size].double()
    # One mode, level at the mean of all cells, then with a small second one at several
    # places.
    level, every = levels(), cells.sum(0)
    mean = (every * level).sum() / every.sum()
    spread = (
        ((every * (level - mean) ** 2).sum() / every.sum()).sqrt().clamp(min=_FIRST_STD)
    )
    none = torch.zeros(1, 1, dtype=torch.float64)
    flat = _Modes(
        mean.expand(1, size), spread.view(1, 1), none, none, none + _FIRST_STD
    )
    single, single_fit = _maximise(cells, flat, _MOST_STEPS)
    places = torch.tensor(_STARTS, dtype=torch.float64).unsqueeze(1)
    small = single._replace(
        weight=torch.full_like(places, _FIRST_WEIGHT),
        mean=places,
        std=torch.full_like(places, _FIRST_STD),
    )
    starts, fits = _maximise(cells, small, _FIRST_STEPS)
    best = _Modes(*(values[fits.argmax()].unsqueeze(0) for values in starts))
    double, double_fit = _maximise(cells, best, _MOST_STEPS)
    least = max(LEAST_GAIN * total, (_FREE_PARAMETERS * math.log(total) + _STRONG) / 2)
    return (
        double
        if double.weight > LEAST_WEIGHT and double_fit - single_fit > least
        else None
    )


def _maximise(cells: Tensor, modes: _Modes, most_steps: int) -> tuple[_Modes, Tensor]:
    """Climbs from S starts at once; gives the last parameters and their log likelihoods
    [S].
    """
    before = torch.tensor(-math.inf, dtype=torch.float64)
    for _ in range(most_steps):
        log_prob, share = _soft_share(modes)
        fit = (cells * log_prob).sum((1, 2))
        if bool((fit - before < _SETTLED * cells.sum()).all()):
            break
        before, modes = fit, _improve(cells, modes, share)
    return modes, (cells * _soft_share(modes)[0]).sum((1, 2))


def _soft_share(modes: _Modes) -> tuple[Tensor, Tensor]:
    """Log probability of a bin of λ, and the second mode's share in it, each of shape
    [S, B, V].
    """
    main = _log_prob(modes.main, modes.main_std) + torch.log1p(-modes.weight).unsqueeze(
        -1
    )
    soft = _log_prob(modes.mean, modes.std) + modes.weight.log().unsqueeze(-1)
    odds = (soft - main).clamp(-_MOST_ODDS, _MOST_ODDS)
    return main + torch.nn.functional.softplus(odds), odds.sigmoid()


def _log_prob(mean: Tensor, std: Tensor) -> Tensor:
    """Of the bins of λ under clipped normal distributions: shape [S, B, V] from means
    [S, B] and deviations [S, 1].
    """
    z = (_INSIDE - mean.unsqueeze(-1)) / std.unsqueeze(-1)
    inside = -0.5 * z**2 - (std * math.sqrt(2 * math.pi) * INSIDE_BINS).log().unsqueeze(
        -1
    )
    at_0, at_1 = (
        torch.special.log_ndtr(-mean / std),
        torch.special.log_ndtr((mean - 1) / std),
    )
    return torch.cat([at_0.unsqueeze(-1), inside, at_1.unsqueeze(-1)], -1)


def _improve(cells: Tensor, modes: _Modes, share: Tensor) -> _Modes:
    """The parameters of greatest expected likelihood, given the shares of the second
    mode [S, B, V].
    """
    soft = cells * share
    count, total, squares = _moments(cells - soft, modes.main, modes.main_std)
    main = _smooth(count, total, modes.main_std)
    gap = squares - 2 * main * total + main**2 * count
    main_std = _deviation(gap.sum(1, keepdim=True) / count.sum(1, keepdim=True))
    if not bool(modes.weight.any()):
        return modes._replace(main=main, main_std=main_std)
    count, total, squares = _moments(soft.sum(1, keepdim=True), modes.mean, modes.std)
    some = count.clamp(min=1e-9)
    mean = total / some
    weight = (count / cells.sum()).clamp(max=_MOST_WEIGHT)
    return _Modes(main, main_std, weight, mean, _deviation(squares / some - mean**2))


def _deviation(variance: Tensor) -> Tensor:
    return variance.clamp(min=_LEAST_STD**2).sqrt()


def _moments(cells: Tensor, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cells, and the sums of their λ and λ² before clipping as far as a normal
    distribution tells it.

    Args:
        cells: shape [S, B, V].
        mean: of the normal distribution, shape [S, B].
        std: of it, shape [S, 1].

    Returns:
        Each of shape [S, B].
    """
    inside = cells[..., 1:-1]
    total, squares = inside @ _INSIDE, inside @ _INSIDE**2
    for clipped, edge, sign in (
        (cells[..., 0], -mean / std, -1),
        (cells[..., -1], (mean - 1) / std, 1),
    ):
        # Of a normal variable beyond the edge (Tobin): h = φ/Φ, mean m ± s·h, variance
        # s²(1 − e·h − h²).
        hazard = torch.exp(-0.5 * edge**2 - torch.special.log_ndtr(edge)) / math.sqrt(
            2 * math.pi
        )
        beyond = mean + sign * std * hazard
        total = total + clipped * beyond
        squares = squares + clipped * (
            beyond**2 + std**2 * (1 - edge * hazard - hazard**2).clamp(min=0)
        )
    return cells.sum(-1), total, squares


def _smooth(count: Tensor, total: Tensor, std: Tensor) -> Tensor:
    """f of least squares, its bends held small, from counts and sums of λ by bins of
    slope, [S, B].
    """
    bends = torch.eye(count.shape[1], dtype=torch.float64).diff(n=2, dim=0) / _BEND_STD
    variance = std**2
    # A little of the level of all cells settles what the data leave open.
    level = (total.sum(1) / count.sum(1)).unsqueeze(1)
    precision = torch.diag_embed(count / variance + 1e-3) + bends.T @ bends
    return torch.linalg.solve(
        precision, (total / variance + 1e-3 * level).unsqueeze(-1)
    ).squeeze(-1)
