"""The files of the page, by fixed names: nothing else is served."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from importlib.resources import files

from infgen.views.page_source import fill
from infgen.views.scene.style import DARK, LIGHT, for_scripts

PAGE = ""
"""Name of the page itself."""
_OWN = ("drive.js", "dashboard.js", "driven.js", "line.js", "live.js", "wheel.js")
_SHARED = (
    "looks.js",
    "payload.js",
    "pose.js",
    "theme.js",
    "roads.js",
    "lights.js",
    "agents.js",
    "camera.js",
    "pane.js",
    "tooltip.js",
    "gestures.js",
)
"""Scripts of the player that draw here too."""
_SCRIPT, _STYLE, _HTML = (
    f"{kind}; charset=utf-8" for kind in ("text/javascript", "text/css", "text/html")
)


@dataclass(frozen=True, slots=True)
class Asset:
    """A file as it is sent."""

    media_type: str
    data: bytes


def read_assets(weights: str) -> Mapping[str, Asset]:
    """Read all files of the page.

    Args:
        weights: Fingerprint of the weights, to be shown.
    """
    own, shared = files("infgen.views.drive"), files("infgen.views.player")
    colours = {"light": LIGHT.css(), "dark": DARK.css()}
    page = {"looks": json.dumps(for_scripts()), "weights": escape(weights)}
    texts = {
        PAGE: (_HTML, fill(own.joinpath("page.html").read_text("utf-8"), page)),
        "page.css": (_STYLE, fill(shared.joinpath("page.css").read_text("utf-8"), colours)),
        "drive.css": (_STYLE, own.joinpath("drive.css").read_text("utf-8")),
        **{name: (_SCRIPT, own.joinpath(name).read_text("utf-8")) for name in _OWN},
        **{name: (_SCRIPT, shared.joinpath(name).read_text("utf-8")) for name in _SHARED},
    }
    return {name: Asset(kind, text.encode()) for name, (kind, text) in texts.items()}
