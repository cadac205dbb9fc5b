"""The compiled code with its arguments, and the data of MuJoCo it works on.

The data of MuJoCo are a scratch workspace: the compiled code resets them for each
episode. Letters in shapes: B episodes, W wheels, H×W cells of a map.
"""

import ctypes
import math
import threading
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from benchnav.core.errors import expect
from benchnav.planning.world.physics.body import PLANE, Drive, build_model
from benchnav.planning.world.physics.library import import_mujoco, load_library
from benchnav.planning.world.physics.settings import Entrapment, Physics

BROKEN = 1
ROLLED_OVER = 2

# Numbers of the controller in an episode's memory, and the means of speed and turn.
CONTROLLER_SIZE = 6
MEAN_SPEED = 4
MEAN_TURN = 5
CELL_SIZE = 3  # numbers of a wheel's cell: λ, slope in degrees, index of the class

_MAX_INTEGRAL_RADPS = 4.0
_STAND_S = 1.0

_INT_FIELDS = ("root", "n_wheels", "is_steered", "has_loop", "has_ruts", "state_size")
_POINTER_FIELDS = (
    "wheel_geom",
    "wheel_body",
    "plane_geom",
    "wheel_x",
    "wheel_y",
    "wheel_radius",
)
_FLOAT_FIELDS = (
    "response",
    "turn_ratio",
    "wheelbase",
    "max_rim_speed",
    "max_steering",
    "loop_gain",
    "max_integral",
    "reverse_after",
    "reverse_for",
    "sinkage",
    "firm_lambda",
    "healing",
    "rut_scale",
    "max_rut",
    "max_resistance",
)


class Plant(ctypes.Structure):
    """Body, controller and soil; `plant_t` in drive.c."""

    _fields_ = [
        *((name, ctypes.c_int) for name in _INT_FIELDS),
        *((name, ctypes.c_void_p) for name in _POINTER_FIELDS),
        *((name, ctypes.c_double) for name in _FLOAT_FIELDS),
        ("soil", ctypes.c_void_p),
    ]


class TerrainMaps(ctypes.Structure):
    """Height maps and slope laws; `terrain_t` in drive.c."""

    _fields_ = [
        ("rows", ctypes.c_int),
        ("columns", ctypes.c_int),
        ("law_size", ctypes.c_int),
        ("resolution", ctypes.c_double),
        ("law_step", ctypes.c_double),
        ("height", ctypes.c_void_p),
        ("law", ctypes.c_void_p),
    ]


class Workspace:
    """A compiled model with the data of MuJoCo, used by one thread at a time.

    Args:
        physics: settings of the backend.
        drive: dimensions and bounds of the robot.

    Attributes:
        n_wheels: number of wheels W.
        state_size: number of values of a state of MuJoCo.
        contact_radius_m: largest distance of a wheel from the reference point.
    """

    def __init__(self, physics: Physics, drive: Drive) -> None:
        """Compile the model and the law.

        Raises:
            ConfigError: If MuJoCo or a compiler is missing, the body is invalid, or it
                does not stand.
        """
        mujoco = import_mujoco()
        soil = physics.law
        self._library = load_library(soil.path)
        self.lock = threading.Lock()
        self.model, wheels = build_model(mujoco, physics, drive)
        self.data = mujoco.MjData(self.model)
        self.n_wheels = len(wheels)
        self.state_size = self._library.state_size(self._address(self.model))
        model = self.model
        geoms = [model.geom(name).id for name in wheels]
        planes = [model.geom(PLANE + name).id for name in wheels]
        mujoco.mj_kinematics(model, self.data)
        root = int(model.jnt_bodyid[0])
        offset = self.data.geom_xpos[geoms] - self.data.xpos[root]
        self.contact_radius_m = float(np.hypot(offset[:, 0], offset[:, 1]).max())
        self.memory_size = CONTROLLER_SIZE + 2 * self.n_wheels
        self._arrays = {
            "wheel_geom": np.array(geoms, np.int32),
            "wheel_body": model.geom_bodyid[geoms].astype(np.int32),
            "plane_geom": np.array(planes, np.int32),
            "wheel_x": offset[:, 0].copy(),
            "wheel_y": offset[:, 1].copy(),
            "wheel_radius": model.geom_size[geoms, 0].copy(),
            "soil": np.array([*soil.parameters, 0.0]),
        }
        self._plant = _plant(physics, drive, self._arrays)
        self._plant.root = root
        self._plant.n_wheels = self.n_wheels
        self._plant.state_size = self.state_size
        self._check_stands()

    def advance(
        self,
        maps: "Maps",
        episodes: np.ndarray,
        n_sub_steps: int,
        state: np.ndarray,
        memory: np.ndarray,
        command: np.ndarray,
        cells: np.ndarray,
    ) -> "Moved":
        """Advance some episodes, and change their `state` and `memory` in place.

        Args:
            maps: height maps and slope laws.
            episodes: indices of the episodes, int32.
            n_sub_steps: number of sub-steps.
            state: states of MuJoCo, float64, shape [B, state_size].
            memory: controller, ruts and loads, float64, shape [B, memory_size].
            command: (v, ω) or (v, δ), float64, shape [B, 2].
            cells: λ, slope in degrees and class of each wheel's cell, float64, shape
                [B, W, 3].

        Returns:
            Poses, contacts and status; only those of `episodes` are set.
        """
        moved = Moved.empty(len(state), self.n_wheels)
        with self.lock:
            self._library.advance(
                self._address(self.model),
                self._address(self.data),
                ctypes.byref(self._plant),
                ctypes.byref(maps.structure),
                len(episodes),
                *map(_pointer, (episodes,)),
                n_sub_steps,
                *map(_pointer, (state, memory, command, cells)),
                *map(_pointer, (moved.pose, moved.contacts_m, moved.status)),
            )
        return moved

    def place(
        self,
        maps: "Maps",
        n_sub_steps: int,
        start: np.ndarray,
        cells: np.ndarray,
        is_free: bool = False,
    ) -> tuple[np.ndarray, np.ndarray, "Moved"]:
        """Put robots at poses and let them settle; see `place` in drive.c.

        Args:
            maps: height maps and slope laws.
            n_sub_steps: number of sub-steps.
            start: poses (x, y, θ), float64, shape [B, 3].
            cells: see `advance`.
            is_free: whether the robots may move while they settle.

        Returns:
            States of MuJoCo, memories, and poses; see `advance`.
        """
        state = np.zeros((len(start), self.state_size))
        memory = np.zeros((len(start), self.memory_size))
        moved = Moved.empty(len(start), self.n_wheels)
        with self.lock:
            self._library.place(
                self._address(self.model),
                self._address(self.data),
                ctypes.byref(self._plant),
                ctypes.byref(maps.structure),
                len(start),
                n_sub_steps,
                int(is_free),
                *map(_pointer, (start, cells, state, memory)),
                *map(_pointer, (moved.pose, moved.contacts_m, moved.status)),
            )
        return state, memory, moved

    def wheels(self, state: np.ndarray) -> np.ndarray:
        """Return the centres (x, y, z) of the wheels, float64, shape [B, W, 3].

        Args:
            state: states of MuJoCo, float64, shape [B, state_size].
        """
        mujoco = import_mujoco()
        geoms = self._arrays["wheel_geom"]
        centres = np.empty((len(state), self.n_wheels, 3))
        first, last = 1, 1 + self.model.nq  # the time is the first value of a state
        with self.lock:
            for index, values in enumerate(state):
                self.data.qpos[:] = values[first:last]
                mujoco.mj_kinematics(self.model, self.data)
                centres[index] = self.data.geom_xpos[geoms]
        return centres

    @property
    def wheel_radius_m(self) -> np.ndarray:
        """Radii of the wheels in metres, float64, shape [W]."""
        return self._arrays["wheel_radius"]

    def soil_forces(self, wheels: np.ndarray) -> np.ndarray:
        """Return the forces of the compiled law, shape [N, 2].

        Args:
            wheels: fields of `wheel_t`, float64, shape [N, 9].
        """
        forces = np.zeros((len(wheels), 2))
        soil = ctypes.c_void_p(self._plant.soil)
        self._library.soil_forces(len(wheels), _pointer(wheels), soil, _pointer(forces))
        return forces

    def _check_stands(self) -> None:
        """Check that the body stands still on level terrain."""
        maps = Maps(np.zeros((1, 8, 8)), 4.0, None, 1.0)
        start = np.array([[16.0, 16.0, 0.0]])
        cells = np.zeros((1, self.n_wheels, CELL_SIZE))
        cells[..., 0] = 1.0
        cells[..., 2] = -1.0
        count = max(1, round(_STAND_S / self.model.opt.timestep))
        state, _, moved = self.place(maps, count, start, cells, is_free=True)
        drift_m = float(np.abs(moved.pose[0, :2] - start[0, :2]).max())
        with self.lock:
            # The time is the first value of a state.
            first = 1 + self.model.nq
            speeds = state[0, first : first + self.model.nv]
        is_standing = not moved.status[0] and drift_m < 0.1
        is_standing = is_standing and float(np.abs(speeds).max()) < 0.05
        expect(
            is_standing,
            "a body that stands still on level terrain for `world.backend` 'physics', "
            f"got one that moved {drift_m:.2g} m in {_STAND_S:g} s or tips over. Check "
            "its wheels and masses.",
        )

    @staticmethod
    def _address(value: Any) -> ctypes.c_void_p:
        return ctypes.c_void_p(value._address)


class Maps:
    """Height maps and slope laws for the compiled code.

    Args:
        height_m: heights of the cells' centres in metres, float64, shape [B, H, W].
        resolution_m: edge length of a cell in metres.
        law: λ of each class by slope, float64, shape [C, N]; None for no laws.
        law_step_deg: step of the slope in degrees.
    """

    def __init__(
        self,
        height_m: np.ndarray,
        resolution_m: float,
        law: np.ndarray | None,
        law_step_deg: float,
    ) -> None:
        """Store contiguous copies, to which the structure points."""
        self._height_m = np.ascontiguousarray(height_m, np.float64)
        self._law = None if law is None else np.ascontiguousarray(law, np.float64)
        _, rows, columns = height_m.shape
        self.structure = TerrainMaps(
            rows=rows,
            columns=columns,
            law_size=0 if law is None else law.shape[1],
            resolution=resolution_m,
            law_step=law_step_deg,
            height=_pointer(self._height_m),
            law=None if self._law is None else _pointer(self._law),
        )


@dataclass(frozen=True)
class Moved:
    """Result of the compiled code.

    Args:
        pose: (x, y, yaw), yaw in [−π, π], float64, shape [B, 3].
        contacts_m: positions (x, y) of the contacts, float64, shape [B, W, 2].
        status: 0, `BROKEN` or `ROLLED_OVER`, int32, shape [B].
    """

    pose: np.ndarray
    contacts_m: np.ndarray
    status: np.ndarray

    @classmethod
    def empty(cls, batch: int, n_wheels: int) -> "Moved":
        """Return a result of zeros."""
        return cls(
            np.zeros((batch, 3)),
            np.zeros((batch, n_wheels, 2)),
            np.zeros(batch, np.int32),
        )


@lru_cache(maxsize=8)
def workspace(physics: Physics, drive: Drive) -> Workspace:
    """Return the workspace of this process for a body and a soil."""
    return Workspace(physics, drive)


def _plant(physics: Physics, drive: Drive, arrays: dict[str, np.ndarray]) -> Plant:
    """Return the plant; only its sizes are missing."""
    body = physics.body
    rut = physics.entrapment or Entrapment()
    lag_s = body.lag_s
    across = arrays["wheel_y"]
    squares = np.square(arrays["wheel_x"]) + np.square(across)
    # Forces in proportion to slip turn a skid-steered robot at ω if the sides differ by
    # this multiple of ω times the track.
    turn_ratio = squares.sum() / max(np.square(across).sum(), 1e-9)
    plant = Plant(
        is_steered=int(drive.is_steered),
        has_loop=int(body.yaw_rate_loop),
        has_ruts=int(physics.entrapment is not None),
        response=1 - math.exp(-physics.substep_s / lag_s) if lag_s else 1.0,
        turn_ratio=turn_ratio,
        wheelbase=drive.wheelbase_m,
        max_rim_speed=body.max_rim_speed * drive.top_speed_mps,
        max_steering=drive.max_steering_rad,
        loop_gain=body.loop_gain,
        max_integral=_MAX_INTEGRAL_RADPS,
        reverse_after=body.reverse_after_s,
        reverse_for=body.reverse_for_s,
        sinkage=rut.sinkage,
        firm_lambda=rut.firm,
        healing=rut.healing_m,
        rut_scale=rut.hold_m,
        max_rut=rut.max_depth_m,
        max_resistance=rut.max_resistance,
    )
    for name in (*_POINTER_FIELDS, "soil"):
        setattr(plant, name, _pointer(arrays[name]).value)
    return plant


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)
