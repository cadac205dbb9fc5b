"""The belief of look-alike classes against closed forms and the copula belief."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from benchnav.core.chosen import choose
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.sensing.classes import Classes
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.labels import unpacked
from benchnav.planning.sensing.sensor import Measurement
from tests.planning.sensing import made
from tests.planning.sensing.made_classes import (
    MEANS,
    STDS,
    after,
    covariance_of,
    even,
    looked,
    mixed,
    prediction,
)

LOOKS = (
    looked((2, 12, 14), {(3, 3): 0.62, (3, 4): 0.6, (4, 10): 1.0}),
    looked((2, 12, 14), {(4, 3): 0.4, (5, 3): 0.0, (4, 9): 0.93, (11, 2): 0.35}),
    looked((2, 12, 14), {(3, 3): 0.6, (5, 4): 0.45, (5, 10): 1.0}),
)


def test_without_look_alikes_it_is_the_copula_belief() -> None:
    prior, other = mixed(2, 12, 14), mixed(2, 12, 14, seed=1)
    covariance = covariance_of(12, 14, pairs=())
    mine, plain = Classes(0.8, 5), Copula(0.8, 5)
    state, wanted = mine.init(prior, covariance), plain.init(prior, covariance)
    for sensed, new in zip(LOOKS, (None, other, None), strict=True):
        before, was = state, wanted
        state, wanted = (
            mine.update(state, sensed, new),
            plain.update(wanted, sensed, new),
        )
        torch.testing.assert_close(state.copula.mean, wanted.mean, rtol=0, atol=1e-9)
        torch.testing.assert_close(state.copula.std, wanted.std, rtol=0, atol=1e-9)
        assert torch.equal(mine.changed(before, state), plain.changed(was, wanted))
    some = wanted.observed
    assert torch.equal(mine.at(state, some).below, plain.at(wanted, some).below)
    found, expected = mine.distribution(state), plain.distribution(wanted)
    torch.testing.assert_close(found.cdf(0.4), expected.cdf(0.4), rtol=0, atol=1e-9)
    torch.testing.assert_close(
        mine.sample_fields(state, 2, (1, 2)), plain.sample_fields(wanted, 2, (1, 2))
    )


def test_cells_that_cannot_be_of_a_pair_are_as_under_the_copula_belief() -> None:
    weights = torch.zeros(2, 5, 12, 14, dtype=torch.float64)
    weights[:, 2] = 1
    weights[1, :2, :, 7:], weights[1, 2, :, 7:] = 0.5, 0  # in the second episode alone
    prior, covariance = prediction(weights), covariance_of(12, 14)
    state, plain = Classes().init(prior, covariance), Copula().init(prior, covariance)
    for sensed in LOOKS:
        state, plain = Classes().update(state, sensed), Copula().update(plain, sensed)
    assert torch.equal(state.copula.mean[0], plain.mean[0])
    assert torch.equal(state.copula.std[0], plain.std[0])


def test_before_anything_is_sensed_it_is_the_prediction() -> None:
    prior = mixed(2, 12, 14)
    state = Classes().init(prior, covariance_of(12, 14))
    found = Classes().distribution(state)
    for value in (0.1, 0.5, 0.9, 1.0):
        torch.testing.assert_close(
            found.cdf(value), prior.cdf(value), rtol=0, atol=1e-9
        )
    assert (state.pair[:, :-2, :7] == 1).all()
    assert (state.pair[:, :-2, 7:] == 2).all()
    assert (state.pair[:, -2:] == 0).all()
    shares = prior.weights[:, 0] / (prior.weights[:, 0] + prior.weights[:, 1])
    torch.testing.assert_close(state.probability()[:, :-2, :7], shares[:, :-2, :7])


def test_cells_for_themselves_follow_bayes_rule() -> None:
    prior = mixed(2, 12, 14)
    covariance = covariance_of(12, 14, 0.0, 0.0)
    values = {(3, 3): 0.62, (4, 4): 0.3, (5, 5): 0.0, (3, 10): 0.8, (4, 10): 1.0}
    state = after(Classes(), prior, covariance, looked((2, 12, 14), values, std=1e-3))
    wanted = state.log_odds.clone()
    for (row, column), value in values.items():
        likely = [
            look.prior.log_prob(torch.full(prior.shape, value).double())[:, row, column]
            for look in state.per_class
        ]
        wanted[:, row, column] += likely[0] - likely[1]
    own = state.pair > 0
    # of intervals noise changes a little
    torch.testing.assert_close(
        state.probability()[own], torch.sigmoid(wanted)[own], rtol=0, atol=2e-3
    )
    torch.testing.assert_close(
        state.probability()[:, 3, 3], torch.sigmoid(wanted)[:, 3, 3], rtol=0, atol=1e-5
    )


def test_further_looks_at_a_cell_count_with_their_own_noise() -> None:
    prior, covariance = mixed(1, 12, 14), covariance_of(12, 14, 0.0, 0.0)
    values, stds = (0.62, 0.5, 0.7), (0.5, 0.3, 0.4)
    looks = [
        looked((1, 12, 14), {(3, 3): value}, std)
        for value, std in zip(values, stds, strict=True)
    ]
    state = after(Classes(), prior, covariance, *looks)
    log_odds = float(state.log_odds[0, 3, 3])
    for sign, look in zip((1, -1), state.per_class, strict=True):
        own = [torch.full(prior.shape, value).double() for value in values]
        scores = np.array(
            [float(look.prior.to_normal(value)[0][0, 3, 3]) for value in own]
        )
        density = (
            sum(float(look.prior.log_prob(value)[0, 3, 3]) for value in own)
            - stats.norm.logpdf(scores).sum()
        )
        noisy = stats.multivariate_normal(np.zeros(3), 1 + np.diag(np.square(stds)))
        log_odds += sign * (density + noisy.logpdf(scores))
    assert float(torch.logit(state.probability()[0, 3, 3])) == pytest.approx(
        log_odds, abs=1e-3
    )


def test_strength_and_length_of_ones_own_go_before_those_of_the_law() -> None:
    prior, covariance, sensed = (
        even(2, 12, 14),
        covariance_of(12, 14, 1.5, 0.3),
        LOOKS[0],
    )
    plain = after(Classes(), prior, covariance, sensed)
    strong = after(Classes(strength=0.8), prior, covariance, sensed)
    assert torch.equal(
        strong.p_first,
        after(Classes(), prior, covariance_of(12, 14, 1.5, 0.8), sensed).p_first,
    )
    beside = (strong.p_first - 0.5).abs()[:, 2, 3] - (plain.p_first - 0.5).abs()[
        :, 2, 3
    ]
    assert bool((beside > 0.05).all())
    short = after(Classes(0.6), prior, covariance, sensed)
    assert torch.equal(
        short.copula.mean,
        after(Classes(), prior, covariance_of(12, 14, 0.6, 0.3), sensed).copula.mean,
    )
    narrow = after(Classes(window=1), prior, covariance, *LOOKS)
    assert not torch.equal(
        narrow.copula.mean, after(Classes(), prior, covariance, *LOOKS).copula.mean
    )


def test_a_fitted_strength_counts_up_to_the_critical_one() -> None:
    prior, covariance, sensed = (
        even(2, 12, 14),
        covariance_of(12, 14, strength=2.26),
        LOOKS[0],
    )
    found = after(Classes(), prior, covariance, sensed).p_first
    assert torch.equal(
        found, after(Classes(strength=0.88), prior, covariance, sensed).p_first
    )
    assert not torch.equal(
        found, after(Classes(strength=2.26), prior, covariance, sensed).p_first
    )


def test_what_is_known_is_an_episodes_own() -> None:
    prior, covariance = mixed(3, 30, 40), covariance_of(30, 40)
    generator = torch.Generator().manual_seed(4)
    looks = []
    for step in range(4):
        found = torch.full(prior.shape, torch.nan, dtype=torch.float64)
        for own in range(3):
            # Of other sizes in other episodes, and nothing new in some.
            if (own + step) % 3:
                row, column = 3 + 7 * own + step, 2 + 11 * own + step
                block = (
                    torch.rand(2 + own, 3, generator=generator, dtype=torch.float64)
                    .mul(1.3)
                    .clamp(max=1)
                )
                found[own, row : row + 2 + own, column : column + 3] = block
        looks.append(Measurement(traversability=found, std=torch.full_like(found, 0.1)))
    state = after(Classes(window=12), prior, covariance, *looks)
    for own in range(3):
        kept = torch.tensor([own])
        alone = after(
            Classes(window=12),
            prior.select(kept),
            covariance,
            *(each.select(kept) for each in looks),
        )
        chosen = Classes().select(state, kept)
        assert torch.equal(alone.labels, chosen.labels)
        torch.testing.assert_close(alone.p_first, chosen.p_first, rtol=0, atol=1e-9)
        torch.testing.assert_close(
            alone.copula.mean, chosen.copula.mean, rtol=0, atol=1e-9
        )


def test_an_update_changes_nothing_that_it_was_given() -> None:
    state = after(Classes(), mixed(2, 12, 14), covariance_of(12, 14), LOOKS[0])
    kept = state.clone()
    Classes().update(state, LOOKS[1], mixed(2, 12, 14, seed=2))
    for name in ("p_first", "labels", "density", "sweeps", "log_odds"):
        assert torch.equal(getattr(state, name), getattr(kept, name))
    assert torch.equal(state.copula.mean, kept.copula.mean)


def test_observed_cells_keep_their_traversability_whatever_their_class() -> None:
    prior, covariance = even(1, 12, 14), covariance_of(12, 14)
    values = {(3, 3): 0.62, (3, 4): 0.6, (5, 6): 0.66}
    state = after(Classes(), prior, covariance, looked((1, 12, 14), values, std=1e-3))
    assert 0.02 < float(state.probability()[0, 3, 3]) < 0.98
    found = Classes().distribution(state)
    for place, value in values.items():
        for level in (0.1, 0.5, 0.9):
            assert float(found.quantile(level)[0][place]) == pytest.approx(
                value, abs=0.01
            )


def test_quantiles_of_some_cells_are_those_of_the_distribution() -> None:
    state = after(Classes(), mixed(2, 12, 14), covariance_of(12, 14), *LOOKS)
    cells = torch.zeros(2, 12, 14, dtype=torch.bool)
    cells[0, 2:7, 2:12], cells[1, 9:12, 3:9] = True, True
    found, wanted = Classes().at(state, cells), Classes().distribution(state).at(cells)
    assert found.shape == (1, int(cells.sum()))
    torch.testing.assert_close(found.mean(), wanted.mean(), rtol=0, atol=0.01)
    torch.testing.assert_close(found.cvar(0.8), wanted.cvar(0.8), rtol=0, atol=0.01)


def test_only_cells_of_which_something_is_learnt_change() -> None:
    prior, covariance = even(1, 40, 40), covariance_of(40, 40)
    before = Classes().init(prior, covariance)
    state = Classes().update(before, looked((1, 40, 40), {(5, 5): 0.9, (5, 6): 0.95}))
    changed = Classes().changed(before, state)
    assert bool(changed[0, 4:8, 4:8].all())
    assert not bool(changed[0, 20:].any())
    assert not bool(changed[0, :, 20:].any())
    assert float(state.probability()[0, 5, 7]) > 0.6
    assert not bool(Classes().changed(state, state).any())
    assert bool(
        Classes()
        .changed(state, Classes().update(state, LOOKS_NOTHING, mixed(1, 40, 40)))
        .all()
    )


LOOKS_NOTHING = looked((1, 40, 40), {})


def test_sensed_traversability_is_kept_under_a_new_prediction() -> None:
    prior, covariance = even(2, 12, 14), covariance_of(12, 14)
    new = mixed(2, 12, 14)
    values = {(3, 3): 0.95, (3, 4): 0.93, (4, 3): 0.9, (5, 10): 0.3, (5, 11): 1.0}
    sensed = looked((2, 12, 14), values)
    changed = Classes().update(
        after(Classes(), prior, covariance, sensed), looked((2, 12, 14), {}), new
    )
    wanted = after(Classes(), new, covariance, sensed)
    for one, other in zip(changed.per_class, wanted.per_class, strict=True):
        torch.testing.assert_close(
            one.lower, other.lower, rtol=0, atol=1e-3, equal_nan=True
        )
    torch.testing.assert_close(changed.density, wanted.density, rtol=0, atol=1e-2)
    torch.testing.assert_close(
        changed.probability(), wanted.probability(), rtol=0, atol=0.25
    )
    assert (changed.probability() - wanted.probability()).abs().mean() < 0.03
    torch.testing.assert_close(
        changed.copula.mean, wanted.copula.mean, rtol=0, atol=0.1
    )


def test_of_a_new_prediction_the_cells_count_that_are_others() -> None:
    prior, covariance = mixed(2, 12, 14), covariance_of(12, 14)
    anew = torch.zeros(2, 12, 14, dtype=torch.bool)
    anew[0, :, 7:] = True
    first = after(Classes(), prior, covariance, LOOKS[0])
    state = Classes().update(
        first, looked((2, 12, 14), {}), prior.replaced(anew, even(2, 12, 14))
    )
    assert torch.equal(state.pair, torch.where(anew, 1, first.pair))
    assert torch.equal(state.log_odds, torch.where(anew, 0.0, first.log_odds))
    # In the other episode, and of seen ground far from λ that was scored anew, all is
    # as it was.
    for name in ("labels", "p_first", "density"):
        assert torch.equal(getattr(state, name)[1], getattr(first, name)[1])
    assert torch.equal(state.sweeps[1], first.sweeps[1])
    assert torch.equal(state.copula.mean[1], first.copula.mean[1])
    assert torch.equal(
        Classes().changed(first, state) | anew, Classes().changed(first, state)
    )


def test_ground_that_is_seen_later_has_patches_of_either_class() -> None:
    covariance, unseen = (
        covariance_of(12, 14),
        prediction(torch.eye(5).double()[2].view(1, 5, 1, 1).expand(1, 5, 12, 14)),
    )
    before = Classes().init(unseen, covariance)
    # Whatever the labels were of ground that could be of no pair.
    for labels in (before.labels, torch.full_like(before.labels, -1)):
        state = Classes().update(
            replace(before, labels=labels), looked((1, 12, 14), {}), even(1, 12, 14)
        )
        bits = unpacked(state.labels)
        assert (
            0.6 < float((bits[..., 1:, :] == bits[..., :-1, :]).double().mean()) < 0.9
        )
        assert float(bits.double().mean()) == pytest.approx(0.5, abs=0.1)


def test_cells_of_no_class_are_as_under_the_copula_belief() -> None:
    covariance, chosen = covariance_of(12, 14), torch.zeros(2, 12, 14, dtype=torch.bool)
    chosen[:, :, :5] = True
    unseen = TraversabilityMixture(
        *(torch.full((2, 1, 12, 14), own).double() for own in (1.0, 0.6, 0.2))
    )
    prior = choose(chosen, mixed(2, 12, 14), unseen)
    assert isinstance(prior, TraversabilityMixture)
    assert prior.group == (0, 1, 2, 3, 4, -1)
    sensed = looked((2, 12, 14), {(3, 10): 0.9, (4, 10): 1.0})
    state, plain = (
        after(Classes(), prior, covariance, sensed),
        Copula().update(Copula().init(prior, covariance), sensed),
    )
    assert torch.equal(state.pair > 0, (mixed(2, 12, 14).weights[:, 2] < 0.5) & chosen)
    assert torch.equal(state.copula.mean, plain.mean)
    found, wanted = Classes().distribution(state), Copula().distribution(plain)
    torch.testing.assert_close(
        found.cdf(0.6)[~chosen], wanted.cdf(0.6)[~chosen], rtol=0, atol=1e-9
    )
    assert torch.equal(
        Classes().at(state, ~chosen).below, Copula().at(plain, ~chosen).below
    )


def test_episodes_that_take_the_places_of_others_are_what_they_were_alone() -> None:
    belief, covariance, more = (
        Classes(),
        covariance_of(12, 14),
        LOOKS[2].select(torch.tensor([0, 0, 0])),
    )
    one = after(
        belief, mixed(3, 12, 14), covariance, LOOKS[0].select(torch.tensor([0, 0, 0]))
    )
    two = after(Classes(0.8), mixed(2, 12, 14, seed=1), covariance, LOOKS[1])
    whole, cells = (
        belief.put(one, torch.tensor([2, 0]), two),
        torch.ones(3, 12, 14, dtype=torch.bool),
    )
    for told in (
        lambda state: state,
        lambda state: belief.update(
            state, more.select(torch.arange(len(state.sweeps)))
        ),
    ):
        found = belief.at(told(whole), cells).mean().view(3, 12, 14)
        first, second = (
            belief.at(told(state), cells[: len(state.sweeps)]).mean().view(-1, 12, 14)
            for state in (one, two)
        )
        torch.testing.assert_close(
            found, torch.stack((second[1], first[1], second[0])), atol=1e-9, rtol=0
        )


def test_a_length_can_be_estimated() -> None:
    prior, covariance = even(1, 24, 24), covariance_of(24, 24, 1.5)
    scores = made.scores(covariance_of(24, 24, 0.5), 1)
    field = torch.full((1, 24, 24), torch.nan, dtype=torch.float64)
    field[:, 10:14, 4:20] = (MEANS[0] + STDS[0] * scores)[:, 10:14, 4:20].clamp(
        0.01, 0.99
    )
    sensed = Measurement(traversability=field, std=torch.full_like(field, 0.1))
    short, fixed = (
        after(Classes(length), prior, covariance, sensed)
        for length in ("estimated", "world")
    )
    assert float(short.copula.field.length) < 2.0
    assert float(fixed.copula.field.length) == 3.0


def test_fields_that_are_drawn_have_the_distribution_and_patches() -> None:
    weights = torch.zeros(1, 5, 12, 14, dtype=torch.float64)
    weights[:, 0], weights[:, 1] = 0.7, 0.3
    prior, covariance = prediction(weights), covariance_of(12, 14)
    state = after(
        Classes(),
        prior,
        covariance,
        looked((1, 12, 14), {(3, 3): 0.95, (3, 4): 0.9, (4, 3): 0.93}),
    )
    fields = Classes().sample_fields(state, 250, (7,))
    found = Classes().distribution(state)
    for place in ((3, 3), (3, 5), (8, 9), (11, 13)):
        for level in (0.4, 0.6, 0.8):
            share = float((fields[0][:, place[0], place[1]] <= level).double().mean())
            assert share == pytest.approx(float(found.cdf(level)[0][place]), abs=0.07)
    one = Classes().sample_fields(state, 3, (7,))
    both = Classes().sample_fields(
        Classes().select(state, torch.tensor([0, 0])), 3, (8, 7)
    )
    torch.testing.assert_close(both[1:], one)
    assert not torch.equal(both[:1], one)
