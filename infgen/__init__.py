"""InfGen: long-term traffic simulation, from driving logs to scored rollouts.

::

    import infgen

    sim = infgen.load("towns")
    scene = infgen.open_scenes("builtin", split="validation")[0]
    rollouts = sim.rollout(scene, seconds=30, count=4)

Rooms, in the order data takes through them: ``sources`` (bytes to ``Scene``), ``tokens``
(``Scene`` to ``SceneTokens``), ``model``, ``rollout`` (weights to ``Rollout``), ``metrics``
and ``views``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.api.arrays import rollouts_from_arrays, score
    from pipeline.api.rollouts import SceneRollouts, open_rollouts
    from pipeline.api.scenes import Scenes, open_scenes
    from pipeline.api.scoring import Reference, SceneScores, open_reference
    from pipeline.api.session import PlannerSession
    from pipeline.api.showing import PlayerPage
    from pipeline.api.simulator import TrafficSimulator, load

__version__ = "0.1.0"
__all__ = [
    "PlannerSession",
    "PlayerPage",
    "Reference",
    "SceneRollouts",
    "SceneScores",
    "Scenes",
    "TrafficSimulator",
    "load",
    "open_reference",
    "open_rollouts",
    "open_scenes",
    "rollouts_from_arrays",
    "score",
]

# These are made of both packages: of traffic (infgen) and of files (pipeline). ``infgen``
# imports nothing of ``pipeline``, so that its parts work without. This is the one door, and
# it opens when a name is first used, so that `import infgen` stays fast.
_FACADE = "pipeline.api"


def __getattr__(name: str) -> Any:
    """Fetch a name of the facade (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(_FACADE).MODULES[name]
    found = getattr(import_module(f"{_FACADE}.{module}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
