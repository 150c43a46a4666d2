import pytest
from hypothesis import given
from hypothesis import strategies as st

from infgen.errors import ConfigError
from pipeline.engine.plan import (
    PlanError,
    StageEntry,
    digest,
    stages_in_order,
    without_locations,
)
from pipeline.engine.stage import Unit


def graph(**deps):
    return {
        name: StageEntry(name, "module", tuple(found), (), f"stages.yaml:{line}")
        for line, (name, found) in enumerate(deps.items(), start=1)
    }


def test_everything_is_planned_on_an_empty_root(workshop):
    plan = workshop.plan()

    assert list(plan.stages) == ["count", "total", "climb"]
    assert all(len(planned.key) == 64 for planned in plan.stages.values())
    assert not workshop.root.store.exists()


def test_a_setting_changes_the_keys_of_its_stage_and_those_after_it(workshop):
    plain, other = workshop.plan(), workshop.plan("total.times=3")

    assert plain["count"].key == other["count"].key
    assert plain["total"].key != other["total"].key
    assert plain["climb"].key != other["climb"].key


def test_a_setting_said_in_other_words_is_the_same_key(workshop):
    keys = {
        workshop.plan(f"total.times={word}")["total"].key for word in ("2", "2.0", "2e0")
    }

    assert keys == {workshop.plan()["total"].key}


def test_keys_depend_on_what_files_hold_and_not_on_where_they_are(workshop, tmp_path):
    before = workshop.plan()["count"].key
    workshop.text("a.txt", "something else")
    changed = workshop.plan()["count"].key
    workshop.text("a.txt", "one two three four")
    again = workshop.plan()["count"].key
    workshop.folder = workshop.folder.rename(tmp_path.with_name(f"{tmp_path.name}-moved"))

    assert before == again == workshop.plan()["count"].key != changed


def test_profiles_change_keys(workshop):
    short = workshop.request(profile="short").plan((), {})

    assert short["count"].values == {"count": {"longest": 3, "sleep_s": 0.0}}
    assert short["count"].key != workshop.plan()["count"].key


def test_unit_keys_leave_out_places_and_nothing_else(workshop):
    planned = workshop.plan()["count"]
    unit = Unit("u", {"file": "abc"}, {"url": "/a/b", "rows": [1, 2]})

    def key(**changes):
        values = {"name": unit.name, "inputs": unit.inputs, "task": unit.task} | changes
        return planned.unit_key(Unit(**values))

    assert key() == key(task={"url": "gs://elsewhere/b", "rows": [1, 2]})
    assert key() != key(task={"url": "/a/b", "rows": [1, 3]})
    assert key() != key(name="v")
    assert key() != key(inputs={"file": "abd"})


def test_only_what_a_target_needs_is_planned_each_after_what_it_reads():
    stages = graph(a=["sources"], b=["a"], c=["a"], d=["c", "b"])

    assert stages_in_order(stages, ["d"]) == ["a", "c", "b", "d"]
    assert stages_in_order(stages, ["b"]) == ["a", "b"]
    assert stages_in_order(stages, ["c", "b"]) == ["a", "c", "b"]


def test_stages_that_need_each_other_are_named():
    with pytest.raises(PlanError, match=r"stages.yaml:1: .*: a -> b -> c -> a"):
        stages_in_order(graph(a=["b"], b=["c"], c=["a"]), ["a"])


def test_a_stage_that_does_not_exist_is_named_with_the_nearest():
    with pytest.raises(PlanError, match="'tokenise', which does not exist; did you mean"):
        stages_in_order(graph(tokenize=[]), ["tokenise"])
    with pytest.raises(PlanError, match=r"stages\.yaml:1 asks for stage 'x'"):
        stages_in_order(graph(a=["x"]), ["a"])


def test_after_gives_all_that_reads_a_stage(workshop):
    assert workshop.plan().after(["total"]) == {"total", "climb"}


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("total.tims=2", "-s total: no setting 'tims'; did you mean 'times'"),
        ("total.times=many", r"-s total\.times is 'many'; expected float"),
        ("count.longest=1.5", r"-s count\.longest is '1.5'; expected int"),
    ],
)
def test_settings_that_cannot_be_are_named(workshop, word, message):
    with pytest.raises(ConfigError, match=message):
        workshop.plan(word)


def test_settings_in_the_file_are_named_with_their_line(workshop):
    workshop.file.write_text(workshop.file.read_text().replace("times: 2", "times: two"))

    with pytest.raises(ConfigError, match=r"stages.yaml:7: total\.times is 'two'"):
        workshop.plan()


def test_a_file_that_disagrees_with_the_code_is_refused(workshop):
    text = workshop.file.read_text()
    workshop.file.write_text(text.replace("params: [total]", "params: [total, count]"))

    with pytest.raises(PlanError, match=r"total lists params \['count', 'total'\]"):
        workshop.plan()


def test_a_module_that_holds_another_stage_is_refused(workshop):
    text = workshop.file.read_text()
    workshop.file.write_text(text.replace("module: toy_total", "module: toy_count"))

    with pytest.raises(PlanError, match="toy_count holds stage 'count'"):
        workshop.plan()


@pytest.mark.parametrize(
    ("module", "message"),
    [("toy_cuont", "there is no module toy_cuont"), ("json", "json ends in no STAGE")],
)
def test_a_module_that_is_no_stage_is_refused(workshop, module, message):
    text = workshop.file.read_text().replace("module: toy_count", f"module: {module}")
    workshop.file.write_text(text)

    with pytest.raises(PlanError, match=rf"stages\.yaml:3: {message}"):
        workshop.plan()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(st.dictionaries(st.text(), json_values, max_size=4))
def test_a_digest_does_not_depend_on_the_order_of_keys(value):
    assert digest(value) == digest(dict(reversed(list(value.items()))))


@given(json_values)
def test_leaving_out_places_twice_is_leaving_them_out_once(value):
    assert without_locations(without_locations(value)) == without_locations(value)
