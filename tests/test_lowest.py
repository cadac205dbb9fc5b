"""The constraints of `make test-lowest` are the lower bounds of pyproject.toml."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "tools" / "lowest.py"

PYPROJECT = """
[project]
dependencies = ["numpy>=2.1", "jsonargparse[signatures]>=4.49", "rerun-sdk>=0.41,<0.42"]
[project.optional-dependencies]
dask = []
geo = ["rasterio >= 1.4.4"]
test = ["pytest>=8", "numpy>=2.1"]
lint = ["types-PyYAML"]
"""


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True
    )


def test_lower_bounds_become_versions(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text(PYPROJECT)
    assert run(tmp_path / "pyproject.toml").stdout.splitlines() == [
        *(
            "numpy==2.1",
            "jsonargparse==4.49",
            "rerun-sdk==0.41",
            "rasterio==1.4.4",
            "pytest==8",
        )
    ]


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        ("pytest>=8", "pytest", "a lower bound, such as numpy>=2.1, got 'pytest'"),
        ("pytest>=8", "pytest==8.1", "got 'pytest==8.1'"),
        (
            '"pytest>=8", "numpy>=2.1"',
            '"numpy>=2.2"',
            "one lower bound of numpy, got 2.1 and 2.2",
        ),
    ],
)
def test_what_has_no_lower_bound_is_refused(
    tmp_path: Path, before: str, after: str, told: str
) -> None:
    (tmp_path / "pyproject.toml").write_text(PYPROJECT.replace(before, after))
    refused = run(tmp_path / "pyproject.toml")
    assert refused.returncode == 1
    assert told in refused.stderr


def test_every_dependency_of_ours_has_one() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = run().stdout.splitlines()
    names = {line.partition("==")[0] for line in lines}
    assert len(lines) == len(names)
    assert {
        requirement.split(">")[0].split("[")[0]
        for requirement in project["dependencies"]
    } < names
    assert {"distributed", "rasterio", "pytest", "setuptools"} < names
    assert "ruff" not in names
    # Each torchvision is built for one torch; a pair that does not fit cannot be
    # installed.
    assert {"torch==2.11", "torchvision==0.26", "lightning==2.6"} < set(lines)
