"""The programs of SUMO (https://eclipse.dev/sumo), which the extra ``towns`` brings."""

import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

PACKAGE = "sumo"
LIBRARY = "libsumo"
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
    words = [str(_folder() / name), *_words(options)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith("Error")]
        last = " ".join(said or done.stderr.splitlines()[-3:])
        raise SumoError(f"{name} failed with code {done.returncode}: {last}")


def run_stepwise(
    options: Mapping[str, object],
    steps: int,
    each_step: Callable[[ModuleType], Callable[[int], None]],
) -> None:
    """Run ``sumo`` in this process, step by step; one at a time.

    Args:
        options: By their long names; True is a flag.
        steps: How many.
        each_step: Given ``libsumo`` with the simulation loaded, returns what is called with
            the number of every step before it is made.

    Raises:
        SumoError: if libsumo is not installed, or the simulation fails.
    """
    with _libsumo() as libsumo:
        try:
            libsumo.start(["sumo", *_words(options)])
            before_step = each_step(libsumo)
            for step in range(steps):
                before_step(step)
                libsumo.simulationStep()
        except (libsumo.TraCIException, libsumo.FatalTraCIError) as error:
            raise SumoError(f"sumo failed, see its words above: {error}") from error


@contextmanager
def _libsumo() -> Iterator[ModuleType]:
    """Give libsumo; its simulation is closed at the end."""
    if find_spec(LIBRARY) is None:
        raise SumoError(f"{LIBRARY} is not installed, and such towns need it; try: {HINT}")
    libsumo = import_module(LIBRARY)
    try:
        yield libsumo
    finally:
        libsumo.close()


def _words(options: Mapping[str, object]) -> list[str]:
    words: list[str] = []
    for option, value in options.items():
        words += [f"--{option}"] if value is True else [f"--{option}", str(value)]
    return words


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
