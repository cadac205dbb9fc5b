"""What ran out of memory is told from what is wrong, wherever it was raised and
whatever wrapped it.
"""

import errno

import numpy as np
import pytest
import torch

from benchnav.core.command import Command, run
from benchnav.core.errors import (
    CheckpointError,
    ConfigError,
    OutOfMemoryError,
    out_of_memory_error,
)
from benchnav.core.settings import call
from benchnav.eval.folder.run_folder import damaged
from benchnav.models import predictor
from benchnav.models.checkpoint import Checkpoint

TOO_MUCH = {
    "python": lambda: bytearray(2**62),
    "numpy": lambda: np.empty(2**60, np.uint8),
    "torch": lambda: torch.empty(2**60, dtype=torch.uint8),
    "system": lambda: (_ for _ in ()).throw(
        OSError(errno.ENOMEM, "Cannot allocate memory")
    ),
    "cuda": lambda: (_ for _ in ()).throw(
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 9 GiB")
    ),
}


def wrapped(work: object) -> None:
    """Work that blames its input for whatever it meets.

    Args:
        work: Which of `TOO_MUCH`.
    """
    try:
        next(iter([TOO_MUCH[str(work)]()]))
    except Exception as error:
        raise CheckpointError("It is damaged. Train the model again.") from error


def faulty(work: str) -> None:
    """Fault of ours.

    Args:
        work: Not used.
    """
    raise RuntimeError(f"index out of bounds in {work}")


@pytest.mark.parametrize("kind", TOO_MUCH)
def test_a_command_says_that_memory_ran_out(
    kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("x", "Does.", {"w": Command(wrapped, ("work",))}, ["w", kind]) == 2
    line = capsys.readouterr().err
    assert line.startswith("x: error: Memory ran out (")
    assert "fewer" in line
    assert line.count("\n") == 1
    assert "Train" not in line


def test_a_fault_of_ours_stays_a_traceback() -> None:
    with pytest.raises(RuntimeError, match="out of bounds"):
        run("x", "Does.", {"f": Command(faulty, ("work",))}, ["f", "a"])
    assert out_of_memory_error(RuntimeError("index out of bounds")) is None
    assert out_of_memory_error(ValueError("not enough memory")) is None
    cycle = ValueError("a")
    cycle.__cause__ = ValueError("b")
    cycle.__cause__.__cause__ = cycle
    assert out_of_memory_error(cycle) is None
    assert (
        out_of_memory_error(ConfigError("Expected `jobs` in 1–10000, got 0.")) is None
    )


def test_neither_part_nor_file_nor_checkpoint_is_blamed(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OutOfMemoryError):
        call("planner 'big'", TOO_MUCH["torch"], {})
    with pytest.raises(OutOfMemoryError), damaged(tmp_path, "Remove it."):  # type: ignore[arg-type]
        TOO_MUCH["torch"]()

    class Family:
        @staticmethod
        def from_checkpoint(checkpoint: Checkpoint) -> object:
            return TOO_MUCH["torch"]()

    found = predictor.registry.Found(target=Family, origin="here")
    monkeypatch.setattr(predictor, "find_family", lambda name: found)
    with pytest.raises(OutOfMemoryError):
        predictor.open_checkpoint(Checkpoint(class_names=("a",), model="mdn"))
