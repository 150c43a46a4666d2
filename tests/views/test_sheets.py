import pytest

from infgen.views.sheets import Measured, Sheet


@pytest.fixture
def sheet():
    rows = [
        ["one", Measured(0.5, 0.4, 0.7), 3, None],
        ["two", Measured(0.25), None, Measured(None)],
    ]
    return Sheet("few", "A few", ["method", "score", "scenes", "ACE"], rows, "A note.")


def test_people_read_half_of_the_interval_behind_a_number(sheet):
    assert Measured(0.5, 0.4, 0.7).words == "0.5000 ± 0.1500"
    assert Measured(12.3456, 10.0, 14.0).words == "12.35 ± 2.0000"
    assert sheet.for_people().rows == [
        ["one", "0.5000 ± 0.1500", 3, None],
        ["two", "0.2500", None, "not measured"],
    ]


def test_programs_get_the_interval_in_columns_of_its_own(sheet):
    table = sheet.for_programs()

    assert table.columns == [
        "method",
        "score",
        "score, low",
        "score, high",
        "scenes",
        "ACE",
    ]
    assert table.rows == [
        ["one", 0.5, 0.4, 0.7, 3, None],
        ["two", 0.25, None, None, None, None],
    ]


def test_all_forms_have_the_title_and_the_note(sheet):
    for table in (sheet.for_people(), sheet.for_programs()):
        assert (table.title, table.note) == ("A few", "A note.")
