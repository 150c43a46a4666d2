import pytest

from pipeline.engine.atomic import StoreError
from pipeline.engine.code_hash import code_hash, imported_modules
from pipeline.engine.registry import MODULES, load_stage


def test_the_hash_of_code_sees_every_file_of_a_package():
    whole = code_hash(("infgen.tokens",))

    assert whole == code_hash(("infgen.tokens",))
    assert whole != code_hash(("infgen.tokens.vocabulary",))
    assert code_hash(("infgen.clock", "infgen.scene")) == code_hash(
        ("infgen.scene", "infgen.clock")
    )


def test_code_without_a_source_is_refused():
    with pytest.raises(StoreError, match=r"infgen\.nowhere has no source"):
        code_hash(("infgen.nowhere",))
    with pytest.raises(StoreError, match="module nowhere has no source"):
        code_hash(("nowhere",))


def test_what_decides_rollouts_is_found_through_imports():
    found = imported_modules(load_stage("pipeline.stages.rollout").modules)

    assert found.keys() >= {"infgen.geometry", "infgen.rollout.session", "infgen.model"}
    assert "infgen.config" not in found, "settings are in keys by their values"
    assert "infgen.views.player" not in found, "nobody who plays draws"


def test_imports_are_followed_into_functions_and_from_module_to_module(
    tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("pipeline.engine.code_hash.LIBRARY", "made_library")
    library = tmp_path / "made_library"
    library.mkdir()
    (library / "__init__.py").write_text("")
    (library / "far.py").write_text("TWO = 2\n")
    (library / "near.py").write_text("from made_library.far import TWO\n")
    (tmp_path / "made_stage.py").write_text("def work():\n    import made_library.near\n")
    one = imported_modules(("made_stage",))

    assert set(one) == {"made_stage", "made_library", "made_library.near",
                        "made_library.far"}  # fmt: skip


@pytest.mark.parametrize("stage", MODULES)
def test_stages_name_modules_of_the_pipeline_alone(stage):
    named = load_stage(MODULES[stage]).modules

    assert named
    assert all(name.startswith("pipeline.") for name in named)
    assert any(name.startswith("infgen.") for name in imported_modules(named))
