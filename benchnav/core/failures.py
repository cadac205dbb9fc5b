"""Messages of commands on standard error, and texts for errors that end a command."""

import errno
import os
import sys
from pathlib import Path

from benchnav.core.errors import BenchnavError, out_of_memory_error

# Maximum length of a message in characters; the middle of a longer message is omitted.
_MAX_LENGTH = 2000


def tell(line: str) -> None:
    """Print a line on standard error; after a broken pipe, discard it and continue."""
    try:
        print(line, file=sys.stderr, flush=True)
    except BrokenPipeError:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


def describe_failure(error: Exception, has_out: bool) -> str | None:
    """Return a message about an error that the user can correct; None for a bug.

    Args:
        error: exception that ended a command.
        has_out: whether the command has a flag `--out`.
    """
    no_memory = out_of_memory_error(error)
    if no_memory:
        return str(no_memory)
    if isinstance(error, BenchnavError | UnicodeDecodeError):
        return str(error)
    if isinstance(error, OSError):
        return _describe_os_error(error, has_out)
    return None


def report_failure(program: str, message: str) -> None:
    """Print an error message in one line on standard error."""
    line = " ".join(message.split())
    if len(line) > _MAX_LENGTH:
        line = f"{line[: _MAX_LENGTH // 2]} … {line[-_MAX_LENGTH // 2 :]}"
    print(f"{program}: error: {line}", file=sys.stderr)


def _describe_os_error(error: OSError, has_out: bool) -> str:
    """Return a message with the path that could not be used, the reason and a remedy."""
    reason = error.strerror or str(error)
    if not error.filename:
        return f"could not use a file: {reason}"
    path = Path(str(error.filename))
    if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"could not use {path}: {reason}"
    path = path.absolute()
    existing = next(
        folder for folder in (path, *path.parents) if os.path.exists(folder)
    )
    remedy = "Choose another path with --out, or change" if has_out else "Change"
    return f"could not use {path}: {reason}. {remedy} the permissions of {existing}."
