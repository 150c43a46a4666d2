"""The map of the code in the documentation is that of the code."""

import re
from collections import Counter
from pathlib import Path

import pytest

from tests.docs.pages import REPOSITORY

ARCHITECTURE = (REPOSITORY / "docs/architecture.md").read_text()
CONTRIBUTING = (REPOSITORY / "CONTRIBUTING.md").read_text()
FILE = re.compile(r"`((?:infgen|pipeline|tests|docs|benchmarks)/[\w/.-]*\.(?:py|yaml|md))`")


def test_every_folder_is_listed_with_its_number_of_modules():
    rows = re.findall(r"^\| `([\w/]+)/` \| (\d+) \|", ARCHITECTURE, re.MULTILINE)
    modules = [
        path.parent.relative_to(REPOSITORY)
        for top in ("infgen", "pipeline")
        for path in (REPOSITORY / top).rglob("*.py")
        if not path.name.startswith("__")
    ]

    assert {Path(name): int(count) for name, count in rows} == Counter(modules)


@pytest.mark.parametrize("page", [ARCHITECTURE, CONTRIBUTING], ids=["map", "contributing"])
def test_every_file_that_is_named_is_there(page):
    named = set(FILE.findall(page))

    assert len(named) > 5
    assert {name for name in named if not (REPOSITORY / name).is_file()} == set()


def test_ten_questions_are_answered_by_a_file_each():
    section = CONTRIBUTING.split("## Ten questions")[1].split("\n## ")[0]

    assert len(FILE.findall(section)) >= 10
