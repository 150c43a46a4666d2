import re
from html.parser import HTMLParser

import pytest

from pipeline.drive.assets import PAGE, read_assets

ASSETS = {name: asset.data.decode() for name, asset in read_assets("abc<b>").items()}
SCRIPTS = {name: text for name, text in ASSETS.items() if name.endswith(".js")}
OWN = ("drive.js", "dashboard.js", "driven.js", "line.js", "live.js", "wheel.js")


class Reader(HTMLParser):
    """Collects ids, and what the page refers to."""

    def __init__(self, text):
        super().__init__()
        self.ids, self.names, self.inline = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        about = dict(attributes)
        if "id" in about:
            self.ids.append(about["id"])
        self.names += [about[key] for key in ("src", "href") if key in about]
        self.inline += [key for key in about if key.startswith("on") or key == "style"]


def test_the_page_refers_to_its_own_files_only_and_runs_nothing_inline():
    reader = Reader(ASSETS[PAGE])

    assert {name for name in reader.names if name != "data:,"} <= set(ASSETS)
    assert reader.inline == []
    assert len(reader.ids) == len(set(reader.ids))
    assert "{{" not in ASSETS[PAGE]


def test_what_is_shown_of_weights_is_escaped():
    assert "abc&lt;b&gt;" in ASSETS[PAGE]


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_imports_files_that_are_served(name):
    for imported in re.findall(r'from "\./([\w.]+)"', SCRIPTS[name]):
        assert imported in SCRIPTS


@pytest.mark.parametrize("name", OWN)
def test_a_script_is_short_and_finds_the_elements_it_names(name):
    lines, ids = SCRIPTS[name].splitlines(), Reader(ASSETS[PAGE]).ids

    assert len(lines) <= 400
    assert max(map(len, lines)) <= 100
    for named in re.findall(r"\bpage\.(\w+)\b", SCRIPTS[name]):
        assert named in ids, named


def test_every_key_of_the_page_has_its_line_in_the_help():
    keys = re.findall(r"^    (\w|\"\W\"): \(\) =>", SCRIPTS["drive.js"], re.MULTILINE)
    help_text = ASSETS[PAGE].split("<dialog")[1]

    named = {key.strip('"').upper() for key in keys} - {"=", "-", "H"}
    assert {"P", "R", "N", "C", "M", "F", "T", "I", "X", "+", "?"} == named
    for key in named:
        assert f"<kbd>{key}</kbd>" in help_text, key


def test_no_script_writes_markup():
    for name in OWN:
        assert not re.search(r"innerHTML|outerHTML|insertAdjacent|eval\(", SCRIPTS[name])
