"""Checks of a user's arguments to an environment, and limits on its threads."""

import multiprocessing
import os
import sys
from collections.abc import Collection, Mapping
from functools import cache
from typing import Any

import gymnasium
import numpy as np
import torch

from benchnav.core.errors import ConfigError, expect
from benchnav.core.settings import check_known
from benchnav.planning.world.world import World

# Id of the process in which PyTorch may use threads; 0 in workers, which share the
# processors.
_MAIN_PROCESS = 0 if multiprocessing.parent_process() else os.getpid()


def limit_threads() -> None:
    """Limit PyTorch to one thread in a worker process.

    Threads do not survive a fork: an operation that waits for threads of the parent
    process never ends. The limit is set once per process, so that a program may set
    another number afterwards.
    """
    _limit_threads(os.getpid())


@cache
def _limit_threads(process: int) -> None:
    if process != _MAIN_PROCESS:
        torch.set_num_threads(1)


def warn(text: str) -> None:
    """Warn by Gymnasium's logger; by default, Python shows each text once."""
    gymnasium.logger.warn("%s", text)


def check_render_mode(render_mode: str | None, modes: Collection[str]) -> None:
    """Check that an environment supports a render mode.

    Args:
        render_mode: mode that the user passed.
        modes: render modes of the environment; empty for benchnav/OffRoad-v0.

    Raises:
        ConfigError: If the mode is not in `modes`.
    """
    if render_mode is None or render_mode in modes:
        return
    if modes:
        expected = " or ".join(map(repr, modes))
        raise ConfigError(f"Expected `render_mode` {expected}, got {render_mode!r}.")
    raise ConfigError(
        f"Expected no `render_mode` for benchnav/OffRoad-v0, got {render_mode!r}. This "
        "environment draws nothing. Use benchnav/OffRoad-v1."
    )


def has_display() -> bool:
    """Return whether Matplotlib has a display, or a backend named by `MPLBACKEND`."""
    if sys.platform != "linux":
        return True
    names = ("MPLBACKEND", "DISPLAY", "WAYLAND_DISPLAY")
    return any(os.environ.get(name) for name in names)


def read_options(options: Any, names: Collection[str], maps: int) -> dict[str, Any]:
    """Return the checked options of a reset.

    Args:
        options: options that the user passed.
        names: names of the environment's options.
        maps: number of the environment's maps.

    Returns:
        The options; `map`, if given, as a Python integer.

    Raises:
        ConfigError: If a name is unknown, or `map` is not the index of a map.
    """
    is_valid = options is None or isinstance(options, Mapping)
    expect(is_valid, f"`options` as a mapping, got {options!r}.")
    checked = dict(options or {})
    for name in checked:
        check_known("an option of `reset`", name, names)
    index = checked.get("map")
    if index is not None:
        is_integer = isinstance(index, int | np.integer)
        is_index = is_integer and not isinstance(index, bool) and 0 <= index < maps
        expect(
            is_index,
            f"option `map` to be an integer from 0 to {maps - 1}, got {index!r}.",
        )
        checked["map"] = int(index)
    return checked


def read_numbers(
    actions: object, single_shape: tuple[int, ...] | None = None
) -> np.ndarray:
    """Return actions as float32.

    Args:
        actions: actions of a policy.
        single_shape: expected shape of the action of a single environment; if None, the
            shape is not checked.

    Raises:
        ConfigError: If the actions are not real numbers, or have another shape.
    """
    try:
        array = np.asarray(actions)
        numbers = None if array.dtype.kind in "cUSmM" else array.astype(np.float32)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None:
        raise ConfigError(
            f"Expected actions as real numbers, got {actions!r:.80}. Pass an array of "
            "floats."
        )
    if single_shape is not None and numbers.shape != single_shape:
        raise ConfigError(
            f"Expected an action of shape {list(single_shape)}, got "
            f"{list(numbers.shape)}."
        )
    return numbers


def check_actions(actions: np.ndarray, acting: np.ndarray) -> None:
    """Check that all actions in use are finite.

    Args:
        actions: actions of B sub-environments, shape [B, A].
        acting: mask of sub-environments that use their action, bool, shape [B].

    Raises:
        ConfigError: If an action that is used is not finite.
    """
    is_finite = np.isfinite(actions).all(axis=1)
    faulty = np.flatnonzero(acting & ~is_finite)
    if len(faulty):
        index = int(faulty[0])
        suffix = f" for sub-environment {index}" if len(actions) > 1 else ""
        raise ConfigError(
            f"Expected finite actions, got {actions[index].tolist()}{suffix}. Check "
            "whether the policy's weights or its observations are NaN."
        )


def warn_of_default_world(world: str | Mapping[str, Any] | World) -> None:
    """Warn if a user did not choose whether terrain immobilises robots.

    A preset, the key `immobile` and a `World` make this choice.
    """
    is_default = world == ""
    if isinstance(world, Mapping):
        is_default = {"preset", "immobile"}.isdisjoint(world)
    if is_default:
        warn(
            "`world` is 'paper' by default, in which low λ ends no episode. Pass "
            "world='stakes' for a world in which terrain immobilises the robot, or "
            "choose the preset 'paper' explicitly to suppress this warning."
        )


def warn_of_default_model() -> None:
    """Warn that the default model is privileged."""
    warn(
        "`model` is 'oracle' by default, a privileged model: it is given the true "
        "distribution of λ. Pass a checkpoint, such as model='stakes-v1', for results "
        "that a robot can reach, or pass model='oracle' to choose it."
    )
