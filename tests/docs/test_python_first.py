"""The first Python a reader copies runs alone, in an empty folder, and ends in a page.

These are the blocks of ``README.md`` that are not marked otherwise, and the first of the
reference.
"""

import subprocess
import sys

import pytest

from tests.docs.pages import REPOSITORY, blocks

PAGES = [REPOSITORY / "README.md", REPOSITORY / "docs/api.md"]
FIRST = [
    block
    for page in PAGES
    for block in blocks(page)
    if block.language == "python" and block.runs
]
MOST_LINES = 8
SHOWN = (".html", ".svg", ".png", ".mp4", ".gif")


@pytest.mark.parametrize("block", FIRST, ids=lambda block: block.name)
def test_the_first_python_is_short(block):
    assert len(block.text.strip().splitlines()) <= MOST_LINES


@pytest.mark.slow
@pytest.mark.parametrize("block", FIRST, ids=lambda block: block.name)
def test_the_first_python_runs_alone_and_ends_in_something_to_look_at(block, tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", block.text],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr[-3000:]
    shown = tmp_path / done.stdout.splitlines()[-1]
    assert shown.suffix in SHOWN
    assert shown.stat().st_size > 0


def test_there_is_such_a_block():
    assert any(block.page.name == "api.md" for block in FIRST)
