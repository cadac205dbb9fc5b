"""Rough ground: fractal elevation and craters, and its slope by Horn's method.

Batched NumPy in float64: NumPy's Fourier transform gives the same numbers on every
machine, those that PyTorch links to do not. Letters in shapes: B maps, H×W cells.

Sources: paper III-A; Yokokohji et al. (2004) for fractal terrain; Pike (1977) for the
proportions of craters; Horn (1981), "Hill shading and the reflectance map", for slope.
"""

import numpy as np
from numpy import ndarray

from benchnav.core import rng

Shape = tuple[int, int]  # (H, W)


def fractal(key: int, indices: ndarray, shape: Shape, roughness: float) -> ndarray:
    """Synthesises fractal surfaces from a power-law spectrum.

    Args:
        key: stream key.
        indices: elements of the stream, shape [B].
        shape: (H, W).
        roughness: Hurst exponent in (0, 1); amplitude falls with frequency to the
            −(roughness + 1).

    Returns:
        Surfaces scaled to a relief (highest minus lowest) of 1, float64, shape [B, H,
        W].
    """
    frequency = _frequencies(shape)
    frequency[0, 0] = np.inf
    surface = _filtered(rng.normal(key, indices, shape), frequency ** -(roughness + 1))
    low = surface.min(axis=(1, 2), keepdims=True)
    return (surface - low) / (surface.max(axis=(1, 2), keepdims=True) - low)


def open_fractal(
    key: int,
    indices: ndarray,
    shape: Shape,
    roughness: float,
    reference_cells: int,
) -> ndarray:
    """Synthesises pieces of fractal ground that goes on beyond the map.

    The spectrum is `fractal`'s for wavelengths under the reference side and levels off
    above it (von Kármán's), so that the ground is as steep on a map of any size. The
    surface is made on twice the
    extent, as a torus, and cropped: the map's opposite edges are no neighbours.

    Args:
        key: stream key.
        indices: elements of the stream, shape [B].
        shape: (H, W).
        roughness: Hurst exponent in (0, 1).
        reference_cells: side of the square that relief is measured on, in cells.

    Returns:
        Surfaces scaled so that highest minus lowest is 1 on the mean of the squares
        that cover the map from its corner, the last of them reaching beyond it;
        float64, shape [B, H, W].

    Source: von Kármán (1948), "Progress in the statistical theory of turbulence", for
    the spectrum.
    """
    tiles_y, tiles_x = (-(-cells // reference_cells) for cells in shape)
    covered = tiles_y * reference_cells, tiles_x * reference_cells
    twice = 2 * covered[0], 2 * covered[1]
    amplitude = np.hypot(_frequencies(twice), 1 / reference_cells) ** -(roughness + 1)
    surface = _filtered(rng.normal(key, indices, twice), amplitude)[
        :, : covered[0], : covered[1]
    ]
    tiles = surface.reshape(
        len(surface), tiles_y, reference_cells, tiles_x, reference_cells
    )
    relief = (tiles.max(axis=(2, 4)) - tiles.min(axis=(2, 4))).mean(axis=(1, 2))
    low = surface.min(axis=(1, 2))
    return (surface[:, : shape[0], : shape[1]] - low[:, None, None]) / relief[
        :, None, None
    ]


def _frequencies(shape: Shape) -> ndarray:
    """Of the half spectrum of (H, W) cells, in cycles a cell, shape [H, W // 2 + 1]."""
    return np.hypot(
        np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    )


def _filtered(white: ndarray, amplitude: ndarray) -> ndarray:
    """Noise of a spectrum, shape of `white`, [B, H, W]."""
    return np.fft.irfft2(np.fft.rfft2(white) * amplitude, s=white.shape[1:])


def place_craters(
    key: int,
    indices: ndarray,
    extent_m: tuple[float, float],
    count: ndarray,
    radius_m: tuple[float, float],
    most: int,
) -> tuple[ndarray, ndarray]:
    """Draws centres and radii of craters whose rims do not overlap, by sequential
    rejection.

    Args:
        key: stream key.
        indices: elements of the stream, shape [B].
        extent_m: size of the map along x and y.
        count: craters asked for in each map, shape [B]; a map too crowded for them gets
            fewer.
        radius_m: smallest and largest radius of a rim.
        most: most craters of any map of the stream; fixes how many numbers a map draws.

    Returns:
        Centres (x, y) in metres, shape [B, N, 2], and radii, shape [B, N]; radius 0
        means no crater.
    """
    tries = 12 * most
    draws = rng.uniform(key, indices, (max(tries, 1), 3))
    centres = draws[..., :2] * np.asarray(extent_m)
    # Small craters are the more frequent: uniform in log radius.
    low, high = np.log(radius_m)
    radii = np.exp(low + (high - low) * draws[..., 2])
    kept = np.zeros_like(radii)
    for i in range(tries):
        wanted = (kept > 0).sum(axis=1) < count
        if not wanted.any():
            break
        gap = np.hypot(*np.moveaxis(centres[:, :i] - centres[:, i : i + 1], -1, 0))
        apart = ((kept[:, :i] == 0) | (gap > kept[:, :i] + radii[:, i : i + 1])).all(
            axis=1
        )
        kept[:, i] = np.where(apart & wanted, radii[:, i], 0)
    # Those that were placed first, in their order.
    order = np.argsort(kept == 0, axis=1, kind="stable")[
        :, : (kept > 0).sum(axis=1).max(initial=0)
    ]
    return np.take_along_axis(centres, order[..., None], axis=1), np.take_along_axis(
        kept, order, axis=1
    )


def crater_elevation(
    centres_m: ndarray,
    radii_m: ndarray,
    shape: Shape,
    resolution_m: float,
    depth_ratio: float,
) -> ndarray:
    """Raises rims and sinks parabolic bowls.

    Args:
        centres_m: shape [B, N, 2].
        radii_m: radius of each rim, 0 for none, shape [B, N].
        shape: (H, W).
        resolution_m: cell width.
        depth_ratio: depth of a bowl below its rim over its diameter; the rim stands a
            fifth of the depth over the plain and falls off outside with the cube of the
            distance.

    Returns:
        Elevation to be added, metres, shape [B, H, W].
    """
    y, x = ((np.arange(n) + 0.5) * resolution_m for n in shape)
    added = np.zeros((len(radii_m), *shape))
    for radius, centre_x, centre_y in zip(radii_m.T, *centres_m.T, strict=True):
        radius = radius[:, None, None]
        distance = np.hypot(
            x - centre_x[:, None, None], y[:, None] - centre_y[:, None, None]
        )
        ratio = distance / np.where(radius > 0, radius, 1)
        depth = 2 * radius * depth_ratio
        bowl = depth * (ratio**2 - 0.8)
        rim = 0.2 * depth * np.maximum(ratio, 1) ** -3.0
        added += np.where(ratio < 1, bowl, rim)
    return added


def horn_gradient(framed_m: ndarray, resolution_m: float) -> tuple[ndarray, ndarray]:
    """Estimates ∂z/∂x and ∂z/∂y by Horn's third-order finite differences.

    Args:
        framed_m: elevation with the ground one cell beyond the map, shape [B, H + 2, W
            + 2]; where that is NaN, not known, the surface is continued linearly, so
            that planes are exact everywhere. See `framed`.
        resolution_m: cell width.

    Returns:
        Two arrays of shape [B, H, W], metres a metre.
    """
    z = framed_m.copy()
    # Where the frame is not known, the plane through the two cells next to it.
    for lines in (z.transpose(2, 0, 1), z.transpose(1, 0, 2)):  # columns, then rows
        for edge, next_to, beyond in ((0, 1, 2), (-1, -2, -3)):
            lines[edge] = np.where(
                np.isnan(lines[edge]), 2 * lines[next_to] - lines[beyond], lines[edge]
            )
    pairs_y, pairs_x = z[:, 1:] + z[:, :-1], z[:, :, 1:] + z[:, :, :-1]
    smooth_y, smooth_x = (
        pairs_y[:, 1:] + pairs_y[:, :-1],
        pairs_x[:, :, 1:] + pairs_x[:, :, :-1],
    )
    along_x = smooth_y[:, :, 2:] - smooth_y[:, :, :-2]
    along_y = smooth_x[:, 2:] - smooth_x[:, :-2]
    return along_x / (8 * resolution_m), along_y / (8 * resolution_m)


def inclination_deg(along_x: ndarray, along_y: ndarray) -> ndarray:
    """Angle between the ground and the horizontal.

    Args:
        along_x: ∂z/∂x, any shape.
        along_y: ∂z/∂y, shape of `along_x`.

    Returns:
        Degrees in [0, 90), shape of `along_x`.
    """
    return np.arctan(np.sqrt(along_x * along_x + along_y * along_y)) * (180 / np.pi)


def slopes_deg(elevation_m: ndarray, resolution_m: float) -> ndarray:
    """Slopes of maps of which nothing beyond is known, float64, shape [B, H, W] of
    both.
    """
    return inclination_deg(
        *horn_gradient(framed(elevation_m.astype(np.float64)), resolution_m)
    )


def framed(elevation_m: ndarray) -> ndarray:
    """Frames maps [B, H, W] with one cell of ground that is not known, NaN, shape [B, H
    + 2, W + 2].
    """
    return np.pad(elevation_m, ((0, 0), (1, 1), (1, 1)), constant_values=np.nan)
