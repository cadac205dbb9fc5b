"""Every example runs as a user runs it, and does what it says."""

import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, folder: Path) -> str:
    """Runs an example in an empty folder and returns what it printed."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name)], cwd=folder, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert list(folder.iterdir()) == []
    return done.stdout


def test_a_model_of_ones_own_beats_a_constant_and_the_oracle_beats_both(tmp_path: Path) -> None:
    lines = run("own_model.py", tmp_path).splitlines()
    assert lines[:2] == ["saved a checkpoint of 'pixel'", "kept the contract"]
    assert lines[2].split() == ["model", "split", "RMSE", "E[λ]", "NLL", "CRPS"]
    rows = {tuple(line.split()[:2]): [float(value) for value in line.split()[2:]] for line in lines[3:]}
    for split in ("test/std", "test/hg", "test/hs"):
        constant, own, oracle = (rows[model, split] for model in ("constant", "own", "oracle"))
        assert own[0] < 0.75 * constant[0]
        assert own[1] < constant[1] - 0.1
        assert all(best < better < worse for best, better, worse in zip(oracle, own, constant, strict=True))
