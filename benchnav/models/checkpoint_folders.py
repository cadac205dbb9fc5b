"""Search for checkpoints by path, by name, or on a hub."""

import re
from pathlib import Path

from benchnav.core import hub, registry
from benchnav.core.errors import CheckpointError, ConfigError
from benchnav.core.shipped_files import shipped_folder
from benchnav.models.checkpoint import CONFIG
from benchnav.models.parts import check_finished

_ONLY_IN_REPOSITORY = "paper-v1"  # a checkpoint that `setup.py` leaves out of wheels


def find_checkpoint(source: str | Path) -> Path:
    """Find the folder of a checkpoint by path, by name, or on a hub.

    A name is looked up in `checkpoints/` of the working directory first, then among the
    shipped checkpoints.

    Args:
        source: path, name or `owner/name@revision`; for `path/to/file.py:Name@CHECKPOINT`
            the result is the folder of CHECKPOINT.

    Raises:
        CheckpointError: If the training of the checkpoint was interrupted.
        ConfigError: If no checkpoint matches the source.
    """
    class_and_checkpoint = split_class_and_checkpoint(source)
    if class_and_checkpoint:
        source = class_and_checkpoint[1]
    path = Path(source)
    candidates = (path, *(folder / source for folder in _checkpoint_folders()))
    for candidate in candidates:
        if (candidate / CONFIG).is_file():
            return candidate
    if path.is_dir():
        return path  # `read_config` reports the missing file
    for candidate in candidates:
        check_finished(candidate)
    if hub.is_address(source):
        return hub.download(str(source), "model", CheckpointError)
    if str(source) == _ONLY_IN_REPOSITORY:
        raise ConfigError(
            f"Expected the checkpoint {source} in checkpoints/, got no such folder. "
            "The wheel does not contain this checkpoint, because it is too large. Copy "
            f"checkpoints/{source} from the repository to checkpoints/, or use another "
            "model, such as stakes-v1."
        )
    names = [folder.name for folder in list_checkpoints()]
    options = sorted({*registry.names("model"), *names})
    siblings = [config.parent.name for config in path.parent.glob(f"*/{CONFIG}")]
    suggestion = (
        registry.hint(str(source), options)
        or registry.hint(path.name, siblings, f"{path.parent}/")
        or registry.hint(path.name, names)
    )
    raise ConfigError(
        f"Expected a model among {', '.join(options)}, the folder of a checkpoint, "
        "package.module:Name, path/to/file.py:Name or owner/name@revision of a hub, "
        f"got {str(source)!r}.{suggestion}"
    )


def list_checkpoints() -> list[Path]:
    """Return the folders of local and shipped checkpoints.

    Local checkpoints are in `checkpoints/` of the working directory. If a local and a
    shipped checkpoint have the same name, only the local one is returned.
    """
    by_name: dict[str, Path] = {}
    for folder in _checkpoint_folders():
        for path in sorted(config.parent for config in folder.glob(f"*/{CONFIG}")):
            by_name.setdefault(path.name, path)
    return list(by_name.values())


def split_class_and_checkpoint(source: str | Path) -> tuple[str, str] | None:
    """Split `path/to/file.py:Name@CHECKPOINT` into class and checkpoint.

    Returns:
        Class and checkpoint; None if the source does not have this form.
    """
    match = re.fullmatch(r"(.+?:[A-Za-z_][\w.]*)@(.+)", str(source))
    if match is None or (Path(source) / CONFIG).is_file():
        return None
    return match[1], match[2]


def _checkpoint_folders() -> tuple[Path, Path]:
    return Path("checkpoints"), shipped_folder("checkpoints")
