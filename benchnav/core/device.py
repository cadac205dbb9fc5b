"""Where tensors are computed: on the CPU, or on a GPU through CUDA."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

import torch

from benchnav.core.errors import BenchnavError, expect

CPU = torch.device("cpu")

# What PyTorch raises where a GPU, and not the code that it runs, has failed.
GPU_FAULTS = (torch.OutOfMemoryError, torch.AcceleratorError)


class DeviceError(BenchnavError):
    """A GPU failed; nothing that was computed there is to be believed."""


def gpu_failed(said: object) -> DeviceError:
    """Tells in one line that a GPU failed, and what PyTorch said of it."""
    line = str(said).strip().splitlines()[0].rstrip(".")
    return DeviceError(
        f"The GPU failed: {line}. Finished work is kept: give the same command again, "
        "if need be with fewer `jobs`."
    )


def find_device(name: str) -> torch.device:
    """Finds a device by name.

    Args:
        name: "cpu"; "cuda"; or "auto", which is CUDA where there is a GPU and else the
            CPU.

    Raises:
        ConfigError: there is no such device here.
    """
    expect(
        name in ("auto", "cpu", "cuda"),
        f"`device` among auto, cpu, cuda, got {name!r}.",
    )
    has_gpu = torch.cuda.is_available()
    expect(
        has_gpu or name != "cuda",
        "a GPU for `device` cuda, got none that PyTorch can use. Use cpu or auto.",
    )
    return torch.device("cuda" if has_gpu and name != "cpu" else "cpu")


def device_of_run(about: Mapping[str, Any]) -> torch.device:
    """Finds the device that a run was computed on.

    Args:
        about: its `run.json`.

    Raises:
        ConfigError: there is no such device here.
    """
    expect(
        about["device"] != "cuda" or torch.cuda.is_available(),
        "a GPU, on which this run was computed, got none that PyTorch can use.",
    )
    return find_device(about["device"])


def gpu_name(device: str | torch.device) -> str | None:
    """What a GPU is called; None of the CPU."""
    return torch.cuda.get_device_name() if torch.device(device).type == "cuda" else None


def exact_convolutions() -> AbstractContextManager[None]:
    """A context in which a GPU convolves in full float32, the same way each time, as
    the CPU does.
    """
    flags: AbstractContextManager[None] = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    return flags
