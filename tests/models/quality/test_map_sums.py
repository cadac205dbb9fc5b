import math

import numpy as np
import pytest
import torch

from benchnav.core.terrain import Terrain
from benchnav.datagen.schema import UNLABELLED
from benchnav.models.base import TraversabilityModel
from benchnav.models.fused import FusedModel
from benchnav.models.predictor import Oracle
from benchnav.models.quality.map_sums import MapTally, by_group
from benchnav.models.quality.measure import Quality, measure
from benchnav.models.quality.scores import pinball_loss_and_width, sparsification
from benchnav.models.quality.scores_of_maps import SCORES
from benchnav.stats.scores import summarise
from tests.models.stub import ColourModel
from tests.models.support import linear_table, make_terrain


class Colours(torch.nn.Module):
    def forward(self, maps: dict[str, torch.Tensor]) -> torch.Tensor:
        return maps["rgb"].float() / 50


MODEL = FusedModel([Colours()], linear_table(), ("a", "b", "c"))


def measured(
    model: TraversabilityModel, *chunks: Terrain, truth: bool = True
) -> tuple[Quality, MapTally]:
    quality = measure(
        model, chunks, torch.Generator().manual_seed(1), (), truth, by_map=True
    )
    assert quality.by_map
    return quality, quality.by_map


def whole(tally: MapTally) -> dict[str, float]:
    (row,) = summarise(tuple(SCORES.values()), {"model": tally.sums()}).to_dict(
        "records"
    )
    return {str(name): value for name, value in row.items()}


def holed() -> Terrain:
    """Maps some of whose cells were not observed, and others have no class; the last
    has no λ at all.
    """
    terrain = make_terrain(batch=4)
    terrain.traversability[0, :5], terrain.traversability[3] = math.nan, math.nan
    terrain.class_id[1, :, :9] = UNLABELLED
    return terrain


@pytest.mark.parametrize("model", [MODEL, Oracle()])
def test_sums_over_all_maps_give_the_measures_of_evaluate(
    model: TraversabilityModel,
) -> None:
    quality, tally = measured(model, make_terrain(batch=3, seed=1), holed())
    found = whole(tally)
    for name in ("rmse_observed", "rmse_expected", "nll", "crps", "coverage"):
        assert found[name] == pytest.approx(
            getattr(quality.traversability, name), rel=1e-9, abs=1e-12
        ), name
    assert found["tail_rate_90"] == pytest.approx(quality.traversability.tail_rate)
    assert tuple(tally.pit) == quality.traversability.pit
    for classes in quality.classes:
        assert found["accuracy"] == pytest.approx(classes.accuracy, rel=1e-6)
        assert found["miou"] == pytest.approx(classes.miou, rel=1e-6)
    assert ("accuracy" in found) == bool(quality.classes)


def test_what_is_kept_for_a_comparison_changes_no_measure() -> None:
    chunks = [make_terrain(batch=3, seed=1), holed()]
    plain = measure(MODEL, chunks, torch.Generator().manual_seed(1))
    assert repr(plain) == repr(measured(MODEL, *chunks)[0])  # NaN is not itself
    assert plain.by_map is None


def test_each_map_has_the_sums_that_it_has_alone() -> None:
    terrain = holed()
    _, tally = measured(MODEL, make_terrain(batch=2, seed=3), terrain)
    sums = tally.sums()
    assert sums["cells"].tolist() == [256, 256, 176, 256, 256, 0]
    for place in range(3):
        alone = measured(MODEL, terrain.select(torch.tensor([place])))[1].sums()
        for name in sums.keys() - {
            "inside",
            "under_80",
            "under_90",
            "under_95",
        }:  # with other draws within atoms
            np.testing.assert_allclose(
                sums[name][2 + place], alone[name][0], rtol=1e-6, err_msg=name
            )


def test_the_measures_of_a_comparison_are_those_computed_by_hand() -> None:
    terrain = make_terrain(batch=2, size=32)
    _, tally = measured(MODEL, terrain)
    predicted, observed = MODEL.predict(terrain.observe()), terrain.traversability
    loss, width = pinball_loss_and_width(predicted, observed)
    found = whole(tally)
    assert found["pinball"] == pytest.approx(float(loss.mean()), rel=1e-6)
    assert found["width"] == pytest.approx(float(width.mean()), rel=1e-6)
    rates = [found[f"tail_rate_{level}"] for level in (80, 90, 95)]
    assert rates[0] > rates[1] > rates[2]
    by_hand = np.abs(np.array(rates) - [0.2, 0.1, 0.05]).mean()
    assert found["tail_error"] == pytest.approx(by_hand)
    error = (predicted.mean() - observed).abs()
    curves = [sparsification(error[m].flatten(), width[m].flatten()) for m in range(2)]
    areas = [float((own[0] - own[1]).mean()) for own in curves]
    assert found["ause"] == pytest.approx(np.mean(areas), rel=1e-5)
    left_out, by_width, by_error = tally.curves()
    assert by_width[0] == pytest.approx(float(error.mean()), rel=1e-5)
    assert by_error[25] == pytest.approx(
        float(np.mean([own[1, 511] for own in curves])), rel=1e-5
    )
    assert left_out[25] == 0.5
    assert np.mean(by_width - by_error) == pytest.approx(found["ause"], rel=0.05)


def test_a_truth_that_is_unknown_gives_no_error_of_the_expected_value() -> None:
    _, tally = measured(MODEL, make_terrain(), truth=False)
    assert math.isnan(whole(tally)["rmse_expected"])
    assert whole(tally)["rmse_observed"] > 0


def test_maps_of_a_group_are_one_unit_and_maps_without_a_cell_none() -> None:
    _, tally = measured(MODEL, make_terrain(batch=2, seed=3), holed())
    sums = tally.sums()
    units = by_group(sums, np.array([7, 3, 3, 9, 7, 1]))
    assert units["cells"].tolist() == [256 + 176, 256 + 256, 256]
    np.testing.assert_allclose(units["hits"][0], sums["hits"][1] + sums["hits"][2])
    np.testing.assert_allclose(units["crps"][1], sums["crps"][0] + sums["crps"][4])


def test_a_model_of_other_classes_is_measured_by_its_traversability_alone() -> None:
    terrain = make_terrain(batch=2)
    quality = measure(
        ColourModel(), [terrain], torch.Generator(), by_map=True, classes=False
    )
    assert quality.classes == ()
    assert quality.by_map
    assert "true" not in quality.by_map.sums()


def test_a_class_that_is_nowhere_true_has_no_share_in_the_miou() -> None:
    counts = {"true": [10, 10, 0], "predicted": [12, 6, 2], "hits": [8, 6, 0]}
    sums = {name: np.array([own], dtype=float) for name, own in counts.items()}
    assert SCORES["accuracy"].value(sums) == pytest.approx(14 / 20)
    assert SCORES["miou"].value(sums) == pytest.approx((8 / 14 + 6 / 10) / 2)


def test_gaps_of_the_tail_do_not_cancel() -> None:
    sums = {"cells": [100], "under_80": [15], "under_90": [13], "under_95": [5]}
    value = SCORES["tail_error"].value(
        {name: np.array(own, dtype=float) for name, own in sums.items()}
    )
    assert value == pytest.approx((0.05 + 0.03 + 0) / 3)
