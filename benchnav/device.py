"""Where tensors are computed: on the CPU, or on a GPU through CUDA."""

import torch

from benchnav.errors import ConfigError


def find_device(name: str) -> torch.device:
    """Finds a device by name.

    Args:
        name: "cpu"; "cuda"; or "auto", which is CUDA where there is a GPU and else the CPU.

    Raises:
        ConfigError: there is no such device here.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ConfigError(f"Expected `device` among auto, cpu, cuda, got {name!r}.")
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise ConfigError("Expected a GPU for `device` cuda, got none that PyTorch can use. Use cpu or auto.")
    return torch.device("cuda" if there and name != "cpu" else "cpu")
