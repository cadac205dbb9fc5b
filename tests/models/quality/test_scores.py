import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import ndtr, ndtri
from scipy.stats import entropy, mannwhitneyu
from torch import Tensor
from torchmetrics.functional.classification import multiclass_calibration_error

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, QuantileDistribution
from benchnav.core.tables import to_markdown
from benchnav.datagen.files.create import create
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.load import load_recipe
from benchnav.models.quality.measure import evaluate
from benchnav.models.quality.report import (
    LOOK_ALIKES,
    quality_csv,
    quality_json,
    quality_table,
)
from benchnav.models.quality.scores import (
    ErrorRanking,
    LookAlikeQuality,
    LookAlikeTally,
    ReliabilityCurve,
    brier_score,
    calibration_error,
    coverage,
    mutual_information,
    pinball_loss_and_width,
    pit,
    pit_counts,
    predictive_entropy,
    sparsification,
    tail_rate,
)
from tests.factories import draw
from tests.models.stub import ColourModel


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def single(
    mean: float, std: float, shape: tuple[int, int] = (200, 200)
) -> TraversabilityMixture:
    ones = torch.ones(1, *shape, dtype=torch.float64)
    return TraversabilityMixture(ones, mean * ones, std * ones)


def random_probabilities(
    maps: int = 3, classes: int = 4, size: int = 20
) -> torch.Tensor:
    return (
        3
        * torch.randn(
            maps, classes, size, size, generator=generator(), dtype=torch.float64
        )
    ).softmax(1)


@settings(max_examples=25, deadline=None)
@given(
    means=st.lists(st.floats(-0.5, 1.5), min_size=3, max_size=3),
    stds=st.lists(st.floats(0.03, 0.5), min_size=3, max_size=3),
    weight=st.floats(0, 1),
    observed=st.floats(0, 1),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_crps_is_the_integral_that_defines_it(
    means: list[float],
    stds: list[float],
    weight: float,
    observed: float,
    dtype: torch.dtype,
) -> None:
    weights = [weight, (1 - weight) / 2, (1 - weight) / 2]
    values = torch.tensor([weights, means, stds], dtype=dtype)
    mixture = TraversabilityMixture(*values[:, :, None, None])

    def gap(x: float) -> float:
        below = sum(
            w * ndtr((x - m) / s)
            for w, m, s in zip(*values.double().tolist(), strict=True)
        )
        return float(below - (observed <= x)) ** 2

    points = sorted({observed, *(m for m in means if 0 < m < 1)})
    exact = quad(gap, 0, 1, points=points, limit=200, epsabs=1e-8)[0]
    score = mixture.crps(torch.tensor([[observed]], dtype=torch.float64))
    assert float(score) == pytest.approx(exact, abs=1e-5)


def test_crps_of_certain_predictions_is_their_distance() -> None:
    mixture, observed = (
        single(0.3, 0.0, (1, 3)),
        torch.tensor([[0.0, 0.3, 1.0]], dtype=torch.float64),
    )
    expected = torch.tensor([[0.3, 0.0, 0.7]], dtype=torch.float64)
    torch.testing.assert_close(mixture.crps(observed), expected, rtol=0, atol=0.02)


def test_pit_is_the_cdf_inside_and_within_the_atoms_at_the_ends() -> None:
    mixture, observed = (
        single(0.5, 0.4, (1, 2000)),
        torch.zeros(1, 2000, dtype=torch.float64),
    )
    atom = float(ndtr(-0.5 / 0.4))
    for value, low, high in ((0.0, 0.0, atom), (1.0, 1 - atom, 1.0)):
        drawn = pit(mixture, observed + value, generator())
        assert low <= float(drawn.min()) < low + 0.01
        assert high - 0.01 < float(drawn.max()) <= high
    inside = pit(mixture, observed + 0.7, generator())
    torch.testing.assert_close(inside, torch.full_like(inside, ndtr(0.5)))


def test_tail_rate_counts_what_lies_under_the_var() -> None:
    mixture = single(0.5, 0.15)
    observed = draw(single(0.45, 0.25), 1, generator())[0]
    share = float((observed < mixture.var(0.9)).double().mean())
    assert tail_rate(pit(mixture, observed, generator(1))) == pytest.approx(
        share, abs=1e-9
    )
    assert share > 0.2


def test_a_prediction_too_narrow_covers_too_little() -> None:
    transformed = pit(
        single(0.5, 0.05), draw(single(0.5, 0.15), 1, generator())[0], generator(1)
    )
    assert coverage(transformed) < 0.5


def test_pit_counts_place_both_ends() -> None:
    counts = pit_counts(torch.tensor([0.0, 0.049, 0.051, 0.999, 1.0]))
    assert counts.tolist() == [2, 1, *[0] * 16, 0, 2]


def test_the_calibration_error_of_the_curve_is_that_of_torchmetrics() -> None:
    probabilities = random_probabilities()
    classes = torch.randint(0, 4, (3, 20, 20), generator=generator(1))
    curve = ReliabilityCurve()
    for one, truth in zip(probabilities.split(2), classes.split(2), strict=True):
        curve.update(one, truth)
    cells, confidence, accuracy = curve.compute()
    expected = multiclass_calibration_error(
        probabilities, classes, num_classes=4, n_bins=15, norm="l1"
    )
    assert calibration_error(curve.compute()) == pytest.approx(
        float(expected), abs=1e-6
    )
    assert int(cells.sum()) == classes.numel()
    edges = torch.arange(16) / 15
    filled = cells > 0
    assert bool(((confidence >= edges[:-1]) & (confidence < edges[1:]))[filled].all())
    assert float((cells * accuracy).sum()) == float(
        (probabilities.argmax(1) == classes).sum()
    )


def test_certainty_falls_in_the_last_bin() -> None:
    curve = ReliabilityCurve()
    curve.update(
        torch.tensor([1.0, 0.0]).view(1, 2, 1, 1),
        torch.zeros(1, 1, 1, dtype=torch.int64),
    )
    assert curve.compute()[:, -1].tolist() == [1, 1, 1]


def test_the_brier_score_is_the_squared_distance_to_the_truth() -> None:
    probabilities = random_probabilities()
    classes = torch.randint(0, 4, (3, 20, 20), generator=generator(1))
    there = torch.nn.functional.one_hot(classes, 4).movedim(-1, 1)
    torch.testing.assert_close(
        brier_score(probabilities, classes), (probabilities - there).square().sum(1)
    )


def cell(*probabilities: float) -> torch.Tensor:
    return torch.tensor(probabilities, dtype=torch.float32).view(1, -1, 1, 1)


def test_entropy_is_zero_for_certainty_and_greatest_for_none() -> None:
    assert float(predictive_entropy(cell(0, 1, 0, 0))) == 0
    assert float(predictive_entropy(cell(0.25, 0.25, 0.25, 0.25))) == pytest.approx(
        math.log(4)
    )


def test_entropy_is_that_of_scipy() -> None:
    probabilities = torch.randn(
        2, 5, 3, 4, generator=generator(), dtype=torch.float64
    ).softmax(1)
    expected = torch.from_numpy(entropy(probabilities.numpy(), axis=1))
    torch.testing.assert_close(predictive_entropy(probabilities), expected)


def test_rounding_makes_no_information_negative() -> None:
    one = torch.randn(
        1, 1, 10, 40, 40, generator=generator(), dtype=torch.float64
    ).softmax(2)
    information = mutual_information(one.expand(7, -1, -1, -1, -1))
    assert 0 <= float(information.min()) <= float(information.max()) < 1e-12


def test_mutual_information_is_the_mean_divergence_from_the_mean() -> None:
    members = torch.randn(
        4, 2, 5, 3, 3, generator=generator(), dtype=torch.float64
    ).softmax(2)
    expected = entropy(
        members.numpy(), members.mean(0, keepdim=True).numpy(), axis=2
    ).mean(0)
    torch.testing.assert_close(mutual_information(members), torch.from_numpy(expected))


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**31), members=st.integers(1, 4), sharpness=st.floats(0.1, 50)
)
def test_mutual_information_lies_between_nothing_and_the_entropy(
    seed: int, members: int, sharpness: float
) -> None:
    drawn = (
        sharpness * torch.randn(members, 1, 3, 2, 2, generator=generator(seed))
    ).softmax(2)
    information = mutual_information(drawn)
    assert bool((information >= 0).all())
    assert bool((information <= math.log(min(members, 3)) + 1e-6).all())
    assert bool((information <= predictive_entropy(drawn.mean(0)) + 1e-6).all())


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_the_ranking_of_errors_is_the_statistic_of_mann_and_whitney(
    scale: float,
) -> None:
    wrong = torch.rand(4000, generator=generator()) < 0.2
    score = scale * (torch.randn(4000, generator=generator(1)) + wrong).exp()
    score[::7] = 0  # ties
    ranking = ErrorRanking()
    for part in (slice(0, 1500), slice(1500, None)):
        ranking.update(score[part], wrong[part])
    exact = mannwhitneyu(score[wrong].numpy(), score[~wrong].numpy()).statistic
    exact /= int(wrong.sum()) * int((~wrong).sum())
    assert ranking.compute()[1] == pytest.approx(exact, abs=1e-4)
    assert exact > 0.6


def test_a_score_under_zero_by_rounding_is_of_the_surest() -> None:
    ranking = ErrorRanking()
    ranking.update(torch.tensor([-1e-6, 1e-8]), torch.tensor([False, True]))
    assert ranking.compute()[1] == 1


def test_without_errors_there_is_no_ranking() -> None:
    ranking = ErrorRanking()
    ranking.update(
        torch.rand(5, generator=generator()), torch.zeros(5, dtype=torch.bool)
    )
    assert math.isnan(ranking.compute()[1])


ALIKE = [(0, 2), (1,), (0, 2), (3,)]  # the first and the third of four classes


def tally(
    probabilities: Tensor, class_id: Tensor, alike: list[tuple[int, ...]] = ALIKE
) -> LookAlikeQuality:
    """Of cells in a row: probabilities [N, C] and classes [N]."""
    counted = LookAlikeTally(alike)
    for part in torch.arange(len(class_id)).tensor_split(3):
        counted.add(probabilities[part].T[None, :, None], class_id[part][None, None])
    return counted.quality()


def drawn(cells: int, share: Tensor) -> Tensor:
    """Classes of cells that are the first of two with probability `share` [N], else the
    third.
    """
    first = torch.rand(cells, generator=torch.Generator().manual_seed(0)) < share
    return torch.where(first, 0, 2)


def test_what_is_right_but_for_look_alikes_is_right_when_they_are_merged() -> None:
    class_id = torch.tensor([0, 2, 0, 1, 3, 3])
    found = torch.tensor([2, 0, 0, 1, 3, 1])
    probabilities = torch.nn.functional.one_hot(found, 4).float()
    quality = tally(probabilities, class_id)
    assert quality.look_alike_accuracy == pytest.approx(5 / 6)
    # Intersection over union: look-alikes 3/3, the second 1/2, the fourth 1/2.
    assert quality.look_alike_miou == pytest.approx((1 + 1 / 2 + 1 / 2) / 3)


def test_look_alikes_that_together_weigh_most_are_found() -> None:
    quality = tally(
        torch.tensor([[0.3, 0.4, 0.3, 0.0]] * 6), torch.tensor([0, 2, 0, 2, 0, 2])
    )
    assert quality.look_alike_accuracy == 1


def test_of_two_look_alikes_one_half_each_is_right() -> None:
    share = torch.full((4000,), 0.5)
    class_id = drawn(4000, share)
    fair = torch.tensor([0.35, 0.2, 0.35, 0.1]).expand(4000, -1)
    quality = tally(fair, class_id)
    assert quality.look_alike_share_error == pytest.approx(0, abs=1e-6)
    assert quality.look_alike_share_ece < 0.03
    sure = torch.tensor([0.7, 0.2, 0.0, 0.1]).expand(4000, -1)
    quality = tally(sure, class_id)
    assert quality.look_alike_share_error == pytest.approx(0.5)
    assert quality.look_alike_share_ece == pytest.approx(0.5, abs=0.03)


def test_shares_other_than_one_half_may_be_calibrated() -> None:
    share = torch.where(torch.arange(20_000) % 2 == 0, 0.8, 0.3)
    class_id = drawn(20_000, share)
    told = torch.stack(
        [0.6 * share, torch.full_like(share, 0.4), 0.6 * (1 - share), 0 * share], 1
    )
    quality = tally(told, class_id)
    assert quality.look_alike_share_ece < 0.02
    assert quality.look_alike_share_error == pytest.approx(0.25, abs=1e-5)
    assert quality.look_alike_accuracy == 1


def test_cells_of_other_classes_and_without_any_share_count_as_nothing_and_as_one_half() -> (
    None
):
    probabilities = torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.9, 0.1, 0.0, 0.0]])
    quality = tally(probabilities, torch.tensor([0, 1]))
    assert quality.look_alike_share_error == 0
    none = tally(probabilities, torch.tensor([1, 3]))
    assert math.isnan(none.look_alike_share_error)
    assert math.isnan(none.look_alike_share_ece)


def test_of_three_look_alikes_a_third_each_is_right() -> None:
    alike = [(0, 1, 2)] * 3
    probabilities = torch.full((9, 3), 1 / 3)
    quality = tally(probabilities, torch.arange(9) % 3, alike)
    assert quality.look_alike_share_error == pytest.approx(0, abs=1e-6)
    assert quality.look_alike_accuracy == 1


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> TerrainDataset:
    """Maps of ten classes of which the first four are of two colours."""
    recipe = load_recipe("tiny-v1")
    colours = [item.colour for item in recipe.classes]
    classes = tuple(
        replace(item, colour=colours[place // 2 if place < 4 else place])
        for place, item in enumerate(recipe.classes)
    )
    splits = {
        name: replace(recipe.splits[name], maps=2) for name in ("test/std", "test/hs")
    }
    path = tmp_path_factory.mktemp("look_alikes") / "look_alikes.h5"
    for _ in create(replace(recipe, classes=classes, splits=splits), path):
        pass
    return TerrainDataset(path)


def test_a_dataset_with_look_alikes_is_measured_with_them_merged(
    dataset: TerrainDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = ColourModel()
    model.colours = torch.tensor(
        [item.colour for item in dataset.recipe.classes]
    ).float()
    qualities = dict(evaluate(model, dataset))
    (measured,) = qualities["test/std"].classes
    assert measured.look_alikes is not None
    assert measured.look_alikes.look_alike_accuracy > measured.accuracy
    # one colour, one probability
    assert measured.look_alikes.look_alike_share_error == pytest.approx(0, abs=1e-6)
    row = json.loads(quality_json({}, qualities))["splits"]["test/std"]
    assert {name: row[name] for name in LOOK_ALIKES} == pytest.approx(
        vars(measured.look_alikes)
    )
    assert f"{measured.look_alikes.look_alike_accuracy:.6g}" in quality_csv(qualities)
    page = to_markdown(quality_table("", qualities, all_columns=True))
    assert "mIoU look-alikes=1" in page
    assert (
        len({row.count("|") for row in page.splitlines() if row.startswith("|")}) == 1
    )


def test_a_dataset_without_look_alikes_has_no_such_numbers(
    dataset: TerrainDataset, tmp_path: Path
) -> None:
    plain = load_recipe("tiny-v1")
    splits = {"test/std": replace(plain.splits["test/std"], maps=1)}
    for _ in create(replace(plain, splits=splits), tmp_path / "plain.h5"):
        pass
    qualities = dict(evaluate(ColourModel(), TerrainDataset(tmp_path / "plain.h5")))
    assert qualities["test/std"].classes[0].look_alikes is None
    assert "look_alikes" not in to_markdown(
        quality_table("", qualities, all_columns=True)
    )
    assert not {*LOOK_ALIKES, "look_alikes"} & set(
        json.loads(quality_json({}, qualities))["splits"]["test/std"]
    )
    assert "look-alike" not in quality_csv(qualities)


def test_the_pinball_loss_is_that_of_the_closed_form_quantiles() -> None:
    mixture = single(0.5, 0.05, (1, 201))
    observed = torch.linspace(0.2, 0.8, 201, dtype=torch.float64)[None]
    loss, width = pinball_loss_and_width(mixture, observed)
    levels = np.arange(1, 21) / 100
    gap = observed.numpy()[0][:, None] - (0.5 + 0.05 * ndtri(levels))
    exact = np.where(gap >= 0, levels * gap, (levels - 1) * gap).mean(1)
    np.testing.assert_allclose(loss[0].numpy(), exact, atol=1e-6)
    np.testing.assert_allclose(width.numpy(), 2 * ndtri(0.95) * 0.05, atol=1e-6)


def test_the_pinball_loss_is_least_where_the_lower_fifth_is_right_and_blind_to_the_rest() -> (
    None
):
    drawn = torch.rand(1, 4000, generator=generator(), dtype=torch.float64)

    def loss(values: Tensor) -> float:
        knots = values.view(-1, 1, 1).expand(-1, 1, 4000).contiguous()
        return float(
            pinball_loss_and_width(QuantileDistribution(knots, LEVELS), drawn)[0].mean()
        )

    levels = torch.tensor(LEVELS, dtype=torch.float64)
    right = loss(torch.from_numpy(np.quantile(drawn.numpy(), LEVELS)))
    assert right < loss(levels + 0.02 * (1 - levels))
    assert right < loss(levels * 0.9)
    upper = torch.where(levels > 0.21, 0.6 + 0.4 * levels, levels)
    assert loss(upper) == pytest.approx(loss(levels), abs=1e-12)
    # Of uniform λ the expected loss at a level u is u(1 − u)/2.
    assert loss(levels) == pytest.approx(
        np.mean([u * (1 - u) / 2 for u in np.arange(1, 21) / 100]), rel=0.05
    )


def test_tail_rates_are_counted_at_any_level() -> None:
    transformed = torch.linspace(0, 1, 1001)
    assert [tail_rate(transformed, level) for level in (0.8, 0.95)] == pytest.approx(
        [0.2, 0.05], abs=2e-3
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 300), st.integers(0, 2**31))
def test_sparsification_is_a_direct_sort(cells: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    error = random.random(cells)
    uncertainty = (
        np.geomspace(0.01, 1.0, cells)[random.permutation(cells)]
        if cells > 1
        else np.ones(1)
    )
    if cells > 300 or np.diff(np.sort(np.log(uncertainty))).min(initial=1) < 2e-3:
        uncertainty = uncertainty**3
    curves = sparsification(
        torch.from_numpy(error), torch.from_numpy(uncertainty)
    ).numpy()
    for row, order in zip(
        curves, (np.argsort(uncertainty), np.argsort(error)), strict=True
    ):
        by_hand = [error[order[: left + 1]].mean() for left in range(cells)]
        np.testing.assert_allclose(row, by_hand, atol=1e-12)


def test_pit_is_drawn_within_any_atom() -> None:
    levels = torch.tensor(LEVELS, dtype=torch.float64)
    quantiles = torch.where((levels >= 0.1) & (levels <= 0.6), 0.3, 0.3 + levels - 0.6)
    quantiles = torch.where(levels < 0.1, 3 * levels, quantiles).clamp(0, 1)
    law = QuantileDistribution(
        quantiles.view(-1, 1, 1).expand(-1, 200, 200).contiguous()
    )
    observed = law.from_normal(
        torch.randn(200, 200, generator=generator(3), dtype=torch.float64)
    )
    assert float((observed == quantiles[30]).double().mean()) == pytest.approx(
        0.5, abs=0.01
    )
    transformed = pit(law, observed, generator(1))
    assert coverage(transformed) == pytest.approx(0.9, abs=0.006)
    assert tail_rate(transformed) == pytest.approx(0.1, abs=0.006)
    counts = pit_counts(transformed)
    assert 1800 < int(counts.min()) <= int(counts.max()) < 2200
