"""The player: one page that holds a film and all it takes to watch it.

Nothing is loaded from elsewhere. Scripts and style are files of their own beside this one;
they are joined here. What comes from records enters as data or escaped.
"""

import json
import re
from html import escape
from importlib.resources import files

from infgen.views.page_source import fill
from infgen.views.player.payload import pack
from infgen.views.scene.style import DARK, LIGHT, for_scripts
from infgen.views.scene.view_model import ViewModel

MODULES = (
    "looks",
    "payload",
    "pose",
    "theme",
    "roads",
    "lights",
    "agents",
    "camera",
    "clock",
    "pane",
    "tooltip",
    "chart",
    "gestures",
    "controls",
    "main",
)
"""Scripts, each after those that it imports."""
_IMPORT = re.compile(r'^import (\{[^}]*\}) from "\./(\w+)\.js";$', re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)


def player_page(view_model: ViewModel) -> str:
    """Write the page (HTML) that plays a film."""
    names = ", ".join(showing.name for showing in view_model.showings)
    about = f"Scene {view_model.scenario_id}: {names}."
    if view_model.weights:
        about += f" Weights {view_model.weights}."
    return fill(
        _read("page.html"),
        {
            "title": escape(f"{view_model.scenario_id} - InfGen"),
            "scene": escape(view_model.scenario_id),
            "about": escape(about),
            "style": fill(_read("page.css"), {"light": LIGHT.css(), "dark": DARK.css()}),
            "looks": json.dumps(for_scripts()),
            "payload": pack(view_model),
            "script": joined_scripts(),
        },
    )


def joined_scripts() -> str:
    """Join all scripts to one that imports nothing, each in a scope of its own."""
    return "\n".join(_scoped(name, _read(f"{name}.js")) for name in MODULES)


def _scoped(name: str, script: str) -> str:
    """Make a constant of what a script exports, by a function that is called at once."""
    exports = ", ".join(found[2] for found in _EXPORT.finditer(script))
    body = _EXPORT.sub(r"\1", _IMPORT.sub(r"const \1 = $\2;", script))
    return f"const ${name} = (() => {{\n{body}return {{ {exports} }};\n}})();"


def _read(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
