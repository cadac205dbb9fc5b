"""Worker processes that end with the command that they work for."""

import os
import threading
import time
from functools import cache

_LOOK_S = 0.5


@cache
def end_with(parent: int) -> None:
    """Ends this process when its parent is gone, which a kill tells no worker; once a process is enough.

    Args:
        parent: number of the process that started this one. It is given, since a worker that is still on its way up
            when its parent is killed would take the process that adopts it for its parent.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
