"""Stored work, of datasets, runs and models alike: held by one writer, written whole or
not at all, made in shards.

A file or folder is written under another name beside its own and then renamed. A text
that describes a store is
sealed: it holds its own digest, so that an edit is found.
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
    """Gives a name to write to; what stands there at the end takes `path`'s place in
    one step.

    A kill at any moment leaves `path` as it was or as it is to be. The name is the
    process's own, so that two writers of one file do not mix.

    Args:
        path: the file to be written; its folder is made.
        durable: wait until it is on the disk, so that not even a loss of power leaves
            it damaged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        if durable:
            with open(partial, "rb") as written:
                os.fsync(written.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def check_output(name: str, option: str = "out") -> None:
    """Refuse what is no path on this machine that an output can be written to.

    Args:
        name: the path; `~` is the user's home.
        option: what it is given as, for messages.

    Raises:
        ConfigError: If it is empty, an address, such as s3://bucket/name, which would
            become a folder `s3:`, or has characters that no listing shows.
    """
    expect(name, f"`{option}` as a path, got ''.")
    expect(
        name.isprintable(),
        f"`{option}` as a path of printable characters, got {name!r}.",
    )
    expect(
        not re.match(r"[A-Za-z][A-Za-z0-9+.-]*:/", name),
        f"`{option}` as a path on this machine, got the address {name!r}. Write to a "
        "folder here, and copy it.",
    )
    path = Path(os.path.expanduser(name))
    nearest = next(
        (place for place in path.absolute().parents if os.path.lexists(place)), path
    )
    expect(
        nearest.is_dir(),
        f"`{option}` as a path in a folder, got {name!r}, and {nearest} is no folder. "
        f"Choose another `{option}`.",
    )
    expect(
        option == "out" or not path.is_dir(),
        f"`{option}` as a file, got the folder {name!r}. Name a file in it.",
    )


def write_text(path: Path, text: str) -> None:
    """Writes a text file whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(text)


def real_place(path: Path) -> Path:
    """The place that a name stands for: where a link points to; the folder that `.` is,
    by its own name.
    """
    return path.resolve() if path.is_symlink() or path.name in ("", "..") else path


@contextmanager
def sole_writer(path: Path, what: str, shared: bool = False) -> Iterator[None]:
    """Holds a file or folder for one process, whether or not it exists yet; a kill
    frees it.

    The lock is a file beside it, so `path` may be moved, replaced or removed while it
    is held.

    Args:
        path: what is held; its folder is made, and removed at the end where nothing
            came into it.
        what: what is written there, for the message.
        shared: hold it together with others who share it, and keep out those who do
            not.

    Raises:
        BenchnavError: another process, or another part of this one, holds it.
    """
    path = path.resolve()
    made = [folder for folder in path.parents if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = path.with_name(f".{path.name}.lock")
    descriptor = _take(lock, what, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
    try:
        yield
    finally:
        with suppress(BlockingIOError):  # others share it still
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Removed while it is still held: whoever opened it meanwhile sees that its
            # name is gone.
            lock.unlink(missing_ok=True)
        os.close(descriptor)
        with suppress(OSError):  # one is not empty, or was removed by others
            for folder in made:
                folder.rmdir()


def _take(lock: Path, what: str, kind: int) -> int:
    """Opens and locks a file that has its name still; gives its descriptor."""
    while True:
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            if _is_same(descriptor, lock):
                return descriptor
        except BlockingIOError as error:
            os.close(descriptor)
            raise BenchnavError(
                f"Another run is writing {what}. Wait for it to end, or choose "
                "another `out`."
            ) from error
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its holder has removed it since it was opened


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def refuse_taken(out: Path, overwrite: bool, foreign: Callable[[Path], str]) -> None:
    """Refuses a place for an output that is taken; one rule for files, folders and
    checkpoints.

    Args:
        out: file or folder that is to be written.
        overwrite: whether what is there may be replaced.
        foreign: says of a place that is taken why it is of another kind, which no
            option may replace, such as "holds notes.txt"; empty where it is not.

    Raises:
        ConfigError: something of another kind is there; or something is there, and may
            not be replaced.
    """
    if not out.exists() and not out.is_symlink():
        return
    if why := foreign(out):
        raise ConfigError(
            "Expected `out` to be new or an earlier result of this command, got "
            f"{out}, which {why}. "
            "Choose another `out`."
        )
    if not overwrite and not (out.is_dir() and not any(out.iterdir())):
        raise ConfigError(
            f"Expected `out` to be new, got {out}, which exists. Pass --overwrite to "
            "replace it."
        )


def new_folder(place: Path) -> Path:
    """Makes an empty folder beside a place, to be filled and then given to
    `take_place`; one that a kill left goes.
    """
    partial = place.with_name(f".{place.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    return partial


@contextmanager
def building(place: Path) -> Iterator[Path]:
    """Gives an empty folder beside a place, to be filled and then given to
    `take_place`; where it was not, it goes.
    """
    partial = new_folder(place.with_name(f"{place.name}.building"))
    try:
        yield partial
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def take_place(partial: Path, place: Path, last: str = "") -> None:
    """Moves a whole folder to where it is to be, in the place of one that is there; see
    `restore`.

    An empty folder that is there is filled, since it may be a link, or the one that the
    user is in.

    Args:
        partial: the folder, beside `place`.
        place: where it is to be.
        last: file that makes an empty folder what it is to be, which so comes into it
            last.
    """
    if place.is_dir() and not any(place.iterdir()):
        for path in sorted(partial.iterdir(), key=lambda path: path.name == last):
            os.replace(path, place / path.name)
        partial.rmdir()
        return
    dropped = _dropped(place)
    shutil.rmtree(dropped, ignore_errors=True)
    if place.exists():
        place.rename(dropped)
    partial.rename(place)
    shutil.rmtree(dropped, ignore_errors=True)


def restore(place: Path) -> None:
    """Gives a folder its name back which `take_place` had taken away, where a kill came
    before the new one had it.
    """
    if _dropped(place).exists() and not place.exists():
        with suppress(FileNotFoundError):  # another process was quicker
            _dropped(place).rename(place)


def _dropped(place: Path) -> Path:
    return place.with_name(f".{place.name}.dropped")


def seal(content: Mapping[str, Any]) -> str:
    """Writes plain data as JSON that holds the SHA-256 of all else in it under `SEAL`."""
    content = {name: value for name, value in content.items() if name != SEAL}
    return json.dumps({**content, SEAL: text_digest(content)}, indent=1)


def unseal(text: str | bytes) -> dict[str, Any]:
    """Reads what `seal` wrote, without the digest.

    Raises:
        ValueError: it is no JSON object, or was changed since.
    """
    content = json.loads(text)
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    if content.pop(SEAL, None) != text_digest(content):
        raise ValueError("it was changed after benchnav wrote it")
    return content


def text_digest(content: Any) -> str:
    """SHA-256 of plain data, whatever the order of its keys."""
    return hashlib.sha256(
        json.dumps(content, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Shard:
    """A share of some work that several machines do apart, written 2/5 on the command
    line.

    Args:
        index: which one, from 1 on.
        of: how many there are.
    """

    index: int
    of: int

    def __post_init__(self) -> None:
        """Refuses one that is none of them."""
        if not 1 <= self.index <= self.of:
            raise ConfigError(f"Expected `shard` I/N with 1 ≤ I ≤ N, got {self}.")

    def __str__(self) -> str:
        """As it is written on the command line."""
        return f"{self.index}/{self.of}"


def read_shard(text: str) -> Shard | None:
    """Reads a shard as it is written on the command line; None of an empty text, which
    means all.

    Raises:
        ConfigError: it is no such text.
    """
    if not text:
        return None
    numbers = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if numbers is None:
        raise ConfigError(f"Expected `shard` I/N, such as 2/5, got {text!r}.")
    return Shard(index=int(numbers[1]), of=int(numbers[2]))


def check_workers(jobs: int, backend: str, scheduler: str) -> None:
    """Refuse numbers and kinds of workers that no machine has.

    Args:
        jobs: worker processes of this machine.
        backend: "local" or "dask".
        scheduler: address of a Dask cluster's scheduler; empty for none.

    Raises:
        ConfigError: If there is none or more than `MAX_JOBS`, or a cluster without an
            address or the reverse.
    """
    expect(1 <= jobs <= MAX_JOBS, f"`jobs` in 1–{MAX_JOBS}, got {jobs}.")
    expect(
        (backend == "dask") == bool(scheduler),
        "`backend` dask and `scheduler` together, got one of the two. Pass both.",
    )
