import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import entropy, mannwhitneyu

from benchnav.models.quality.uncertainty import ErrorRanking, mutual_information, predictive_entropy


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cell(*probabilities: float) -> torch.Tensor:
    return torch.tensor(probabilities, dtype=torch.float32).view(1, -1, 1, 1)


def test_entropy_is_zero_for_certainty_and_greatest_for_none() -> None:
    assert float(predictive_entropy(cell(0, 1, 0, 0))) == 0
    assert float(predictive_entropy(cell(0.25, 0.25, 0.25, 0.25))) == pytest.approx(math.log(4))


def test_entropy_is_that_of_scipy() -> None:
    probabilities = torch.randn(2, 5, 3, 4, generator=generator(), dtype=torch.float64).softmax(1)
    expected = torch.from_numpy(entropy(probabilities.numpy(), axis=1))
    torch.testing.assert_close(predictive_entropy(probabilities), expected)


def test_members_that_agree_share_no_doubt_and_sure_ones_that_differ_have_nothing_else() -> None:
    unsure = cell(0.5, 0.5, 0)
    assert float(mutual_information(torch.stack([unsure, unsure]))) == 0
    differ = torch.stack([cell(1, 0, 0), cell(0, 1, 0), cell(0, 0, 1)])
    assert float(mutual_information(differ)) == pytest.approx(math.log(3))
    assert mutual_information(differ).dtype == differ.dtype


def test_rounding_makes_no_information_negative() -> None:
    one = torch.randn(1, 1, 10, 40, 40, generator=generator(), dtype=torch.float64).softmax(2)
    information = mutual_information(one.expand(7, -1, -1, -1, -1))
    assert 0 <= float(information.min()) <= float(information.max()) < 1e-12


def test_mutual_information_is_the_mean_divergence_from_the_mean() -> None:
    members = torch.randn(4, 2, 5, 3, 3, generator=generator(), dtype=torch.float64).softmax(2)
    expected = entropy(members.numpy(), members.mean(0, keepdim=True).numpy(), axis=2).mean(0)
    torch.testing.assert_close(mutual_information(members), torch.from_numpy(expected))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31), members=st.integers(1, 4), sharpness=st.floats(0.1, 50))
def test_mutual_information_lies_between_nothing_and_the_entropy(
    seed: int, members: int, sharpness: float
) -> None:
    drawn = (sharpness * torch.randn(members, 1, 3, 2, 2, generator=generator(seed))).softmax(2)
    information = mutual_information(drawn)
    assert bool((information >= 0).all())
    assert bool((information <= math.log(min(members, 3)) + 1e-6).all())
    assert bool((information <= predictive_entropy(drawn.mean(0)) + 1e-6).all())


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_the_ranking_of_errors_is_the_statistic_of_mann_and_whitney(scale: float) -> None:
    wrong = torch.rand(4000, generator=generator()) < 0.2
    score = scale * (torch.randn(4000, generator=generator(1)) + wrong).exp()
    score[::7] = 0  # ties
    ranking = ErrorRanking()
    for part in (slice(0, 1500), slice(1500, None)):
        ranking.update(score[part], wrong[part])
    exact = mannwhitneyu(score[wrong].numpy(), score[~wrong].numpy()).statistic
    exact /= int(wrong.sum()) * int((~wrong).sum())
    assert float(ranking.compute()) == pytest.approx(exact, abs=1e-4)
    assert exact > 0.6


def test_a_ranking_is_right_wrong_or_blind() -> None:
    wrong = torch.tensor([[True, False], [False, True]])
    for score, expected in (
        (torch.tensor([[2.0, 1.0], [0.0, 3.0]]), 1.0),
        (torch.tensor([[0.0, 1.0], [2.0, -0.0]]), 0.0),
        (torch.ones(2, 2), 0.5),
    ):
        ranking = ErrorRanking()
        ranking.update(score, wrong)
        assert float(ranking.compute()) == expected


def test_a_score_under_zero_by_rounding_is_of_the_surest() -> None:
    ranking = ErrorRanking()
    ranking.update(torch.tensor([-1e-6, 1e-8]), torch.tensor([False, True]))
    assert float(ranking.compute()) == 1


def test_without_errors_there_is_no_ranking() -> None:
    ranking = ErrorRanking()
    ranking.update(torch.rand(5, generator=generator()), torch.zeros(5, dtype=torch.bool))
    assert math.isnan(float(ranking.compute()))
