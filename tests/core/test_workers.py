import os
import subprocess
import sys

import pytest

LIVES = (
    "import time; from benchnav.core.workers import end_with; "
    "end_with({parent}); time.sleep({seconds}); print('done')"
)


@pytest.mark.parametrize(("of_this", "printed"), [(True, "done\n"), (False, "")])
def test_a_worker_lives_as_long_as_the_process_it_was_given(of_this: bool, printed: str) -> None:
    # One whose parent was killed before it came up has another parent from the first.
    parent, seconds = (os.getpid(), 1.2) if of_this else (os.getppid(), 60)
    code = LIVES.format(parent=parent, seconds=seconds)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert ended.stdout == printed
