"""Checksums of what is made of a run: reports, figures, playback, the ground of driven
paths, and tracebacks.

They stand in `SHA256SUMS` of the run folder, which `sha256sum --check` reads too.
`run.json`, units and steps hold digests of their own, and `run.json` that of the table
of episodes.
"""

import re
from collections.abc import Iterable
from pathlib import Path

from benchnav.core.sources import digest_of_path
from benchnav.core.store import write_text
from benchnav.eval.folder.run_folder import RUN

SUMS = "SHA256SUMS"
_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def read_checksums(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of files of a run folder by their path in it; empty if none
    were noted.

    A line that is no checksum has its whole text for a path, and no SHA-256.
    """
    path = folder / SUMS
    text = path.read_text(errors="replace") if path.is_file() else ""
    matches = [(line, _LINE.fullmatch(line)) for line in text.splitlines()]
    return dict(
        (match[2], match[1]) if match else (line, "") for line, match in matches
    )


def note_checksums(folder: Path, files: Iterable[Path]) -> None:
    """Note the SHA-256 of files that were written into a run folder; elsewhere nothing
    is noted.

    Args:
        folder: where they were written.
        files: their paths, below `folder`.
    """
    if not (folder / RUN).is_file():
        return
    known = read_checksums(folder)
    known |= {
        path.relative_to(folder).as_posix(): digest_of_path(path) for path in files
    }
    lines = [
        f"{known[name]}  {name}\n"
        for name in sorted(known)
        if known[name] and (folder / name).is_file()
    ]
    if lines or (folder / SUMS).exists():
        write_text(folder / SUMS, "".join(lines))


def is_as_noted(folder: Path, file: Path) -> bool:
    """Return whether a file of a run folder has the SHA-256 that was noted, or none
    was.
    """
    if not file.is_relative_to(folder):
        return True
    digest = read_checksums(folder).get(file.relative_to(folder).as_posix())
    return digest is None or digest == digest_of_path(file)
