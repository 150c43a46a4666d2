"""The model card says what the weights say of themselves."""

import json
import re

import pytest

from infgen.pretrained import builtin_weights
from infgen.pretrained.card import BEGIN, END, builtin_card, facts, with_facts
from pipeline.storage.weights import load_network


def section(title):
    return builtin_card().split(f"## {title}\n")[1].split("\n## ")[0]


def test_the_facts_of_the_card_are_those_of_the_weights():
    folder = builtin_weights()

    assert with_facts(builtin_card(), facts(folder)) == builtin_card()
    about = json.loads((folder / "model.json").read_text())
    assert f"| parameters | {about['parameters']:,} |" in section("Facts")
    assert f"| steps of the last training | {about['step']:,} |" in section("Facts")
    assert about["weights"].startswith(re.search(r"weights \| `(\w+)`", builtin_card())[1])


def test_the_parameters_are_counted_right():
    network = load_network(builtin_weights())

    count = sum(parameter.numel() for parameter in network.parameters())
    assert f"| parameters | {count:,} |" in facts(builtin_weights())


def test_other_weights_give_other_facts(tmp_path):
    about = json.loads((builtin_weights() / "model.json").read_text())
    (tmp_path / "model.json").write_text(json.dumps(about | {"step": 12_345}))
    (tmp_path / "model.safetensors").write_bytes(bytes(2_500_000))

    table = facts(tmp_path)

    assert "| steps of the last training | 12,345 |" in table
    assert "| size | 2.5 MB |" in table


@pytest.mark.parametrize(
    "title", ["Facts", "Data", "Training", "Scores", "Limits", "Licence"]
)
def test_the_card_has_all_its_sections(title):
    assert section(title).strip()


def test_a_card_without_a_place_for_facts_is_refused():
    with pytest.raises(ValueError, match="the card lacks"):
        with_facts(f"# Card {BEGIN}", "facts")
    assert with_facts(f"a {BEGIN} old {END} b", "new") == f"a {BEGIN}\nnew\n{END} b"
