from dataclasses import replace

import pytest
import torch

from benchnav.datagen.schema import UNLABELLED
from benchnav.models.slope_gp.measure import measure_latent
from benchnav.models.slope_gp.table import SoftModes
from tests.factories import normal
from tests.models.support import linear_table, make_terrain


def test_latent_metrics_read_each_cell_with_its_own_class() -> None:
    terrain, table = make_terrain(batch=4), linear_table()
    mean, std = table.lookup(terrain.slope_deg)
    own = terrain.class_id[:, None]
    mean, std = mean.gather(1, own)[:, 0], std.gather(1, own)[:, 0]
    perfect = replace(terrain, truth=normal(mean, std))
    exact = measure_latent(table, [perfect])
    assert exact["latent_rmse"] == pytest.approx(0, abs=1e-6)
    assert exact["noise_error"] == pytest.approx(0, abs=1e-6)
    shifted = replace(terrain, truth=normal(mean + 0.1, std))
    assert measure_latent(table, [shifted])["latent_rmse"] == pytest.approx(0.1, rel=1e-4)
    # In pieces as in one.
    pieces = [shifted.select(torch.tensor(which)) for which in ([0], [1, 2, 3])]
    assert measure_latent(table, pieces) == pytest.approx(measure_latent(table, [shifted]))
    louder = replace(terrain, truth=normal(mean, std / 1.25))
    pieces = [perfect.select(torch.tensor([0])), louder.select(torch.tensor([1]))]
    assert measure_latent(table, pieces)["noise_error"] == pytest.approx(0.25, rel=1e-5)
    one_cell = std.clone()
    one_cell[2, 3, 4] /= 1.25
    found = measure_latent(table, [replace(terrain, truth=normal(mean, one_cell))])
    assert found["noise_error"] == pytest.approx(0.25, rel=1e-5)  # the largest, not the mean


def test_a_second_mode_counts_in_the_nll_of_the_processes_and_not_in_their_error() -> None:
    terrain, table = make_terrain(batch=2), linear_table()
    soft = SoftModes(weight=torch.full((3,), 0.4), mean=torch.full((3,), 0.1), std=torch.full((3,), 0.3))
    plain, both = (measure_latent(one, [terrain]) for one in (table, replace(table, soft=soft)))
    assert both["latent_rmse"] == plain["latent_rmse"]
    own = replace(table, soft=soft).own(terrain.class_id, terrain.slope_deg)
    wanted = -float(own.log_prob(terrain.traversability).mean())
    assert both["nll"] == pytest.approx(wanted, rel=1e-5)
    assert both["nll"] != pytest.approx(plain["nll"], rel=1e-2)


def test_cells_without_a_class_are_no_part_of_it() -> None:
    terrain, table = make_terrain(batch=2), linear_table()
    class_id, means, seen = (
        terrain.class_id.clone(),
        terrain.truth.means.clone(),
        terrain.traversability.clone(),
    )
    class_id[1], means[1] = UNLABELLED, torch.nan
    holed = replace(
        terrain, class_id=class_id, truth=replace(terrain.truth, means=means), traversability=seen
    )
    wanted = measure_latent(table, [terrain.select(torch.tensor([0]))])
    assert measure_latent(table, [holed]) == pytest.approx(wanted)
    assert measure_latent(table, [holed.select(torch.tensor([1])), holed]) == pytest.approx(wanted)
