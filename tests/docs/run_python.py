"""Runs blocks of Python one after the other in one namespace: each line of standard
input names a file of one.
"""

import sys

namespace: dict[str, object] = {"__name__": "__main__"}
for line in sys.stdin:
    path = line.strip()
    with open(path) as file:
        code = compile(file.read(), path, "exec")
    exec(code, namespace)
    print("done", flush=True)
