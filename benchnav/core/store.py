"""Storage of datasets, runs and models: locks, atomic writes, digests and shards.

A file or folder is written under a temporary name in the same parent folder and then
renamed. A text from `seal` contains its own digest, so that an edit is detected.
"""

import fcntl
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchnav.core.errors import BenchnavError, ConfigError, expect

SEAL = "manifest_digest"
MAX_JOBS = 10_000


@contextmanager
def replacing(path: Path, durable: bool = True) -> Iterator[Path]:
    """Write a file atomically: yield a temporary path, and rename that file at the end.

    If the process is killed, either the old or the new file exists. The temporary name
    contains the process ID, so that two processes never write the same temporary file.

    Args:
        path: file to write; its folder is created.
        durable: whether to wait until the data is on the disk, so that a power failure
            cannot damage the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        if durable:
            with open(partial, "rb") as file:
                os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def check_output(name: str, option: str = "out") -> None:
    """Check that an output can be written to a path on this machine.

    Args:
        name: path of the output; `~` is the user's home folder.
        option: name of the option that sets the path, for messages.

    Raises:
        ConfigError: If `name` is empty, has non-printable characters, is below a path
            that is not a folder, or is an address, such as s3://bucket/name. If
            `option` is not `out`, also if `name` is a folder.
    """
    expect(name, f"`{option}` to be a path, got ''.")
    expect(
        name.isprintable(),
        f"`{option}` to be a path of printable characters, got {name!r}.",
    )
    expect(
        not re.match(r"[A-Za-z][A-Za-z0-9+.-]*:/", name),
        f"`{option}` to be a path on this machine, got the address {name!r}. Write to "
        "a local folder, and copy it.",
    )
    path = Path(os.path.expanduser(name))
    existing = filter(os.path.lexists, path.absolute().parents)
    nearest = next(existing, path)
    expect(
        nearest.is_dir(),
        f"`{option}` to be a path in a folder, got {name!r}, but {nearest} is not a "
        f"folder. Choose another `{option}`.",
    )
    expect(
        option == "out" or not path.is_dir(),
        f"`{option}` to be a file, got the folder {name!r}. Name a file in it.",
    )


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with replacing(path) as partial:
        partial.write_text(text)


def write_texts(stem: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts, given by their suffixes, to files STEM + suffix; return the paths."""
    paths = []
    for suffix, text in texts.items():
        path = stem.with_name(stem.name + suffix)
        write_text(path, text)
        paths.append(path)
    return paths


def resolve_link(path: Path) -> Path:
    """Return the path to which a link, or a path that ends in `.` or `..`, leads.

    Any other path is returned unchanged.
    """
    return path.resolve() if path.is_symlink() or path.name in ("", "..") else path


@contextmanager
def sole_writer(path: Path, output: str, shared: bool = False) -> Iterator[None]:
    """Acquire an exclusive lock on a path, which need not exist.

    The lock is a file in the same parent folder, so that `path` may be moved, replaced
    or removed while it is locked. The lock ends with the process, even if it is killed.

    Args:
        path: file or folder to lock. Missing parent folders are created, and removed at
            the end if they are empty.
        output: name of the output at `path`, for the message.
        shared: whether other processes that set `shared` may lock `path` at the same
            time.

    Raises:
        BenchnavError: If this or another process has locked `path`.
    """
    path = path.resolve()
    new_folders = [folder for folder in path.parents if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    descriptor = _lock(lock, output, kind)
    try:
        yield
    finally:
        with suppress(BlockingIOError):  # other processes still share the lock
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The lock file is removed while it is locked. A process that has opened it
            # meanwhile detects the removal, see `_is_same`.
            lock.unlink(missing_ok=True)
        os.close(descriptor)
        with suppress(OSError):  # a folder is not empty, or already removed
            for folder in new_folders:
                folder.rmdir()


def _lock(lock: Path, output: str, kind: int) -> int:
    """Open and lock a lock file, and return its descriptor."""
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            if _is_same(descriptor, lock):
                return descriptor
        except BlockingIOError as error:
            os.close(descriptor)
            raise BenchnavError(
                f"Another run is writing {output}. Wait until it ends, or choose "
                "another `out`."
            ) from error
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # another process has removed the file: open a new one


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def check_replaceable(
    out: Path, overwrite: bool, foreign: Callable[[Path], str]
) -> None:
    """Check that a file, folder or checkpoint may be written to `out`.

    Args:
        out: file or folder to write.
        overwrite: whether an earlier output may be replaced.
        foreign: function that returns why an existing path is not an earlier output,
            such as "contains notes.txt", or an empty text if it is one. A foreign path
            is never replaced.

    Raises:
        ConfigError: If `out` exists, and either is foreign or may not be replaced.
    """
    if not out.exists() and not out.is_symlink():
        return
    reason = foreign(out)
    if reason:
        raise ConfigError(
            "Expected `out` to be new or an earlier result of this command, got "
            f"{out}, which {reason}. Choose another `out`."
        )
    is_empty_folder = out.is_dir() and not any(out.iterdir())
    if not overwrite and not is_empty_folder:
        raise ConfigError(
            f"Expected `out` to be new, got {out}, which exists. Pass --overwrite to "
            "replace it."
        )


def new_folder(path: Path) -> Path:
    """Create an empty folder next to `path`, to fill and then pass to `replace_folder`.

    The folder that an interrupted process left is replaced.
    """
    partial = path.with_name(f".{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    return partial


@contextmanager
def building(path: Path) -> Iterator[Path]:
    """Yield a new empty folder next to `path`, to fill and then pass to `replace_folder`.

    If it was not passed to `replace_folder`, the folder is removed at the end.
    """
    partial = new_folder(path.with_name(f"{path.name}.building"))
    try:
        yield partial
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def replace_folder(partial: Path, path: Path, last: str = "") -> None:
    """Replace the folder at `path` by a complete one; see `restore`.

    If `path` is an empty folder, the files are moved into it, because the folder may be
    a link or the user's working directory.

    Args:
        partial: the complete folder, next to `path`.
        path: final path of the folder.
        last: name of the file that marks a folder as complete. It is moved last.
    """
    if path.is_dir() and not any(path.iterdir()):
        for file in sorted(partial.iterdir(), key=lambda file: file.name == last):
            os.replace(file, path / file.name)
        partial.rmdir()
        return
    dropped = _dropped(path)
    shutil.rmtree(dropped, ignore_errors=True)
    if path.exists():
        path.rename(dropped)
    partial.rename(path)
    shutil.rmtree(dropped, ignore_errors=True)


def restore(path: Path) -> None:
    """Restore the old folder that an interrupted `replace_folder` had renamed."""
    dropped = _dropped(path)
    if dropped.exists() and not path.exists():
        with suppress(FileNotFoundError):  # another process has restored it
            dropped.rename(path)


def _dropped(path: Path) -> Path:
    return path.with_name(f".{path.name}.dropped")


def seal(content: Mapping[str, Any]) -> str:
    """Return plain data as JSON, with the data's SHA-256 under the key `SEAL`."""
    content = {name: value for name, value in content.items() if name != SEAL}
    return json.dumps({**content, SEAL: text_digest(content)}, indent=1)


def unseal(text: str | bytes) -> dict[str, Any]:
    """Return the data in a text from `seal`, without the digest.

    Raises:
        ValueError: If the text is not a JSON object, or does not match its digest.
    """
    content = json.loads(text)
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    if content.pop(SEAL, None) != text_digest(content):
        raise ValueError("it was changed after benchnav wrote it")
    return content


def text_digest(content: Any) -> str:
    """Return the SHA-256 of plain data, independent of the order of keys."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Shard:
    """Fraction of some work, for one of several machines, written as 2/5.

    Args:
        index: number of this shard, from 1 to `of`.
        of: total number of shards.

    Raises:
        ConfigError: If `index` is out of range.
    """

    index: int
    of: int

    def __post_init__(self) -> None:
        """Check the range of the index."""
        if not 1 <= self.index <= self.of:
            raise ConfigError(f"Expected `shard` as I/N with 1 ≤ I ≤ N, got {self}.")

    def __str__(self) -> str:
        """Return the shard as on the command line, such as 2/5."""
        return f"{self.index}/{self.of}"


def read_shard(text: str) -> Shard | None:
    """Return the shard that a text such as 2/5 names; None (all work) if it is empty.

    Raises:
        ConfigError: If the text has another form, or the index is out of range.
    """
    if not text:
        return None
    numbers = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if numbers is None:
        raise ConfigError(f"Expected `shard` as I/N, such as 2/5, got {text!r}.")
    return Shard(index=int(numbers[1]), of=int(numbers[2]))


def check_workers(jobs: int, backend: str, scheduler: str) -> None:
    """Check the number and kind of workers.

    Args:
        jobs: number of worker processes on this machine, 1–`MAX_JOBS`.
        backend: "local" or "dask".
        scheduler: address of a Dask cluster's scheduler; empty without a cluster.

    Raises:
        ConfigError: If `jobs` is out of range, or the backend is dask without an
            address, or an address is given for another backend.
    """
    expect(1 <= jobs <= MAX_JOBS, f"`jobs` in 1–{MAX_JOBS}, got {jobs}.")
    expect(
        (backend == "dask") == bool(scheduler),
        "`backend` dask and `scheduler` together, got only one of them. Set both.",
    )
