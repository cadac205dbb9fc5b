"""What the ground looks like, against a model of colour blindness."""

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from benchnav.core.figures import bytes_of
from benchnav.eval.report.plan_layers import IMMOBILISING, field_colours

# Machado, Oliveira and Fernandes (2009), full severity, on linear RGB.
SEEN = {
    "all": np.eye(3),
    "without red": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "without green": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "without blue": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def lab(colours: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """CIE L*a*b* of sRGB colours in [0, 1], as somebody sees them."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = (linear @ seen.T).clip(0, 1) @ to_xyz.T / to_xyz.sum(axis=1)
    x, y, z = np.moveaxis(np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116), -1, 0)
    return np.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), axis=-1)


@pytest.mark.parametrize("seen", SEEN)
def test_what_immobilises_a_robot_has_a_colour_that_no_traversability_has(seen: str) -> None:
    shades = field_colours(np.linspace(0, 1, 256)[None], np.zeros((1, 256), bool))[0] / 255
    away = lab(shades, SEEN[seen]) - lab(np.array(to_rgb(IMMOBILISING)), SEEN[seen])
    # A difference of 2.3 can just be seen.
    assert np.linalg.norm(away, axis=1).min() > 30


def test_cells_have_the_colour_of_their_own_traversability_or_that_of_what_holds() -> None:
    field = np.random.default_rng(0).random((5, 7))
    immobilising = field < 0.3
    colours = field_colours(field, immobilising)
    assert (colours.dtype, colours.shape) == (np.uint8, (5, 7, 3))
    usual = np.round(255 * matplotlib.colormaps["viridis"](field)[..., :3])
    np.testing.assert_array_equal(colours[~immobilising], usual[~immobilising])
    assert (colours[immobilising] == bytes_of(IMMOBILISING)[:3]).all()
