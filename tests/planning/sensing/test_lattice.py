"""A field of many observed cells by a lattice, against the dense equations on all of
them.
"""

import numpy as np
import pytest
import torch
from numpy import ndarray

from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.planning.sensing.gaussian import Field, Observed, condition, predict
from benchnav.planning.sensing.lattice import Cells, Lattice, condition_and_predict

SHAPE = (40, 48)
INF = float("inf")


def dense(
    field: Field, observed: Observed, cells: Cells, wanted: Cells
) -> tuple[ndarray, ndarray, ndarray]:
    def covariance(one: Cells, other: Cells) -> ndarray:
        rows, columns = (
            torch.from_numpy(a[:, None] - b) for a, b in zip(one, other, strict=True)
        )
        return field.covariance(0, rows, columns).numpy()

    among = covariance(cells, cells)
    return predict(
        condition(among, observed), among, observed, covariance(cells, wanted)
    )


def strip(half_width: int) -> Cells:
    """Cells along a way that turns and crosses itself."""
    seen = np.zeros(SHAPE, bool)
    seen[20 - half_width : 20 + half_width, 4:40] = True
    seen[4:34, 30 - half_width : 30 + half_width] = True
    return seen.nonzero()


def told(
    length: float, cells: Cells, std: float, share: float, seed: int = 0
) -> tuple[Observed, ndarray]:
    """What a noisy sensor tells of a field of the law: a number, or for a share of
    cells that it is low or not.
    """
    scores = correlated_normal(
        rng.stream_key(seed, "lattice"), np.arange(1), SHAPE, length
    )[0]
    generator = np.random.default_rng(seed)
    value = scores[cells] + std * generator.standard_normal(len(cells[0]))
    low = value < np.quantile(value, share)
    end = value[low].max() if low.any() else 0.0
    zeros = np.zeros_like(value)
    lower, upper = np.where(low, -INF, value), np.where(low, end, value)
    return Observed(lower, upper, np.full_like(value, std), zeros, zeros), scores


@pytest.mark.parametrize("length", [4.0, 5.5, 6.0, 8.0])
@pytest.mark.parametrize("std", [0.1, 0.3])
@pytest.mark.parametrize("nugget", [0.0, 0.1])
def test_numbers_tell_of_all_cells_what_the_dense_equations_say(
    length: float, std: float, nugget: float
) -> None:
    field = Field.of(SHAPE, (length,), "cpu", nugget)
    cells, wanted = strip(5), np.ones(SHAPE, bool).nonzero()
    observed, _ = told(length, cells, std, 0.0)
    lattice = Lattice.around(field, 0, cells)
    assert len(lattice.basis[0]) < len(cells[0]) / 1.5
    *terms, found = condition_and_predict(lattice, observed, cells, wanted)
    mean, variance, _ = dense(field, observed, cells, wanted)
    np.testing.assert_allclose(np.sqrt(found[1]), np.sqrt(variance), atol=0.01)
    assert np.sqrt(np.mean((found[0] - mean) ** 2)) < 0.01
    assert not found[2].any()
    np.testing.assert_allclose(terms[0], 1 / std**2)
    np.testing.assert_allclose(terms[1], observed.lower / std**2)


@pytest.mark.parametrize("nugget", [0.0, 0.1])
def test_intervals_tell_of_all_cells_what_the_dense_equations_say(
    nugget: float,
) -> None:
    length = 6.0
    field = Field.of(SHAPE, (length,), "cpu", nugget)
    cells, wanted = strip(4), np.ones(SHAPE, bool).nonzero()
    observed, _ = told(length, cells, 0.1, 0.2)
    assert 50 < observed.interval.sum() < len(cells[0]) / 2
    *terms, found = condition_and_predict(
        Lattice.around(field, 0, cells), observed, cells, wanted
    )
    mean, variance, skew = dense(field, observed, cells, wanted)
    assert np.sqrt(np.mean((np.sqrt(found[1]) - np.sqrt(variance)) ** 2)) < 0.01
    assert np.sqrt(np.mean((found[0] - mean) ** 2)) < 0.02
    assert np.abs(skew).max() > 0.3
    assert np.sqrt(np.mean((found[2] - skew) ** 2)) < 0.03
    # Asked again from the terms that were found, it stays where it is.
    begun = Observed(observed.lower, observed.upper, observed.std, terms[0], terms[1])
    *_, again = condition_and_predict(
        Lattice.around(field, 0, cells), begun, cells, wanted
    )
    np.testing.assert_allclose(again[0], found[0], atol=0.005)
