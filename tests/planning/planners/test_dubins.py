"""Dubins paths to points, against closed forms, the symmetries of the plane and random
paths of their kind.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.planning.planners.dubins import (
    dubins_length_to_point,
    dubins_segments_to_point,
    sample_segments,
)

WORDS = np.array(
    [(a, b, c) for a in (1, 0, -1) for b in (1, 0, -1) for c in (1, 0, -1)]
)
COORDINATE = st.floats(-8, 8, allow_nan=False)
ANGLE = st.floats(-math.pi, math.pi, allow_nan=False)
POSE = st.tuples(COORDINATE, COORDINATE, ANGLE)
POINT = st.tuples(COORDINATE, COORDINATE)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def random_poses(count: int, seed: int, size_m: float = 6.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return uniform * tensor(size_m, size_m, math.tau) - tensor(0, 0, math.pi)


def drive(
    start: np.ndarray, word: np.ndarray, lengths: np.ndarray, radius: float
) -> np.ndarray:
    """Ends of paths of arcs and straights by turning about circle centres in the
    complex plane.
    """
    position, heading = start[:, 0] + 1j * start[:, 1], start[:, 2].copy()
    for side, length in zip(word.T, lengths.T, strict=True):
        turn = side * length / radius
        centre = position + 1j * side * radius * np.exp(1j * heading)
        turned = centre + (position - centre) * np.exp(1j * turn)
        position = np.where(side == 0, position + length * np.exp(1j * heading), turned)
        heading = heading + turn
    return np.stack((position.real, position.imag), axis=1)


@pytest.mark.parametrize(
    ("point", "radius", "length"),
    [
        ((5, 0), 1.0, 5),
        ((0, 0), 1.0, 0),
        ((0, 2), 1.0, math.pi),
        ((0, -4), 2.0, 2 * math.pi),
        ((1, 1), 1.0, math.pi / 2),
        ((-1, 1), 1.0, 3 * math.pi / 2),
        ((1, -4), 1.0, 3 + math.pi / 2),
        ((-4, 0), 1.0, 4 + math.pi + 2 * math.atan(1 / 4)),
        ((0, 1), 1.0, math.acos(7 / 8) + math.tau - math.acos(1 / 4)),
    ],
)
def test_length_in_closed_form(
    point: tuple[float, ...], radius: float, length: float
) -> None:
    # The last point is the centre of the circle: the circles' centres are 2 apart, the
    # point 2 from one of them and 1 from the other, which by the law of cosines gives
    # both angles.
    got = dubins_length_to_point(tensor(0, 0, 0), tensor(*point), radius).item()
    assert got == pytest.approx(length, abs=1e-8)


def test_no_path_of_arcs_and_straights_is_shorter() -> None:
    # With the next test, which drives a path of that length, this makes the length
    # exact.
    rng = np.random.default_rng(0)
    count, radius = 100_000, 0.8
    start = random_poses(count, seed=1).numpy()
    word = WORDS[rng.integers(len(WORDS), size=count)]
    lengths = rng.uniform(0, math.tau * radius, (count, 3)) * rng.choice(
        (1.0, 0.3, 0.02, 0.0), (count, 3)
    )
    point = torch.from_numpy(drive(start, word, lengths, radius))
    shortest = dubins_length_to_point(torch.from_numpy(start), point, radius).numpy()
    # On the turning circles the length jumps: just within, the point is no longer
    # reached by the arc alone.
    beside = radius * np.stack((-np.sin(start[:, 2]), np.cos(start[:, 2])), axis=1)
    off_circle = [
        np.abs(
            np.linalg.norm(point.numpy() - start[:, :2] - side * beside, axis=1)
            - radius
        )
        for side in (1, -1)
    ]
    clear = np.minimum(*off_circle) > 1e-6
    assert clear.mean() > 0.7
    optimal = np.isclose(shortest, lengths.sum(axis=1), rtol=0, atol=1e-6) & clear
    assert (shortest <= lengths.sum(axis=1) + 1e-6)[clear].all()
    assert optimal.mean() > 0.1
    away_and_back = (
        (word[:, 0] * word[:, 1] == -1)
        & (lengths[:, :2] > 0.01).all(axis=1)
        & (lengths[:, 2] == 0)
    )
    assert (
        optimal & away_and_back
    ).sum() > 50  # to points within the turning circles, the harder case


@pytest.mark.parametrize("size_m", [2.0, 6.0])
def test_path_reaches_the_point_at_its_length_forward_and_no_tighter_than_the_radius(
    size_m: float,
) -> None:
    spacing, radius = 0.02, 0.7
    start, point = random_poses(1000, 2, size_m), random_poses(1000, 3, size_m)[:, :2]
    length = dubins_length_to_point(start, point, radius)
    curvature, lengths = dubins_segments_to_point(start, point, tensor(radius))
    torch.testing.assert_close(lengths.sum(-1), length)
    path = sample_segments(
        start, curvature, lengths, spacing, math.ceil(float(length.max()) / spacing) + 1
    )
    torch.testing.assert_close(path[:, 0], start)
    torch.testing.assert_close(path[:, -1, :2], point)
    moved = path[:, 1:] - path[:, :-1]
    polyline = torch.hypot(moved[..., 0], moved[..., 1]).sum(dim=1)
    assert (polyline <= length + 1e-9).all()
    torch.testing.assert_close(polyline, length, rtol=1e-4, atol=1e-4)
    assert moved[..., 2].abs().max() <= spacing / radius + 1e-9
    middle = (path[:, 1:, 2] + path[:, :-1, 2]) / 2
    ahead = moved[..., 0] * middle.cos() + moved[..., 1] * middle.sin()
    aside = moved[..., 1] * middle.cos() - moved[..., 0] * middle.sin()
    assert ahead.min() >= 0
    # where one segment gives way to the next
    assert aside.abs().max() < spacing**2 / (2 * radius)


def test_points_past_the_end_repeat_it() -> None:
    path = sample_segments(tensor(0, 0, 0), tensor(0, 1), tensor(1, 0), 0.25, 8)
    torch.testing.assert_close(path[:5, 0], torch.arange(5) * tensor(0.25))
    torch.testing.assert_close(path[4:], tensor(1, 0, 0).expand(4, 3))


@settings(max_examples=200, deadline=None)
@given(POSE, POINT, POSE)
def test_length_is_the_same_anywhere_in_the_plane(
    start: tuple[float, ...], point: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    cos, sin = math.cos(shift[2]), math.sin(shift[2])

    def move(x: float, y: float) -> tuple[float, float]:
        return x * cos - y * sin + shift[0], x * sin + y * cos + shift[1]

    expected = dubins_length_to_point(tensor(*start), tensor(*point), 1.0)
    moved = tensor(*move(*start[:2]), start[2] + shift[2])
    got = dubins_length_to_point(moved, tensor(*move(*point)), 1.0)
    assert_same_length(got, expected, tensor(*start), tensor(*point))


@settings(max_examples=200, deadline=None)
@given(POSE, POINT, st.floats(0.2, 5))
def test_length_mirrors_and_scales(
    start: tuple[float, ...], point: tuple[float, ...], scale: float
) -> None:
    begin, end = tensor(*start), tensor(*point)
    expected = dubins_length_to_point(begin, end, 1.0)
    mirrored = dubins_length_to_point(
        begin * tensor(1, -1, -1), end * tensor(1, -1), 1.0
    )
    assert_same_length(mirrored, expected, begin, end)
    large = dubins_length_to_point(begin * tensor(scale, scale, 1), end * scale, scale)
    assert_same_length(large / scale, expected, begin, end)


def assert_same_length(
    got: torch.Tensor, expected: torch.Tensor, start: torch.Tensor, end: torch.Tensor
) -> None:
    """Compares lengths, but for points on the turning circles, where they jump."""
    beside = torch.stack((-start[2].sin(), start[2].cos()))
    centres = start[:2] + torch.stack((beside, -beside))
    off_circle = (torch.linalg.vector_norm(end - centres, dim=1) - 1).abs().min()
    if off_circle > 1e-6:
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)


def test_nearly_straight_ahead_is_nearly_straight_in_single_precision() -> None:
    # Rounding must not turn "no arc" into a full circle.
    generator = torch.Generator().manual_seed(10)
    count = 20_000
    sign = torch.randint(0, 2, (count,), generator=generator) * 2.0 - 1
    aside = sign * 10 ** (torch.rand(count, generator=generator) * 6 - 9)
    x = torch.rand(count, generator=generator) * 26 + 4
    length = dubins_length_to_point(
        torch.zeros(count, 3), torch.stack((x, aside), dim=1), 1.0
    )
    torch.testing.assert_close(length, x, rtol=0, atol=0.01)


def test_leading_dimensions_and_radii_broadcast() -> None:
    start, point = random_poses(4, 11), random_poses(5, 12)[:, :2]
    radius = tensor(0.5, 1.0, 1.5, 2.0)
    lengths = dubins_length_to_point(start[:, None], point[None], radius[:, None])
    assert lengths.shape == (4, 5)
    torch.testing.assert_close(
        lengths[2, 3], dubins_length_to_point(start[2], point[3], 1.5)
    )
    curvature, parts = dubins_segments_to_point(
        start[:, None], point[None], radius[:, None]
    )
    torch.testing.assert_close(parts.sum(-1), lengths)
    assert sample_segments(start[:, None], curvature, parts, 0.1, 7).shape == (
        4,
        5,
        7,
        3,
    )
