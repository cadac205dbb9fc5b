"""The pages of the documentation and their blocks of code."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
GENERATED = DOCS / "reference" / "commands"
_BLOCK = re.compile(
    r"^(?: *<!-- not run: (?P<why>[^\n]+) -->\n)?"
    r"^(?P<indent> *)```(?P<kind>\w*)(?P<about>[^\n]*)\n(?P<body>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True, kw_only=True)
class Block:
    """A block of code.

    Args:
        kind: its language.
        file: the file that it is the content of, from `title="…"`; empty where there is
            none.
        body: the code.
        why_not: why it is not run, from the comment before it; empty where it is.
        line: where it begins.
    """

    kind: str
    file: str
    body: str
    why_not: str
    line: int


def pages() -> list[Path]:
    """All pages that are written by hand, README.md first."""
    written = (
        path for path in sorted(DOCS.rglob("*.md")) if GENERATED not in path.parents
    )
    return [ROOT / "README.md", *written]


def name(page: Path) -> str:
    """The name of a page in this repository."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page, from first to last."""
    text = page.read_text()
    for found in _BLOCK.finditer(text):
        indent, title = found["indent"], re.search(r'title="([^"]+)"', found["about"])
        body = "\n".join(
            line.removeprefix(indent) for line in found["body"].splitlines()
        )
        yield Block(
            kind=found["kind"],
            file=title[1] if title else "",
            body=body + "\n",
            why_not=found["why"] or "",
            line=text.count("\n", 0, found.start()) + 1,
        )
