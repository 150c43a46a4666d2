"""The site builds without a warning, loads nothing from elsewhere, lists everything."""

import html
import os
import re
import subprocess
import sys
from dataclasses import fields

import pytest
import typer

import cli
from infgen.scene import Tracks
from pipeline.engine.registry import load_stage
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from tests.docs.pages import REPOSITORY

LOADED = re.compile(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=\"?(https?:|//)[^>]*>")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Pages of the site, by name."""
    pytest.importorskip("material", reason="needs the extra `docs`")
    folder = tmp_path_factory.mktemp("site")
    words = ["build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", *words],
        cwd=REPOSITORY,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return {path.stem: path.read_text() for path in folder.glob("*.html")}


def test_every_page_of_the_folder_is_a_page_of_the_site(site):
    pages = {path.stem for path in REPOSITORY.glob("docs/*.md")}

    assert pages <= site.keys()
    navigation = site["index"]
    for page in pages:
        assert re.search(rf'href="?(\./)?{page}\.html', navigation), page


def test_nothing_is_loaded_from_elsewhere(site):
    for name, page in site.items():
        loaded = [
            match[0] for match in LOADED.finditer(page) if "canonical" not in match[0]
        ]
        assert not loaded, name


def test_every_command_and_each_of_its_options_is_listed(site):
    page = html.unescape(site["commands"])
    group = typer.main.get_command(cli.app)
    with group.make_context("infgen", [], resilient_parsing=True) as context:
        for name in group.list_commands(context):
            assert f"infgen {name}" in page
            for parameter in group.get_command(context, name).params:
                for flag in parameter.opts:
                    assert flag in page or parameter.param_type_name == "argument"


def test_every_setting_of_every_stage_is_listed_with_what_it_means(site):
    page = html.unescape(site["settings"])

    for entry in load_stages(DEFAULT_FILE, {}).stages.values():
        for section, kind in load_stage(entry.module).settings.items():
            assert f'id="{section}"' in page
            for field in fields(kind):
                cells = rf"<code>{field.name}</code></td>\s*<td>.*?</td>\s*<td>(.+?)</td>"
                row = re.search(cells, page)
                assert row, f"{section}.{field.name} is not said to mean anything"


def test_fields_of_files_have_their_types_and_shapes(site):
    page = html.unescape(site["file-formats"])

    for field in fields(Tracks):
        assert f"<code>{field.name}</code>" in page
    assert re.search(
        r"<code>xyz_m</code></td>\s*<td>float32</td>\s*<td>\[agent, step, 3\]", page
    )
    assert "<!-- fields" not in page
