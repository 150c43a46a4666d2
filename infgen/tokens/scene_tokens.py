"""The tokens of one scene: agents, insertions, map and the interleaved sequence.

The agent matrix has one row per kept agent and one column per half-second token; a token's
pose is the pose at its end. ``Presence`` is the state of each entry of the matrix.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int8, Int16, Int32, UInt8, UInt16

NO_MOTION_TOKEN = -1
"""Motion token of a token step at which the agent is absent or not observed."""
FIRST_MOTION_TOKEN = -2
"""Motion token of the token step at which an agent is inserted (the paper's BOS)."""
EGO = 0
"""Row of the ego among the agents, in batches as in simulation."""
NO_CELL = -1
"""Cell of an absent agent, or of one outside the grid."""


class Presence(IntEnum):
    """State of an agent at a token step."""

    ABSENT = 0
    PRESENT = 1
    INSERTED = 2
    REMOVED = 3


class SignalClass(IntEnum):
    """Signal states merged by what they ask of a driver."""

    STOP = 0
    GO = 1
    CAUTION = 2
    UNKNOWN = 3
    NO_SIGNAL = 4


class TokenType(IntEnum):
    """Token types in the interleaved sequence."""

    MOTION = 0
    KEEP = 1
    REMOVE = 2
    ADD = 3
    POSITION = 4
    HEADING = 5
    AGENT_TYPE = 6
    BEGIN_MOTION = 7


@dataclass(frozen=True, slots=True)
class SceneTokens:
    """One tokenized scene.

    World frame of the scene (its local origin). Token ``now`` ends at the last step of the
    history.

    Attributes:
        scenario_id: Id of the log.
        origin_xyz_m: World position of the local origin.
        now: Token that ends at the last step of the history (1 in WOMD).
        ego: Row of the recording car.
        track_id: Id of each kept agent's track.
        agent_type: ``AgentType``.
        size_lwh_m: One box per agent (mean over its observed steps).
        z_m: Height of the box centre at each token's end; meaningless where absent.
        pose: Quantised x, y, heading at each token's end; zero where absent. An agent that
            is present but not observed keeps the last pose it had.
        motion_token: Row of the motion vocabulary of the agent's type,
            ``FIRST_MOTION_TOKEN`` or ``NO_MOTION_TOKEN``.
        presence: ``Presence``.
        observed: Whether the log shows the agent at both ends of the token; False at
            ``INSERTED`` (SPEC 3.3).
        pattern: Bit i: whether the log shows the agent at step i + 1 of the token, before
            short gaps are filled and at any distance (``tokens.validity_patterns``); 0
            where absent.
        cell: Cell of the ego's grid that holds the agent, or ``NO_CELL``; only where it is
            observed or inserted.
        near: Whether the agent is ever observed within the motion-loss radius of the ego.
        insertion_token: Token step of each insertion, ascending; within a step from near
            to far. An insertion outside the grid has ``insertion_cell`` ``NO_CELL``.
        insertion_agent: Row of the inserted agent.
        insertion_offset_m: Position less the cell's centre, in the ego's grid frame.
        insertion_heading: Heading bin relative to the ego.
        insertion_residual_rad: Heading less the bin's centre.
        map_pose: First point and heading of each map token.
        map_z_m: Height of its first point.
        map_token: Row of the map vocabulary.
        map_point_type: ``tokens.map.PointType``.
        map_polyline_type: ``tokens.map.PolylineType`` of its polyline.
        map_polyline: Index of that polyline; consecutive tokens of one polyline are
            adjacent.
        map_signal: ``SignalClass`` of its lane at ``now``.
        signal_polyline: Polylines (as in ``map_polyline``) that ever have a signal.
        signal_state: ``SignalClass`` of those at each token's end.
        sequence_type: The interleaved sequence: ``TokenType`` ...
        sequence_value: ... its value (motion token, cell, heading bin or agent type; else
            0) ...
        sequence_agent: ... the agent's row (-1 for ``BEGIN_MOTION``) ...
        sequence_step: ... and the token step it belongs to.
        anchor_agent: Row of each agent whose chain of motion tokens restarts from the log:
            after a gap (at the last token not observed), and the ego at its first token.
        anchor_token: Token step of the restart.
        anchor_pose: Logged pose at the end of that token.
    """

    scenario_id: str
    origin_xyz_m: Float64[np.ndarray, "3"]
    now: int
    ego: int
    track_id: Int32[np.ndarray, " agent"]
    agent_type: Int8[np.ndarray, " agent"]
    size_lwh_m: Float32[np.ndarray, "agent 3"]
    z_m: Float32[np.ndarray, "agent token"]
    pose: Float32[np.ndarray, "agent token 3"]
    motion_token: Int16[np.ndarray, "agent token"]
    presence: Int8[np.ndarray, "agent token"]
    observed: Bool[np.ndarray, "agent token"]
    pattern: UInt8[np.ndarray, "agent token"]
    cell: Int16[np.ndarray, "agent token"]
    near: Bool[np.ndarray, " agent"]
    insertion_token: Int16[np.ndarray, " insertion"]
    insertion_agent: Int16[np.ndarray, " insertion"]
    insertion_cell: Int16[np.ndarray, " insertion"]
    insertion_offset_m: Float32[np.ndarray, "insertion 2"]
    insertion_heading: Int16[np.ndarray, " insertion"]
    insertion_residual_rad: Float32[np.ndarray, " insertion"]
    map_pose: Float32[np.ndarray, "map_token 3"]
    map_z_m: Float32[np.ndarray, " map_token"]
    map_token: Int16[np.ndarray, " map_token"]
    map_point_type: Int8[np.ndarray, " map_token"]
    map_polyline_type: Int8[np.ndarray, " map_token"]
    map_polyline: Int32[np.ndarray, " map_token"]
    map_signal: Int8[np.ndarray, " map_token"]
    signal_polyline: Int32[np.ndarray, " signal"]
    signal_state: Int8[np.ndarray, "signal token"]
    sequence_type: UInt8[np.ndarray, " item"]
    sequence_value: Int16[np.ndarray, " item"]
    sequence_agent: Int16[np.ndarray, " item"]
    sequence_step: UInt16[np.ndarray, " item"]
    anchor_agent: Int16[np.ndarray, " anchor"]
    anchor_token: Int16[np.ndarray, " anchor"]
    anchor_pose: Float32[np.ndarray, "anchor 3"]

    @property
    def num_agents(self) -> int:
        """Number of kept agents."""
        return int(self.pose.shape[0])

    @property
    def num_tokens(self) -> int:
        """Number of half-second tokens."""
        return int(self.pose.shape[1])

    @property
    def num_map_tokens(self) -> int:
        """Number of map tokens."""
        return len(self.map_token)
