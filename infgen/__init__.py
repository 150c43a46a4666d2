"""InfGen: long-term traffic simulation, from driving logs to scored rollouts.

Rooms, in the order data takes through them: ``sources`` (bytes to ``Scene``), ``tokens``
(``Scene`` to ``SceneTokens``), ``model``, ``rollout`` (weights to ``Rollout``), ``metrics``
and ``views``.
"""

__version__ = "0.1.0"
