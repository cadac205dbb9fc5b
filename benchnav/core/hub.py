"""Datasets and checkpoints of a hub, `owner/name@revision`, as cached downloads.

Only the files in `FILES` are downloaded, and no code is executed. The address contains
the revision, so that a run records its exact input. A commit never changes; a branch or
tag may move. The environment variables `HF_HOME`, `HF_HUB_OFFLINE`, `HF_ENDPOINT` and
`HF_TOKEN` act as in huggingface_hub.
"""

import json
import re
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Literal

from benchnav.core.command import tell
from benchnav.core.errors import BenchnavError, quiet

Kind = Literal["model", "dataset"]

FILES: dict[Kind, tuple[str, ...]] = {
    "model": ("config.json", "ground.json", "*.safetensors", "README.md"),
    "dataset": ("*.h5", "manifest.json", "README.md"),
}
"""Name patterns of the files that are downloaded, by kind of repository."""

_ADDRESS = re.compile(r"(\w[\w.-]*/\w[\w.-]*)@([\w][\w./-]*)", re.ASCII)
_COMMIT = re.compile(r"[0-9a-f]{40}")


def is_address(source: str | Path) -> bool:
    """Return whether a text has the form `owner/name@revision`."""
    return _ADDRESS.fullmatch(str(source)) is not None


@cache
def download(address: str, kind: Kind, error: type[BenchnavError]) -> Path:
    """Download a revision, unless the cache contains it, and return its folder.

    Args:
        address: `owner/name@revision`.
        kind: kind of the repository.
        error: exception class to raise.

    Returns:
        The folder of the revision in the cache.

    Raises:
        BenchnavError: If the hub cannot be reached, or has no such repository or
            revision. The exception is an instance of `error`.
    """
    from huggingface_hub import errors, snapshot_download

    match = _ADDRESS.fullmatch(address)
    assert match is not None
    name, revision = match.groups()

    def snapshot(local: bool) -> Path:
        folder = snapshot_download(
            name,
            repo_type=kind,
            revision=revision,
            allow_patterns=list(FILES[kind]),
            local_files_only=local,
        )
        return Path(folder)

    with quiet("huggingface_hub"):
        # A commit never changes, so that a complete copy needs no request.
        if _COMMIT.fullmatch(revision):
            try:
                folder = snapshot(local=True)
            except (errors.LocalEntryNotFoundError, OSError):
                pass
            else:
                if _is_complete(folder, kind):
                    return folder
        try:
            folder = snapshot(local=False)
        except Exception as cause:  # the client's exceptions have no common base class
            raise error(f"Expected {_reason(cause, name, revision, kind)}") from cause
    if not _COMMIT.fullmatch(revision):
        commit = folder.name
        tell(
            f"benchnav: note: {address} is commit {commit} now and may change; "
            f"@{commit} never changes"
        )
    return folder


def _is_complete(folder: Path, kind: Kind) -> bool:
    """Return whether a folder contains all files that its index file lists.

    Files are missing after an interrupted download.
    """
    try:
        if kind == "model":
            config = json.loads((folder / "config.json").read_text())
            names = [f"{part}.safetensors" for part in config["parts"]]
            names += ["ground.json"] if "ground" in config else []
        elif (folder / "manifest.json").exists():
            manifest = json.loads((folder / "manifest.json").read_text())
            shards = chain.from_iterable(manifest["shards"].values())
            names = [shard["file"] for shard in shards]
        else:
            return len(list(folder.glob("*.h5"))) == 1
        return all((folder / name).is_file() for name in names)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _reason(cause: Exception, name: str, revision: str, kind: Kind) -> str:
    """Return the message for an exception of huggingface_hub, after "Expected"."""
    from huggingface_hub import errors

    if isinstance(cause, errors.RevisionNotFoundError):
        return (
            f"a revision of {name} on the hub, got {revision!r}, which does not exist. "
            "Name a commit, tag or branch."
        )
    if isinstance(cause, errors.GatedRepoError):
        return (
            f"access to {name} on the hub, got no access. Request access from the owner, "
            "and log in with `hf auth login`."
        )
    if isinstance(cause, errors.RepositoryNotFoundError):
        return (
            f"a {kind} repository on the hub, got {name!r}, which does not exist or is "
            "private. Check the name, or log in with `hf auth login`."
        )
    if isinstance(cause, errors.HFValidationError):
        return f"the name of a repository as owner/name, got {name!r}."
    detail = " ".join(str(cause).split())[:160]
    return (
        f"the hub to be reachable for {name}@{revision}, which is not in the cache, got "
        f"{type(cause).__name__}: {detail.rstrip('.')}. Try again with a network "
        "connection, or name a local folder."
    )
