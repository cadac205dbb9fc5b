"""What a check says of a part that breaks its contract."""

import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError


def refusal(check: Callable[..., None], part: Any) -> str:
    """The one line with which a check refuses a part, which may leave the global generators elsewhere."""
    states = torch.random.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    try:
        with pytest.raises(ConfigError) as caught:
            check(part)
    finally:
        torch.random.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])
    assert "\n" not in str(caught.value)
    return str(caught.value)
