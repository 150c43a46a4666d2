"""Every command of the documentation works as it stands, or says why no test can run it."""

import re
import shlex
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import typer

import cli
from pipeline.engine.registry import MODULES
from pipeline.settings.stages_file import DEFAULT_FILE, load_stages
from tests.docs.pages import PAGES, REPOSITORY, RUN, blocks, lines

ALL = [block for page in PAGES for block in blocks(page)]
SHOWN = ("", "text", "yaml", "json", "toml", "latex", "bibtex", "crontab", "html")
COMMAND = re.compile(
    r"^\s*(?:\S*/)?(infgen|python3?|make|torchrun|pip|dask) ", re.MULTILINE
)
ENDS = {"|", ">", ">>", "&&", ";", "&", "2>", "2>&1"}
LEAST_REASON = 12
RUN_LIKE = {"run", "plan", "status", *MODULES}


def pages_that_run():
    return [page for page in PAGES if any(block.runs for block in blocks(page))]


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", pages_that_run(), ids=lambda page: str(page.relative_to(REPOSITORY))
)
def test_a_page_works_as_it_stands(page, desk):
    for block in blocks(page):
        if "file" in block.notes:
            (desk.folder / block.notes["file"]).write_text(block.text)
        elif block.runs:
            desk.run(block)


@pytest.mark.parametrize("block", ALL, ids=lambda block: block.name)
def test_a_block_says_what_it_is_and_why_it_is_not_run(block):
    assert block.language in (*RUN, *SHOWN)
    if block.language in SHOWN and "file" not in block.notes:
        named = block.language == "crontab"
        assert named or not COMMAND.search(block.text), "commands belong in ```bash"
    reason = block.notes.get("not run")
    assert reason is None or len(reason) >= LEAST_REASON


def words_after(program: str, line: str) -> list[str] | None:
    """Words of a program's call in a line of shell; None if it is not called."""
    called = re.search(rf"(?:^|[\s/]){program}(?=\s|$)(.*)", line)
    if called is None or "pip install" in line:
        return None
    found = []
    whole = called[1].count("'") % 2 == 0  # Or the line is a part of something quoted.
    text = called[1] if whole else called[1].replace("'", "")
    for word in shlex.split(text, comments=True):
        if word in ENDS:
            break
        found.append(word)
    return found


NOT_RUN = [
    pytest.param(line, id=f"{block.name}: {line.strip()[:40]}")
    for block in ALL
    if block.language in ("bash", "console", "crontab") and not block.runs
    for line in lines(block)
]


@pytest.mark.parametrize("line", NOT_RUN)
def test_a_command_that_is_not_run_has_words_that_exist(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = words_after("infgen", line)
    if words:
        check_infgen(words)
    for target in words_after("make", line) or ():
        assert re.search(
            rf"^{target}:", (REPOSITORY / "Makefile").read_text(), re.MULTILINE
        )
    script = next(iter(words_after("python", line) or ()), "")
    assert not script.endswith(".py") or (REPOSITORY / script).is_file()


def check_infgen(words: list[str]) -> None:
    """Parse a call without making it; settings and profiles must be there too."""
    command = typer.main.get_command(cli.app)
    with command.make_context("infgen", [], resilient_parsing=True) as context:
        _, verb, rest = command.resolve_command(context, words)
        parsed = verb.make_context(words[0], rest, parent=context).params
    if words[0] in RUN_LIKE:
        chosen = [word for word in parsed["set"] or () if not re.search("=[A-Z]+$", word)]
        profile = ["--profile", parsed["profile"]] if parsed["profile"] else []
        settings = [part for word in chosen for part in ("-s", word)]
        with TemporaryDirectory() as root:
            plan = ["plan", "--root", root, "--records", "builtin"]
            assert exit_code([*plan, *profile, *settings]) == 0
    if parsed.get("preset"):
        load_stages(DEFAULT_FILE, {}).preset(parsed["preset"])
    for stage in parsed.get("stages") or ():
        assert stage in load_stages(DEFAULT_FILE, {}).stages


def exit_code(words: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        cli.main(words)
    return left.value.code or 0


def test_a_command_that_does_not_exist_would_be_found():
    with pytest.raises(Exception, match="No such option: --profil"):
        check_infgen(["run", "--profil", "small"])
    with pytest.raises(AssertionError):
        check_infgen(["run", "-s", "train.stps=3"])
    with pytest.raises(AssertionError):
        check_infgen(["run", "reprt"])


@pytest.mark.slow
def test_the_readers_folder_has_the_profiles_of_the_package(desk):
    ours = load_stages(desk.folder / "stages.yaml", {})

    assert set(ours.profiles) == set(load_stages(DEFAULT_FILE, {}).profiles)
    assert Path(desk.folder / "work/report/report.html").is_file()
