"""Towns: synthetic WOMD records that anyone may use, and a few that come with the package.

layout (``build``) -> strips (``town``) -> traffic (``traffic``) -> what one car sees
(``sight``) -> ``Scene`` (``scenes``) -> records (``records``).
"""

from infgen.sources.towns.recording import builtin_records, write_towns

__all__ = ["builtin_records", "write_towns"]
