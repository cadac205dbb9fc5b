"""The contract of sensors, of appearance and of the ground, tried on small hills made
on the spot.

Letters in shapes: B episodes, S state dimensions, H×W cells, N cells.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.batch import Batch, find_tensor_fault
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning.sensing.sensor import (
    LEAST_STD,
    Appearance,
    Moment,
    Sensed,
    Sensor,
)
from benchnav.testing.breaches import NOTHING, SEED, Breaches, same

_RESOLUTION_M = 0.5
_KEYS, _OTHER_KEYS = (3, 14, 15, 92), (65, 35, 89, 79)
_STEPS = (0, 7)


def check_sensor(
    sensor: Any,
    shapes: Sequence[tuple[int, int]] = ((24, 24), (20, 33)),
    device: torch.device | str = "cpu",
    sinks: bool = True,
    tolerance: float = 1e-5,
) -> None:
    """Tries whether a sensor of appearance or of the ground keeps the contract, by
    letting it sense on four hills.

    The robots: one in the middle of the map, two at its borders, one off it.
    The contract: some cell is sensed or seen; a `Sensed` of the field's shape, dtype
    and device; λ in [0, 1], NaN where it is not sensed, with a standard deviation of at
    least `LEAST_STD`; of an `Appearance` the terrain's own layers, with elevation and a
    doubt ≥ 0 in every cell that is seen; the arguments left as they were, and with them
    the global generators of Python, NumPy and PyTorch; the same answer when asked
    again, and for some episodes alone and in another order what it is in the batch;
    noise, where there is any, that is another in each episode and in each step.

    It shows nothing that it should not. Nothing that it reports changes when the truth
    elsewhere is replaced: λ, its distribution and its class in all cells but those
    whose λ is sensed; colour, slope and layers in all cells but those that are sensed
    or seen. The elevation of those cells is sunk by 1 to 3 m, not raised, as ground
    that rises into view is rightly seen; the ground under the robot stays, since it
    carries the sensor.

    Args:
        sensor: any sensor, or the name, file or mapping of one as suites have it.
        shapes: (H, W) of the maps to try.
        device: where the maps are.
        sinks: elevation is replaced too; False for a line of sight that may be barred
            by ground that is not seen itself, as where single rays are cast to the
            centres of cells.
        tolerance: by how much numbers may differ where the same is expected of other
            arguments.

    Raises:
        ConfigError: the sensor breaks the contract; every breach is named.
    """
    name = sensor.get("part") if isinstance(sensor, Mapping) else sensor
    is_ground = isinstance(name, str) and name.partition(":")[0] in registry.names(
        "ground"
    )
    made = registry.take("ground" if is_ground else "sensor", sensor)
    breaches = Breaches("sensor", type(made).__name__)
    breaches.expect(
        isinstance(made.sees_all, bool),
        f"Expected `sees_all` of type bool, got {made.sees_all!r}.",
    )
    for height, width in shapes:
        hills = _make_hills(height, width, torch.device(device))
        for step in _STEPS:
            breaches.place = f"{height}×{width} in step {step}"
            _Trial(made, hills, step, sinks, breaches, tolerance).run()
    breaches.refuse()


@dataclass(frozen=True, kw_only=True)
class _Truth(Batch):
    """What a sensor is given, but for its noise."""

    terrain: Terrain
    field: Tensor
    robot_state: Tensor


@dataclass(frozen=True)
class _Trial:
    """A sensor in one step of four episodes, and where its breaches are noted."""

    sensor: Sensor
    truth: _Truth
    step: int
    sinks: bool
    breaches: Breaches
    tolerance: float

    def run(self) -> None:
        """Senses, then anew under what should change nothing, or the noise alone."""
        sensed = self.ask(self.truth)
        if sensed is NOTHING:
            return
        look = sensed.appearance
        self.breaches.expect(
            bool(sensed.mask.any()) or (look is not None and bool(look.seen.any())),
            "Expected a robot in the middle of a map to sense or see some cell, got "
            "none.",
        )
        shown = _shown(sensed)
        is_same = self.breaches.expect(
            self.is_alike(self.ask(self.truth), shown, 0),
            "Expected the same when asked again, got another.",
        )
        for members in ([3], [2, 0]):
            some = torch.tensor(members, device=self.truth.field.device)
            alone = self.ask(self.truth.select(some), [_KEYS[own] for own in members])
            self.breaches.expect(
                self.is_alike(
                    alone, tuple(values[some] for values in shown), self.tolerance
                ),
                "Expected for episodes alone and in another order what they got in "
                "the batch, got another. Draw noise "
                "by `Moment.normal`.",
            )
        if not is_same:
            return  # or everything would seem to hang on everything
        for what, changed in _replaced(self.truth, sensed, self.sinks):
            self.breaches.expect(
                self.is_alike(self.ask(changed), shown, self.tolerance),
                f"Expected the same whatever {what}, got another. Look at no cell "
                "that is not reported.",
            )
        self.try_noise(sensed)

    def try_noise(self, sensed: Sensed) -> None:
        """Expects noise that is another in each episode and in each step."""
        by_key, by_step = (
            other is not NOTHING and _differ(sensed, other)
            for other in (
                self.ask(self.truth, _OTHER_KEYS),
                self.ask(self.truth, step=self.step + 1),
            )
        )
        self.breaches.expect(
            by_step or not by_key,
            "Expected other noise in another step, got the same. Draw it by "
            "`Moment.normal`.",
        )
        self.breaches.expect(
            by_key or not by_step,
            "Expected other noise under another key of the episode, got the same "
            "though it differs from step to step. "
            "Draw it by `Moment.normal`.",
        )

    def ask(
        self, truth: _Truth, keys: Sequence[int] = _KEYS, step: int | None = None
    ) -> Any:
        """Lets the sensor sense; `NOTHING` where what came is of no use."""
        given, moment = (
            vars(truth),
            Moment(tuple(keys), self.step if step is None else step),
        )
        answer = self.breaches.watch(
            "sense",
            lambda: self.sensor.sense(
                truth.terrain, truth.field, truth.robot_state, moment
            ),
            **given,
        )
        faults = [] if answer is NOTHING else list(_faults(answer, truth))
        for fault in faults:
            self.breaches.expect(False, fault)
        return NOTHING if faults else answer

    def is_alike(
        self, sensed: Any, shown: tuple[Tensor, ...], tolerance: float
    ) -> bool:
        # what raised is noted
        return sensed is NOTHING or same(_shown(sensed), shown, tolerance)


def _faults(sensed: Any, truth: _Truth) -> Iterator[str]:
    """Tells what is wrong with the form of an answer, a line each."""
    like = truth.field
    if not isinstance(sensed, Sensed):
        yield f"Expected a Sensed from `sense`, got {type(sensed).__name__}."
        return
    maps = {
        "`Sensed.traversability`": sensed.traversability,
        "`Sensed.std`": sensed.std,
    }
    if wrong := [
        fault
        for what, values in maps.items()
        if (fault := _tensor_fault(what, values, like))
    ]:
        yield from wrong
        return
    found, std = sensed.traversability[sensed.mask], sensed.std[sensed.mask]
    if not bool(((found >= 0) & (found <= 1)).all()):
        yield "Expected λ in [0, 1], or NaN where it is not sensed, got other numbers."
    if not bool(((std >= LEAST_STD) & std.isfinite()).all()):
        yield (
            f"Expected `Sensed.std` of at least {LEAST_STD:g}, and finite, where λ "
            "is sensed, got others."
        )
    if sensed.appearance is not None:
        yield from _faults_of_look(sensed.appearance, truth)


def _faults_of_look(look: Any, truth: _Truth) -> Iterator[str]:
    like, known = truth.field, truth.terrain.observe()
    if not isinstance(look, Appearance) or not isinstance(
        look.observation, Observation
    ):
        yield (
            "Expected `Sensed.appearance` as an Appearance with an Observation, "
            "got "
            "something else."
        )
        return
    given = look.observation
    if given.layers.keys() != known.layers.keys() or given.grid != known.grid:
        yield (
            "Expected the terrain's own grid and layers in `Appearance.observation`, "
            f"{', '.join(known.layers)}, got "
            f"{given.grid} and {', '.join(given.layers) or 'none'}."
        )
        return
    pairs = {
        "seen": (look.seen, like.bool()),
        "doubt": (look.doubt, like),
        "observation.rgb": (given.rgb, known.rgb),
        "observation.elevation_m": (given.elevation_m, known.elevation_m),
    }
    pairs |= {
        f"observation.layers[{name!r}]": (given.layers[name], own)
        for name, own in known.layers.items()
    }
    faults = [
        _tensor_fault(f"`Appearance.{name}`", *pair) for name, pair in pairs.items()
    ]
    yield from filter(None, faults)
    if any(faults):
        return
    if not bool((look.doubt[look.seen] >= 0).all()):
        yield "Expected `Appearance.doubt` ≥ 0 where a cell is seen, got others."
    if not bool(given.elevation_m[look.seen].isfinite().all()):
        yield "Expected finite elevation where a cell is seen, got others."


def _tensor_fault(what: str, values: Any, like: Tensor) -> str:
    return find_tensor_fault(what, values, like.dtype, tuple(like.shape), like.device)


def _shown(sensed: Sensed) -> tuple[Tensor, ...]:
    """What is reported, without what means nothing; the first of each tensor's
    dimensions is B.
    """
    own = (sensed.traversability, sensed.std.where(sensed.mask, torch.nan))
    if sensed.appearance is None:
        return own
    look, seen = sensed.appearance, sensed.appearance.seen
    return (
        *own,
        seen,
        *(values.where(seen, torch.nan) for values in (look.doubt, *_looks(look))),
    )


def _looks(look: Appearance) -> tuple[Tensor, ...]:
    """Colours, elevation and layers, each of shape [B, H, W]."""
    known = look.observation
    return (*known.rgb.float().unbind(1), known.elevation_m, *known.layers.values())


def _differ(first: Sensed, second: Sensed) -> bool:
    """Tells whether two report something else of a cell that both report."""
    both = first.mask & second.mask
    differ = bool((first.traversability != second.traversability)[both].any())
    if first.appearance is None or second.appearance is None:
        return differ
    both = first.appearance.seen & second.appearance.seen
    pairs = zip(_looks(first.appearance), _looks(second.appearance), strict=True)
    return differ or not all(same(one[both], other[both]) for one, other in pairs)


def _replaced(
    truth: _Truth, sensed: Sensed, sinks: bool
) -> Iterator[tuple[str, _Truth]]:
    """Truths that differ in what is not reported, and what that is."""
    terrain, look, mask = truth.terrain, sensed.appearance, sensed.mask
    reported = mask if look is None else mask | look.seen
    # Others in each cell, and in all that sums them up, such as a map's mean and
    # greatest.
    law = replace(
        terrain.truth,
        weights=terrain.truth.weights.where(
            mask[:, None], terrain.truth.weights.flip(1, 2)
        ),
        means=terrain.truth.means.where(mask[:, None], 0.4 * (1 - terrain.truth.means)),
        stds=terrain.truth.stds.where(mask[:, None], 0.5 * terrain.truth.stds),
    )
    other = replace(
        terrain,
        class_id=terrain.class_id.where(mask, terrain.class_id + 1),
        truth=law,
        traversability=terrain.traversability.where(
            mask, 0.4 * (1 - terrain.traversability)
        ),
    )
    field = truth.field.where(mask, 0.4 * (1 - truth.field))
    yield (
        "λ, its distribution and its class are where λ is not sensed",
        replace(truth, terrain=other, field=field),
    )
    other = replace(
        terrain,
        rgb=terrain.rgb.where(reported[:, None], (255 - terrain.rgb) // 2),
        slope_deg=terrain.slope_deg.where(reported, terrain.slope_deg + 5),
        layers={
            name: layer.where(reported, layer + 1)
            for name, layer in terrain.layers.items()
        },
    )
    yield (
        "colour, slope and layers are where nothing is sensed or seen",
        replace(truth, terrain=other),
    )
    if not sinks:
        return
    under = terrain.grid.cell_of(truth.robot_state[:, 0], truth.robot_state[:, 1])
    stays, height = reported.clone(), terrain.elevation_m
    stays[torch.arange(len(stays), device=stays.device), under[0], under[1]] = True
    other = replace(
        terrain, elevation_m=height.where(stays, height - 2 - (7 * height).sin())
    )
    yield (
        "the elevation is where nothing is sensed or seen",
        replace(truth, terrain=other),
    )


def _make_hills(height: int, width: int, device: torch.device) -> _Truth:
    """Four maps of waves that hide one another, with two classes, a layer, λ of 0 and 1
    here and there.
    """
    generator = torch.Generator().manual_seed(SEED)
    shape, grid = (4, height, width), Grid(height, width, _RESOLUTION_M)
    drawn = torch.rand(8, *shape, generator=generator).to(device)
    rows, columns = (
        torch.arange(height, device=device)[:, None],
        torch.arange(width, device=device),
    )
    waves = (0.7 * torch.sin(0.9 * rows + 0.3) + 0.7 * torch.sin(0.8 * columns)).repeat(
        4, 1, 1
    )
    means = torch.stack((0.1 + 0.1 * drawn[0], 0.5 + 0.3 * drawn[1]), dim=1)
    share = 0.1 + 0.2 * drawn[2]
    truth = TraversabilityMixture(
        torch.stack((share, 1 - share), dim=1),
        means,
        torch.full_like(means, 0.1),
        (0, 0),
    )
    field = truth.from_normal(0.2 + 2 * (drawn[3] - 0.5))
    terrain = Terrain(
        rgb=(255 * drawn[4:7]).to(torch.uint8).movedim(0, 1).contiguous(),
        class_id=(drawn[0] > 0.5).long(),
        elevation_m=waves + 0.1 * drawn[7],
        slope_deg=20 * drawn[2],
        truth=truth,
        traversability=field.flip(1),
        grid=grid,
        layers={"vegetation_m": drawn[1]},
    )
    x, y = grid.extent_m
    places = [
        [0.52 * x, 0.47 * y, 0.6],
        [0.3, 0.2, 0.9],
        [0.6 * x, y - 0.1, -2.5],
        [-0.3, 2.0, 0.0],
    ]
    state = torch.tensor([[*place, 0.5] for place in places], device=device)
    return _Truth(terrain=terrain, field=field, robot_state=state)
