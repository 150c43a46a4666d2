"""A gymnasium environment: one drives the ego, the network all others (extra ``gym``).

Importing this package registers ``infgen/Drive-v0``; so does the id
``infgen.environment:infgen/Drive-v0``. The network is loaded when an environment is made.
"""

try:
    import gymnasium
except ImportError as error:
    raise ImportError(
        f"the environment needs gymnasium: pip install 'infgen[gym]' ({error})"
    ) from error

ID = "infgen/Drive-v0"

if ID not in gymnasium.registry:
    gymnasium.register(
        ID,
        entry_point="infgen.environment.single:DriveEnv",
        vector_entry_point="infgen.environment.vector:DriveVectorEnv",
    )
