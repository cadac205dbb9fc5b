"""Datasets and checkpoints of a hub, `owner/name@revision`: downloaded once into the
cache of huggingface_hub.

Data alone is downloaded, files of the names that the readers read, and nothing of it is
run. The revision is part of
the name, so that a run says what it read: a commit is for good, a branch or tag may
move. What `HF_HOME`, `HF_HUB_OFFLINE`, `HF_ENDPOINT` and `HF_TOKEN` mean to
huggingface_hub they mean here.
"""

import json
import re
from functools import cache
from pathlib import Path
from typing import Literal

from benchnav.core.command import tell
from benchnav.core.errors import BenchnavError, quiet

Kind = Literal["model", "dataset"]

FILES: dict[Kind, tuple[str, ...]] = {
    "model": ("config.json", "ground.json", "*.safetensors", "README.md"),
    "dataset": ("*.h5", "manifest.json", "README.md"),
}
"""What is downloaded, by kind of repository."""

_ADDRESS = re.compile(r"(\w[\w.-]*/\w[\w.-]*)@([\w][\w./-]*)", re.ASCII)
_COMMIT = re.compile(r"[0-9a-f]{40}")


def is_address(source: str | Path) -> bool:
    """Tells whether a text is of the form `owner/name@revision`."""
    return _ADDRESS.fullmatch(str(source)) is not None


@cache
def download(address: str, kind: Kind, error: type[BenchnavError]) -> Path:
    """Downloads what is not in the cache yet.

    Args:
        address: `owner/name@revision`.
        kind: of the repository.
        error: what is raised.

    Returns:
        The folder of the revision.

    Raises:
        BenchnavError: of the type `error`: the hub cannot be reached, or has no such
            repository or revision.
    """
    from huggingface_hub import errors, snapshot_download

    named = _ADDRESS.fullmatch(address)
    assert named is not None
    name, revision = named[1], named[2]

    def snapshot(local: bool) -> Path:
        patterns = list(FILES[kind])
        return Path(
            snapshot_download(
                name,
                repo_type=kind,
                revision=revision,
                allow_patterns=patterns,
                local_files_only=local,
            )
        )

    with quiet("huggingface_hub"):
        if _COMMIT.fullmatch(
            revision
        ):  # which does not change, so that the hub need not be asked again
            try:
                folder = snapshot(local=True)
            except (errors.LocalEntryNotFoundError, OSError):
                pass
            else:
                if _is_whole(folder, kind):
                    return folder
        try:
            folder = snapshot(local=False)
        except Exception as cause:  # of many kinds, and not of one base
            raise error(f"Expected {_refused(cause, name, revision, kind)}") from cause
    if not _COMMIT.fullmatch(revision):
        commit = folder.name
        tell(
            f"benchnav: note: {address} is {commit} now and may move; @{commit} stays "
            "what it is"
        )
    return folder


def _is_whole(folder: Path, kind: Kind) -> bool:
    """Tells whether all files are there that the first of them names: a download may
    have been cut short.
    """
    try:
        if kind == "model":
            config = json.loads((folder / "config.json").read_text())
            named = [f"{part}.safetensors" for part in config["parts"]]
            named += ["ground.json"] if "ground" in config else []
        elif (folder / "manifest.json").exists():
            shards = json.loads((folder / "manifest.json").read_text())["shards"]
            named = [shard["file"] for own in shards.values() for shard in own]
        else:
            return len(list(folder.glob("*.h5"))) == 1
        return all((folder / name).is_file() for name in named)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _refused(cause: Exception, name: str, revision: str, kind: Kind) -> str:
    from huggingface_hub import errors

    if isinstance(cause, errors.RevisionNotFoundError):
        return (
            f"a revision of {name} on the hub, got {revision!r}, which it has "
            "not. "
            "Name a commit, tag or branch."
        )
    if isinstance(cause, errors.GatedRepoError):
        return (
            f"access to {name} on the hub, got none. Ask its owner for it, and "
            "log "
            "in with `hf auth login`."
        )
    if isinstance(cause, errors.RepositoryNotFoundError):
        return (
            f"a {kind} repository on the hub, got {name!r}, which is not there or is "
            "private. Check the name, or log "
            "in with `hf auth login`."
        )
    if isinstance(cause, errors.HFValidationError):
        return f"the name of a repository, owner/name, got {name!r}."
    return (
        f"to reach the hub for {name}@{revision}, which is not in the cache, got "
        f"{type(cause).__name__}: "
        f"{' '.join(str(cause).split())[:160]} Try again with a connection, or name a "
        "local folder."
    )
