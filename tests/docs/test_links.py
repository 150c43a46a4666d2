"""No link of the documentation is dead."""

import re
import unicodedata
from pathlib import Path

import pytest

from tests.docs.pages import PAGES, REPOSITORY, prose

LINK = re.compile(r"!?\[(?:[^\]\[]|\[[^\]]*\])*\]\(([^)\s]+)(?: \"[^\"]*\")?\)")
HEADING = re.compile(r"^#+ +(.+?) *#*$", re.MULTILINE)
NAMED = re.compile(r"(?:id|name)=\"([^\"]+)\"")


def links():
    for page in PAGES:
        for match in LINK.finditer(prose(page)):
            line = prose(page).count("\n", 0, match.start()) + 1
            yield pytest.param(
                page, match[1], id=f"{page.relative_to(REPOSITORY)}:{line}: {match[1]}"
            )


def slug(heading: str) -> str:
    """The anchor of a heading, as both the site and code hosts write it."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", heading)
    ascii_only = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", ascii_only).strip().lower())


def anchors(page: Path) -> set[str]:
    fenceless = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return {slug(heading) for heading in HEADING.findall(fenceless)} | set(
        NAMED.findall(fenceless)
    )


@pytest.mark.parametrize(("page", "target"), list(links()))
def test_a_link_leads_somewhere(page, target):
    if re.match(r"https?://|mailto:", target):
        assert not target.endswith((".", ","))
        return
    path, _, anchor = target.partition("#")
    place = (page.parent / path).resolve() if path else page

    assert place.exists()
    assert place.is_relative_to(REPOSITORY)
    if page.parent.name == "docs":  # The site holds nothing else.
        assert place.is_relative_to(page.parent)
    if anchor:
        assert anchor in anchors(place)


def test_anchors_are_written_as_the_site_writes_them():
    assert slug("The `WOSAC` metric") == "the-wosac-metric"
    assert slug("Who, where & when?") == "who-where-when"
    assert slug("A [link](x.md) here") == "a-link-here"
