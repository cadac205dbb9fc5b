"""Dubins paths to a point: shortest paths of a vehicle that only drives forward.

The vehicle has a minimum turning radius. A path is a sequence of arcs and straight
lines, "segments", each with a curvature and a length. From a pose (x, y, θ) to a point
with any heading, the shortest path has two segments: an arc of the minimum radius and a
straight line. If the point is inside the turning circle, the segments are two arcs: one
away from the point, then one back to it. A point to the right of the vehicle is
mirrored to the left.

Sources: Dubins (1957), "On curves of minimal length with a constraint on average
curvature"; Boissonnat and Bui (1994), "Accessibility region for a car that only moves
forwards along optimal paths" (any final heading).
Letters in shapes: N points, G segments.
"""

import math

import torch
from torch import Tensor


def dubins_length_to_point(
    start: Tensor, point: Tensor, radius: float | Tensor
) -> Tensor:
    """Return the lengths in metres of shortest paths to points with any heading.

    The arguments are those of `dubins_segments_to_point`.
    """
    arc, second, *_ = _to_point(start, point, radius)
    return (arc + second) * radius


def dubins_segments_to_point(
    start: Tensor, point: Tensor, radius: Tensor, far_side: bool = False
) -> tuple[Tensor, Tensor]:
    """Return shortest paths from poses to points with any heading.

    Args:
        start: poses (x, y, θ) in metres and radians, shape [*B, 3].
        point: positions (x, y) in metres, shape [*B, 2]. The leading dimensions of
            `start`, `point` and `radius` broadcast.
        radius: minimum turning radius in metres, shape [*B].
        far_side: whether to use the turning circle on the side away from the point,
            which makes the path longer.

    Returns:
        Curvatures in 1/m, positive to the left, and lengths in metres of the two
        segments, each of shape [*B, 2].
    """
    arc, second, side, inside = _to_point(start, point, radius, far_side)
    first_side = torch.where(inside, -side, side)
    second_side = torch.where(inside, side, 0)
    radius = radius[..., None]
    curvature = torch.stack((first_side, second_side), dim=-1) / radius
    return curvature, torch.stack((arc, second), dim=-1) * radius


def sample_segments(
    start: Tensor, curvature: Tensor, length_m: Tensor, spacing: float, count: int
) -> Tensor:
    """Sample paths by arc length.

    Args:
        start: poses (x, y, θ) in metres and radians, shape [*B, 3].
        curvature: curvatures of the segments in 1/m, shape [*B, G].
        length_m: lengths of the segments in metres, shape [*B, G].
        spacing: arc length between neighbouring points in metres.
        count: number of points N; points beyond the end repeat the end pose.

    Returns:
        Poses (x, y, θ), shape [*B, N, 3]; θ is continuous and not wrapped.
    """
    arc = torch.arange(count, dtype=start.dtype, device=start.device) * spacing
    x = start[..., 0, None]
    y = start[..., 1, None]
    heading = start[..., 2, None]
    begin = torch.zeros_like(heading)
    at_begin = heading
    curvatures = curvature[..., None].unbind(-2)
    lengths = length_m[..., None].unbind(-2)
    for bend, length in zip(curvatures, lengths, strict=True):
        within = torch.minimum((arc - begin).clamp(min=0), length)
        half_turn = within * (0.5 * bend)
        chord = within * torch.sinc(half_turn / math.pi)
        mean = at_begin + half_turn
        x = x + chord * mean.cos()
        y = y + chord * mean.sin()
        heading = heading + 2 * half_turn
        begin = begin + length
        at_begin = at_begin + bend * length
    return torch.stack((x, y, heading), dim=-1)


def _to_point(
    start: Tensor, point: Tensor, radius: float | Tensor, far_side: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the segments of shortest paths; see `dubins_segments_to_point`.

    Returns:
        Lengths of the two segments in radii, the side of a turning circle (1 left, −1
        right), and a mask of points inside that circle, each of shape [*B]. The circle
        is on the point's side or, with `far_side`, on the other side.
    """
    # (x, y) is the point in the robot's frame, in radii: x ahead and y to the left.
    scale = 1 / radius
    dx = (point[..., 0] - start[..., 0]) * scale
    dy = (point[..., 1] - start[..., 1]) * scale
    cos = start[..., 2].cos()
    sin = start[..., 2].sin()
    x = dx * cos + dy * sin
    y = dy * cos - dx * sin
    side = torch.where(y < 0, -1.0, 1.0).to(y)
    y = y.abs()
    if far_side:
        side = -side
        y = -y
    # Power of the point with respect to the left circle, whose centre is (0, 1).
    power = x * x + y * (y - 2)
    inside = power < 0
    # If the point is outside the circle, the arc ends where its tangent meets the
    # point.
    straight = power.clamp(min=0).sqrt()
    tangent = torch.atan2(torch.ones_like(straight), straight)
    arc = _wrap(torch.atan2(y - 1, x) + tangent)
    # If the point is inside the circle, consider the triangle of three points: the
    # centre of the right circle, (0, −1); the centre of the second circle, at distance
    # 2 from it; and the point, at distance 1 from the centre of the second circle.
    square = x * x + (y + 1) * (y + 1)
    apex_cos = (square + 3) / (4 * square.sqrt())
    apex = torch.acos(apex_cos.clamp(-1, 1))
    bearing = torch.atan2(y + 1, x)
    away = _wrap(math.pi / 2 + apex - bearing)
    back_cos = (5 - square) / 4
    back = math.tau - torch.acos(back_cos.clamp(-1, 1))
    first = torch.where(inside, away, arc)
    second = torch.where(inside, back, straight)
    return first, second, side, inside


def _wrap(angle: Tensor) -> Tensor:
    """Return angles in [0, 2π); angles just below 2π, within rounding, become 0."""
    wrapped = torch.remainder(angle, math.tau)
    tolerance = torch.finfo(angle.dtype).eps ** 0.75
    return torch.where(wrapped > math.tau - tolerance, 0, wrapped)
