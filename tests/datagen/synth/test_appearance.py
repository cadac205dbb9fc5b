import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.datagen.noise import fractal_perlin
from benchnav.datagen.recipe.latent import latent_mean, latent_std
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.synth import appearance
from benchnav.datagen.synth.elevation import horn_gradient, pad_missing


@given(st.lists(st.floats(0.05, 1), min_size=1, max_size=6), st.integers(0, 5))
@settings(deadline=None)
def test_bands_meet_their_shares_to_a_cell(shares: list[float], seed: int) -> None:
    occupancy = np.array(shares) / sum(shares)
    noise = fractal_perlin(seed, ("n",), np.arange(2), (16, 16), [8, 4])
    bands = appearance.class_bands(noise, occupancy)
    for band in bands:
        counts = np.bincount(band.ravel(), minlength=len(shares))
        assert (np.abs(counts - occupancy * 256) <= 1).all()
    order = np.argsort(noise[0].ravel())
    assert (np.diff(bands[0].ravel()[order]) >= 0).all()


def test_perlin_noise_is_smooth_and_zero_at_its_lattice() -> None:
    noise = fractal_perlin(0, ("n",), np.arange(20), (64, 64), [16])
    assert 0.3 < np.abs(noise).max() < 0.75
    assert np.abs(np.diff(noise, axis=1)).max() < 0.2
    assert noise.std() > 0.15


def test_shading_is_lamberts_law() -> None:
    _, x = np.mgrid[:5, :5] * 0.5
    slope = np.tan(np.radians(20))
    plane = horn_gradient(pad_missing((slope * x)[None]), 0.5)
    light = appearance.light_direction(
        np.array([np.pi]), np.array([np.cos(np.radians(20))])
    )
    # Light along the plane's normal: full brightness. Overhead: cos 20°. Behind:
    # ambient alone.
    np.testing.assert_allclose(appearance.shade(*plane, light, 0.1), 1)
    overhead = np.array([[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(
        appearance.shade(*plane, overhead, 0.1), 0.1 + 0.9 * np.cos(np.radians(20))
    )
    grazing = np.array([[1.0, 0.0, 0.0]])
    np.testing.assert_allclose(appearance.shade(*plane, grazing, 0.1), 0.1)


def test_paint_scales_colours() -> None:
    colours = np.array([[200.0, 100, 50], [0, 10, 255]]).T.reshape(1, 3, 1, 2)
    image = appearance.paint(colours, np.array([[[0.5, 1.0]]]))
    assert image[0, :, 0].T.tolist() == [[100, 50, 25], [0, 10, 255]]


def test_latent_functions_follow_their_formula() -> None:
    classes = load_recipe("paper-v1").classes
    class_id, slope = np.array([[[3, 9]]]), np.array([[[10.0, 80.0]]])
    c = classes[3]
    expected = 1 - (c.scale * 1e-3 * 10**c.exponent + c.offset)
    assert latent_mean(class_id, slope, classes)[0, 0].tolist() == [
        pytest.approx(expected),
        0,
    ]
    assert latent_std(class_id, classes)[0, 0].tolist() == [
        classes[3].noise,
        classes[9].noise,
    ]
