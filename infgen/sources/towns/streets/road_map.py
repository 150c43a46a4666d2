"""A town's streets as a ``RoadMap`` in the town's frame, and parts of such maps."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool

from infgen.scene import (
    FeatureType,
    LaneType,
    LinkType,
    RoadMap,
    Side,
)
from infgen.sources.towns.streets.curves import Points, resample
from infgen.sources.towns.streets.markings import Line, Sign
from infgen.sources.towns.streets.network import Connector, Lane, Network, Use
from infgen.sources.towns.streets.road_edges import RoadEdge
from infgen.sources.towns.streets.street_types import MPS_PER_MPH

SPACING_M = 1.0


@dataclass(frozen=True, slots=True)
class Furniture:
    """All of a town's map but its lanes.

    Attributes:
        lines: Painted lines.
        road_edges: Road edges.
        crosswalks: Outlines.
        driveways: Outlines.
        bumps: Outlines of speed bumps.
        signs: Stop signs.
    """

    lines: Sequence[Line]
    road_edges: Sequence[RoadEdge]
    crosswalks: Sequence[Points]
    driveways: Sequence[Points]
    bumps: Sequence[Points]
    signs: Sequence[Sign]


class _Tables:
    """A map as it is written down: features from id 1 on, and relations between them."""

    def __init__(self) -> None:
        self.ids: dict[str, int] = {}
        self.features: list[tuple[int, int, float]] = []
        self.points_m: list[Points] = []
        self.link: list[tuple[int, int, int]] = []
        self.neighbour: list[tuple[int, ...]] = []
        self.boundary: list[tuple[int, ...]] = []
        self.sign: list[tuple[int, int]] = []

    def add(
        self, kind: FeatureType, xy_m: Points, of: int = 0, limit_mps: float = 0.0
    ) -> int:
        """Add a feature; return its id."""
        self.features.append((kind, of, limit_mps / MPS_PER_MPH))
        self.points_m.append(xy_m)
        return len(self.features)

    def last_point(self, feature: int) -> int:
        """Index of the last point of a feature."""
        return len(self.points_m[feature - 1]) - 1


def draw_map(network: Network, furniture: Furniture) -> tuple[RoadMap, dict[str, int]]:
    """Draw the map in the town's frame; also return the ids of lanes and connectors."""
    tables = _Tables()
    for name, lane in network.lanes.items():
        tables.ids[name] = _add_lane(tables, lane)
    for connector in network.connectors:
        tables.ids[connector.name] = _add_connector(tables, connector, network)
    line_ids = [
        tables.add(FeatureType.ROAD_LINE, resample(line.xy_m, SPACING_M), line.kind)
        for line in furniture.lines
    ]
    for kerb in furniture.road_edges:
        tables.add(FeatureType.ROAD_EDGE, resample(kerb.xy_m, SPACING_M), kerb.kind)
    for outlines, kind in (
        (furniture.crosswalks, FeatureType.CROSSWALK),
        (furniture.driveways, FeatureType.DRIVEWAY),
        (furniture.bumps, FeatureType.SPEED_BUMP),
    ):
        for outline_m in outlines:
            tables.add(kind, outline_m)
    for sign in furniture.signs:
        sign_id = tables.add(FeatureType.STOP_SIGN, sign.xy_m[None])
        tables.sign += [(sign_id, tables.ids[name]) for name in sign.connectors]
    _link(tables, network)
    _set_beside(tables, network, furniture.lines, line_ids)
    return _road_map(tables), tables.ids


def _add_lane(tables: _Tables, lane: Lane) -> int:
    cycled = lane.use is Use.CYCLISTS
    return tables.add(
        FeatureType.LANE,
        resample(lane.xy_m, SPACING_M),
        LaneType.BIKE_LANE if cycled else LaneType.SURFACE_STREET,
        0.0 if cycled else lane.limit_mps,
    )


def _add_connector(tables: _Tables, connector: Connector, network: Network) -> int:
    ends = network.lanes[connector.start], network.lanes[connector.end]
    cycled = any(lane.use is Use.CYCLISTS for lane in ends)
    # Lanes end and ways across begin at the same point, whatever netconvert rounded.
    xy_m = np.concatenate([ends[0].xy_m[-1:], connector.xy_m, ends[1].xy_m[:1]])
    return tables.add(
        FeatureType.LANE,
        resample(xy_m, SPACING_M),
        LaneType.BIKE_LANE if cycled else LaneType.SURFACE_STREET,
        0.0 if cycled else min(lane.limit_mps for lane in ends),
    )


def _link(tables: _Tables, network: Network) -> None:
    """Say which lane follows which."""
    found: dict[tuple[int, int], list[int]] = {}
    for each in network.connectors:
        way = tables.ids[each.name]
        start, end = tables.ids[each.start], tables.ids[each.end]
        for lane, kind, other in (
            (start, LinkType.EXIT, way),
            (way, LinkType.ENTRY, start),
            (way, LinkType.EXIT, end),
            (end, LinkType.ENTRY, way),
        ):
            found.setdefault((lane, kind), []).append(other)
    tables.link = [
        (lane, kind, other)
        for (lane, kind), others in sorted(found.items())
        for other in others
    ]


def _set_beside(
    tables: _Tables, network: Network, lines: Sequence[Line], line_ids: Sequence[int]
) -> None:
    """Say which lanes lie side by side, and which lines they run along."""
    along: dict[tuple[str, Side], tuple[int, int]] = {}
    for line, line_id in zip(lines, line_ids, strict=True):
        named = (line_id, int(line.kind))
        along |= {(name, Side.LEFT): named for name in line.left_of}
        along |= {(name, Side.RIGHT): named for name in line.right_of}
    for edge in network.edges.values():
        row = {lane.name: at for at, lane in enumerate(edge.driven)}
        for lane in edge.driven:
            for side, step in ((Side.LEFT, 1), (Side.RIGHT, -1)):
                at = row[lane.name] + step
                beside = edge.driven[at] if 0 <= at < len(edge.driven) else None
                _add_side(tables, lane, side, beside, along.get((lane.name, side)))
            _add_own_boundaries(tables, lane, along)


def _add_side(
    tables: _Tables,
    lane: Lane,
    side: Side,
    beside: Lane | None,
    line: tuple[int, int] | None,
) -> None:
    own = tables.ids[lane.name]
    last = tables.last_point(own)
    if beside is None or beside.use is not lane.use:
        return
    other = tables.ids[beside.name]
    if line is not None:
        tables.boundary.append((own, side, *line, 0, last, len(tables.neighbour)))
    tables.neighbour.append((own, side, other, 0, last, 0, tables.last_point(other)))


def _add_own_boundaries(
    tables: _Tables, lane: Lane, along: dict[tuple[str, Side], tuple[int, int]]
) -> None:
    """Add what bounds a lane itself: in a record it comes after all its neighbours."""
    own = tables.ids[lane.name]
    for side in (Side.LEFT, Side.RIGHT):
        line = along.get((lane.name, side))
        if line is not None:
            tables.boundary.append((own, side, *line, 0, tables.last_point(own), -1))


def _road_map(tables: _Tables) -> RoadMap:
    count = len(tables.features)
    kinds, types, limits_mph = zip(*tables.features, strict=True)
    points_m = np.concatenate(tables.points_m)
    sizes = [len(each) for each in tables.points_m]
    links = np.array(tables.link, np.int64).reshape(-1, 3)
    beside = np.array(tables.neighbour, np.int64).reshape(-1, 7)
    along = np.array(tables.boundary, np.int64).reshape(-1, 7)
    signs = np.array(tables.sign, np.int64).reshape(-1, 2)
    return RoadMap(
        feature_id=np.arange(1, count + 1, dtype=np.int64),
        feature_type=np.array(kinds, np.int8),
        feature_subtype=np.array(types, np.int8),
        speed_limit_mph=np.round(np.array(limits_mph), 0).astype(np.float32),
        interpolating=np.zeros(count, bool),
        point_offsets=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        xyz_m=np.pad(points_m, ((0, 0), (0, 1))).astype(np.float32),
        link_lane_id=links[:, 0],
        link_type=links[:, 1].astype(np.int8),
        link_other_id=links[:, 2],
        neighbour_lane_id=beside[:, 0],
        neighbour_side=beside[:, 1].astype(np.int8),
        neighbour_other_id=beside[:, 2],
        neighbour_span=beside[:, 3:].astype(np.int32),
        boundary_lane_id=along[:, 0],
        boundary_side=along[:, 1].astype(np.int8),
        boundary_feature_id=along[:, 2],
        boundary_type=along[:, 3].astype(np.int8),
        boundary_span=along[:, 4:6].astype(np.int32),
        boundary_neighbour=along[:, 6].astype(np.int32),
        sign_id=signs[:, 0],
        sign_lane_id=signs[:, 1],
    )


def keep_features(road_map: RoadMap, kept: Bool[np.ndarray, " feature"]) -> RoadMap:
    """Keep some features, and the relations among them."""
    ids = set(road_map.feature_id[kept].tolist())
    there = np.zeros(int(road_map.feature_id.max()) + 1, bool)
    there[road_map.feature_id[kept]] = True
    sizes = np.diff(road_map.point_offsets)
    link = there[road_map.link_lane_id] & there[road_map.link_other_id]
    beside = there[road_map.neighbour_lane_id] & there[road_map.neighbour_other_id]
    along = there[road_map.boundary_lane_id] & there[road_map.boundary_feature_id]
    shared = road_map.boundary_neighbour
    along &= (shared < 0) | beside[shared]
    sign = there[road_map.sign_id] & there[road_map.sign_lane_id]
    rows = {"feature": kept, "link": link, "neighbour": beside, "boundary": along}
    rows |= {"sign": sign, "speed": kept, "interpolating": kept}
    taken = {
        field.name: getattr(road_map, field.name)[rows[field.name.split("_")[0]]]
        for field in fields(road_map)
        if field.name not in ("point_offsets", "xyz_m")
    }
    numbered = np.cumsum(beside) - 1
    shared = taken["boundary_neighbour"]
    taken["boundary_neighbour"] = np.where(shared < 0, -1, numbered[shared]).astype(
        np.int32
    )
    assert len(ids) == kept.sum()
    return RoadMap(
        point_offsets=np.concatenate([[0], np.cumsum(sizes[kept])]).astype(np.int64),
        xyz_m=road_map.xyz_m[np.repeat(kept, sizes)],
        **taken,
    )
