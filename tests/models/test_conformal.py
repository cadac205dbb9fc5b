"""Conformal recalibration: its promise by simulation over exchangeable maps, and its
table by hand.
"""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS
from benchnav.models.checkpoint import Checkpoint
from benchnav.models.conformal import (
    ConformalModel,
    ConformalTable,
    fit_table,
    recalibrated,
)
from tests.factories import normal
from tests.models.stub import ColourModel
from tests.models.support import make_terrain

CHOSEN = (0.05, 0.1, 0.2, 0.5, 0.9)
AT = [LEVELS.index(level) for level in CHOSEN]
MAPS = 9


def draw_maps(generator: np.random.Generator, count: int) -> list[np.ndarray]:
    """λ of exchangeable maps that differ, with atoms at 0 and 1; hard maps have few
    cells.

    A model says N(0.5, 0.2) of all of them.
    """
    found = []
    for shift in generator.normal(0, 0.25, count):
        cells = 5 if shift < -0.1 else 60
        found.append((0.5 + shift + generator.normal(0, 0.15, cells)).clip(0, 1))
    return found


def scores_of(lam: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """PIT values under N(0.5, 0.2), clipped, drawn within atoms."""
    value = norm.cdf(lam, 0.5, 0.2)
    lower, upper = np.where(lam <= 0, 0, value), np.where(lam >= 1, 1, value)
    return lower + generator.uniform(size=len(lam)) * (upper - lower)


def share_below(table: ConformalTable, lam: np.ndarray) -> np.ndarray:
    """P(λ < Q_conf(u)) over the cells of a map, at the chosen levels."""
    quantiles = norm.ppf(np.array(table.values)[AT], 0.5, 0.2).clip(0, 1)
    return (lam[:, None] < quantiles).mean(0)


def simulate(group: bool, draws: int = 1200) -> tuple[np.ndarray, np.ndarray]:
    """The mean and standard error of `share_below` on a new map; with maps as groups,
    or each cell as its own.
    """
    generator, found = np.random.default_rng(0), []
    for _ in range(draws):
        *maps, new = draw_maps(generator, MAPS + 1)
        scores = [scores_of(lam, generator) for lam in maps]
        if not group:
            scores = [cell for own in scores for cell in own[:, None]]
        found.append(share_below(fit_table(scores), new))
    return np.mean(found, 0), np.std(found, 0) / draws**0.5


def test_lower_quantiles_of_a_new_map_keep_their_promise() -> None:
    share, error = simulate(group=True)
    assert bool((share <= np.array(CHOSEN) + 3 * error).all()), share
    # Nor is more given away than the new map's own weight and one step.
    assert bool((share >= np.array(CHOSEN) - 2.5 / (MAPS + 1)).all()), share


def test_cells_as_if_they_were_maps_would_break_it() -> None:
    share, error = simulate(group=False)
    assert bool((share[1:3] > np.array(CHOSEN)[1:3] + 3 * error[1:3]).all()), share


def test_without_the_weight_of_the_new_map_it_would_break() -> None:
    """As `fit_table` with n maps whose weights are 1 / n."""
    generator, found = np.random.default_rng(0), []
    for _ in range(1200):
        *maps, new = draw_maps(generator, MAPS + 1)
        scores = [scores_of(lam, generator) for lam in maps]
        pooled = np.concatenate(scores)
        weights = np.concatenate(
            [np.full(len(own), 1 / MAPS / len(own)) for own in scores]
        )
        order = np.argsort(pooled)
        values = pooled[order][
            np.searchsorted(
                weights[order].cumsum(), np.array(LEVELS), side="right"
            ).clip(max=len(pooled) - 1)
        ]
        found.append(
            share_below(
                ConformalTable(levels=LEVELS, values=tuple(values), maps=MAPS), new
            )
        )
    share, error = np.mean(found, 0), np.std(found, 0) / 1200**0.5
    assert share[1] > CHOSEN[1] + 3 * error[1], share


def test_the_table_by_hand() -> None:
    # Two maps, and the new one with 1/3: the share of scores up to each is 1/3 + 1/6, +
    # 1/6, + 1/3.
    levels = (0.0, 0.3, 0.4, 0.6, 0.7, 0.99, 1.0)
    table = fit_table([np.array([0.2, 0.6]), np.array([0.8]), np.array([])], levels)
    assert table.values == (0.0, 0.0, 0.2, 0.6, 0.8, 0.8, 1.0)
    assert table.maps == 2


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.lists(st.floats(0, 1), min_size=1, max_size=6), min_size=1, max_size=8),
    st.floats(0, 1),
)
def test_the_table_is_the_supremum_of_its_definition(
    maps: list[list[float]], level: float
) -> None:
    values = fit_table([np.array(own) for own in maps], (0.0, level, 1.0)).values

    def share(value: float) -> float:
        return (sum(np.mean(np.array(own) < value) for own in maps) + 1) / (
            len(maps) + 1
        )

    assert values[0] == 0 or share(values[0]) <= 0
    if values[1] > 0:
        assert share(values[1]) <= level + 1e-6
    above = np.nextafter(values[1], 2)
    assert level >= 1 or values[1] >= 1 or share(above) > level - 1e-6
    assert list(values) == sorted(values)


def test_the_order_of_maps_and_of_cells_is_of_no_account() -> None:
    generator = np.random.default_rng(1)
    maps = [generator.uniform(size=count) for count in (3, 50, 7, 20)]
    mixed = [generator.permutation(own) for own in reversed(maps)]
    np.testing.assert_allclose(fit_table(maps).values, fit_table(mixed).values)


def test_a_model_that_is_right_is_left_nearly_as_it_is() -> None:
    generator = np.random.default_rng(2)
    table = fit_table([generator.uniform(size=400) for _ in range(400)])
    assert float(np.abs(np.array(table.values) - LEVELS).max()) < 0.01
    assert bool((np.array(table.values)[1:-1] < np.array(LEVELS)[1:-1] + 0.004).all())


def test_maps_without_a_score_are_refused() -> None:
    with pytest.raises(ConfigError, match="got 0 such maps"):
        fit_table([np.array([])])


def test_quantiles_are_read_at_the_levels_of_the_table() -> None:
    table = ConformalTable(
        levels=LEVELS, values=tuple(level**2 for level in LEVELS), maps=4
    )
    generator = torch.Generator().manual_seed(0)
    base = normal(
        torch.rand(2, 3, 4, generator=generator),
        0.1 + torch.rand(2, 3, 4, generator=generator),
    )
    found = recalibrated(base, table)
    assert found.shape == (2, 3, 4)
    for level in (0.0, 0.05, 0.2, 0.5, 0.9, 1.0):
        torch.testing.assert_close(found.quantile(level), base.quantile(level**2))
    # Where the base has no atom, F_conf(Q_conf(u)) = u.
    inside = found.quantile(0.2)
    free = (inside > 0) & (inside < 1)
    assert bool(free.any())
    torch.testing.assert_close(
        found.cdf(inside)[free], torch.full_like(inside, 0.2)[free], atol=1e-4, rtol=0
    )


def test_a_recalibrated_model_tells_no_classes() -> None:
    table = ConformalTable(levels=LEVELS, values=LEVELS, maps=4)
    base = ColourModel()
    model, seen = ConformalModel(base, table), make_terrain(classes=10).observe()
    assert base.class_names
    assert model.class_names == ()
    assert model.member_probabilities(seen) is None
    found, raw = model.predict(seen), base.predict(seen)
    assert isinstance(raw, TraversabilityMixture)
    torch.testing.assert_close(found.quantile(0.1), raw.quantile(0.1))


def changed(**values: Any) -> dict[str, Any]:
    return {**ConformalTable(levels=LEVELS, values=LEVELS, maps=4).plain(), **values}


def test_a_table_is_read_as_it_was_written() -> None:
    table = ConformalTable(
        levels=LEVELS, values=tuple(level**2 for level in LEVELS), maps=4
    )
    assert ConformalTable.read(table.plain()) == table


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": [0.0, 1.0]},
        {"values": [1 - level for level in LEVELS]},
        {"values": [2 * level for level in LEVELS]},
        {"values": ["x"] * len(LEVELS)},
        {"levels": None},
        {"maps": "many"},
    ],
)
def test_a_table_that_is_none_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(CheckpointError):
        ConformalTable.read(changed(**wrong))


def test_another_part_makes_another_model_that_is_not_recalibrated() -> None:
    checkpoint = Checkpoint(class_names=(), conformal=changed())
    assert checkpoint.with_part("gp", None).conformal == {}  # type: ignore[arg-type]
