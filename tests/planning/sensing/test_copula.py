import numpy as np
import pytest
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.planning.sensing.belief import Law
from benchnav.planning.sensing.copula import Copula, CopulaState
from benchnav.planning.sensing.sensor import LEAST_STD, Contact, Moment, Probe, Sensed
from tests.planning.sensing import made

HEIGHT, WIDTH = 14, 16
LAW = made.law(HEIGHT, WIDTH, 1.5)
INF = float("inf")


def looked(values: dict[tuple[int, int], float], std: float = LEAST_STD, batch: int = 1) -> Sensed:
    found = torch.full((batch, HEIGHT, WIDTH), torch.nan, dtype=torch.float64)
    for (row, column), value in values.items():
        found[:, row, column] = value
    return Sensed(traversability=found, std=torch.full_like(found, std))


def after(belief: Copula, prior: TraversabilityDistribution, *looks: Sensed, law: Law = LAW) -> CopulaState:
    state = belief.init(prior, law)
    for sensed in looks:
        state = belief.update(state, sensed)
    return state


def covariance(one: list[tuple[int, int]], other: list[tuple[int, int]], length: float = 3.0) -> np.ndarray:
    away = ((np.array(one)[:, None] - np.array(other)[None]) ** 2).sum(-1)
    return np.exp(-away / (2 * length**2))


EVERY = [(row, column) for row in range(HEIGHT) for column in range(WIDTH)]


def test_before_anything_is_sensed_it_is_the_prediction() -> None:
    prior = made.mixture(2, HEIGHT, WIDTH)
    found = Copula().distribution(Copula().init(prior, LAW))
    for level in (0.1, 0.5, 0.9):
        torch.testing.assert_close(found.quantile(level), prior.quantile(level), atol=1e-9, rtol=0)


def test_scores_that_are_observed_condition_the_field_as_linear_algebra_says() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    places = {(4, 4): 0.55, (5, 6): 0.3, (12, 15): 0.8}
    state = after(Copula(), prior, looked(places, std=0.2))
    where = list(places)
    values = torch.tensor([list(places.values())], dtype=torch.float64)
    mask = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    for place in where:
        mask[0][place] = True
    score = prior.at(mask).to_normal(values[None])[0].numpy().ravel()
    inner = covariance(where, where) + 0.04 * np.eye(3)
    across = covariance(where, EVERY)
    mean = (across.T @ np.linalg.solve(inner, score)).reshape(HEIGHT, WIDTH)
    variance = 1 - (across * np.linalg.solve(inner, across)).sum(0).reshape(HEIGHT, WIDTH)
    np.testing.assert_allclose(state.mean[0], mean, atol=6e-3)
    np.testing.assert_allclose(state.std[0], np.sqrt(variance), atol=6e-3)
    found = Copula().distribution(state)
    assert isinstance(found, ConditionedDistribution)
    assert found.base is state.prior


def test_ground_at_zero_is_an_interval_up_to_the_atoms_end() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(6, 6): 0.0}))
    assert float(state.lower[0, 6, 6]) == -INF
    end = float(state.upper[0, 6, 6])
    assert float(prior.from_normal(torch.full(prior.shape, end - 0.01, dtype=torch.float64))[0, 6, 6]) == 0
    found = Copula().distribution(state)
    assert float(found.cdf(0.1)[0, 6, 6]) > 0.99
    assert float(found.mean()[0, 6, 6]) < 0.005
    assert float(found.mean()[0, 6, 8]) < float(prior.mean()[0, 6, 8])


def test_λ_that_the_prediction_holds_impossible_is_at_its_end() -> None:
    flat = torch.linspace(0.3, 0.7, len(LEVELS), dtype=torch.float64)[:, None, None]
    prior = QuantileDistribution(flat.expand(1, len(LEVELS), HEIGHT, WIDTH))
    for value, side in ((0.0, -1), (0.1, -1), (0.9, 1), (1.0, 1)):
        state = after(Copula(), prior, looked({(6, 6): value}, 0.1))
        assert state.mean.isfinite().all()
        assert side * float(state.mean[0, 6, 6]) > 2
        assert side * float(state.mean[0, 6, 8]) > 1


def test_two_looks_with_noise_are_averaged_and_an_interval_is_told_by_the_sharpest() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    once, twice = (after(Copula(), prior, *[looked({(6, 6): 0.5}, 0.4)] * n) for n in (1, 2))
    assert float(twice.noise_std[0, 6, 6]) == pytest.approx(0.4 / np.sqrt(2))
    assert float(twice.std[0, 6, 6]) < float(once.std[0, 6, 6])
    apart = after(Copula(), prior, looked({(6, 6): 0.4}, 0.4), looked({(6, 6): 0.6}, 0.2))
    scores = [float(after(Copula(), prior, looked({(6, 6): v})).lower[0, 6, 6]) for v in (0.4, 0.6)]
    assert float(apart.lower[0, 6, 6]) == pytest.approx(0.2 * scores[0] + 0.8 * scores[1])
    held, again = (after(Copula(), prior, *[looked({(6, 6): 0.0}, 0.4)] * n) for n in (1, 2))
    assert torch.equal(held.mean, again.mean)
    sharp, noisy = looked({(6, 6): 0.0}, 0.01), looked({(6, 6): 0.0}, 0.8)
    for looks in ((sharp, noisy), (noisy, sharp)):
        wanted = after(Copula(), prior, sharp).mean
        torch.testing.assert_close(after(Copula(), prior, *looks).mean, wanted, atol=0.006, rtol=0)
    # A number says more than an interval, whichever comes first.
    for looks in ((0.0, 0.3), (0.3, 0.0)):
        state = after(Copula(), prior, *(looked({(6, 6): value}, 0.4) for value in looks))
        wanted = after(Copula(), prior, looked({(6, 6): 0.3}, 0.4)).mean
        torch.testing.assert_close(state.mean, wanted, atol=0.006, rtol=0)


def test_the_same_look_without_noise_changes_nothing() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(6, 6): 0.5}))
    again = Copula().update(state, looked({(6, 6): 0.5}))
    assert again.mean is state.mean or torch.equal(again.mean, state.mean)
    assert float(again.noise_std[0, 6, 6]) == LEAST_STD


def test_the_order_of_looks_and_the_other_episodes_do_not_matter() -> None:
    prior = made.mixture(2, HEIGHT, WIDTH)
    looks = [looked({(4, 4): 0.55, (4, 5): 0.0}, 0.1), looked({(6, 6): 0.3}, 0.1), looked({(5, 9): 1.0}, 0.1)]
    first = prior.select(torch.tensor([0]))
    forward, backward = after(Copula(), first, *looks), after(Copula(), first, *looks[::-1])
    torch.testing.assert_close(forward.mean, backward.mean, atol=0.012, rtol=0)
    torch.testing.assert_close(forward.std, backward.std, atol=0.012, rtol=0)
    state = Copula().init(prior, LAW)
    for place, sensed in enumerate(looks):
        both = sensed.traversability.repeat(2, 1, 1)
        both[1] = torch.nan
        both[1, 2 : 4 + 4 * place, 2 + 3 * place] = 0.4
        state = Copula().update(state, Sensed(traversability=both, std=torch.full_like(both, 0.1)))
    torch.testing.assert_close(state.mean[:1], forward.mean, atol=1e-9, rtol=0)
    torch.testing.assert_close(state.std[:1], forward.std, atol=1e-9, rtol=0)
    kept = Copula().select(state, torch.tensor([1]))
    assert torch.equal(kept.mean, state.mean[1:])


def test_nothing_is_told_beyond_four_lengths() -> None:
    law = made.law(40, 40, 1.0)
    prior = made.mixture(1, 40, 40)
    found = torch.full((1, 40, 40), torch.nan, dtype=torch.float64)
    found[0, 20, 20] = 0.2
    state = after(Copula(), prior, Sensed(traversability=found, std=torch.full_like(found, 0.01)), law=law)
    told = (state.mean != 0).nonzero()[:, 1:] - 20
    assert 5 <= int(told.abs().max()) <= 8
    # Nor is anything noted that is under the least change: a correlation of 0.004 here.
    score = float(state.lower[0, 20, 20])
    assert float(state.mean[0, 20, 26]) == pytest.approx(score * np.exp(-36 / 8), abs=0.006)


def test_the_reach_is_of_an_episodes_own_cells_whatever_others_sense() -> None:
    law, prior = made.law(HEIGHT, WIDTH, 0.5), made.mixture(2, HEIGHT, WIDTH)
    sensed = looked({(6, 6): 0.5}, 0.1, batch=2)
    sensed.traversability[1, 0, 0] = sensed.traversability[1, 13, 15] = 0.4
    both = after(Copula(), prior, sensed, law=law)
    first = torch.tensor([0])
    alone = after(Copula(), prior.select(first), sensed.select(first), law=law)
    assert torch.equal(both.mean[:1] != 0, alone.mean != 0)
    assert torch.equal(both.std[:1] != 1, alone.std != 1)


@pytest.mark.parametrize("correlation_m", [0.0, 0.5])
def test_the_length_that_is_believed_takes_the_worlds_place(correlation_m: float) -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(correlation_m), prior, looked({(6, 6): 0.2}))
    other = after(Copula(), prior, looked({(6, 6): 0.2}), law=made.law(HEIGHT, WIDTH, correlation_m))
    assert torch.equal(state.mean, other.mean)
    if correlation_m == 0:
        assert (state.mean != 0).nonzero().tolist() == [[0, 6, 6]]


def test_a_window_looks_at_what_is_near_and_loses_little() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    score = made.scores(LAW, 1)
    field = prior.from_normal(score)
    path = [(2 + place // 2, 2 + place) for place in range(12)]
    looks = [looked({place: float(field[0][place])}, 0.1) for place in path]
    whole, near, one = (after(Copula(window=window), prior, *looks) for window in (128, 6, 1))
    ahead = (slice(None), slice(6, 12), slice(10, 16))
    assert (whole.mean[ahead] - near.mean[ahead]).abs().max() < 0.12
    assert (whole.mean[ahead] - one.mean[ahead]).abs().max() > (
        whole.mean[ahead] - near.mean[ahead]
    ).abs().max()


def test_a_look_at_more_cells_than_the_window_tells_of_all() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    field = prior.from_normal(made.scores(LAW, 1))
    sensed = Sensed(traversability=field, std=torch.full_like(field, 0.1))
    state = after(Copula(window=16), prior, sensed)
    assert (state.std < 0.5).all()
    held = field < 0.02
    assert float(Copula().distribution(state).mean()[held].max()) < 0.1


def test_another_prediction_is_conditioned_on_the_same_λ() -> None:
    prior, other = made.mixture(1, HEIGHT, WIDTH), made.mixture(1, HEIGHT, WIDTH, seed=3)
    looks = [looked({(4, 4): 0.5, (6, 6): 0.0}, 0.1), looked({(10, 12): 0.4}, 0.1)]
    state = after(Copula(), prior, *looks)
    nothing = looked({})
    found, wanted = Copula().update(state, nothing, other), after(Copula(), other, *looks)
    assert found.prior is other
    # λ̂ is another everywhere, where the score stayed as well.
    assert Copula().changed(state, found).all()
    torch.testing.assert_close(found.mean, wanted.mean, atol=0.02, rtol=0)
    torch.testing.assert_close(found.std, wanted.std, atol=0.02, rtol=0)


def test_fields_that_are_drawn_have_what_is_believed_and_what_was_observed() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(4, 4): 0.5, (4, 7): 0.0, (9, 9): 0.85}, 0.05))
    fields = Copula().sample_fields(state, 800, (9,))[0]
    found = Copula().distribution(state)
    for place in ((4, 4), (4, 5), (6, 7), (9, 9), (13, 0)):
        drawn = fields[:, *place].numpy()
        for level in (0.1, 0.3, 0.6, 0.9):
            assert (drawn <= level).mean() == pytest.approx(float(found.cdf(level)[0][place]), abs=0.07)
    # Cells between are drawn together: their scores keep the correlation that is left.
    left = covariance([(6, 7)], [(6, 8)]) - (
        covariance([(6, 7)], [(4, 4), (9, 9)])
        @ np.linalg.inv(covariance([(4, 4), (9, 9)], [(4, 4), (9, 9)]) + 0.0025 * np.eye(2))
        @ covariance([(4, 4), (9, 9)], [(6, 8)])
    )
    assert left > 0.3
    ranks = fields[:, 6, 7].argsort().argsort().double(), fields[:, 6, 8].argsort().argsort().double()
    assert float(torch.corrcoef(torch.stack(ranks))[0, 1]) > 0.5
    # Two batches of one key are the same fields.
    again = Copula().sample_fields(state, 40, (9,))[0]
    assert torch.equal(again, Copula().sample_fields(state, 40, (9,))[0])


@pytest.mark.parametrize("sensor", [Contact(), Probe(1.0, 0.1)])
def test_nine_of_ten_cells_near_the_robot_lie_in_the_90_percent_interval(sensor: Contact | Probe) -> None:
    """Randomised PIT of cells not yet observed, within 2ℓ of a robot on a straight way, by maps."""
    batch, steps = 150, 10
    law = made.law(20, 20, 1.5)
    prior = made.mixture(batch, 20, 20)
    field = prior.from_normal(made.scores(law, batch))
    terrain, keys = made.terrain(prior, field), list(range(batch))
    belief = Copula()
    state = belief.init(prior, law)
    for step in range(steps):
        where = torch.tensor([[1.25 + 0.6 * step, 5.1, 0.0]], dtype=torch.float64).repeat(batch, 1)
        state = belief.update(state, sensor.sense(terrain, field, where, Moment(keys, step)))
    row, column = torch.arange(20)[:, None] * 0.5 + 0.25, torch.arange(20) * 0.5 + 0.25
    near = torch.hypot(row - 5.1, column - float(where[0, 0])) <= 3.0
    asked = near[None] & ~state.observed
    low, high = belief.distribution(state).cdf_limits(field)
    draw = torch.from_numpy(rng.uniform(1, np.arange(batch), (20, 20)))
    pit = torch.lerp(low, high, draw)
    inside = ((pit > 0.05) & (pit < 0.95)) & asked
    by_map = inside.flatten(1).sum(1) / asked.flatten(1).sum(1)
    share, error = float(inside.sum() / asked.sum()), float(by_map.std() / np.sqrt(batch))
    assert abs(share - 0.9) < 2.5 * error
    assert error < 0.012
    # And the belief is narrower than the prediction.
    gain = prior.log_prob(field)[asked].mean() - belief.distribution(state).log_prob(field)[asked].mean()
    assert float(gain) < -0.05


@pytest.mark.parametrize("base", ["mixture", "quantiles"])
def test_of_some_cells_it_is_told_quickly_what_is_believed(base: str) -> None:
    prior: TraversabilityDistribution = made.mixture(2, HEIGHT, WIDTH)
    if base == "quantiles":
        values = torch.stack([prior.quantile(level) for level in LEVELS], 1)
        prior = QuantileDistribution(values)
    state = Copula().init(prior, LAW)
    for sensed in (looked({(4, 4): 0.5, (4, 7): 0.0}, 0.05, 2), looked({(9, 9): 1.0}, 0.2, 2)):
        state = Copula().update(state, sensed)
    cells = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    cells[0, 3:10, 3:10] = cells[1, 8:, 5] = True
    found, exact = Copula().at(state, cells), Copula().distribution(state).at(cells)
    assert found.shape == exact.shape == (1, 49 + 6)
    for measure in (
        lambda one: one.mean(), lambda one: one.cvar(0.8), lambda one: one.cvar(0.95), lambda one: one.var(0.9),
        lambda one: 1 / one.expected_time(0.05), lambda one: one.chance(0.1),
    ):  # fmt: skip
        torch.testing.assert_close(
            measure(found), measure(exact), atol=0.005 if base == "mixture" else 0.01, rtol=0
        )


def test_cells_are_told_that_have_changed() -> None:
    prior = made.mixture(2, HEIGHT, WIDTH)
    before = Copula().init(prior, LAW)
    sensed = looked({(6, 6): 0.2}, 0.1, 2)
    sensed.traversability[1] = torch.nan
    after = Copula().update(before, sensed)
    changed = Copula().changed(before, after)
    assert not changed[1].any()
    assert torch.equal(changed[0], (after.mean[0] != 0) | (after.std[0] != 1))
    assert changed[0, 6, 6]
    assert not Copula().changed(after, Copula().update(after, sensed.select(torch.tensor([1, 1])))).any()


@pytest.mark.parametrize("noise_std", [LEAST_STD, 0.1])
def test_beside_ground_at_zero_risk_is_that_of_all_fields_that_match(noise_std: float) -> None:
    """Against four million pairs of scores; the Gaussian term of an interval is off by most right beside it."""
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(6, 6): 0.0}, noise_std))
    found, end = Copula().distribution(state), float(state.upper[0, 6, 6])
    here, other, noise = np.random.default_rng(0).standard_normal((3, 1_000_000))
    held = here + noise_std * noise < end
    for away, (mean_error, chance_error) in {1: (0.004, 0.025), 2: (0.002, 0.01), 4: (0.004, 0.01)}.items():
        r = np.exp(-(away**2) / 18)
        score = torch.from_numpy((r * here + np.sqrt(1 - r * r) * other)[held][:20_000])
        place = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
        place[0, 6, 6 + away] = True
        one = prior.at(place)
        wide = [
            getattr(one, name).expand(*one.weights.shape[:-1], len(score))
            for name in ("weights", "means", "stds")
        ]
        matching = TraversabilityMixture(*wide).from_normal(score[None])[0]
        assert len(matching) == 20_000
        believed = found.at(place)
        worst = matching.sort()[0][:4000].mean()
        assert float(believed.mean()) == pytest.approx(float(matching.mean()), abs=mean_error + 0.004)
        assert float(believed.cvar(0.8)) == pytest.approx(float(worst), abs=0.01)
        assert float(believed.cdf(0.1)) == pytest.approx(
            float((matching <= 0.1).double().mean()), abs=chance_error
        )


@pytest.mark.parametrize("wrong", [{"correlation_m": -1.0}, {"window": 0}])
def test_what_cannot_be_believed_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Copula(**wrong)  # type: ignore[arg-type]


def test_a_state_is_not_changed_by_an_update() -> None:
    prior = made.mixture(1, HEIGHT, WIDTH)
    state = after(Copula(), prior, looked({(4, 4): 0.5}))
    before = state.clone()
    Copula().update(state, looked({(6, 6): 0.0}))
    for name in ("lower", "upper", "noise_std", "precision", "shift", "mean", "std"):
        one: Tensor = getattr(state, name)
        torch.testing.assert_close(one, getattr(before, name), rtol=0, atol=0, equal_nan=True)
