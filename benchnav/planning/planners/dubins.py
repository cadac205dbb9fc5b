"""Dubins paths to a point: shortest ways of a vehicle that drives forward and turns no
tighter than a radius.

A path is a row of arcs and straights, "segments", each with a curvature and a length.
From a pose (x, y, θ) to a point at which any heading will do the shortest has two: an
arc of the least radius and a straight or, for a point inside the turning circle, an arc
away from it and one back. A point to the right is solved by mirroring it to the left.

Sources: Dubins (1957), "On curves of minimal length with a constraint on average
curvature"; Boissonnat and Bui (1994), "Accessibility region for a car that only moves
forwards along optimal paths" (free heading).
Letters in shapes: N points, G segments.
"""

import math

import torch
from torch import Tensor


def dubins_length_to_point(
    start: Tensor, point: Tensor, radius: float | Tensor
) -> Tensor:
    """Length of the shortest path to points with free heading; see
    `dubins_segments_to_point`.
    """
    arc, rest, *_ = _to_point(start, point, radius)
    return (arc + rest) * radius


def dubins_segments_to_point(
    start: Tensor, point: Tensor, radius: Tensor, far_side: bool = False
) -> tuple[Tensor, Tensor]:
    """Finds the shortest path from poses to points at which any heading will do.

    Args:
        start: poses (x, y, θ) in metres and radians, shape [*B, 3].
        point: positions (x, y), shape [*B, 2]; the leading dimensions of both
            broadcast.
        radius: least turning radius in metres, broadcasts to [*B].
        far_side: on the turning circle that lies away from the point, in place of the
            shortest.

    Returns:
        Curvatures, positive to the left, in 1/m, and lengths in metres of two segments,
        an arc and a straight or two arcs, each of shape [*B, 2].
    """
    arc, rest, side, inside = _to_point(start, point, radius, far_side)
    sides = torch.where(inside, -side, side), torch.where(inside, side, 0)
    radius = radius[..., None]
    return torch.stack(sides, dim=-1) / radius, torch.stack(
        (arc, rest), dim=-1
    ) * radius


def sample_segments(
    start: Tensor, curvature: Tensor, length_m: Tensor, spacing: float, count: int
) -> Tensor:
    """Samples paths by arc length.

    Args:
        start: poses (x, y, θ) in metres and radians, shape [*B, 3].
        curvature: of the segments, shape [*B, G].
        length_m: of the segments, shape [*B, G].
        spacing: arc length from one point to the next in metres.
        count: number of points N; those past the end repeat the end pose.

    Returns:
        Poses, shape [*B, N, 3]; headings run on without wrapping.
    """
    arc = torch.arange(count, dtype=start.dtype, device=start.device) * spacing
    x, y, heading = (start[..., i, None] for i in range(3))
    begin, at_begin = torch.zeros_like(heading), heading
    for bend, length in zip(
        curvature[..., None].unbind(-2), length_m[..., None].unbind(-2), strict=True
    ):
        within = torch.minimum((arc - begin).clamp(min=0), length)
        half_turn = within * (0.5 * bend)
        chord = within * torch.sinc(half_turn / math.pi)
        x = x + chord * (at_begin + half_turn).cos()
        y = y + chord * (at_begin + half_turn).sin()
        heading = heading + 2 * half_turn
        begin = begin + length
        at_begin = at_begin + bend * length
    return torch.stack((x, y, heading), dim=-1)


def _to_point(
    start: Tensor, point: Tensor, radius: float | Tensor, far_side: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lengths of both segments in radii, the side of the first circle (±1), whether it
    holds the point.
    """
    # The point as the pose has it, ahead and to the left, in radii.
    scale = 1 / radius
    offset_x, offset_y = (
        (point[..., 0] - start[..., 0]) * scale,
        (point[..., 1] - start[..., 1]) * scale,
    )
    cos, sin = start[..., 2].cos(), start[..., 2].sin()
    x, y = offset_x * cos + offset_y * sin, offset_y * cos - offset_x * sin
    side = torch.where(y < 0, -1.0, 1.0).to(y)
    y = y.abs()
    if far_side:
        side, y = -side, -y
    power = x * x + y * (y - 2)  # of the point over the left circle, centre (0, 1)
    inside = power < 0
    # The arc ends where its tangent meets the point.
    straight = power.clamp(min=0).sqrt()
    arc = _wrap(
        torch.atan2(y - 1, x) + torch.atan2(torch.ones_like(straight), straight)
    )
    # Triangle of the right circle's centre (0, -1), the last circle's centre (2 away)
    # and the point.
    square = x * x + (y + 1) * (y + 1)
    apex = torch.acos(((square + 3) / (4 * square.sqrt())).clamp(-1, 1))
    away = _wrap(math.pi / 2 + apex - torch.atan2(y + 1, x))
    back = math.tau - torch.acos(((5 - square) / 4).clamp(-1, 1))
    return (
        torch.where(inside, away, arc),
        torch.where(inside, back, straight),
        side,
        inside,
    )


def _wrap(angle: Tensor) -> Tensor:
    """Angles in [0, 2π); rounding just under a full turn counts as none."""
    wrapped = torch.remainder(angle, math.tau)
    return torch.where(
        wrapped > math.tau - torch.finfo(angle.dtype).eps ** 0.75, 0, wrapped
    )
