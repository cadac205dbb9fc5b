"""Sentences of the project, and the words that they should not have.

    python -m tests.prose    # an editor's list: words to decide sentence by sentence

Sentences are docstrings, comments, messages and the text of pages, without code,
quotations and italics, since words of others and of files stay as they are.
"""

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
CODE = ("benchnav", "benchmarks", "studies", "tools", "examples")
PAGES = ("docs", "datasets", "checkpoints", "studies", "examples")
ROOT_PAGES = ("README.md", "CONTRIBUTING.md", "STYLE.md")

REFUSED = re.compile(
    r"\b(anew|h[au]ngs? together|(?:is|are) (?-i:none)|so many|not a number|told|nobody|somebody)\b"
    r"|\bas of (?!version|\d)",
    re.IGNORECASE,
)
TRIALS = re.compile(r"\btrials?\b", re.IGNORECASE)
# Statistics and Optuna have trials.
TRIALS_OF_OTHERS = re.compile(
    r"Randomization Trials|[Bb]inomial|Bernoulli|McNemar|Wilson|Optuna"
)
FIRST_WORDS = re.compile(r"^(Refuses|Tells|What|How)\b")
EDITORS_LIST = re.compile(
    r"\b(alone|beside|by itself|of which|share|ground(?! truth)|way|held|place|look)\b",
    re.IGNORECASE,
)
_QUOTED = re.compile(
    r"`[^`]*`|\"[^\"\n]*\"|“[^”]*”|'[^'\n]{2,}'(?!\w)|(?<![*\w])\*[^*\n]+\*(?!\*)|\]\([^)]*\)"
)


@dataclass(frozen=True)
class Sentence:
    """Text of a place in a file.

    Args:
        path: from the root of the repository.
        line: where it begins.
        text: without code and quotations.
        is_docstring: whether it documents a module, class or function.
    """

    path: str
    line: int
    text: str
    is_docstring: bool = False

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {' '.join(self.text.split())[:100]}"


def sentences() -> Iterator[Sentence]:
    """List the sentences of code and pages."""
    for folder in CODE:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield from _of_code(path)
    pages = [page for folder in PAGES for page in sorted((ROOT / folder).rglob("*.md"))]
    pages += [ROOT / name for name in ROOT_PAGES if (ROOT / name).exists()]
    for path in pages:
        yield from _of_page(path)


def breaches() -> list[str]:
    """List the sentences with a word that is refused."""
    lines = []
    for sentence in sentences():
        words = [match[0] for match in REFUSED.finditer(sentence.text)]
        if not TRIALS_OF_OTHERS.search(sentence.text):
            words += TRIALS.findall(sentence.text)
        if sentence.is_docstring and FIRST_WORDS.match(sentence.text):
            words.append(sentence.text.split()[0])
        lines += [f"{sentence} [{word}]" for word in words]
    return lines


def _of_code(path: Path) -> Iterator[Sentence]:
    name, text = path.relative_to(ROOT).as_posix(), path.read_text()
    tree = ast.parse(text)
    documented = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            docstring = ast.get_docstring(node)
            if docstring is None:
                continue
            first = node.body[0]
            documented.add(first.lineno)
            yield Sentence(name, first.lineno, _unquoted(docstring), is_docstring=True)
    parts = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant | ast.JoinedStr)
            and node.lineno not in documented
            and id(node) not in parts
        ):
            message = _message(node)
            if len(message.split()) > 2:
                yield Sentence(name, node.lineno, _unquoted(message))
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield Sentence(name, token.start[0], _unquoted(token.string))


def _message(node: ast.Constant | ast.JoinedStr) -> str:
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    parts = [part.value for part in node.values if isinstance(part, ast.Constant)]
    return "…".join(str(part) for part in parts)


def _of_page(path: Path) -> Iterator[Sentence]:
    name = path.relative_to(ROOT).as_posix()
    text = re.sub(
        r"^ *```.*?^ *```$", _blank, path.read_text(), flags=re.MULTILINE | re.DOTALL
    )
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip():
            yield Sentence(name, number, _unquoted(line))


def _blank(block: re.Match[str]) -> str:
    """Keep the line numbers of what follows."""
    return "\n" * block[0].count("\n")


def _unquoted(text: str) -> str:
    return _QUOTED.sub("…", text)


def main() -> None:
    """Print how often each word of the editor's list stands, and in which files most."""
    words: Counter[str] = Counter()
    files: Counter[str] = Counter()
    for sentence in sentences():
        found = [match[0].lower() for match in EDITORS_LIST.finditer(sentence.text)]
        words.update(found)
        files[sentence.path] += len(found)
    counts = ", ".join(f"{word} {count}" for word, count in words.most_common())
    print(f"words to decide sentence by sentence: {counts or 'none'}")
    for path, count in files.most_common(5):
        print(f"  {path}: {count}")


if __name__ == "__main__":
    main()
