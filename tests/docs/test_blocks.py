"""Every block of every page runs as it is written, on fewer maps; `make docs-test`.

Blocks of a page are run from its first to its last in one folder, which has the shipped
maps and models and the
examples: `sh` by bash, `python` in one namespace. A block with `title="FILE"` is
written to that file. Others are not run, nor is one after the comment `<!-- not run:
WHY -->`.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.pages import ROOT, Block, blocks, name, pages

LIMIT_S = 900


@pytest.mark.docs
@pytest.mark.parametrize("page", pages(), ids=name)
def test_what_a_page_shows_runs(
    page: Path, folder: Path, environment: dict[str, str]
) -> None:
    python = subprocess.Popen(
        [sys.executable, str(ROOT / "tests/docs/run_python.py")],
        cwd=folder, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    for number, block in enumerate(blocks(page)):
        if block.why_not:
            continue
        where = f"{name(page)}:{block.line}"
        if block.file:
            place = folder / block.file
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(block.body)
        elif block.kind == "sh":
            done = subprocess.run(
                ["bash", "-euo", "pipefail", "-c", block.body],
                cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=LIMIT_S,
            )  # fmt: skip
            assert done.returncode == 0, (
                f"{where}\n{done.stdout[-3000:]}{done.stderr[-3000:]}"
            )
        elif block.kind == "python":
            _run_python(python, folder / f".block-{number}.py", block, where)
    python.communicate()


def _run_python(
    python: subprocess.Popen[str], path: Path, block: Block, where: str
) -> None:
    """Has a running interpreter run a block."""
    path.write_text("\n" * block.line + block.body)
    assert python.stdin
    assert python.stdout
    python.stdin.write(f"{path}\n")
    python.stdin.flush()
    said = []
    for line in python.stdout:
        if line == "done\n":
            return
        said.append(line)
    pytest.fail(f"{where}\n{''.join(said)[-3000:]}")
