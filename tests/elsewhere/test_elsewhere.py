"""Cases on another device, in processes of their own.

Once PyTorch has a device that is not there (`device`), the GPUs that other tests
pretend to have no longer work.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch


@pytest.mark.parametrize(
    "cases",
    [("units", "models"), *([("gpu",)] if torch.cuda.is_available() else [])],
    ids=" and ".join,
)
def test_cases_on_another_device(cases: tuple[str, ...]) -> None:
    here = Path(__file__).parent
    files = [str(here / f"{name}.py") for name in cases]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *files]
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("PYTEST_")
    }
    done = subprocess.run(
        command, cwd=here.parents[1], env=environment, capture_output=True, text=True
    )
    if done.returncode == pytest.ExitCode.NO_TESTS_COLLECTED:
        pytest.skip("this PyTorch cannot be given a device in Python")
    assert done.returncode == 0, done.stdout
