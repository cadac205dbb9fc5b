"""Checks of what a user passes to an environment, and the threads of the process that
it runs in.
"""

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

# The process in which PyTorch may use threads; 0 in workers, which share the
# processors.
_MAIN_PROCESS = 0 if multiprocessing.parent_process() else os.getpid()


def limit_threads() -> None:
    """Limit PyTorch to one thread in a worker process, once; a program may then set
    another number.

    Threads do not survive a fork: an operation that waits for those of the parent never
    ends.
    """
    _limit_threads(os.getpid())


@cache
def _limit_threads(process: int) -> None:
    if process != _MAIN_PROCESS:
        torch.set_num_threads(1)


def warn(text: str) -> None:
    """Warn as Gymnasium does, once for each text unless filters say otherwise."""
    gymnasium.logger.warn("%s", text)


def check_render_mode(render_mode: str | None, modes: Collection[str]) -> None:
    """Raise where an environment does not have a render mode.

    Args:
        render_mode: as passed by the user.
        modes: those of the environment; empty for version 0.

    Raises:
        ConfigError: If it is none of them.
    """
    if render_mode is None or render_mode in modes:
        return
    if modes:
        raise ConfigError(
            f"Expected `render_mode` {' or '.join(map(repr, modes))}, got "
            f"{render_mode!r}."
        )
    raise ConfigError(
        "Expected no `render_mode` of benchnav/OffRoad-v0, which draws nothing, got "
        f"{render_mode!r}. "
        "Take benchnav/OffRoad-v1."
    )


def has_display() -> bool:
    """Return whether Matplotlib may find a display, or `MPLBACKEND` names a backend
    that needs none.
    """
    return sys.platform != "linux" or any(
        os.environ.get(name) for name in ("MPLBACKEND", "DISPLAY", "WAYLAND_DISPLAY")
    )


def read_options(options: Any, known: Collection[str], maps: int) -> dict[str, Any]:
    """Check the options of a reset.

    Args:
        options: as passed by the user.
        known: names that the environment has.
        maps: how many maps it has.

    Returns:
        The options, with `map` as a Python integer where it is named.

    Raises:
        ConfigError: If a name is unknown, or `map` is not the index of a map.
    """
    expect(
        options is None or isinstance(options, Mapping),
        f"`options` as a mapping, got {options!r}.",
    )
    checked = dict(options or {})
    for name in checked:
        check_known("an option of `reset`", name, known)
    index = checked.get("map")
    if index is not None:
        is_index = (
            isinstance(index, int | np.integer)
            and not isinstance(index, bool)
            and 0 <= index < maps
        )
        expect(
            is_index, f"option `map` as a whole number in 0–{maps - 1}, got {index!r}."
        )
        checked["map"] = int(index)
    return checked


def read_numbers(
    actions: object, single_shape: tuple[int, ...] | None = None
) -> np.ndarray:
    """Return actions as float32.

    Args:
        actions: of a policy.
        single_shape: of the action of a single environment, which is checked; None for
            several.

    Raises:
        ConfigError: If the actions are no real numbers, or the one action is of another
            shape.
    """
    try:
        array = np.asarray(actions)
        numbers = None if array.dtype.kind in "cUSmM" else array.astype(np.float32)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None:
        raise ConfigError(
            f"Expected actions of real numbers, got {actions!r:.80}. Pass an array of "
            "floats."
        )
    if single_shape is not None and numbers.shape != single_shape:
        raise ConfigError(
            f"Expected an action of shape {list(single_shape)}, got "
            f"{list(numbers.shape)}."
        )
    return numbers


def check_actions(actions: np.ndarray, acting: np.ndarray) -> None:
    """Raise where an action is NaN or infinite.

    Args:
        actions: shape [B, A].
        acting: sub-environments that use theirs, bool, shape [B].

    Raises:
        ConfigError: If an action that is used is not finite.
    """
    faulty = np.flatnonzero(acting & ~np.isfinite(actions).all(axis=1))
    if len(faulty):
        index = int(faulty[0])
        where = f" for sub-environment {index}" if len(actions) > 1 else ""
        raise ConfigError(
            f"Expected finite actions, got {actions[index].tolist()}{where}. See "
            "whether the policy's weights or "
            "its observations are NaN."
        )


def warn_of_default_world(world: str | Mapping[str, Any] | World) -> None:
    """Warn of a world without stakes that was not chosen.

    A user who names the preset `paper`, sets `immobile` or passes a `World` has chosen
    it, and is not warned. A mapping of other changes leaves the default preset
    unchosen, and warns.
    """
    is_chosen = (
        not {"preset", "immobile"}.isdisjoint(world)
        if isinstance(world, Mapping)
        else world != ""
    )
    if not is_chosen:
        warn(
            "`world` is 'paper' by default, where low λ ends no episode. Pass "
            "world='stakes' for one in which "
            "terrain immobilises the robot, or name preset 'paper' to choose it."
        )


def warn_of_default_model() -> None:
    """Warn of a privileged model that was not chosen."""
    warn(
        "`model` is 'oracle' by default, a privileged model: it is given the true "
        "distribution of λ. Pass a "
        "checkpoint, such as model='stakes-v1', for results that a robot could have, "
        "or model='oracle' to choose it."
    )
