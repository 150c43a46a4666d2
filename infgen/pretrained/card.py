"""The model card of weights: its table of facts follows from what the weights say.

``python -m infgen.pretrained.card`` writes that table into the card again.
"""

import json
from pathlib import Path
from typing import Any

from infgen.pretrained import builtin_weights

CARD = "MODEL_CARD.md"
BEGIN, END = "<!-- facts -->", "<!-- end of facts -->"


def facts(folder: Path) -> str:
    """Write the table of facts of some weights as Markdown.

    Args:
        folder: With ``model.json`` and ``model.safetensors``.
    """
    about: dict[str, Any] = json.loads((folder / "model.json").read_text())
    model, tokens = about["model"], about["tokenize"]
    megabytes = (folder / "model.safetensors").stat().st_size / 1e6
    blocks = ", ".join(
        f"{model[name]} {name.removesuffix('_blocks')}"
        for name in ("map_blocks", "motion_blocks", "scene_blocks")
    )
    rows = {
        "parameters": f"{about['parameters']:,}",
        "size": f"{megabytes:.1f} MB",
        "width, heads": f"{model['width']}, {model['heads']}",
        "blocks": blocks,
        "inserts and removes agents": _yes(model["insertion_and_removal"]),
        "sees lights change": _yes(model["signals_each_step"]),
        "grid": f"{tokens['grid_radius_m']:g} m around the ego in cells of "
        f"{tokens['grid_cell_m']:g} m",
        "steps of the last training": f"{about['step']:,}",
        "fingerprint of the weights": f"`{about['weights'][:16]}`",
        "fingerprint of the vocabularies": f"`{about['vocabulary'][:16]}`",
        "schema": f"`{about['schema']}`",
    }
    lines = [f"| {name} | {value} |" for name, value in rows.items()]
    return "\n".join(["| | |", "|---|---|", *lines])


def with_facts(card: str, table: str) -> str:
    """Replace the table of facts of a card.

    Raises:
        ValueError: if the card has no place for it.
    """
    before, begin, rest = card.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the card lacks {BEGIN} and {END} around its table of facts")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"


def builtin_card() -> str:
    """Return the card of the weights that come with the package."""
    return (builtin_weights() / CARD).read_text()


def _yes(value: bool) -> str:
    return "yes" if value else "no"


if __name__ == "__main__":
    (builtin_weights() / CARD).write_text(
        with_facts(builtin_card(), facts(builtin_weights()))
    )
