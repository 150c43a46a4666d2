"""Where a town's streets run: skeletons of nodes and links, drawn by SUMO's netgenerate."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64, Int64

from infgen.sources.towns.sumo import run_program
from infgen.sources.towns.variety import BASIC, Pattern, StreetVariety

_GRIDS = (Pattern.GRID, Pattern.T_JUNCTIONS, Pattern.CURVED_GRID)
_MOST_SEED = 1 << 31


@dataclass(frozen=True, slots=True)
class Skeleton:
    """Nodes, and which are joined by a street.

    Attributes:
        xy_m: Positions of the nodes.
        link: Pairs of nodes, the lower number first, ascending.
    """

    xy_m: Float64[np.ndarray, "node 2"]
    link: Int64[np.ndarray, "link 2"]

    @property
    def degree(self) -> Int64[np.ndarray, " node"]:
        """How many links meet at each node."""
        return np.bincount(self.link.ravel(), minlength=len(self.xy_m))


def draw_skeleton(
    folder: Path,
    rng: np.random.Generator,
    spread: float = 1.0,
    variety: StreetVariety = BASIC.streets,
) -> Skeleton:
    """Draw where streets run; dead ends are cut off, and some streets lead out of town.

    None do of a wide town: who plays a trip of minutes must not come to where streets end.

    Args:
        folder: Where to put netgenerate's files.
        rng: Of all that is drawn.
        spread: How many times as many blocks there are from one rim to the other.
        variety: What patterns and blocks there are.

    Raises:
        SumoError: if netgenerate fails.
    """
    shares = variety.patterns
    pattern = list(shares)[rng.choice(len(shares), p=list(shares.values()))]
    prefix = folder / "skeleton"
    run_program(
        "netgenerate",
        {
            **_options(pattern, spread, variety, rng),
            "seed": int(rng.integers(_MOST_SEED)),
            "plain-output-prefix": prefix,
            "output-file": folder / "skeleton.net.xml",
        },
    )
    drawn = _without_dead_ends(_read(prefix))
    if pattern is Pattern.T_JUNCTIONS:
        drawn = _without_dead_ends(_without_crossings(drawn, rng))
    inner = _stirred(drawn, pattern, rng)
    if pattern is Pattern.CURVED_GRID:
        inner = _warped(inner, rng)
    return inner if spread > 1 else _with_ways_out(inner, rng)


def _options(
    pattern: Pattern, spread: float, variety: StreetVariety, rng: np.random.Generator
) -> dict[str, object]:
    match pattern:
        case _ if pattern in _GRIDS:
            return {
                "grid": True,
                "grid.x-number": round(spread * int(rng.integers(4, 6))),
                "grid.y-number": round(spread * int(rng.integers(4, 6))),
                "grid.x-length": round(float(rng.uniform(*variety.block_m)), 1),
                "grid.y-length": round(float(rng.uniform(*variety.block_m)), 1),
            }
        case Pattern.SPIDER:
            return {
                "spider": True,
                "spider.arm-number": round(spread**0.5 * int(rng.integers(5, 8))),
                "spider.circle-number": round(spread * int(rng.integers(3, 5))),
                "spider.space-radius": round(float(rng.uniform(85.0, 120.0)), 1),
                "spider.omit-center": True,
            }
        case _:
            least_m = round(float(rng.uniform(70.0, 105.0)), 1)
            return {
                "rand": True,
                "rand.iterations": round(spread**1.4 * int(rng.integers(45, 75))),
                "rand.min-distance": least_m,
                "rand.max-distance": round(2.0 * least_m, 1),
                "rand.min-angle": 50,
                "rand.connectivity": 0.95,
                "rand.num-tries": 60,
            }


def _read(prefix: Path) -> Skeleton:
    """Read netgenerate's nodes and edges."""
    nodes = ElementTree.parse(f"{prefix}.nod.xml").getroot().findall("node")
    edges = ElementTree.parse(f"{prefix}.edg.xml").getroot().findall("edge")
    number = {node.attrib["id"]: at for at, node in enumerate(nodes)}
    pairs = {
        tuple(sorted((number[edge.attrib["from"]], number[edge.attrib["to"]])))
        for edge in edges
    }
    xy_m = [[float(node.attrib[axis]) for axis in "xy"] for node in nodes]
    return Skeleton(np.array(xy_m), np.array(sorted(pairs), np.int64))


def _without_dead_ends(skeleton: Skeleton) -> Skeleton:
    """Cut off what ends nowhere, until nothing does, and drop the nodes left alone."""
    link = skeleton.link
    while True:
        degree = np.bincount(link.ravel(), minlength=len(skeleton.xy_m))
        goes_on = (degree[link] > 1).all(axis=1)
        if goes_on.all():
            break
        link = link[goes_on]
    kept, numbered = np.unique(link, return_inverse=True)
    return Skeleton(skeleton.xy_m[kept], numbered.reshape(-1, 2))


def _without_crossings(skeleton: Skeleton, rng: np.random.Generator) -> Skeleton:
    """Take streets away between nodes of four and more, so that most join three.

    A street stays where the town would fall apart without it.
    """
    link = skeleton.link
    for at in rng.permutation(len(link)).tolist():
        street = skeleton.link[at]
        degree = np.bincount(link.ravel(), minlength=len(skeleton.xy_m))
        if (degree[street] > 3).all():
            left = link[(link != street).any(axis=1)]
            if _is_connected(left, len(skeleton.xy_m)):
                link = left
    return Skeleton(skeleton.xy_m, link)


def _is_connected(link: Int64[np.ndarray, "link 2"], num_nodes: int) -> bool:
    """Whether all nodes are reached from the first."""
    reached = np.zeros(num_nodes, bool)
    reached[0] = True
    while True:
        onward = reached[link].any(axis=1)
        if reached[link[onward]].all():
            return bool(reached.all())
        reached[link[onward]] = True


def _warped(skeleton: Skeleton, rng: np.random.Generator) -> Skeleton:
    """Shift nodes by waves across the town, so that straight streets wind."""
    waves_m = rng.uniform(*_WAVES_M, 2)
    phase_rad = rng.uniform(0.0, 2 * np.pi, 2)
    height_m = rng.uniform(*_WAVE_SLOPES, 2) * waves_m / (2 * np.pi)
    across_m = skeleton.xy_m[:, ::-1]
    shift_m = height_m * np.sin(2 * np.pi * across_m / waves_m + phase_rad)
    return Skeleton(skeleton.xy_m + shift_m, skeleton.link)


def _stirred(skeleton: Skeleton, pattern: Pattern, rng: np.random.Generator) -> Skeleton:
    """Move the middle to the origin and every node a little."""
    spread_m = _SHIFTS_M[pattern]
    shift_m = np.clip(rng.normal(0.0, spread_m, skeleton.xy_m.shape), -12.0, 12.0)
    xy_m = skeleton.xy_m + shift_m
    middle_m = (xy_m.max(axis=0) + xy_m.min(axis=0)) / 2
    return Skeleton(xy_m - middle_m, skeleton.link)


_SHIFTS_M = {
    Pattern.GRID: 5.0,
    Pattern.SPIDER: 4.0,
    Pattern.RANDOM: 0.0,
    Pattern.T_JUNCTIONS: 5.0,
    Pattern.CURVED_GRID: 3.0,
}
"""How far nodes are moved at random: standard deviation."""
_WAVES_M, _WAVE_SLOPES = (450.0, 900.0), (0.25, 0.5)
"""Lengths and steepest slopes of the waves of a curved grid."""
WAY_OUT_M = 190.0
"""How far the streets out of town run."""
_CLEAR_RAD = np.deg2rad(65.0)
_SHARE_OUT = 0.75


def _with_ways_out(skeleton: Skeleton, rng: np.random.Generator) -> Skeleton:
    """Let streets lead out from nodes at the rim, where they have room."""
    xy_m, links = list(skeleton.xy_m), skeleton.link.tolist()
    around = _bearings(skeleton)
    ends: list[np.ndarray] = []
    for node in range(len(skeleton.xy_m)):
        if len(around[node]) > 3:
            continue
        way_rad = _widest_gap(around[node], skeleton.xy_m[node])
        if way_rad is None:
            continue
        away = np.array([np.cos(way_rad), np.sin(way_rad)])
        end_m = skeleton.xy_m[node] + WAY_OUT_M * away
        if rng.random() > _SHARE_OUT or not _clear(skeleton, node, end_m, ends):
            continue
        ends += [end_m, (end_m + skeleton.xy_m[node]) / 2]
        links.append([node, len(xy_m)])
        xy_m.append(end_m)
    return Skeleton(np.array(xy_m), np.array(links, np.int64))


def _bearings(skeleton: Skeleton) -> list[Float64[np.ndarray, " _"]]:
    """Directions of the links of every node, ascending."""
    found: list[list[float]] = [[] for _ in skeleton.xy_m]
    for one, other in skeleton.link.tolist():
        x_m, y_m = skeleton.xy_m[other] - skeleton.xy_m[one]
        found[one].append(np.arctan2(y_m, x_m))
        found[other].append(np.arctan2(-y_m, -x_m))
    return [np.sort(np.array(bearings)) for bearings in found]


def _widest_gap(
    bearings_rad: Float64[np.ndarray, " link"], xy_m: Float64[np.ndarray, "2"]
) -> float | None:
    """Direction that halves the widest gap, if it leads outwards and is wide enough."""
    gaps_rad = np.diff(np.append(bearings_rad, bearings_rad[0] + 2 * np.pi))
    widest = int(gaps_rad.argmax())
    way_rad = float(bearings_rad[widest] + gaps_rad[widest] / 2)
    outwards = xy_m @ np.array([np.cos(way_rad), np.sin(way_rad)]) > 0
    return way_rad if outwards and gaps_rad[widest] > 2 * _CLEAR_RAD else None


def _clear(
    skeleton: Skeleton, node: int, end_m: np.ndarray, ends: list[np.ndarray]
) -> bool:
    """Whether a way out keeps away from all other streets and other ways out."""
    way_m = end_m - skeleton.xy_m[node]
    link = skeleton.link[(skeleton.link != node).all(axis=1)]
    start_m, stop_m = np.moveaxis(skeleton.xy_m[link], 1, 0)
    along = np.linspace(0.0, 1.0, 9)[:, None, None]
    streets_m = (start_m + along * (stop_m - start_m)).reshape(-1, 2)
    points = np.concatenate([streets_m, np.array(ends).reshape(-1, 2)])
    part = ((points - skeleton.xy_m[node]) @ way_m / (way_m @ way_m)).clip(0.0, 1.0)
    apart_m = np.linalg.norm(points - skeleton.xy_m[node] - part[:, None] * way_m, axis=1)
    return bool(apart_m.min() > 55.0)
