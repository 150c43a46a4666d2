"""Sources of pages: text with gaps, as ``{{name}}``."""

import re
from collections.abc import Mapping

_GAP = re.compile(r"\{\{(\w+)\}\}")


def fill(text: str, parts: Mapping[str, str]) -> str:
    """Fill all gaps at once, so that nothing is filled into what was filled in."""
    return _GAP.sub(lambda gap: parts[gap[1]], text)
