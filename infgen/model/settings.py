"""Settings of the network."""

import math
from dataclasses import dataclass, fields

from infgen.coerce import ConfigError, check_numbers


@dataclass(frozen=True, slots=True)
class ModelSettings:
    """The network's sizes and reach (SPEC 4; the paper's table 4).

    Attributes:
        width: Width of every feature (D).
        heads: Attention heads.
        map_blocks: Blocks of the map encoder.
        motion_blocks: Blocks of the motion stack.
        scene_blocks: Blocks of the scene stack.
        fourier_bands: Learned frequencies per scalar.
        dropout: Of attention weights and feed-forward layers.
        temporal_window_tokens: Past tokens that temporal attention sees.
        map_map_radius_m: Reach of map tokens among themselves.
        map_agent_radius_m: Reach of an agent to the map.
        agent_agent_radius_m: Reach of agents among themselves.
        position_query_radius_m: Reach of the query for a newcomer's cell.
        heading_query_radius_m: Reach of the query for a newcomer's heading.
        map_map_neighbours: Nearest map tokens that a map token sees.
        map_agent_neighbours: Nearest map tokens that an agent sees.
        map_agent_lookahead_m: They are those nearest to (and within the radius of) a point
            so far ahead of the agent: what lies behind, it has passed.
        map_agent_lateral_offset: Whether an agent is also told how far to the side of each
            of them it is: of a lane's tokens, how far off the lane's centre it drives.
        agent_agent_neighbours: Nearest agents that an agent sees.
        position_query_map_neighbours: Nearest map tokens that a query for a cell sees.
        heading_query_map_neighbours: Nearest map tokens that a query for a heading sees.
        heading_query_agent_neighbours: Nearest agents that a query for a heading sees.
        max_insertions: Newcomers per half second that are supervised (L').
        insertion_and_removal: Whether agents enter and leave. Without it nothing is left
            but motion: SMART (SPEC 7.1). The next three switches are the ablations of SPEC
            7.2.
        remove_token: Whether the network says who leaves.
        position_token: Whether newcomers are placed by cell and offset, not by regression.
        heading_token: Whether newcomers' headings are bins, not regressed.
        validity_pattern_tokens: Whether the network says at which steps of the next half
            second a log would show the agent: detections flicker.
        cell_feature_width: Features of every cell by which newcomers' cells and headings
            are told from the street that is there; 0 to tell them from the query alone, as
            the paper does.
        motion_feature_width: Features of every move by which the next one is told from
            where it leads; 0 for a logit per move, each learned alone, as in the paper.
        ego_embedding: Whether the ego's embedding says that it is the ego: whoever records
            is under way, where one that looks the same may be parked.
        signals_each_step: Whether agents see traffic lights as they are in each half
            second, not as they were at the end of the history; in rollouts,
            ``rollout.lights`` says what they show. In half of the scenes of a training
            nobody looks at them after the history, so that rollouts may go on without.
        signal_ahead_m: So far ahead every agent is told by itself what the traffic light of
            its lane shows, and for how long it has; 0 for only among all other road tokens.
    """

    width: int = 128
    heads: int = 8
    map_blocks: int = 3
    motion_blocks: int = 6
    scene_blocks: int = 3
    fourier_bands: int = 64
    dropout: float = 0.1
    temporal_window_tokens: int = 12
    map_map_radius_m: float = 10.0
    map_agent_radius_m: float = 30.0
    agent_agent_radius_m: float = 60.0
    position_query_radius_m: float = 75.0
    heading_query_radius_m: float = 10.0
    map_map_neighbours: int = 32
    map_agent_neighbours: int = 64
    map_agent_lookahead_m: float = 0.0
    map_agent_lateral_offset: bool = False
    agent_agent_neighbours: int = 64
    position_query_map_neighbours: int = 256
    heading_query_map_neighbours: int = 32
    heading_query_agent_neighbours: int = 16
    max_insertions: int = 10
    insertion_and_removal: bool = True
    remove_token: bool = True
    position_token: bool = True
    heading_token: bool = True
    validity_pattern_tokens: bool = False
    cell_feature_width: int = 0
    motion_feature_width: int = 0
    ego_embedding: bool = False
    signals_each_step: bool = False
    signal_ahead_m: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no network can be made of.

        Raises:
            ConfigError: naming the setting, its value and what is expected.
        """
        one_or_more = (
            "width",
            "heads",
            "motion_blocks",
            "fourier_bands",
            "temporal_window_tokens",
        )
        bounds = {
            **dict.fromkeys(one_or_more, (1, math.inf)),
            **{f.name: (1, math.inf) for f in fields(self) if "_neighbours" in f.name},
            "dropout": (0, 1),
        }
        check_numbers(self, "model", bounds)
        if self.width % self.heads:
            raise ConfigError(
                f"model.width is {self.width}; expected a multiple of model.heads "
                f"({self.heads})"
            )
        if self.signal_ahead_m and not self.signals_each_step:
            raise ConfigError(
                f"model.signal_ahead_m is {self.signal_ahead_m:g}, which needs "
                "model.signals_each_step=true; set that as well, or model.signal_ahead_m=0"
            )
