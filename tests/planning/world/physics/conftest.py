"""Compiled laws of the whole session, where MuJoCo and a compiler are installed."""

import shutil
from collections.abc import Iterator

import pytest

from benchnav.planning.world.physics.library import _compiler


@pytest.fixture(scope="session", autouse=True)
def compiled_laws(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep compiled code out of the user's cache; skip where it cannot be compiled."""
    pytest.importorskip("mujoco", reason="the extra `physics` is not installed")
    if shutil.which(_compiler()[0]) is None:
        pytest.skip("no C compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BENCHNAV_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
