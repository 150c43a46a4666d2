"""Towns: synthetic WOMD records that anyone may use, and a few that come with the package.

Traffic is SUMO's. ``skeletons`` (where streets run) -> ``layouts`` (what streets they are)
-> ``plain`` (SUMO's input) -> ``network`` (its net) -> ``demand`` (who sets out) ->
``simulation`` (SUMO plays) -> ``motion`` (bodies) -> ``town`` (all of it) -> ``views`` (who
records) -> ``sight`` (what they see) -> ``scenes`` (``Scene``) -> ``drawing`` (by number).
"""

from infgen.sources.towns.builtin import builtin_records

__all__ = ["builtin_records"]
