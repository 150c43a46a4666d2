"""Notebooks run from top to bottom, and what git keeps of them is small and whole.

``make notebooks`` runs them again and keeps what they show.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
RUN = Path(__file__).with_name("run_notebooks.py")
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
LARGEST_BYTES = 200_000
LONGEST_S = 600


def outputs(path: Path) -> list[list[dict]]:
    """Outputs of each code cell, all of which were run in order from a fresh start."""
    cells = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(not cell["metadata"] for cell in cells), "times differ from run to run"
    found = [cell["outputs"] for cell in cells]
    assert not [each for cell in found for each in cell if each["output_type"] == "error"]
    return found


def pages(path: Path) -> list[str]:
    """What is shown as HTML in a frame of its own: player pages."""
    shown = [each.get("data", {}).get("text/html", "") for c in outputs(path) for each in c]
    return [html for html in map("".join, shown) if html.startswith("<iframe srcdoc=")]


def test_there_are_three_notebooks():
    names = [path.stem for path in NOTEBOOKS]

    assert names == ["bring_your_planner", "score_your_simulator", "simulate_and_look"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_keeps_what_it_shows_and_is_small(path):
    assert path.stat().st_size < LARGEST_BYTES
    assert len(pages(path)) == 1
    assert str(EXAMPLES.parent) not in path.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(path, tmp_path):
    pytest.importorskip("nbclient", reason="the extra dev is not installed")
    copy = shutil.copy(path, tmp_path / path.name)

    done = subprocess.run(
        [sys.executable, str(RUN), str(copy)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )

    assert done.returncode == 0, done.stderr[-3000:]
    assert len(pages(copy)) == 1
    assert (tmp_path / f"{path.stem}.html").is_file()
