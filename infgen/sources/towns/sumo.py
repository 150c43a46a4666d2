"""The programs of SUMO (https://eclipse.dev/sumo), which the extra ``towns`` brings."""

import subprocess
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

PACKAGE = "sumo"
HINT = "pip install 'infgen[towns]'"


class SumoError(ValueError):
    """SUMO is missing, or one of its programs failed."""


def run_program(name: str, options: Mapping[str, object]) -> None:
    """Run a program of SUMO to its end.

    Args:
        name: ``netgenerate``, ``netconvert`` or ``sumo``.
        options: By their long names; True is a flag.

    Raises:
        SumoError: if SUMO is not installed, or the program fails; with its last words.
    """
    words = [str(_folder() / name)]
    for option, value in options.items():
        words += [f"--{option}"] if value is True else [f"--{option}", str(value)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith("Error")]
        last = " ".join(said or done.stderr.splitlines()[-3:])
        raise SumoError(f"{name} failed with code {done.returncode}: {last}")


def check_installed() -> None:
    """See that SUMO is there.

    Raises:
        SumoError: if it is not, saying how to get it.
    """
    _folder()


def _folder() -> Path:
    """Folder of the programs. The package is found, not imported: it sets variables."""
    spec = find_spec(PACKAGE)
    for place in (spec.submodule_search_locations or []) if spec else []:
        folder = Path(place) / "bin"
        if folder.is_dir():
            return folder
    raise SumoError(f"SUMO is not installed, and towns are made with it; try: {HINT}")
