from functools import partial
from pathlib import Path

import pytest

from infgen.errors import ConfigError
from pipeline.engine.plan import PlanError
from pipeline.settings.request import complete_request
from pipeline.settings.stages_file import DEFAULT_FILE


@pytest.fixture
def ask(workshop, monkeypatch):
    monkeypatch.chdir(workshop.folder)

    def build(*overrides, records=(), profile=None, file=None):
        return complete_request(
            workshop.root,
            file=file,
            profile=profile,
            records=records,
            overrides=overrides,
            environ={},
        )

    def run(*overrides, **more):
        request = build(*overrides, **more)
        request.remember(request.plan((), {}))
        return request

    build.run = run
    return build


TEXTS = ["texts/*.txt"]


def test_what_is_not_named_is_as_last_time(ask):
    first = ask.run("total.times=3", records=TEXTS, profile="short")

    assert ask() == first
    assert first.records[0].startswith("/")


def test_words_go_over_those_of_last_time(ask):
    ask.run("total.times=3", records=TEXTS)

    assert ask("climb.steps=2").overrides == ("total.times=3", "climb.steps=2")


@pytest.mark.parametrize("named", [{"records": TEXTS}, {"profile": "short"}])
def test_naming_records_or_a_profile_starts_a_new_request(ask, named):
    ask.run("total.times=3", records=TEXTS, profile="short")

    assert ask(**named).overrides == ()
    assert ask(**named).profile == "short"


def test_asking_alone_is_not_remembered(ask):
    ask.run(records=TEXTS)
    ask("total.times=3")

    assert ask().overrides == ()


def told(root):
    """All that a root remembers, by name of the file."""
    return {path.name: path.read_text() for path in root.refs.iterdir()}


def is_asked(ask, request):
    return ask() == request


def make(request, error, meanwhile=lambda: True):
    """Remember a request while something else goes on, until making it ends in an error."""
    with request.remembered(request.plan((), {})):
        assert meanwhile()
        raise error("not so")


@pytest.mark.parametrize("refused", [ConfigError, PlanError])
def test_what_is_refused_while_it_is_made_is_forgotten_again(ask, workshop, refused):
    ask.run(records=TEXTS)
    before = told(workshop.root)
    for request in (ask("total.times=3"), ask(profile="short")):
        with pytest.raises(refused):
            make(request, refused, partial(is_asked, ask, request))
        assert told(workshop.root) == before


def test_a_first_request_that_is_refused_leaves_no_memory(ask, workshop):
    request = ask(records=TEXTS)
    with pytest.raises(ConfigError):
        make(request, ConfigError)

    assert told(workshop.root) == {}


def test_what_fails_or_is_stopped_is_remembered(ask, workshop):
    request = ask("total.times=3", records=TEXTS)
    with pytest.raises(KeyboardInterrupt):
        make(request, KeyboardInterrupt)

    assert ask() == request


def test_what_another_command_asked_meanwhile_stays(ask, workshop):
    ask.run(records=TEXTS)
    request = ask("total.times=3")
    with pytest.raises(ConfigError):
        make(request, ConfigError, lambda: ask.run("climb.steps=2", records=TEXTS))

    assert ask().overrides == ("climb.steps=2",)


def test_each_profile_remembers_its_own_keys(ask, workshop):
    plain = ask.run(records=TEXTS)
    short = ask.run(profile="short")

    assert short.records == plain.records
    assert short.made()["count"] != plain.made()["count"]


def test_a_profile_with_its_own_sources_does_not_take_those_of_another(ask, workshop):
    text = workshop.file.read_text() + "  own: {sources: texts/a.txt}\n"
    workshop.file.write_text(text)
    ask.run(records=TEXTS)

    own = ask(profile="own")

    assert own.records == ()
    assert len(own.plan((), {})["count"].sources) == 1


def test_a_run_of_one_stage_keeps_the_other_keys(ask):
    request = ask.run(records=TEXTS)
    request.remember(request.plan(("count",), {}))

    assert set(request.made()) == {"count", "total", "climb"}


def test_the_file_is_the_named_one_or_this_folders_or_the_last_or_the_packaged(
    ask, workshop, monkeypatch, tmp_path_factory
):
    ask.run(records=TEXTS)
    assert ask().file == workshop.file
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    assert ask().file == workshop.file
    assert ask(file=DEFAULT_FILE).file == DEFAULT_FILE
    (workshop.root.refs / "last").unlink()
    (workshop.root.refs / "default.json").unlink()
    assert ask().file == DEFAULT_FILE


def test_an_unknown_profile_is_refused(ask):
    with pytest.raises(ConfigError, match="no profile 'shrt'; did you mean 'short'"):
        ask(profile="shrt")


def test_a_damaged_memory_is_as_none(ask, workshop):
    ask.run(records=TEXTS, profile="short")
    Path(workshop.root.refs / "short.json").write_text("{")

    assert ask().profile is None


def test_the_request_in_words(ask):
    words = ask("total.times=3", records=["/t/*"], profile="short").words

    assert words == "--profile short --records /t/* -s total.times=3"
