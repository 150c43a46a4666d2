"""What everything that moves or lies on a map looks like: colours and widths, in one place.

Player, video and strips draw by these. Agents have the paper's colours (ego red, initial
blue, inserted green), chosen so that red-green, green-weak and blue-blind people tell them
apart by lightness too; the ego wears a ring and inserted agents a dot.
"""

from dataclasses import asdict, dataclass
from typing import Any

from infgen.views.scene.drawn_map import RoadLook


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours, as ``#rrggbb``.

    Attributes:
        ground: Where no road is.
        road: Under lanes.
        bike: Under bicycle lanes.
        driveway: Under driveways.
        lane: Middle of a lane.
        white: White paint.
        yellow: Yellow paint.
        crosswalk: Stripes.
        bump: Speed bumps.
        edge: Of a road.
        median: Of a road.
        sign: Stop signs.
        ego: The recording car.
        initial: Agents that are there at now.
        inserted: Agents that come later.
        outline: Around agents, and signs on them.
        stop: Red lights.
        caution: Yellow lights.
        go: Green lights.
        unknown: Lights that show nothing known.
        panel: Behind words and charts.
        ink: Words.
        quiet: Less important words.
        faint: Lines between things.
        accent: Whatever is chosen.
        log: The log in charts.
        s0: First rollout in charts.
        s1: Second.
        s2: Third.
        s3: Fourth.
        s4: Fifth.
    """

    ground: str
    road: str
    bike: str
    driveway: str
    lane: str
    white: str
    yellow: str
    crosswalk: str
    bump: str
    edge: str
    median: str
    sign: str
    ego: str
    initial: str
    inserted: str
    outline: str
    stop: str
    caution: str
    go: str
    unknown: str
    panel: str
    ink: str
    quiet: str
    faint: str
    accent: str
    log: str
    s0: str
    s1: str
    s2: str
    s3: str
    s4: str

    def css(self) -> str:
        """All colours as custom properties of a style sheet."""
        return " ".join(f"--{name}: {colour};" for name, colour in asdict(self).items())


LIGHT = Theme(
    ground="#eceff2",
    road="#d3d8df",
    bike="#c5d8cf",
    driveway="#dfe3e8",
    lane="#c6ccd5",
    white="#ffffff",
    yellow="#e2a71f",
    crosswalk="#f7f9fa",
    bump="#c7a25a",
    edge="#8d97a5",
    median="#a7afbb",
    sign="#b3202c",
    ego="#b01048",
    initial="#1c57c9",
    inserted="#3aa64f",
    outline="#ffffff",
    stop="#b5121f",
    caution="#f0a000",
    go="#10a37a",
    unknown="#8d97a5",
    panel="#ffffff",
    ink="#17202b",
    quiet="#566273",
    faint="#dbe0e7",
    accent="#1c57c9",
    log="#17202b",
    s0="#c06a00",
    s1="#7650cf",
    s2="#078a95",
    s3="#b8407f",
    s4="#617d0e",
)
DARK = Theme(
    ground="#0d1116",
    road="#212933",
    bike="#1d332b",
    driveway="#171d25",
    lane="#2d3743",
    white="#95a0ae",
    yellow="#b98d2d",
    crosswalk="#4d5866",
    bump="#6b5a35",
    edge="#617083",
    median="#4b5766",
    sign="#e05660",
    ego="#fb4f80",
    initial="#b3d6ff",
    inserted="#55df72",
    outline="#0d1116",
    stop="#ff4d5e",
    caution="#ffbe3d",
    go="#6ff0c4",
    unknown="#8791a0",
    panel="#151a21",
    ink="#e9eef4",
    quiet="#9aa6b4",
    faint="#2a323d",
    accent="#7fbfff",
    log="#e9eef4",
    s0="#f2ae49",
    s1="#b59fff",
    s2="#46cfd9",
    s3="#f28fc2",
    s4="#b6d465",
)
THEMES = {"light": LIGHT, "dark": DARK}
NUM_SERIES = 5


@dataclass(frozen=True, slots=True)
class Stroke:
    """One pass over the map: lines of some looks are drawn, or their insides filled.

    Attributes:
        looks: Of the lines.
        colour: Name of a theme's colour.
        width_m: Of the line; 0 to fill its inside.
        least_px: Thinner lines are drawn so wide.
        dash_m: Lengths of dash and gap; empty for a whole line.
        bridges: Whether lanes that only bridge a crossing are drawn as well.
    """

    looks: tuple[RoadLook, ...]
    colour: str
    width_m: float = 0.0
    least_px: float = 0.0
    dash_m: tuple[float, ...] = ()
    bridges: bool = True


_DASH_M = (3.0, 4.5)
_PAINT_M, _DOUBLE_M, _SLIT_M = 0.18, 0.55, 0.2
STROKES = (
    Stroke((RoadLook.DRIVEWAY,), "driveway"),
    Stroke((RoadLook.LANE, RoadLook.FREEWAY), "road", 4.3, 2.0),
    Stroke((RoadLook.BIKE_LANE,), "bike", 1.8, 1.0),
    Stroke((RoadLook.LANE, RoadLook.FREEWAY), "lane", 0.12, 0.8, bridges=False),
    Stroke((RoadLook.CROSSWALK,), "crosswalk"),
    Stroke((RoadLook.SPEED_BUMP,), "bump"),
    Stroke((RoadLook.WHITE_BROKEN,), "white", _PAINT_M, 1.0, _DASH_M),
    Stroke((RoadLook.WHITE_SOLID,), "white", _PAINT_M, 1.0),
    Stroke((RoadLook.WHITE_DOUBLE,), "white", _DOUBLE_M, 2.4),
    Stroke((RoadLook.WHITE_DOUBLE,), "road", _SLIT_M, 0.8),
    Stroke((RoadLook.YELLOW_BROKEN,), "yellow", _PAINT_M, 1.0, _DASH_M),
    Stroke((RoadLook.YELLOW_SOLID,), "yellow", _PAINT_M, 1.0),
    Stroke((RoadLook.YELLOW_DOUBLE,), "yellow", _DOUBLE_M, 2.4),
    Stroke((RoadLook.YELLOW_DOUBLE,), "road", _SLIT_M, 0.8),
    Stroke((RoadLook.MEDIAN,), "median", 0.3, 1.3),
    Stroke((RoadLook.EDGE,), "edge", 0.3, 1.3),
)
"""The map from the bottom up. Stop signs stand on it."""


@dataclass(frozen=True, slots=True)
class AgentStyle:
    """Shapes of agents, as shares of their boxes, and how they come and go.

    Attributes:
        front: Radius of a car's front corners, of its width.
        rear: Radius of its rear corners.
        screen_base: From its front to the lower end of the windscreen, of its length ...
        screen_base_most_m: ... but no more than this.
        screen_tip: The same to its upper end ...
        screen_tip_most_m: ... and its limit.
        screen_base_half: Half the windscreen's width below, of the car's width ...
        screen_tip_half: ... and above.
        beak: How far a pedestrian's nose reaches, of its radius.
        dot: Radius of the dot that inserted agents wear, of their width ...
        dot_back: ... and how far behind a car's middle it is, of its length.
        halo: Radius of the ego's ring, of its length.
        halo_alpha: Opacity within it.
        least_px: Smaller agents are drawn so large.
        outline_px: Width of the outline.
        fade_steps: An agent that leaves begins to fade so many steps before.
        ghost_steps: So many steps after it has left its outline is still seen.
        leaving_alpha: Opacity of whoever leaves in this step.
        arrive_steps: A inserted agent's opacity grows for so long.
        arrive_alpha: Opacity of whoever came in this step.
        ping_steps: A ring grows around an inserted agent for so long.
        trail_steps: Length of a trail.
        trail_bands: Parts of a trail that are drawn alike.
        trail_alpha: Opacity of its newest part.
        trail_m: Its width ...
        trail_px: ... but no less than this.
    """

    front: float = 0.42
    rear: float = 0.16
    screen_base: float = 0.42
    screen_base_most_m: float = 2.3
    screen_tip: float = 0.26
    screen_tip_most_m: float = 1.2
    screen_base_half: float = 0.36
    screen_tip_half: float = 0.29
    beak: float = 1.75
    dot: float = 0.2
    dot_back: float = 0.24
    halo: float = 0.68
    halo_alpha: float = 0.16
    least_px: float = 7.0
    outline_px: float = 1.0
    fade_steps: int = 10
    ghost_steps: int = 7
    leaving_alpha: float = 0.35
    arrive_steps: int = 4
    arrive_alpha: float = 0.25
    ping_steps: int = 9
    trail_steps: int = 30
    trail_bands: int = 6
    trail_alpha: float = 0.5
    trail_m: float = 0.45
    trail_px: float = 1.6


AGENTS = AgentStyle()


@dataclass(frozen=True, slots=True)
class SignalStyle:
    """Shapes of traffic lights, around where the lane's traffic stops.

    Attributes:
        size_m: Radius of a disc ...
        least_px: ... but no less than this.
        bar_half: Half the length of a red bar across the lane, of the size ...
        bar_thick: ... and its thickness.
        diamond: Reach of a yellow diamond.
        ring: Thickness of the ring of an unknown light.
        held_alpha: Opacity once the log is over, and the last state is held.
    """

    size_m: float = 0.9
    least_px: float = 3.0
    bar_half: float = 1.5
    bar_thick: float = 0.8
    diamond: float = 1.3
    ring: float = 0.4
    held_alpha: float = 0.45


LIGHTS = SignalStyle()
SIGN_M, SIGN_LEAST_PX = 0.9, 3.5
"""Radius of a stop sign."""
FIRST_REACH_M = 52.0
"""From the middle of a view to its nearer edge, at first."""


def for_scripts() -> dict[str, Any]:
    """All that scripts need to know, named as scripts name things."""
    return {
        "colours": list(asdict(LIGHT)),
        "series": NUM_SERIES,
        "strokes": [_for_scripts(stroke) for stroke in STROKES],
        "agents": _for_scripts(AGENTS),
        "lights": _for_scripts(LIGHTS),
        "signM": SIGN_M,
        "signLeastPx": SIGN_LEAST_PX,
        "reachM": FIRST_REACH_M,
    }


def _for_scripts(looks: Stroke | AgentStyle | SignalStyle) -> dict[str, Any]:
    return {_camel(name): value for name, value in asdict(looks).items()}


def _camel(name: str) -> str:
    first, *more = name.split("_")
    return first + "".join(word.capitalize() for word in more)
