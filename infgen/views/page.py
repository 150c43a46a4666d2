"""Pages: one HTML file each, readable in light and dark, in print and on a phone.

The templates lie in ``templates/``. Everything that they insert is escaped, but drawings.
"""

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from infgen.views.charts.canvas import Chart
from infgen.views.tables import is_text, words


def render(template: str, **values: Any) -> str:
    """Fill in a template of ``infgen/views/templates``.

    Args:
        template: Its name: ``report.html``.
        values: What it inserts, by name.

    Raises:
        jinja2.UndefinedError: if the template asks for a value that is not given.
    """
    return _templates().get_template(template).render(values)


@cache
def _templates() -> Environment:
    """Everything is escaped, and a name that is not known is an error."""
    templates = Environment(
        autoescape=True,
        loader=PackageLoader("infgen.views"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters["words"] = words
    templates.filters["drawing"] = _drawing
    templates.tests["text"] = is_text
    return templates


def _drawing(chart: Chart | str) -> Markup:
    """Mark a chart, or the SVG of a scene, as markup: both have escaped their words."""
    return Markup(chart if isinstance(chart, str) else chart.to_svg())
