"""How fast scenes become tokens: the door to ``tokenize_speed.py``.

Python looks for modules in a script's own folder first. So whatever script of this folder
runs, the standard library's ``tokenize`` (which ``inspect`` and so numpy need) would be
this file. It puts the real one in its place, whoever asks.
"""

import importlib
import os
import sys


def put_standard_library_first() -> None:
    """Import the standard library's ``tokenize`` under its name."""
    here, path = os.path.dirname(os.path.abspath(__file__)), sys.path[:]
    sys.path[:] = [entry for entry in path if os.path.abspath(entry) != here]
    sys.modules.pop("tokenize", None)
    importlib.import_module("tokenize")
    sys.path[:] = path


put_standard_library_first()

if __name__ == "__main__":
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    importlib.import_module("tokenize_speed").main()
