"""The documentation as tests read it: pages, their fenced blocks, and notes to the tests.

A note is a comment in Markdown right above a block:

- ``<!-- not run: why -->``: needs what no test has (Waymo's records, a cluster, hours). Its
  words are still checked against the command line.
- ``<!-- exit code 2 -->``: how its last command leaves, where that is not 0.
- ``<!-- file: name -->``: the block is a file that later commands read.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
PAGES = sorted(
    [
        *REPOSITORY.glob("*.md"),
        *REPOSITORY.glob("docs/*.md"),
    ]
)
RUN = ("bash", "console", "python")
_FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```[ ]*$", re.MULTILINE | re.DOTALL)
_NOTE = re.compile(r"<!-- (not run|exit code|file):? +((?:(?!-->).)+?) -->\s*\Z", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block.

    Attributes:
        page: File it stands in.
        line: Number of its first line.
        language: Word after the fence; empty without one.
        text: What it holds, without the indent of the fence.
        notes: Notes right above it, by kind.
    """

    page: Path
    line: int
    language: str
    text: str
    notes: dict[str, str]

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(REPOSITORY)}:{self.line}"

    @property
    def runs(self) -> bool:
        return self.language in RUN and "not run" not in self.notes

    @property
    def exit_code(self) -> int:
        return int(self.notes.get("exit code", 0))


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page."""
    text = page.read_text()
    return [
        Block(
            page=page,
            line=text.count("\n", 0, match.start()) + 2,
            language=match[2],
            text=re.sub(f"^{match[1]}", "", match[3], flags=re.MULTILINE),
            notes=dict(_notes(text[: match.start()])),
        )
        for match in _FENCE.finditer(text)
    ]


def _notes(before: str) -> Iterator[tuple[str, str]]:
    while found := _NOTE.search(before):
        yield found[1], " ".join(found[2].split())
        before = before[: found.start()]


def prose(page: Path) -> str:
    """A page without fenced blocks, comments and code; its lines stay where they are."""

    def blank(match):
        return "\n" * match[0].count("\n")

    text = _FENCE.sub(blank, page.read_text())
    text = re.sub(r"<!--.*?-->", blank, text, flags=re.DOTALL)
    return re.sub(r"`[^`\n]*`", "``", text)


def commands(block: Block) -> list[tuple[str, list[str]]]:
    """Commands of a console block, each with the lines it is said to print."""
    found: list[tuple[str, list[str]]] = []
    for line in block.text.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        elif found and found[-1][0].endswith("\\"):
            found[-1] = (f"{found[-1][0][:-1]}{line.lstrip('> ')}", [])
        elif line.strip():
            found[-1][1].append(line)
    return found


def lines(block: Block) -> list[str]:
    """Command lines of a block, continued ones joined, comments left out."""
    if block.language == "console":
        return [command for command, _ in commands(block)]
    joined = block.text.replace("\\\n", " ")
    return [line for line in joined.splitlines() if line.strip() and line[0] != "#"]
