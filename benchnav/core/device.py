"""Devices of computation: the CPU, or a GPU through CUDA."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

import torch

from benchnav.core.errors import BenchnavError, expect

CPU = torch.device("cpu")

# Exceptions that PyTorch raises if a GPU fails.
GPU_FAULTS = (torch.OutOfMemoryError, torch.AcceleratorError)


class DeviceError(BenchnavError):
    """A GPU failed; its results are invalid."""


def gpu_failed(error: object) -> DeviceError:
    """Return an error that quotes the first line of PyTorch's message."""
    line = str(error).strip().splitlines()[0].rstrip(".")
    return DeviceError(
        f"The GPU failed: {line}. Finished work is kept. Run the same command again, if "
        "necessary with fewer `jobs`."
    )


def find_device(name: str) -> torch.device:
    """Return a device by name.

    Args:
        name: "cpu", "cuda", or "auto", which is CUDA if there is a GPU and else the CPU.

    Raises:
        ConfigError: If the device is not available.
    """
    expect(
        name in ("auto", "cpu", "cuda"),
        f"`device` among auto, cpu, cuda, got {name!r}.",
    )
    has_gpu = torch.cuda.is_available()
    expect(
        has_gpu or name != "cuda",
        "a GPU that PyTorch can use for `device` cuda, got none. Use cpu or auto.",
    )
    return torch.device("cuda" if has_gpu and name != "cpu" else "cpu")


def device_of_run(run: Mapping[str, Any]) -> torch.device:
    """Return the device that a run was computed on.

    Args:
        run: contents of the run's `run.json`.

    Raises:
        ConfigError: If the device is not available.
    """
    expect(
        run["device"] != "cuda" or torch.cuda.is_available(),
        "a GPU that PyTorch can use, got none. This run was computed on a GPU. Run the "
        "command on a machine with a GPU.",
    )
    return find_device(run["device"])


def gpu_name(device: str | torch.device) -> str | None:
    """Return the name of a GPU; None for the CPU."""
    return torch.cuda.get_device_name() if torch.device(device).type == "cuda" else None


def exact_convolutions() -> AbstractContextManager[None]:
    """Return a context in which GPU convolutions are float32 and deterministic."""
    flags: AbstractContextManager[None] = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    return flags
