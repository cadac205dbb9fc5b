"""What a check says of a part that breaks its contract."""

import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError


def refusal(check: Callable[..., None], part: Any) -> str:
    """How a check refuses a part, which may leave the global generators elsewhere: a
    line for each breach.
    """
    states = torch.random.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    try:
        with pytest.raises(ConfigError) as caught:
            check(part)
    finally:
        torch.random.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])
    first, *breaches = str(caught.value).split("\n")
    assert all(
        line.startswith(f"({number}) ") for number, line in enumerate(breaches, start=1)
    )
    assert first.endswith("which breaks it:" if breaches else ".")
    return str(caught.value)
