"""Run notebooks where they lie, and keep what they show: ``make notebooks``.

Times are left out, and lines that are printed one after the other become one output, so
that equal results are equal files.
"""

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def run(path: Path) -> None:
    notebook = nbformat.read(path, nbformat.NO_CONVERT)
    NotebookClient(
        notebook,
        timeout=600,
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": str(path.parent)}},
    ).execute()
    nbformat.write(notebook, path)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        run(Path(name).absolute())
