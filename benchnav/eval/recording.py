"""An episode with all that is shown of it, and the file that holds it.

Running fills it. Viewer files, videos, comparisons and figures are made of it alone,
without dataset or prediction.
Letters in shapes: N steps, H×W cells, S state and A action dimensions, P points.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from torch import Tensor

from benchnav.core.grid import Grid, outline
from benchnav.core.store import replacing
from benchnav.eval.folder.run_folder import damaged
from benchnav.planning.world.outcome import Outcome

# The ground that whole driven paths of a run are shown on, in its folder.
GROUND = "ground.npz"
# What one map under one draw of λ is known by.
MAP = ["data", "scenario", "world", "seed", "realisation", "map"]
# The moment that figures show: about half-way for most episodes; the paper shows 25 s,
# when robots here have mostly arrived.
MOMENT_S = 15.0
# Of a layer of a plan in a recording: keeps long episodes of planners with many
# thoughts within 3 MB.
MOST_POINTS = 160

_DRAW_EVERY_S = 0.5
# Maps of what is known: in a file numbers in steps of 1/255, and masks as bits.
NUMBERS, _MASKS = ("predicted", "mean", "spread"), ("free", "seen", "sensed")
_LEVELS = 255


@dataclass(frozen=True, kw_only=True)
class DrawnPlan:
    """What a planner had in mind at one step of one episode.

    Args:
        step: the step.
        lines: by layer its polylines, (x, y) in metres, each of shape [P, 2] with P ≥
            2.
    """

    step: int
    lines: Mapping[str, Sequence[np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class KnownMap:
    """What a robot knew of its map from a step on.

    Args:
        step: the first step at which it held.
        predicted: λ̂ as the risk setting gives it, shape [H, W].
        free: S_free, bool, shape [H, W].
        mean: E[λ] of the belief, shape [H, W].
        spread: half of the range from the 16 % to the 84 % quantile of λ, shape [H, W].
        seen: cells whose appearance was seen by then, bool, shape [H, W].
        sensed: cells whose λ was sensed by then, bool, shape [H, W].
        outline: of the ground that the sensors reached at that step, (x, y) in metres,
            shape [P, 2]; rows of NaN part one line from the next.
    """

    step: int
    predicted: np.ndarray
    free: np.ndarray
    mean: np.ndarray
    spread: np.ndarray
    seen: np.ndarray
    sensed: np.ndarray
    outline: np.ndarray

    @property
    def outlines(self) -> list[np.ndarray]:
        """The lines of the outline, each of shape [P, 2]."""
        ends = np.flatnonzero(np.isnan(self.outline[:, 0]))
        lines = [line[~np.isnan(line[:, 0])] for line in np.split(self.outline, ends)]
        return [line for line in lines if len(line) > 1]


def reach_outline(cells: np.ndarray, resolution_m: float) -> np.ndarray:
    """The `KnownMap.outline` of cells that sensors reached.

    Args:
        cells: bool, shape [H, W].
        resolution_m: edge length of a cell.
    """
    edges = outline(cells, resolution_m)
    return np.pad(edges, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(
        -1, 2
    )


@dataclass(frozen=True, kw_only=True)
class Ground:
    """A map under one draw of λ: what driven paths are shown on.

    Args:
        about: what it is known by: labels of a condition, `seed`, `realisation` and
            `map` among them.
        resolution_m: edge length of a cell.
        rgb: uint8, shape [3, H, W].
        field: λ of every cell in the episode, shape [H, W]; None where it was
            resampled.
        immobilising: cells of the field that immobilise a robot, bool, shape [H, W].
        goal_m: (x, y).
    """

    about: Mapping[str, Any]
    resolution_m: float
    rgb: np.ndarray
    field: np.ndarray | None
    immobilising: np.ndarray
    goal_m: np.ndarray

    _REMEDY: ClassVar[str] = "Remove it; the run's command makes it again."

    @property
    def grid(self) -> Grid:
        """The map's."""
        height, width = self.immobilising.shape
        return Grid(height, width, self.resolution_m)

    def save(self, path: Path) -> None:
        """Writes it to an `.npz` file, whole or not at all: arrays by their names, all
        else as JSON.
        """
        stored = self._stored()
        arrays: dict[str, Any] = {
            name: v for name, v in stored.items() if isinstance(v, np.ndarray)
        }
        rest = json.dumps(
            {name: value for name, value in stored.items() if name not in arrays}
        )
        with replacing(path) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, scalars=np.array(rest), **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Reads what `save` wrote.

        Raises:
            ConfigError: the file is damaged.
        """
        with damaged(path, cls._REMEDY), np.load(path, allow_pickle=False) as stored:
            values = dict(stored)
            return cls._read(json.loads(str(values.pop("scalars"))) | values)

    def _stored(self) -> dict[str, Any]:
        return {item.name: getattr(self, item.name) for item in fields(self)}

    @classmethod
    def _read(cls, values: dict[str, Any]) -> Self:
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class Recording(Ground):
    """An episode of any robot, from its start to its end; `about` holds `condition` and
    `outcome` too, all as text.

    Args:
        elevation_m: shape [H, W].
        true_mean: E[λ] of the truth, shape [H, W].
        soft: ground with soft spots that do not show, bool, shape [H, W].
        predicted: λ̂, the map the planner was given when it set out, shape [H, W].
        free: S_free of that map, bool, shape [H, W].
        free_by: the map that decides what is free, `risk` or `mean`.
        free_above: what that map has to exceed.
        dt_s: time step.
        time_budget_s: T.
        action_names: what each action is, with its unit, A of them.
        states: robot states beginning with (x, y, θ), shape [N + 1, S].
        actions: shape [N, A].
        traversability: observed λ, shape [N].
        plans: what was planned, in order of steps; those after the episode's end are
            left out.
        layers: optional fields of the map, by name, each of shape [H, W].
        known: what the robot knew of its map, in order of steps; empty where it learnt
            nothing on the way.
    """

    elevation_m: np.ndarray
    true_mean: np.ndarray
    soft: np.ndarray
    predicted: np.ndarray
    free: np.ndarray
    free_by: str
    free_above: float
    dt_s: float
    time_budget_s: float
    action_names: tuple[str, ...]
    states: np.ndarray
    actions: np.ndarray
    traversability: np.ndarray
    plans: Sequence[DrawnPlan] = ()
    layers: Mapping[str, np.ndarray] = field(default_factory=dict)
    known: tuple[KnownMap, ...] = ()

    _REMEDY: ClassVar[str] = "Remove it and its .rrd; `replay` makes them again."

    @property
    def title(self) -> str:
        """What it is, for people."""
        named = ("planner", "risk", "model", "scenario", "map", "outcome")
        return ", ".join(self.about[name] for name in named)

    @property
    def outcome(self) -> str:
        """How it ended, in words."""
        return self.about["outcome"].replace("_", " ")

    @property
    def track(self) -> np.ndarray:
        """Driven positions to the end, shape [N + 1, 2]."""
        return self.states[:, :2]

    @property
    def end_s(self) -> float:
        """When it ended."""
        return len(self.traversability) * self.dt_s

    @property
    def immobilised_at(self) -> np.ndarray | None:
        """Where it ended on ground that immobilises a robot, (x, y); None where it
        ended otherwise.
        """
        return (
            self.track[-1]
            if self.about["outcome"] == Outcome.IMMOBILISED.name.lower()
            else None
        )

    @property
    def predicted_at_end(self) -> float:
        """λ̂ where it ended; NaN outside the map."""
        column, row = np.floor(
            self.track[-1].astype(np.float64) / self.resolution_m
        ).astype(int)
        inside = 0 <= row < self.grid.height and 0 <= column < self.grid.width
        return float(self.predicted[row, column]) if inside else float("nan")

    @property
    def own_plans(self) -> list[DrawnPlan]:
        """Plans up to the last step that was taken; the first is one of them, also
        where none was taken.
        """
        last = max(len(self.traversability) - 1, 0)
        return [plan for plan in self.plans if plan.step <= last]

    @property
    def plan(self) -> DrawnPlan:
        """The plan that figures show: that of `MOMENT_S`, or of half-way where the
        episode was short.
        """
        return self.plan_at(min(MOMENT_S, self.end_s / 2))

    @property
    def now(self) -> int:
        """The step that figures show: that of the plan; the last where none was
        recorded.
        """
        last = len(self.traversability)
        return min(self.plan.step, last) if self.own_plans else last

    def plan_at(self, time_s: float) -> DrawnPlan:
        """The last plan that was drawn by a time; an empty one where there is none."""
        due = time_s / self.dt_s + 1e-6
        known = [plan for plan in self.own_plans if plan.step <= due]
        return known[-1] if known else DrawnPlan(step=0, lines={})

    def known_at(self, step: int) -> KnownMap | None:
        """What was known at a step; None where the robot learnt nothing on the way."""
        return next(
            (known for known in reversed(self.known) if known.step <= step), None
        )

    def given_at(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """λ̂ and S_free as the planner had them at a step, each of shape [H, W]."""
        known = self.known_at(step)
        return (
            (self.predicted, self.free)
            if known is None
            else (known.predicted, known.free)
        )

    def _stored(self) -> dict[str, Any]:
        """Its values; plans are thinned but the one of figures, and packed into few
        arrays, as what was known is.
        """
        values, shown = super()._stored(), self.plan.step
        del values["plans"]
        values |= _pack_known(values.pop("known"))
        values |= {
            f"layers:{name}": layer for name, layer in values.pop("layers").items()
        }
        return values | _pack(
            [plan if plan.step == shown else thinned(plan) for plan in self.own_plans]
        )

    @classmethod
    def _read(cls, values: dict[str, Any]) -> Self:
        layers, plans, known = (
            _under(prefix, values) for prefix in ("layers:", "plans:", "known:")
        )
        own = {name: value for name, value in values.items() if ":" not in name}
        own["action_names"] = tuple(own["action_names"])
        return cls(
            **own,
            layers=layers,
            plans=_unpack(plans),
            known=_unpack_known(known) if known else (),
        )


def _under(prefix: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values whose names begin with a prefix, by the rest of their names."""
    return {
        name.removeprefix(prefix): value
        for name, value in values.items()
        if name.startswith(prefix)
    }


def read_recordings(folder: Path) -> list[Recording]:
    """Reads every recorded episode of a run."""
    return [
        Recording.load(path) for path in sorted((folder / "playback").glob("*.npz"))
    ]


def drawing_interval(dt_s: float) -> int:
    """Steps from one plan that is drawn to the next."""
    return max(1, round(_DRAW_EVERY_S / dt_s))


def drawn_plan(step: int, layers: Mapping[str, Tensor]) -> DrawnPlan:
    """Keeps of a plan what can be drawn: points that are numbers, lines of at least two
    of them.

    Args:
        step: when it was planned.
        layers: from `Plan.lines`, polylines of shape [lines, P, 2] by layer; unused
            points are NaN.
    """
    lines = {}
    for name, layer in layers.items():
        kept = [
            line[np.isfinite(line).all(axis=1)] for line in layer.detach().cpu().numpy()
        ]
        lines[name] = [line for line in kept if len(line) > 1]
    return DrawnPlan(step=step, lines=lines)


def thinned(plan: DrawnPlan) -> DrawnPlan:
    """Leaves out lines and points within lines where a layer has too many; what is thin
    stays as it is.
    """
    layers = {}
    for name, lines in plan.lines.items():
        shown = [lines[place] for place in _spread(len(lines), MOST_POINTS // 2)]
        most = MOST_POINTS // max(len(shown), 1)
        layers[name] = [line[_spread(len(line), most)] for line in shown]
    return DrawnPlan(step=plan.step, lines=layers)


def _spread(count: int, most: int) -> np.ndarray:
    """Indices of so many, evenly spread, the first and the last among them; of all
    where they are few.
    """
    return np.linspace(0, count - 1, min(count, most)).round().astype(int)


def _pack(plans: Sequence[DrawnPlan]) -> dict[str, np.ndarray]:
    """Packs plans, in order of steps, into few arrays, which `_unpack` takes apart.

    Returns:
        `plans:steps`; by layer all points as `plans:points/LAYER`, points of each line
        as `plans:sizes/LAYER`, and lines of each plan as `plans:counts/LAYER`.
    """
    arrays: dict[str, np.ndarray] = {
        "plans:steps": np.array([plan.step for plan in plans], np.int64)
    }
    for name in dict.fromkeys(name for plan in plans for name in plan.lines):
        layers = [plan.lines.get(name, ()) for plan in plans]
        lines = [line for layer in layers for line in layer]
        arrays[f"plans:points/{name}"] = np.concatenate(
            [np.empty((0, 2), np.float32), *lines]
        )
        arrays[f"plans:sizes/{name}"] = np.array(
            [len(line) for line in lines], np.int64
        )
        arrays[f"plans:counts/{name}"] = np.array(
            [len(layer) for layer in layers], np.int64
        )
    return arrays


def _unpack(arrays: Mapping[str, np.ndarray]) -> list[DrawnPlan]:
    points, sizes, counts = (
        _under(kind, arrays) for kind in ("points/", "sizes/", "counts/")
    )
    layers = {
        name: _cut(_cut(points[name], sizes[name]), counts[name]) for name in points
    }
    return [
        DrawnPlan(
            step=int(step), lines={name: lines[place] for name, lines in layers.items()}
        )
        for place, step in enumerate(arrays["steps"])
    ]


def _cut(values: Any, sizes: np.ndarray) -> list[Any]:
    """Cuts a sequence into consecutive pieces of given sizes."""
    ends = sizes.cumsum()
    return [values[end - size : end] for end, size in zip(ends, sizes, strict=True)]


def _pack_known(known: Sequence[KnownMap]) -> dict[str, np.ndarray]:
    """Packs what was known into few arrays, which `_unpack_known` takes apart; none
    where there is none.

    Of each map only its difference from the one before is kept, which compresses well:
    most cells stay as they were.

    Returns:
        `known:steps`; by field of λ `known:NAME`, uint8, and by mask the same in bits;
        the outlines' points as `known:outline`, and how many each map has as
        `known:sizes`.
    """
    if not known:
        return {}
    arrays: dict[str, np.ndarray] = {
        "known:steps": np.array([each.step for each in known], np.int64)
    }
    for name in NUMBERS:
        levels = (
            np.stack([getattr(each, name) for each in known])
            .astype(np.float32)
            .clip(0, 1)
            * _LEVELS
        )
        # Differences of whole numbers modulo 256, which sums take back.
        arrays[f"known:{name}"] = np.diff(
            levels.round().astype(np.uint8), axis=0, prepend=np.uint8(0)
        )
    for name in _MASKS:
        masks = np.stack([getattr(each, name) for each in known])
        changed = np.diff(masks, axis=0, prepend=False)
        arrays[f"known:{name}"] = np.packbits(changed, axis=-1)
    outlines = [each.outline for each in known]
    arrays["known:outline"] = np.concatenate(outlines).astype(np.float32)
    arrays["known:sizes"] = np.array([len(each) for each in outlines], np.int64)
    return arrays


def _unpack_known(arrays: Mapping[str, np.ndarray]) -> tuple[KnownMap, ...]:
    values = dict(arrays)
    width = values[NUMBERS[0]].shape[-1]
    for name in NUMBERS:
        values[name] = (
            values[name].cumsum(axis=0, dtype=np.uint8).astype(np.float32) / _LEVELS
        )
    for name in _MASKS:
        changed = np.unpackbits(values[name], axis=-1, count=width)
        values[name] = np.logical_xor.accumulate(changed.astype(bool), axis=0)
    outlines = _cut(values["outline"], values["sizes"])
    return tuple(
        KnownMap(
            step=int(step),
            outline=lines,
            **{name: values[name][place] for name in (*NUMBERS, *_MASKS)},
        )
        for place, (step, lines) in enumerate(
            zip(values["steps"], outlines, strict=True)
        )
    )
