import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchnav.core import rng
from benchnav.datagen.synth import elevation

INDICES = np.arange(40)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.1, 2))
def test_horn_is_exact_on_planes_up_to_the_border(
    along_x: float, along_y: float, resolution: float
) -> None:
    y, x = np.mgrid[:7, :9] * resolution
    plane = (3 + along_x * x + along_y * y)[None]
    gradient_x, gradient_y = elevation.horn_gradient(
        elevation.pad_missing(plane), resolution
    )
    np.testing.assert_allclose(gradient_x, along_x, atol=1e-9)
    np.testing.assert_allclose(gradient_y, along_y, atol=1e-9)
    expected = np.degrees(np.arctan(np.hypot(along_x, along_y)))
    np.testing.assert_allclose(
        elevation.inclination_deg(gradient_x, gradient_y), expected, atol=1e-9
    )


def test_horn_weights_are_1_2_1() -> None:
    bump = np.zeros((1, 5, 5))
    bump[0, 2, 2] = 8.0
    gradient_x, gradient_y = elevation.horn_gradient(elevation.pad_missing(bump), 1.0)
    assert gradient_x[0, 1:4, 1].tolist() == [1, 2, 1]
    assert gradient_x[0, 1:4, 3].tolist() == [-1, -2, -1]
    assert gradient_y[0, 1, 1:4].tolist() == [1, 2, 1]


def test_fractal_spectrum_falls_with_the_asked_exponent() -> None:
    surface = elevation.fractal(rng.stream_key(0, "z"), np.arange(200), (64, 64), 0.75)
    np.testing.assert_allclose(np.ptp(surface, axis=(1, 2)), 1)
    power = (
        np.abs(np.fft.rfft2(surface - surface.mean(axis=(1, 2), keepdims=True))) ** 2
    ).mean(0)
    frequency = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.rfftfreq(64)[None])
    some = (frequency > 0.03) & (frequency < 0.45)
    fitted = np.polyfit(np.log(frequency[some]), np.log(power[some]), 1)[0]
    assert fitted == pytest.approx(-2 * 1.75, abs=0.1)


def test_craters_keep_apart_and_are_as_many_as_fit() -> None:
    count = np.repeat([0, 2, 4, 50], 10)
    centres, radii = elevation.place_craters(
        rng.stream_key(0, "c"), INDICES, (32, 32), count, (2.0, 4.5), 50
    )
    made = (radii > 0).sum(axis=1)
    assert (made <= count).all()
    assert (made[count <= 4] == count[count <= 4]).all()
    assert made[count == 50].min() > 5
    for place, size in zip(centres, radii, strict=True):
        there = size > 0
        assert ((size[there] >= 2.0) & (size[there] <= 4.5)).all()
        gap = np.linalg.norm(place[there][:, None] - place[there][None], axis=2)
        reach = size[there][:, None] + size[there][None]
        assert (gap + 1e9 * np.eye(there.sum()) > reach).all()


def test_a_crater_has_rim_and_bowl() -> None:
    shape = (81, 81)
    z = elevation.crater_elevation(
        np.array([[[20.25, 20.25]]]), np.array([[5.0]]), shape, 0.5, 0.1
    )[0]
    assert z[40, 40] == pytest.approx(-0.8)
    assert z[40, 50] == pytest.approx(0.2)
    assert np.argmax(z[40, 40:]) == 10
    assert (np.diff(z[40, 50:]) < 0).all()
    assert abs(z[40, 80]) < 0.01


def test_the_slope_at_an_edge_follows_the_ground_beyond_where_it_is_known() -> None:
    ground = np.random.default_rng(0).normal(size=(2, 14, 18))
    whole = np.stack(elevation.horn_gradient(elevation.pad_missing(ground), 0.5))
    window = ground[:, 2:10, 4:12].copy()
    np.testing.assert_array_equal(
        elevation.horn_gradient(window, 0.5), whole[:, :, 3:9, 5:11]
    )
    # What is not known is continued linearly, cell by cell, and nothing else changes.
    window[0, 3, 0] = np.nan
    filled = window.copy()
    filled[0, 3, 0] = 2 * window[0, 3, 1] - window[0, 3, 2]
    np.testing.assert_array_equal(
        elevation.horn_gradient(window, 0.5), elevation.horn_gradient(filled, 0.5)
    )
    assert np.isnan(window[0, 3, 0])
    # At the corner of the ground the map sees what the whole ground does.
    corner = np.full((2, 8, 8), np.nan)
    corner[:, 1:, 1:] = ground[:, :7, :7]
    np.testing.assert_array_equal(
        elevation.horn_gradient(corner, 0.5), whole[:, :, :6, :6]
    )
