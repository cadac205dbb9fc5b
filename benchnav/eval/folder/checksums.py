"""Checksums of files derived from a run: reports, figures, playback, map, tracebacks.

Checksums are stored in `SHA256SUMS` of the run folder, which `sha256sum --check` can
read. Other files need no checksum: `run.json`, units and steps contain their own
digests, and `run.json` contains the digest of the table of episodes.
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
    """Return the recorded SHA-256 of files of a run folder, by path in the folder.

    A line of another form is returned as a path with an empty SHA-256.
    """
    path = folder / SUMS
    text = path.read_text(errors="replace") if path.is_file() else ""
    checksums = {}
    for line in text.splitlines():
        match = _LINE.fullmatch(line)
        if match:
            checksums[match[2]] = match[1]
        else:
            checksums[line] = ""
    return checksums


def note_checksums(folder: Path, files: Iterable[Path]) -> None:
    """Record the SHA-256 of files of a run folder; do nothing in other folders.

    Args:
        folder: folder of the files.
        files: paths below `folder`.
    """
    if not (folder / RUN).is_file():
        return
    digests = read_checksums(folder)
    for path in files:
        name = path.relative_to(folder).as_posix()
        digests[name] = digest_of_path(path)
    lines = []
    for name, digest in sorted(digests.items()):
        if digest and (folder / name).is_file():
            lines.append(f"{digest}  {name}\n")
    if lines or (folder / SUMS).exists():
        write_text(folder / SUMS, "".join(lines))


def matches_checksum(folder: Path, file: Path) -> bool:
    """Return whether a file agrees with its recorded SHA-256; True without a record."""
    if not file.is_relative_to(folder):
        return True
    name = file.relative_to(folder).as_posix()
    digest = read_checksums(folder).get(name)
    return digest is None or digest == digest_of_path(file)
