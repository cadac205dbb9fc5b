"""Rough terrain: fractal elevation and craters, and slope by Horn's method.

Computations are in NumPy and float64, since NumPy's Fourier transform returns the same
numbers on every machine, in contrast to PyTorch's. Letters in shapes: B maps, H×W
cells, N craters.

Sources: Endo et al. (2024), "BenchNav: Simulation Platform for Benchmarking Off-road
Navigation Algorithms with Probabilistic Traversability", III-A; Yokokohji et al.
(2004) for fractal terrain; Pike (1977) for the proportions of craters; Horn (1981),
"Hill shading and the reflectance map", for slope.
"""

import numpy as np
from numpy import ndarray

from benchnav.core import rng

Shape = tuple[int, int]  # (H, W)


def fractal(key: int, indices: ndarray, shape: Shape, roughness: float) -> ndarray:
    """Return fractal surfaces from a power-law spectrum.

    Args:
        key: key of the random stream.
        indices: index of each map's element of the stream, shape [B].
        shape: number of rows and columns, (H, W).
        roughness: Hurst exponent in [0, 1]; the amplitude at a frequency f is
            proportional to f^−(roughness + 1).

    Returns:
        Surfaces scaled to a relief (maximum minus minimum) of 1, float64, shape [B, H,
        W].
    """
    frequency = _frequencies(shape)
    frequency[0, 0] = np.inf
    amplitude = frequency ** -(roughness + 1)
    white = rng.normal(key, indices, shape)
    surface = _filtered(white, amplitude)
    low = surface.min(axis=(1, 2), keepdims=True)
    high = surface.max(axis=(1, 2), keepdims=True)
    return (surface - low) / (high - low)


def open_fractal(
    key: int,
    indices: ndarray,
    shape: Shape,
    roughness: float,
    reference_cells: int,
) -> ndarray:
    """Return sections of fractal terrain that continues beyond the map.

    The spectrum is that of `fractal` for wavelengths below the side of the reference
    square, and flat for longer ones (von Kármán's spectrum). The steepness therefore
    does not depend on the size of the map. The surface is generated periodically, with
    twice the map's extent, and cropped, so that opposite edges of the map differ.

    Args:
        key: key of the random stream.
        indices: index of each map's element of the stream, shape [B].
        shape: number of rows and columns, (H, W).
        roughness: Hurst exponent in [0, 1].
        reference_cells: side of the reference square, on which relief is measured, in
            cells.

    Returns:
        Surfaces, float64, shape [B, H, W]. They are scaled so that the mean relief of
        the reference squares that cover the map is 1; these may extend beyond the map.

    Source: von Kármán (1948), "Progress in the statistical theory of turbulence", for
    the spectrum.
    """
    height, width = shape
    tiles_y = -(-height // reference_cells)
    tiles_x = -(-width // reference_cells)
    covered_y = tiles_y * reference_cells
    covered_x = tiles_x * reference_cells
    torus = (2 * covered_y, 2 * covered_x)
    frequency = np.hypot(_frequencies(torus), 1 / reference_cells)
    amplitude = frequency ** -(roughness + 1)
    white = rng.normal(key, indices, torus)
    surface = _filtered(white, amplitude)[:, :covered_y, :covered_x]
    tiles = surface.reshape(
        len(surface), tiles_y, reference_cells, tiles_x, reference_cells
    )
    tile_relief = tiles.max(axis=(2, 4)) - tiles.min(axis=(2, 4))
    relief = tile_relief.mean(axis=(1, 2))
    low = surface.min(axis=(1, 2))
    heights = surface[:, :height, :width] - low[:, None, None]
    return heights / relief[:, None, None]


def _frequencies(shape: Shape) -> ndarray:
    """Return the frequencies of a half spectrum, cycles per cell, [H, W // 2 + 1]."""
    frequency_y = np.fft.fftfreq(shape[0])[:, None]
    frequency_x = np.fft.rfftfreq(shape[1])[None, :]
    return np.hypot(frequency_y, frequency_x)


def _filtered(white: ndarray, amplitude: ndarray) -> ndarray:
    """Return white noise [B, H, W], with its spectrum multiplied by the amplitude."""
    spectrum = np.fft.rfft2(white) * amplitude
    return np.fft.irfft2(spectrum, s=white.shape[1:])


def place_craters(
    key: int,
    indices: ndarray,
    extent_m: tuple[float, float],
    count: ndarray,
    radius_m: tuple[float, float],
    max_count: int,
) -> tuple[ndarray, ndarray]:
    """Draw centres and radii of craters; craters that would overlap are rejected.

    Args:
        key: key of the random stream.
        indices: index of each map's element of the stream, shape [B].
        extent_m: size of the map in x and y, in metres.
        count: requested number of craters on each map, shape [B]. A map has fewer if
            too many draws are rejected.
        radius_m: minimum and maximum radius of a rim, in metres.
        max_count: maximum of `count` over all maps of the stream; it determines the
            number of draws per map.

    Returns:
        Centres (x, y) in metres, shape [B, N, 2], and radii in metres, shape [B, N]; a
        radius of 0 marks an unused entry.
    """
    n_draws = 12 * max_count
    shape = (max(n_draws, 1), 3)
    draws = rng.uniform(key, indices, shape)
    centres = draws[..., :2] * np.asarray(extent_m)
    # Small craters are more frequent: logarithms of radii are uniform.
    low, high = np.log(radius_m)
    log_radii = low + (high - low) * draws[..., 2]
    radii = np.exp(log_radii)
    accepted = np.zeros_like(radii)
    for i in range(n_draws):
        n_accepted = (accepted > 0).sum(axis=1)
        is_short = n_accepted < count
        if not is_short.any():
            break
        earlier = accepted[:, :i]
        radius = radii[:, i : i + 1]
        offset = centres[:, :i] - centres[:, i : i + 1]
        distance = np.hypot(*np.moveaxis(offset, -1, 0))
        is_apart = (earlier == 0) | (distance > earlier + radius)
        is_accepted = is_apart.all(axis=1) & is_short
        accepted[:, i] = np.where(is_accepted, radii[:, i], 0)
    n_accepted = (accepted > 0).sum(axis=1)
    # Accepted craters are moved to the front, in the order of their draws.
    order = np.argsort(accepted == 0, axis=1, kind="stable")
    order = order[:, : n_accepted.max(initial=0)]
    centres = np.take_along_axis(centres, order[..., None], axis=1)
    radii = np.take_along_axis(accepted, order, axis=1)
    return centres, radii


def crater_elevation(
    centres_m: ndarray,
    radii_m: ndarray,
    shape: Shape,
    resolution_m: float,
    depth_ratio: float,
) -> ndarray:
    """Return the elevation of craters: raised rims and parabolic bowls.

    Args:
        centres_m: centres (x, y) in metres, shape [B, N, 2].
        radii_m: radius of each rim in metres, 0 for unused entries, shape [B, N].
        shape: number of rows and columns, (H, W).
        resolution_m: cell width in metres.
        depth_ratio: depth of a bowl below its rim, divided by the rim's diameter. The
            rim is a fifth of the depth above the surrounding plain. Outside the rim,
            the height decreases with the inverse cube of the distance.

    Returns:
        Elevation to add to the terrain in metres, shape [B, H, W].
    """
    height, width = shape
    y = (np.arange(height)[:, None] + 0.5) * resolution_m
    x = (np.arange(width) + 0.5) * resolution_m
    added = np.zeros((len(radii_m), height, width))
    for radius, centre_x, centre_y in zip(radii_m.T, *centres_m.T, strict=True):
        radius = radius[:, None, None]
        offset_x = x - centre_x[:, None, None]
        offset_y = y - centre_y[:, None, None]
        distance = np.hypot(offset_x, offset_y)
        scale = np.where(radius > 0, radius, 1)
        ratio = distance / scale
        depth = 2 * radius * depth_ratio
        bowl = depth * (ratio**2 - 0.8)
        rim = 0.2 * depth * np.maximum(ratio, 1) ** -3.0
        added += np.where(ratio < 1, bowl, rim)
    return added


def horn_gradient(padded_m: ndarray, resolution_m: float) -> tuple[ndarray, ndarray]:
    """Return ∂z/∂x and ∂z/∂y by Horn's third-order finite differences.

    Args:
        padded_m: elevation in metres, padded by one cell of the surrounding terrain,
            shape [B, H + 2, W + 2]. NaN padding (`pad_missing`) is replaced by a linear
            extrapolation, so gradients of planes are exact at the edges too.
        resolution_m: cell width in metres.

    Returns:
        ∂z/∂x and ∂z/∂y, dimensionless, each of shape [B, H, W].
    """
    z = padded_m.copy()
    columns = z.transpose(2, 0, 1)
    rows = z.transpose(1, 0, 2)
    # Missing padding lies on the plane through the two cells next to it.
    for lines in (columns, rows):
        for edge, first, second in ((0, 1, 2), (-1, -2, -3)):
            plane = 2 * lines[first] - lines[second]
            padding = lines[edge]
            lines[edge] = np.where(np.isnan(padding), plane, padding)
    pairs_y = z[:, 1:] + z[:, :-1]
    pairs_x = z[:, :, 1:] + z[:, :, :-1]
    smooth_y = pairs_y[:, 1:] + pairs_y[:, :-1]
    smooth_x = pairs_x[:, :, 1:] + pairs_x[:, :, :-1]
    rise_x = smooth_y[:, :, 2:] - smooth_y[:, :, :-2]
    rise_y = smooth_x[:, 2:] - smooth_x[:, :-2]
    run_m = 8 * resolution_m
    return rise_x / run_m, rise_y / run_m


def inclination_deg(along_x: ndarray, along_y: ndarray) -> ndarray:
    """Return the angle between the terrain and the horizontal plane.

    Args:
        along_x: ∂z/∂x, any shape.
        along_y: ∂z/∂y, shape of `along_x`.

    Returns:
        Angle in degrees, in [0, 90), shape of `along_x`.
    """
    steepness = np.sqrt(along_x * along_x + along_y * along_y)
    return np.arctan(steepness) * (180 / np.pi)


def slopes_deg(elevation_m: ndarray, resolution_m: float) -> ndarray:
    """Return the slopes of maps whose surrounding terrain is unknown.

    Args:
        elevation_m: elevation in metres, shape [B, H, W].
        resolution_m: cell width in metres.

    Returns:
        Slope in degrees, float64, shape [B, H, W].
    """
    padded_m = pad_missing(elevation_m.astype(np.float64))
    gradient = horn_gradient(padded_m, resolution_m)
    return inclination_deg(*gradient)


def pad_missing(elevation_m: ndarray) -> ndarray:
    """Return maps [B, H, W] padded by one cell of NaN, shape [B, H + 2, W + 2]."""
    return np.pad(elevation_m, ((0, 0), (1, 1), (1, 1)), constant_values=np.nan)
