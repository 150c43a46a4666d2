import pytest

from pipeline.engine.artefacts import describe, differences, find
from pipeline.engine.plan import PlanError


@pytest.fixture
def two(workshop):
    """Folders of one stage made with two settings."""
    folders = []
    for word in ("total.times=2", "total.times=3"):
        key = workshop.run(word)["total"].key
        folders.append(workshop.root.folder("total", key))
    return folders


def test_a_folder_is_found_by_the_start_of_its_key(workshop, two):
    assert find(workshop.root, two[0].name[:8]) == two[0]
    assert find(workshop.root, two[0].name) == two[0]


def test_a_stage_name_finds_its_latest(workshop, two):
    assert find(workshop.root, "total") == two[1]


@pytest.mark.parametrize("key", ["", "abc", "zzzz"])
def test_an_unknown_or_too_short_key_is_refused(workshop, two, key):
    with pytest.raises(PlanError, match="starts with"):
        find(workshop.root, key)


def test_a_key_with_two_meanings_is_refused(workshop, two):
    twin = two[0].with_name(f"{two[0].name[:6]}0000000000")
    twin.mkdir()
    (twin / "manifest.json").write_text("{}")

    with pytest.raises(PlanError, match="is the start of 2 keys"):
        find(workshop.root, two[0].name[:6])


def test_a_folder_describes_how_it_was_made(two):
    about = describe(two[0])

    assert about["settings"]["total"]["times"] == 2.0
    assert about["run"]["seconds"] >= 0


def test_differences_name_settings_units_and_figures(two):
    found = {what: (one, other) for what, one, other in differences(*two)}

    assert found["settings.total.times"] == (2.0, 3.0)
    assert found["report.total"] == (50.0, 75.0)
    assert "units.a.txt" in found
    assert not any(what.startswith("inputs") for what in found)


def test_a_folder_does_not_differ_from_itself(two):
    assert list(differences(two[0], two[0])) == []
