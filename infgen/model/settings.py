"""Settings of the network: sizes, radii, and which parts it has."""

from typing import Literal

from pydantic import model_validator
from pydantic.dataclasses import dataclass

from infgen.settings import RULES, AtLeastOne, Bool, Count, NonNegative, Share

NUM_COORDINATES = 12
"""Numbers that tell the relative pose of a pair with ``relations=rotary``."""
REFINEMENT_GROUPS = 4
"""Groups of the second convolution of ``cell_refinement``."""


@dataclass(frozen=True, slots=True, config=RULES)
class ModelSettings:
    """The network's sizes and radii (SPEC 4; the paper's table 4)."""

    width: AtLeastOne = 128
    """Width of every feature (D)."""
    heads: AtLeastOne = 8
    """Attention heads."""
    map_blocks: Count = 3
    """Blocks of the map encoder."""
    motion_blocks: AtLeastOne = 6
    """Blocks of the motion stack."""
    scene_blocks: Count = 3
    """Blocks of the scene stack."""
    relations: Literal["features", "rotary"] = "features"
    """How attention is told relative poses: by features of every pair of neighbours, as in
    the paper, or by turning the features of both by their headings and times, beside a few
    coordinates of each pair that are not learned."""
    relation_width: Count = 0
    """Width of the features of relative poses, which cost most of all: there are as many
    as pairs of neighbours; 0 for that of all other features, as in the paper."""
    fourier_bands: AtLeastOne = 64
    """Learned frequencies per scalar."""
    dropout: Share = 0.1
    """Dropout of attention weights and feed-forward layers."""
    temporal_window_tokens: AtLeastOne = 12
    """Past token steps that temporal attention sees."""
    map_map_radius_m: NonNegative = 10.0
    """Radius within which map tokens see map tokens."""
    map_agent_radius_m: NonNegative = 30.0
    """Radius within which an agent sees map tokens."""
    agent_agent_radius_m: NonNegative = 60.0
    """Radius within which agents see agents."""
    position_query_radius_m: NonNegative = 75.0
    """Radius of what the query for the position token of an inserted agent sees."""
    heading_query_radius_m: NonNegative = 10.0
    """Radius of what the query for the heading of an inserted agent sees."""
    map_map_neighbours: AtLeastOne = 32
    """Nearest map tokens that a map token sees."""
    map_agent_neighbours: AtLeastOne = 64
    """Nearest map tokens that an agent sees."""
    map_agent_lookahead_m: NonNegative = 0.0
    """These are the nearest to a point so far ahead of the agent, and within the radius of
    that point: what lies behind it, the agent has passed."""
    map_agent_lateral_offset: Bool = False
    """Whether the relation of an agent to a map token includes the lateral offset: from the
    tokens of a lane, how far the agent is off its centre."""
    agent_agent_neighbours: AtLeastOne = 64
    """Nearest agents that an agent sees."""
    position_query_map_neighbours: AtLeastOne = 256
    """Nearest map tokens that a position query sees."""
    heading_query_map_neighbours: AtLeastOne = 32
    """Nearest map tokens that a heading query sees."""
    heading_query_agent_neighbours: AtLeastOne = 16
    """Nearest agents that a heading query sees."""
    max_insertions: Count = 10
    """Insertions per token step that are supervised (L')."""
    insertion_and_removal: Bool = True
    """Whether agents are inserted and removed. Without it the network has motion tokens
    only: SMART (SPEC 7.1). The next three are the ablations of SPEC 7.2."""
    remove_token: Bool = True
    """Whether the network predicts removals."""
    position_token: Bool = True
    """Whether positions of inserted agents are a cell and an offset, not regressed."""
    heading_token: Bool = True
    """Whether headings of inserted agents are bins, not regressed."""
    offset_token: Bool = False
    """Whether the offset of an inserted agent within its cell is one of 144 bins of 0.25 m,
    and its heading is sampled given that. Otherwise the offset is regressed, as in the
    reference: to between a lane and the road edge where both are in one cell of 3 m."""
    validity_pattern_tokens: Bool = False
    """Whether the network predicts at which steps of the next token step a log would show
    the agent: detections flicker."""
    cell_feature_width: Count = 0
    """Width of map features per cell, from which position and heading logits are computed;
    0 to compute them from the query alone, as in the paper."""
    cell_refinement_width: Count = 0
    """Width of a closer look at the cells that position logits are of, up to 9 m around
    each, a multiple of 4; 0 for none. It does not change whether agents are inserted, and
    needs `cell_feature_width` and `position_token`, without which there is none."""
    agent_spacing_width: Count = 0
    """Width of what agents say of the cells, and the offset bins, around them by the gaps
    to their boxes and what these sweep within a second: how far inserted agents keep
    from those there, and from each other; 0 for none. It does not change whether
    agents are inserted, and needs `position_token` for cells and `offset_token` for offset
    bins."""
    placement_features: Bool = False
    """Whether offset bins of inserted agents are judged by how far each is over the nearest
    road edge, and headings by their angles to the lanes there. It needs `offset_token`."""
    motion_feature_width: Count = 0
    """Width of features of where each motion token leads, from which its logit is computed;
    0 for one logit per token, each learned alone, as in the paper."""
    ego_embedding: Bool = False
    """Whether the embedding marks the ego. It drives, where an agent that looks the same
    may be parked."""
    signals_each_step: Bool = False
    """Whether agents see traffic signals as they are at each token step, not as they were
    at the end of the history; in rollouts `rollout.signals` says what they show. In half of
    the training scenes signals after the history are hidden, so that rollouts may go on
    without them."""
    density_features: Bool = False
    """Whether insertion and removal know how many agents are around the ego, beside how
    many there were over the last 3 s and 30 s."""
    standing_features: Bool = False
    """Whether agents know for how long each has stood, and whether it has ever driven: a
    vehicle that waits from one that is parked."""
    ego_features: Bool = False
    """Whether insertion and removal know what the ego did last, and, with
    `standing_features`, for how long it has stood: where it stands, fewer agents enter and
    leave, and others."""
    removal_features: Bool = False
    """Whether removal knows how far an agent is from the ego, in which direction, and
    whether it comes nearer: logs lose sight of agents at the edge of what the ego sees."""
    latent_rates: Bool = False
    """Whether insertions and removals have latent rates, the same for all agents of a
    rollout, that vary in time as no feature tells: numbers of agents in logs vary several
    times as much as those of independent choices."""
    approach_features: Bool = False
    """Whether agents know how others around them move relative to themselves, pair by pair,
    and when and how near they would meet: attention only adds up places and motions."""
    clearance_width: Count = 0
    """Width of what agents make of the clearance of each motion token: the gaps to others
    that it would leave over 2 s if all went on as they move; 0 for none."""
    edge_clearance_width: Count = 0
    """The same for how far each motion token leads over road edges within 1 s."""
    last_move_head: Bool = False
    """Whether logits of motion tokens depend on what each changes of the last move, beside
    where it leads: speeds are held where logs are few, at high ones too."""
    over_edge_head: Bool = False
    """Whether logits of motion tokens that drive depend, for just inserted agents, on how
    far the box is over the nearest road edge, beside where they lead."""
    signal_ahead_m: NonNegative = 0.0
    """Every agent sees the signal of its own lane up to so far ahead, and how long it has
    shown that; 0 to see it only among all other map tokens."""

    @property
    def relation_features(self) -> int:
        """Numbers that tell the relative pose of a pair of neighbours."""
        if self.relations == "rotary":
            return NUM_COORDINATES
        return self.relation_width or self.width

    @model_validator(mode="after")
    def _check(self) -> "ModelSettings":
        if self.width % self.heads:
            raise ValueError(
                f"width is {self.width}; expected a multiple of heads ({self.heads})"
            )
        if self.relations == "rotary":
            self._check_rotary()
        if self.offset_token and not (self.position_token and self.heading_token):
            raise ValueError(
                "offset_token needs position_token and heading_token; set both to true, or "
                "offset_token=false"
            )
        if self.cell_refinement_width % REFINEMENT_GROUPS:
            raise ValueError(
                f"cell_refinement_width is {self.cell_refinement_width}; expected a "
                f"multiple of {REFINEMENT_GROUPS}"
            )
        if self.signal_ahead_m and not self.signals_each_step:
            raise ValueError(
                f"signal_ahead_m is {self.signal_ahead_m:g}, which needs "
                "signals_each_step=true; set that as well, or signal_ahead_m=0"
            )
        return self

    def _check_rotary(self) -> None:
        if self.width % 2:
            raise ValueError(
                f"width is {self.width}; expected an even number with relations=rotary, "
                "which turns features two numbers at a time"
            )
        if self.relation_width or self.map_agent_lateral_offset:
            raise ValueError(
                f"relation_width is {self.relation_width} and map_agent_lateral_offset is "
                f"{self.map_agent_lateral_offset}; expected 0 and False with "
                "relations=rotary, whose coordinates have a width of their own and include "
                "the lateral offset"
            )
