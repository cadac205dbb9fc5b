"""Commands as a shell would run them, in this process."""

import sys
from importlib import import_module

import pytest

PACKAGES = {
    "datagen": "benchnav.datagen",
    "train": "benchnav.models",
    "eval": "benchnav.eval",
}


def call(program: str, *words: object) -> int:
    """Runs `benchnav-PROGRAM` with these words; its exit status."""
    main = import_module(f"{PACKAGES[program]}.cli").main
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [f"benchnav-{program}", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
    return int(ended.value.code or 0)
