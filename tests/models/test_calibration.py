import math

import pytest
import torch
from scipy.special import ndtr

from benchnav.datagen.store import TerrainDataset
from benchnav.errors import CheckpointError, DatasetError
from benchnav.mixture import TraversabilityMixture
from benchnav.models.calibration import coverage, crps, evaluate, measure, measure_latent, pit, tail_rate
from benchnav.models.predictor import FusedModel, Oracle
from benchnav.terrain import Observation

from .support import linear_table, make_terrain


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def single(mean: float, std: float, shape: tuple[int, int] = (200, 200)) -> TraversabilityMixture:
    ones = torch.ones(1, *shape, dtype=torch.float64)
    return TraversabilityMixture(ones, mean * ones, std * ones)


def test_crps_is_the_closed_form_of_a_gaussian_far_from_the_bounds() -> None:
    mixture = single(0.5, 0.05, (1, 101))
    observed = torch.linspace(0.3, 0.7, 101, dtype=torch.float64)[None]
    z = ((observed - 0.5) / 0.05).numpy()
    density = torch.exp(-0.5 * torch.from_numpy(z) ** 2) / math.sqrt(2 * math.pi)
    exact = 0.05 * (torch.from_numpy(z * (2 * ndtr(z) - 1)) + 2 * density - 1 / math.sqrt(math.pi))
    torch.testing.assert_close(crps(mixture, observed), exact, rtol=0, atol=1e-5)


def test_crps_of_clipped_mixtures_agrees_with_sampling() -> None:
    weights = torch.tensor([0.6, 0.4], dtype=torch.float64).view(2, 1, 1).expand(2, 1, 4)
    means = torch.tensor([0.9, 0.1], dtype=torch.float64).view(2, 1, 1).expand(2, 1, 4)
    mixture = TraversabilityMixture(weights, means, torch.full((2, 1, 4), 0.2, dtype=torch.float64))
    observed = torch.tensor([[0.0, 0.3, 0.9, 1.0]], dtype=torch.float64)
    first, second = mixture.sample(400_000, generator()), mixture.sample(400_000, generator(1))
    sampled = (first - observed).abs().mean(0) - 0.5 * (first - second).abs().mean(0)
    torch.testing.assert_close(crps(mixture, observed), sampled, rtol=0, atol=2e-3)


@pytest.mark.parametrize("mean", [0.5, 0.95, 0.05, 1.2])
def test_what_is_drawn_from_the_prediction_is_calibrated(mean: float) -> None:
    mixture = single(mean, 0.15)
    transformed = pit(mixture, mixture.sample(1, generator())[0], generator(1))
    assert coverage(transformed) == pytest.approx(0.9, abs=0.006)
    assert tail_rate(transformed) == pytest.approx(0.1, abs=0.006)
    assert float(transformed.mean()) == pytest.approx(0.5, abs=0.006)


def test_tail_rate_counts_what_lies_under_the_var() -> None:
    mixture = single(0.5, 0.15)
    observed = single(0.45, 0.25).sample(1, generator())[0]
    share = float((observed < mixture.var(0.9)).double().mean())
    assert tail_rate(pit(mixture, observed, generator(1))) == pytest.approx(share, abs=1e-9)
    assert share > 0.2


def test_a_prediction_too_narrow_covers_too_little() -> None:
    transformed = pit(single(0.5, 0.05), single(0.5, 0.15).sample(1, generator())[0], generator(1))
    assert coverage(transformed) < 0.5


def test_the_oracle_is_calibrated_and_has_no_class_metrics() -> None:
    terrain = make_terrain(batch=20, size=32)
    quality = measure(Oracle(), [terrain], generator(1))
    figures = quality.traversability
    assert quality.maps == 20
    assert quality.classes == ()
    assert figures.rmse_expected == 0
    assert figures.coverage == pytest.approx(0.9, abs=0.01)
    assert figures.tail_rate == pytest.approx(0.1, abs=0.01)
    truth = Oracle().predict_terrain(terrain)
    by_hand = -truth.log_prob(terrain.traversability).mean()
    assert figures.nll == pytest.approx(float(by_hand), rel=1e-5)
    error = (truth.mean() - terrain.traversability).square().mean().sqrt()
    assert figures.rmse_observed == pytest.approx(float(error), rel=1e-5)


def test_class_metrics_are_those_counted_by_hand() -> None:
    class Half:
        """Says class 0 with certainty 0.8 everywhere; classes are 0 in the left half, else 1."""

        class_names = ("a", "b", "c")

        def predict(self, observation: Observation) -> TraversabilityMixture:
            share = torch.tensor([0.8, 0.15, 0.05]).view(1, 3, 1, 1)
            weights = share.expand(len(observation.rgb), 3, *observation.grid.shape).clone()
            return TraversabilityMixture(weights, weights, torch.full_like(weights, 0.1))

    terrain = make_terrain()
    terrain.class_id[:] = 0
    terrain.class_id[:, :, 8:] = 1
    chunks = [make_terrain(), make_terrain()]
    for chunk in chunks:
        chunk.class_id[:] = terrain.class_id
    (classes,) = measure(Half(), chunks, generator()).classes
    assert classes.accuracy == pytest.approx(0.5)
    assert classes.miou == pytest.approx((0.5 + 0) / 2)
    assert classes.ece == pytest.approx(0.3, abs=1e-4)
    left, right = 0.2**2 + 0.15**2 + 0.05**2, 0.8**2 + 0.85**2 + 0.05**2
    assert classes.brier == pytest.approx((left + right) / 2)


def test_latent_metrics_read_each_cell_with_its_own_class() -> None:
    terrain, table = make_terrain(batch=4), linear_table()
    mean, std = table.lookup(terrain.slope_deg)
    own = terrain.class_id[:, None]
    perfect = make_terrain(batch=4)
    perfect.traversability_mean[:] = mean.gather(1, own)[:, 0]
    perfect.traversability_std[:] = std.gather(1, own)[:, 0]
    exact = measure_latent(table, perfect)
    assert exact["latent_rmse"] == pytest.approx(0, abs=1e-6)
    assert exact["noise_error"] == pytest.approx(0, abs=1e-6)
    perfect.traversability_mean[:] += 0.1
    assert measure_latent(table, perfect)["latent_rmse"] == pytest.approx(0.1, rel=1e-4)


def test_splits_are_measured_one_at_a_time(dataset: TerrainDataset) -> None:
    found = dict(evaluate(Oracle(), dataset))
    assert list(found) == ["test/std", "test/hs"]
    assert found["test/std"].maps == 2
    assert list(dict(evaluate(Oracle(), dataset, ["valid"]))) == ["valid"]
    assert dict(evaluate(Oracle(), dataset)) == found


def test_a_split_that_is_not_there_is_refused(dataset: TerrainDataset) -> None:
    with pytest.raises(DatasetError, match="test/hg"):
        dict(evaluate(Oracle(), dataset, ["test/hg"]))


def test_a_model_of_other_classes_is_refused(dataset: TerrainDataset) -> None:
    model = FusedModel(torch.nn.Identity(), linear_table(), ("a", "b", "c"))
    with pytest.raises(CheckpointError, match="class table"):
        dict(evaluate(model, dataset))
