"""Count the tokens of Python code, without comments, docstrings and layout.

    python tools/size.py                    # per folder
    python tools/size.py --against REVISION # compared with a revision of the repository

Run it with Python 3.11: later versions split f-strings into tokens.
"""

import argparse
import ast
import io
import subprocess
import sys
import tokenize
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
# Names that do not say what their value is.
EVERYDAY = frozenset({
    "found", "own", "place", "known", "told", "made", "whole", "both", "here", "there",
    "left", "every", "asked", "given", "each", "one", "other", "way", "said", "kept",
    "wanted", "met", "about", "share", "held", "most", "least",
})  # fmt: skip
MAX_LINES = 450  # per file
# Folders at the root whose files are counted.
_COUNTED = ("benchnav", "benchmarks", "studies", "tools", "tests")


def count(text: str) -> int:
    """Count the tokens of a module that are neither layout nor documentation."""
    documented = _docstring_lines(ast.parse(text))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(
        token.type not in _LAYOUT
        and not (token.type == tokenize.STRING and token.start[0] in documented)
        for token in tokens
    )


def _docstring_lines(module: ast.Module) -> set[int]:
    lines = set()
    for node in ast.walk(module):
        if not isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ):
            continue
        # A statement that is only a string documents the statement above it.
        for statement in node.body:
            if not isinstance(statement, ast.Expr):
                continue
            value = statement.value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                lines.add(statement.lineno)
    return lines


def style(text: str) -> Counter[str]:
    """Count tokens, logical lines, assigned names and parameters, and everyday names."""
    tree = ast.parse(text)
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    logical_lines = sum(token.type == tokenize.NEWLINE for token in tokens)
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.append(node.id)
        elif isinstance(node, ast.arg) and node.arg not in ("self", "cls"):
            names.append(node.arg)
    return Counter(
        tokens=count(text),
        lines=logical_lines - len(_docstring_lines(tree)),
        names=len(names),
        everyday=sum(name in EVERYDAY for name in names),
    )


def print_style() -> None:
    """Print the density of lines and the fraction of everyday names of each package."""
    totals: dict[str, Counter[str]] = {}
    for path in sorted(sizes()):
        if path.startswith("benchnav/"):
            text = (ROOT / path).read_text()
            package = "/".join(path.split("/")[:-1][:2])
            for name in (package, "all"):
                totals[name] = totals.get(name, Counter()) + style(text)
            if (length := len(text.splitlines())) > MAX_LINES:
                print(f"{path}: {length} lines, expected at most {MAX_LINES}")
    for name, total in totals.items():
        tokens_a_line = total["tokens"] / total["lines"]
        everyday = 1000 * total["everyday"] / max(total["names"], 1)
        print(
            f"{name:25} {tokens_a_line:5.2f} tokens a logical line, "
            f"{everyday:5.1f} everyday names of 1 000"
        )


def sizes(revision: str = "") -> dict[str, int]:
    """Count the tokens of each Python file of the working tree, or of a revision."""
    listed = (
        _git("ls-tree", "-r", "--name-only", revision)
        if revision
        else _git("ls-files", "-co", "--exclude-standard")
    )
    paths = [
        path
        for path in listed.splitlines()
        if path.endswith(".py")
        and path.partition("/")[0] in _COUNTED
        and (revision or (ROOT / path).exists())
    ]
    return {
        path: count(
            _git("show", f"{revision}:{path}")
            if revision
            else (ROOT / path).read_text()
        )
        for path in paths
    }


def _git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


def by_folder(files: dict[str, int]) -> Counter[str]:
    """Sum tokens per folder of the first two levels; of large packages, of three."""
    totals: Counter[str] = Counter()
    for path, tokens in files.items():
        folders = path.split("/")[:-1]
        is_large = folders[:2] in (["benchnav", "eval"], ["benchnav", "models"])
        depth = 3 if is_large else 2
        totals["/".join(folders[:depth])] += tokens
        totals["package"] += tokens * (folders[0] == "benchnav")
    return totals


def main() -> None:
    """Print a table of tokens, or of the style of each package."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", default="", help="revision to compare with")
    parser.add_argument("--files", action="store_true", help="one row per file")
    parser.add_argument(
        "--style",
        action="store_true",
        help="tokens per logical line, and everyday names",
    )
    arguments = parser.parse_args()
    if arguments.style:
        print_style()
        return
    if sys.version_info[:2] != (3, 11):
        print(
            f"warning: Python {sys.version_info[0]}.{sys.version_info[1]} may count "
            "tokens differently from 3.11"
        )
    current, before = sizes(), sizes(arguments.against) if arguments.against else {}
    if not arguments.files:
        current, before = by_folder(current), by_folder(before)
    for name in sorted(current.keys() | before.keys()):
        change = (
            f" {before.get(name, 0):8} {current.get(name, 0) - before.get(name, 0):+8}"
            if arguments.against
            else ""
        )
        print(f"{name:50} {current.get(name, 0):8}{change}")


if __name__ == "__main__":
    main()
