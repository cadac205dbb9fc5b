"""Dubins paths, against closed forms, the symmetries of the plane and all other paths of their kind."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.planning.dubins import (
    dubins_length,
    dubins_length_to_point,
    dubins_path,
    dubins_segments_to_point,
    sample_segments,
)

WORDS = ((1, 0, 1), (-1, 0, -1), (1, 0, -1), (-1, 0, 1), (1, -1, 1), (-1, 1, -1))
COORDINATE = st.floats(-8, 8, allow_nan=False)
ANGLE = st.floats(-math.pi, math.pi, allow_nan=False)
POSE = st.tuples(COORDINATE, COORDINATE, ANGLE)


def pose(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def random_poses(count: int, seed: int, size_m: float = 6.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return uniform * pose(size_m, size_m, math.tau) - pose(0, 0, math.pi)


def drive(start: np.ndarray, word: np.ndarray, lengths: np.ndarray, radius: float) -> np.ndarray:
    """Ends of three-segment paths by turning about circle centres in the complex plane."""
    position, heading = start[:, 0] + 1j * start[:, 1], start[:, 2].copy()
    for side, length in zip(word.T, lengths.T, strict=True):
        turn = side * length / radius
        centre = position + 1j * side * radius * np.exp(1j * heading)
        turned = centre + (position - centre) * np.exp(1j * turn)
        position = np.where(side == 0, position + length * np.exp(1j * heading), turned)
        heading = heading + turn
    return np.stack((position.real, position.imag, heading), axis=1)


@pytest.mark.parametrize(
    ("end", "radius", "length"),
    [
        ((5, 0, 0), 1.0, 5),
        ((0, 0, 0), 1.0, 0),
        ((0, 2, math.pi), 1.0, math.pi),
        ((0, -4, math.pi), 2.0, 2 * math.pi),
        ((1, 1, math.pi / 2), 1.0, math.pi / 2),
        ((-1, 1, -math.pi / 2), 1.0, 3 * math.pi / 2),
        ((4, 1, math.pi / 2), 1.0, 3 + math.pi / 2),
        ((0, 0, math.pi), 1.0, 7 * math.pi / 3),
    ],
)
def test_length_in_closed_form(end: tuple[float, ...], radius: float, length: float) -> None:
    assert dubins_length(pose(0, 0, 0), pose(*end), radius).item() == pytest.approx(length, abs=1e-8)


def test_no_path_of_the_six_words_is_shorter() -> None:
    # With the next test, which drives a path of that length, this makes the length exact.
    rng = np.random.default_rng(0)
    count, radius = 60_000, 0.8
    start = random_poses(count, seed=1).numpy()
    word = np.array(WORDS)[rng.integers(len(WORDS), size=count)]
    lengths = rng.uniform(0, math.tau * radius, (count, 3)) * rng.choice((1.0, 0.3, 0.02), (count, 3))
    end = drive(start, word, lengths, radius)
    shortest = dubins_length(torch.from_numpy(start), torch.from_numpy(end), radius).numpy()
    assert (shortest <= lengths.sum(axis=1) + 1e-9).all()
    assert np.isclose(shortest, lengths.sum(axis=1)).mean() > 0.2


def test_path_reaches_the_end_at_its_length() -> None:
    start, end, spacing, radius = random_poses(2000, 2), random_poses(2000, 3), 0.02, 1.3
    length = dubins_length(start, end, radius)
    path = dubins_path(start, end, radius, spacing, math.ceil(float(length.max()) / spacing) + 1)
    torch.testing.assert_close(path[:, 0], start)
    torch.testing.assert_close(path[:, -1, :2], end[:, :2])
    turned = torch.remainder(path[:, -1, 2] - end[:, 2] + 1, math.tau) - 1
    assert turned.abs().max() < 1e-8
    moved = path[:, 1:] - path[:, :-1]
    polyline = torch.hypot(moved[..., 0], moved[..., 1]).sum(dim=1)
    assert (polyline <= length + 1e-9).all()
    torch.testing.assert_close(polyline, length, rtol=1e-4, atol=1e-4)


def test_path_turns_no_tighter_than_the_radius_and_drives_forward() -> None:
    spacing, radius = 0.05, 0.7
    path = dubins_path(random_poses(500, 4), random_poses(500, 5), radius, spacing, 400)
    moved = path[:, 1:] - path[:, :-1]
    assert moved[..., 2].abs().max() <= spacing / radius + 1e-9
    middle = (path[:, 1:, 2] + path[:, :-1, 2]) / 2
    ahead = moved[..., 0] * middle.cos() + moved[..., 1] * middle.sin()
    aside = moved[..., 1] * middle.cos() - moved[..., 0] * middle.sin()
    assert ahead.min() >= 0
    assert aside.abs().max() < spacing**2 / (2 * radius)  # where one segment gives way to the next


def test_points_past_the_end_repeat_it() -> None:
    path = dubins_path(pose(0, 0, 0), pose(1, 0, 0), 1.0, 0.25, 8)
    torch.testing.assert_close(path[:5, 0], torch.arange(5) * pose(0.25))
    torch.testing.assert_close(path[4:], pose(1, 0, 0).expand(4, 3))


@settings(max_examples=200, deadline=None)
@given(POSE, POSE, POSE)
def test_length_is_the_same_anywhere_in_the_plane(
    start: tuple[float, ...], end: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    ends = torch.stack((pose(*start), pose(*end)))
    cos, sin = math.cos(shift[2]), math.sin(shift[2])
    x, y, heading = ends.unbind(1)
    moved = torch.stack(
        (x * cos - y * sin + shift[0], x * sin + y * cos + shift[1], heading + shift[2]), dim=1
    )
    expected = dubins_length(ends[0], ends[1], 1.0)
    torch.testing.assert_close(dubins_length(moved[0], moved[1], 1.0), expected, rtol=1e-6, atol=1e-6)


@settings(max_examples=200, deadline=None)
@given(POSE, POSE, st.floats(0.2, 5))
def test_length_mirrors_reverses_and_scales(
    start: tuple[float, ...], end: tuple[float, ...], scale: float
) -> None:
    ends = torch.stack((pose(*start), pose(*end)))
    expected = dubins_length(ends[0], ends[1], 1.0)
    mirrored = ends * pose(1, -1, -1)
    torch.testing.assert_close(dubins_length(mirrored[0], mirrored[1], 1.0), expected, rtol=1e-6, atol=1e-6)
    back = ends + pose(0, 0, math.pi)
    torch.testing.assert_close(dubins_length(back[1], back[0], 1.0), expected, rtol=1e-6, atol=1e-6)
    large = ends * pose(scale, scale, 1)
    length = dubins_length(large[0], large[1], scale)
    torch.testing.assert_close(length, expected * scale, rtol=1e-6, atol=1e-6)


def test_free_heading_is_the_best_of_all_headings() -> None:
    start, end = random_poses(150, 6, size_m=3.0), random_poses(150, 7, size_m=3.0)
    headings = torch.linspace(0, math.tau, 2001, dtype=torch.float64)
    ends = torch.cat((end[:, None, :2].expand(-1, 2001, -1), headings.expand(150, -1)[..., None]), dim=-1)
    brute = dubins_length(start[:, None], ends, 1.0).amin(dim=1)
    length = dubins_length_to_point(start, end[:, :2], 1.0)
    assert (length <= brute + 1e-9).all()
    torch.testing.assert_close(length, brute, rtol=0, atol=1e-4)
    inside = (brute > math.pi + 0.1).sum()
    assert inside > 5  # points within the turning circles, the harder case, are among them


def test_free_heading_path_reaches_the_point() -> None:
    start, point = random_poses(1000, 8, size_m=3.0), random_poses(1000, 9, size_m=3.0)[:, :2]
    segments = dubins_segments_to_point(start, point, 1.0)
    torch.testing.assert_close(segments.total_m, dubins_length_to_point(start, point, 1.0))
    path = sample_segments(start, segments, 0.1, 120)
    torch.testing.assert_close(path[:, -1, :2], point)
    assert segments.curvature.abs().max() <= 1


def test_nearly_straight_ahead_is_nearly_straight_in_single_precision() -> None:
    # Rounding must not turn "no arc" into a full circle.
    generator = torch.Generator().manual_seed(10)
    count = 20_000
    signs = torch.randint(0, 2, (2, count), generator=generator) * 2.0 - 1
    aside, turn = signs * 10 ** (torch.rand(2, count, generator=generator) * 6 - 9)
    x = torch.rand(count, generator=generator) * 26 + 4
    start, end = torch.zeros(count, 3), torch.stack((x, aside, turn), dim=1)
    torch.testing.assert_close(dubins_length(start, end, 1.0), x, rtol=0, atol=0.01)
    torch.testing.assert_close(dubins_length_to_point(start, end[:, :2], 1.0), x, rtol=0, atol=0.01)


def test_leading_dimensions_and_radii_broadcast() -> None:
    start, end = random_poses(4, 11), random_poses(5, 12)
    radius = torch.tensor([0.5, 1.0, 1.5, 2.0], dtype=torch.float64)
    lengths = dubins_length(start[:, None], end[None], radius[:, None])
    assert lengths.shape == (4, 5)
    one = dubins_length(start[2], end[3], 1.5)
    torch.testing.assert_close(lengths[2, 3], one)
    assert dubins_path(start[:, None], end[None], radius[:, None], 0.1, 7).shape == (4, 5, 7, 3)
