import re
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files

import pytest

from infgen.views.player import page as player
from infgen.views.player import player_page
from infgen.views.player.payload import unpack

EVIL = "</script><script>alert(1)</script>{{payload}}&\"'"


class Reader(HTMLParser):
    """Collects scripts with their attributes, all other words, and all ids."""

    def __init__(self, text):
        super().__init__()
        self.scripts, self.words, self.ids = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.ids += [value for name, value in attributes if name == "id"]
        if tag == "script":
            self.scripts.append([dict(attributes), ""])

    def handle_data(self, data):
        if self.lasttag == "script" and data.strip():
            self.scripts[-1][1] += data
        else:
            self.words.append(data)


def test_the_page_holds_the_film(view_model, same):
    (packed,) = [
        text
        for about, text in Reader(player_page(view_model)).scripts
        if about.get("id") == "payload"
    ]

    same(view_model, unpack(packed))


def test_ids_from_records_are_data_and_no_markup(view_model, same):
    evil = replace(view_model, scenario_id=EVIL, weights="<b>")
    reader = Reader(player_page(evil))

    assert len(reader.scripts) == len(Reader(player_page(view_model)).scripts) == 3
    assert any(EVIL in words for words in reader.words)
    same(evil, unpack(reader.scripts[1][1]))


def test_the_page_loads_nothing_from_elsewhere(view_model):
    html = player_page(view_model).replace("http://www.w3.org", "")
    about = html.replace(Reader(html).scripts[1][1], "")

    assert not re.findall(r"https?://|@import|url\(|src=", about)
    assert "default-src 'none'" in about


def test_every_gap_is_filled(view_model):
    assert not re.findall(r"\{\{\w+\}\}", player_page(view_model))


def test_every_script_is_joined_after_those_it_imports():
    there = {
        name.name.removesuffix(".js")
        for name in files("infgen.views.player").iterdir()
        if name.name.endswith(".js")
    }
    assert set(player.MODULES) == there
    for at, name in enumerate(player.MODULES):
        script = files("infgen.views.player").joinpath(f"{name}.js").read_text()
        for imported in re.findall(r'from "\./(\w+)\.js"', script):
            assert imported in player.MODULES[:at], f"{name} imports {imported}"


def test_the_joined_scripts_import_and_export_nothing():
    assert not re.findall(r"^(?:import|export)\b", player.joined_scripts(), re.MULTILINE)


def test_every_id_is_given_once(view_model):
    ids = Reader(player_page(view_model)).ids

    assert len(ids) == len(set(ids))


@pytest.mark.parametrize(
    "name", ["page.html", "page.css", *(f"{m}.js" for m in player.MODULES)]
)
def test_a_source_of_the_page_is_short(name):
    lines = files("infgen.views.player").joinpath(name).read_text().splitlines()

    assert len(lines) <= 400
    if name.endswith(".js"):
        assert max(map(len, lines)) <= 100
