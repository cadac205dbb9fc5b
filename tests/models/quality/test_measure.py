import math
from collections.abc import Iterator, Mapping
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu

from benchnav.core.errors import CheckpointError, DatasetError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation, Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.base import TraversabilityModel
from benchnav.models.fused import FusedModel
from benchnav.models.predictor import Oracle
from benchnav.models.quality.baselines import nearest_colour, nearest_colour_accuracy
from benchnav.models.quality.measure import (
    choose_splits,
    evaluate,
    measure,
)
from benchnav.models.quality.scores import mutual_information, predictive_entropy
from benchnav.models.slope_gp.cells import measure_latent
from benchnav.models.slope_gp.table import SoftModes
from tests.factories import normal, tiny_dataset, tiny_recipe
from tests.models.stub import ColourModel
from tests.models.support import linear_table, make_terrain


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class Colours(torch.nn.Module):
    """A classifier whose logits are the colours."""

    def forward(self, maps: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return maps["rgb"]


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
    assert figures.crps == pytest.approx(
        float(truth.crps(terrain.traversability).mean()), rel=1e-5
    )
    cells = terrain.traversability.numel()
    assert sum(figures.pit) == cells
    assert sum(figures.pit[1:-1]) / cells == pytest.approx(figures.coverage, abs=1e-4)
    assert sum(figures.pit[:2]) / cells == pytest.approx(figures.tail_rate, abs=1e-4)


def test_a_model_off_by_a_constant_is_off_by_it_in_truth() -> None:
    class Shifted(TraversabilityModel):
        """Says N(0.4, 0.01) of ground that is N(0.5, 0.01)."""

        def predict(self, observation: Observation) -> TraversabilityMixture:
            ones = torch.ones(len(observation.rgb), 1, *observation.grid.shape)
            return TraversabilityMixture(ones, 0.4 * ones, 0.01 * ones)

    drawn = make_terrain(batch=3)
    level = torch.full_like(drawn.traversability, 0.5)
    terrain = replace(drawn, truth=normal(level, 0.02 * level), traversability=level)
    figures = measure(Shifted(), [terrain], generator()).traversability
    assert figures.rmse_expected == pytest.approx(0.1, abs=1e-5)
    assert figures.rmse_observed == pytest.approx(0.1, abs=1e-5)
    assert figures.coverage == figures.tail_rate == 0
    assert figures.pit[-1] == level.numel()


def test_class_metrics_are_those_counted_by_hand() -> None:
    class Half(TraversabilityModel):
        """Says class 0 with certainty 0.8 everywhere; classes are 0 in the left half,
        else 1.
        """

        class_names = ("a", "b", "c")

        def predict(self, observation: Observation) -> TraversabilityMixture:
            share = torch.tensor([0.8, 0.15, 0.05]).view(1, 3, 1, 1)
            weights = share.expand(
                len(observation.rgb), 3, *observation.grid.shape
            ).clone()
            return TraversabilityMixture(
                weights, weights, torch.full_like(weights, 0.1)
            )

    terrain = make_terrain()
    terrain.class_id[:] = 0
    terrain.class_id[:, :, 8:] = 1
    chunks = [make_terrain(), make_terrain()]
    for chunk in chunks:
        chunk.class_id[:] = terrain.class_id
    (classes,) = measure(Half(), chunks, generator()).classes
    assert classes.accuracy == pytest.approx(0.5)
    assert classes.miou == classes.miou_predicted == pytest.approx((0.5 + 0) / 2)
    assert classes.ece == pytest.approx(0.3, abs=1e-4)
    left, right = 0.2**2 + 0.15**2 + 0.05**2, 0.8**2 + 0.85**2 + 0.05**2
    assert classes.brier == pytest.approx((left + right) / 2)
    half = terrain.class_id.numel() // 2 * len(chunks)
    assert classes.confusion == ((half, 0, 0), (half, 0, 0), (0, 0, 0))
    assert classes.reliability["cells"][12] == 2 * half
    assert classes.reliability["accuracy"][12] == 0.5
    assert classes.reliability["confidence"][12] == pytest.approx(0.8)
    nats = -sum(p * math.log(p) for p in (0.8, 0.15, 0.05))
    assert classes.entropy == pytest.approx(nats, rel=1e-5)
    assert classes.entropy_auroc == 0.5
    assert math.isnan(classes.mutual_information)
    assert math.isnan(classes.mutual_information_auroc)


def test_a_class_that_is_only_predicted_counts_in_the_measure_named_for_it_alone() -> (
    None
):
    """Colour 0 is of class a, 100 of b and 200 of c, which no cell is; two cells of a
    look like c.
    """

    class Colours(TraversabilityModel):
        class_names = ("a", "b", "c")

        def predict(self, observation: Observation) -> TraversabilityMixture:
            found = torch.nn.functional.one_hot(observation.rgb[:, 0].long() // 100, 3)
            weights = found.movedim(-1, 1).float()
            return TraversabilityMixture(
                weights, weights, torch.full_like(weights, 0.1)
            )

    terrain = make_terrain(batch=1)
    terrain.class_id[:] = (torch.arange(256) % 2).view(1, 16, 16)
    terrain.rgb[:, 0] = (100 * terrain.class_id).byte()
    terrain.rgb[0, 0, 0, :4:2] = 200
    (classes,) = measure(
        Colours(), [terrain], generator(), ((0,), (1, 2), (1, 2))
    ).classes
    assert classes.accuracy == pytest.approx(254 / 256)
    assert classes.miou == pytest.approx((126 / 128 + 1) / 2)
    assert classes.miou_predicted == pytest.approx((126 / 128 + 1 + 0) / 3)
    assert classes.look_alikes
    assert classes.look_alikes.look_alike_miou == pytest.approx(
        (126 / 128 + 128 / 130) / 2
    )


def test_uncertainty_is_ranked_over_all_maps(dataset: TerrainDataset) -> None:
    model, terrain = ColourModel(), dataset.terrain("test/hs")
    chunks = [terrain.select(torch.tensor([index])) for index in range(len(terrain))]
    (classes,) = measure(model, chunks, generator()).classes
    members = model.member_probabilities(terrain.observe())
    wrong = members.mean(0).argmax(1) != terrain.class_id
    for values, mean, auroc in (
        (predictive_entropy(members.mean(0)), classes.entropy, classes.entropy_auroc),
        (
            mutual_information(members),
            classes.mutual_information,
            classes.mutual_information_auroc,
        ),
    ):
        exact = mannwhitneyu(values[wrong].numpy(), values[~wrong].numpy()).statistic
        exact /= int(wrong.sum()) * int((~wrong).sum())
        assert mean == pytest.approx(float(values.mean()), rel=1e-5)
        assert auroc == pytest.approx(exact, abs=1e-3)


def test_one_member_has_no_mutual_information(dataset: TerrainDataset) -> None:
    quality = measure(ColourModel((40.0,)), [dataset.terrain("valid")], generator())
    assert math.isnan(quality.classes[0].mutual_information)
    assert quality.classes[0].entropy > 0


def test_slopes_are_counted_by_true_class() -> None:
    terrain = make_terrain(batch=1, classes=10)
    terrain.slope_deg[:] = 12.5
    terrain.slope_deg[0, 0, :2] = torch.tensor([0.0, 90.0])
    terrain.class_id[0, 0, :2] = torch.tensor([4, 6])
    cells = torch.tensor(
        measure(ColourModel(), [terrain], generator()).classes[0].slope_cells
    )
    assert cells.shape == (10, 90)
    assert (
        cells.sum(1).tolist()
        == terrain.class_id.flatten().bincount(minlength=10).tolist()
    )
    assert cells[4, 0] == cells[6, 89] == 1
    assert int(cells[:, 12].sum()) == terrain.class_id.numel() - 2


def test_measures_do_not_depend_on_how_maps_are_read(dataset: TerrainDataset) -> None:
    terrain = dataset.terrain("valid")
    whole = measure(ColourModel(), [terrain], generator())
    parts = [
        terrain.select(torch.arange(4)[part]) for part in (slice(0, 1), slice(1, 4))
    ]
    pieces = measure(ColourModel(), parts, generator())
    assert pieces.maps == whole.maps == 4
    one, other = pieces.classes[0], whole.classes[0]
    assert one.confusion == other.confusion
    assert astuple(one)[:9] == pytest.approx(astuple(other)[:9], rel=1e-6)
    named = ("rmse_observed", "rmse_expected", "nll", "crps")
    assert [getattr(pieces.traversability, name) for name in named] == pytest.approx(
        [getattr(whole.traversability, name) for name in named], rel=1e-6
    )


def test_the_classes_are_measured_whole_where_they_have_two_modes() -> None:
    terrain = make_terrain(batch=2)
    soft = SoftModes(
        weight=torch.tensor([0.6, 0.0, 0.0]),
        mean=torch.full((3,), 0.1),
        std=torch.full((3,), 0.3),
    )
    names = ("a", "b", "c")
    plain, both = (
        measure(FusedModel([Colours()], table, names), [terrain], generator(1))
        for table in (linear_table(), replace(linear_table(), soft=soft))
    )
    assert both.classes[0].confusion == plain.classes[0].confusion
    assert both.classes[0].brier == pytest.approx(plain.classes[0].brier)
    assert both.classes[0].entropy == pytest.approx(plain.classes[0].entropy)
    assert both.traversability.nll != plain.traversability.nll


def test_splits_are_measured_one_at_a_time(dataset: TerrainDataset) -> None:
    found = dict(evaluate(Oracle(), dataset))
    assert list(found) == ["test/std", "test/hs"]
    assert found["test/std"].maps == 2
    assert list(dict(evaluate(Oracle(), dataset, ["valid"]))) == ["valid"]
    assert dict(evaluate(Oracle(), dataset)) == found


def test_a_model_of_other_classes_is_refused(dataset: TerrainDataset) -> None:
    model = ColourModel()
    model.class_names = ("a", "b", "c")
    with pytest.raises(CheckpointError, match="other classes than those of"):
        choose_splits(model, dataset)


def test_a_split_named_twice_is_measured_once(dataset: TerrainDataset) -> None:
    assert choose_splits(Oracle(), dataset, ["valid", "test/std", "valid"]) == [
        "valid",
        "test/std",
    ]


def test_cells_that_were_not_observed_are_left_out() -> None:
    terrain = make_terrain(batch=2)
    gone = torch.zeros(2, 16, 16, dtype=torch.bool)
    gone[:, :, :5] = True
    holed = replace(
        terrain, traversability=terrain.traversability.masked_fill(gone, torch.nan)
    )
    rest = replace(
        terrain,
        **{  # the same cells, cut to a map of their own
            name: getattr(terrain, name)[..., 5:]
            for name in (
                "rgb", "class_id", "elevation_m", "slope_deg", "traversability",
            )
        },
        truth=normal(terrain.truth.means[:, 0, :, 5:], terrain.truth.stds[:, 0, :, 5:]),
        grid=Grid(16, 11, 0.5),
    )  # fmt: skip
    model = FusedModel([Colours()], linear_table(), ("a", "b", "c"))
    found, wanted = (
        measure(model, [one], generator(1)).traversability for one in (holed, rest)
    )
    for name in ("rmse_observed", "rmse_expected", "nll", "crps"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-6), (
            name
        )
    assert sum(found.pit) == 2 * 16 * 11
    latent = [measure_latent(linear_table(), [one])["nll"] for one in (holed, rest)]
    assert latent[0] == pytest.approx(latent[1], rel=1e-6)
    with pytest.raises(DatasetError, match="observed"):
        measure(
            model,
            [
                replace(
                    holed,
                    traversability=torch.full_like(holed.traversability, torch.nan),
                )
            ],
            generator(1),
        )


def half_labelled() -> tuple[Terrain, Terrain]:
    """Maps of tiny-v1's classes whose right half has no class, and their left half
    alone.
    """
    drawn = make_terrain(batch=3, classes=len(ColourModel().class_names))
    left = drawn.traversability.clone()
    kept = slice(None, 8)
    truth = drawn.truth
    half = replace(
        drawn,
        rgb=drawn.rgb[..., kept],
        class_id=drawn.class_id[..., kept],
        elevation_m=drawn.elevation_m[..., kept],
        slope_deg=drawn.slope_deg[..., kept],
        truth=TraversabilityMixture(
            truth.weights[..., kept],
            truth.means[..., kept],
            truth.stds[..., kept],
            (0,),
        ),
        traversability=left[..., kept],
        grid=Grid(16, 8, 0.5),
    )
    class_id, means = drawn.class_id.clone(), truth.means.clone()
    class_id[..., 8:], means[..., 8:] = UNLABELLED, math.nan
    unknown = TraversabilityMixture(truth.weights, means, truth.stds, (0,))
    return replace(drawn, class_id=class_id, truth=unknown), half


def test_cells_without_a_class_count_in_no_measure_of_classes() -> None:
    holed, half = half_labelled()
    alike = ((0, 1), (0, 1), *((c,) for c in range(2, len(ColourModel().class_names))))
    whole, wanted = (
        measure(ColourModel(), [one], generator(), alike) for one in (holed, half)
    )
    found, expected = whole.classes[0], wanted.classes[0]
    assert found.confusion == expected.confusion
    assert found.slope_cells == expected.slope_cells
    assert found.reliability["cells"] == expected.reliability["cells"]
    names = (
        "accuracy", "miou", "ece", "brier", "entropy", "mutual_information", "entropy_auroc",
        "mutual_information_auroc",
    )  # fmt: skip
    for name in names:
        assert getattr(found, name) == pytest.approx(
            getattr(expected, name), rel=1e-6
        ), name
    assert found.look_alikes is not None
    assert expected.look_alikes is not None
    assert astuple(found.look_alikes) == pytest.approx(astuple(expected.look_alikes))


def test_where_no_class_is_known_the_measured_traversability_counts_and_the_expected_does_not() -> (
    None
):
    holed, half = half_labelled()
    found, of_half = (
        measure(ColourModel(), [one], generator()).traversability
        for one in (holed, half)
    )
    assert found.rmse_expected == pytest.approx(of_half.rmse_expected, rel=1e-6)
    assert sum(found.pit) == 2 * sum(of_half.pit)
    mixture = ColourModel().predict(holed.observe())
    wanted = -float(mixture.log_prob(holed.traversability).mean())
    assert found.nll == pytest.approx(wanted, rel=1e-5)


def test_maps_without_any_class_are_measured_by_their_traversability_alone() -> None:
    holed, _ = half_labelled()
    bare = replace(
        holed,
        class_id=torch.full_like(holed.class_id, UNLABELLED),
        truth=replace(holed.truth, means=torch.full_like(holed.truth.means, math.nan)),
    )
    quality = measure(ColourModel(), [holed, bare], generator())
    assert (
        quality.classes[0].accuracy
        == measure(ColourModel(), [holed], generator()).classes[0].accuracy
    )
    alone = measure(ColourModel(), [bare], generator())
    assert math.isnan(alone.traversability.rmse_expected)
    assert alone.classes == ()


def test_who_knows_the_truth_is_measured_where_it_says_something() -> None:
    holed, half = half_labelled()
    found, wanted = (
        measure(Oracle(), [one], generator()).traversability for one in (holed, half)
    )
    assert sum(found.pit) == sum(wanted.pit) == half.traversability.numel()
    for name in (
        "rmse_observed",
        "rmse_expected",
        "nll",
        "crps",
        "coverage",
        "tail_rate",
    ):
        assert getattr(found, name) == pytest.approx(
            getattr(wanted, name), rel=1e-6, abs=1e-9
        ), name


def test_maps_without_any_observed_traversability_are_passed_over() -> None:
    terrain = make_terrain(batch=2, classes=len(ColourModel().class_names))
    unseen = replace(
        terrain, traversability=torch.full_like(terrain.traversability, math.nan)
    )
    both = measure(ColourModel(), [terrain, unseen], generator())
    assert (
        both.traversability
        == measure(ColourModel(), [terrain], generator()).traversability
    )
    assert (
        both.classes == measure(ColourModel(), [terrain, terrain], generator()).classes
    )
    with pytest.raises(DatasetError, match="maps with observed λ"):
        measure(ColourModel(), [unseen], generator())


def test_an_ensemble_classifies_each_map_once(monkeypatch: pytest.MonkeyPatch) -> None:
    class Member(torch.nn.Module):
        def __init__(self, shift: float) -> None:
            super().__init__()
            self.shift = shift

        def forward(self, maps: Mapping[str, torch.Tensor]) -> torch.Tensor:
            rgb = maps["rgb"]
            seen.append(len(rgb))
            return rgb.float() / 100 + self.shift * torch.arange(3).view(3, 1, 1)

    seen: list[int] = []
    model = FusedModel(
        [Member(0.0), Member(0.3)],
        linear_table(),
        ("a", "b", "c"),
        pool_temperature=0.7,
    )
    terrain = make_terrain(batch=3)
    quality = measure(model, [terrain], generator())
    assert sum(seen) == 2 * 3
    mixture = model.predict(terrain.observe())
    probabilities = mixture.weights
    entropy = predictive_entropy(probabilities).double().mean()
    assert quality.classes[0].entropy == pytest.approx(float(entropy), rel=1e-6)
    information = (
        mutual_information(model.member_probabilities(terrain.observe()))
        .double()
        .mean()
    )
    assert quality.classes[0].mutual_information == pytest.approx(
        float(information), rel=1e-6
    )


def test_the_nearest_colour_is_found_for_each_cell() -> None:
    colours = torch.tensor([[0, 0, 0], [100, 100, 100], [200, 100, 0]])
    rgb = torch.tensor(
        [[40, 40, 40], [60, 60, 60], [190, 90, 20]], dtype=torch.uint8
    ).T.view(1, 3, 1, 3)
    assert nearest_colour(rgb, colours).tolist() == [[[0, 1, 2]]]


def test_cells_without_a_class_do_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = tiny_recipe()
    bright = {name: replace(one, ambient=1.0) for name, one in recipe.scenarios.items()}
    lit = TerrainDataset(
        tiny_dataset(tmp_path / "lit.h5", replace(recipe, scenarios=bright))
    )
    read = lit.chunks

    def holed(*given: object) -> Iterator[tuple[object, dict[str, np.ndarray]]]:
        for indices, maps in read(*given):
            maps["class_id"][:, :11] = UNLABELLED
            yield indices, maps

    monkeypatch.setattr(lit, "chunks", holed)
    assert nearest_colour_accuracy(lit, "train") == pytest.approx(1)
