"""A layout as SUMO's plain XML, and the net that netconvert makes of it."""

from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from jaxtyping import Float64

from infgen.sources.towns.streets.curves import Points
from infgen.sources.towns.streets.layouts import Control, Layout
from infgen.sources.towns.streets.street_types import CURB_M, Rank, Street
from infgen.sources.towns.sumo import run_program
from infgen.sources.towns.variety import BASIC, StreetVariety

NO_USE = "none"
"""User of strips of the road that are no lanes."""
DRIVERS = "drivers"
"""Users of lanes beside which cyclists have their own."""
EVERYONE = "everyone"
_REFUSED = {NO_USE: "all", DRIVERS: "pedestrian bicycle", EVERYONE: "pedestrian"}
_BEND_POINTS = 9
_RING_LIMIT_MPS = 6.0
_NETCONVERT: dict[str, object] = {
    "offset.disable-normalization": True,
    "no-turnarounds": True,
    "junctions.internal-link-detail": 16,
    "junctions.corner-detail": 8,
    "junctions.limit-turn-speed": 3.0,
    "default.junctions.radius": 6.5,
    "crossings.guess": True,
    "crossings.guess.speed-threshold": 30,
    "walkingareas": True,
    "roundabouts.guess": True,
    "tls.yellow.time": 3,
    "tls.allred.time": 2,
    "tls.left-green.time": 8,
    "precision": 3,
}


def build_net(
    layout: Layout,
    folder: Path,
    rng: np.random.Generator,
    variety: StreetVariety = BASIC.streets,
) -> Path:
    """Write a layout as plain XML and let netconvert make a net of it.

    Raises:
        SumoError: if netconvert fails.
    """
    nodes, edges = Element("nodes"), Element("edges")
    for node in range(len(layout.control)):
        _write_node(layout, node, nodes, edges)
    for link in range(len(layout.street)):
        _write_link(layout, link, edges)
    net = folder / "town.net.xml"
    paths = {"node-files": folder / "town.nod.xml", "edge-files": folder / "town.edg.xml"}
    for path, root in zip(paths.values(), (nodes, edges), strict=True):
        ElementTree.ElementTree(root).write(path)
    timing = {
        "tls.cycle.time": int(rng.integers(50, 90)),
        "tls.default-type": "static",
        "junctions.limit-turn-speed.min-angle": variety.free_bend_deg,
    }
    run_program("netconvert", {**_NETCONVERT, **timing, **paths, "output-file": net})
    return net


def _write_node(layout: Layout, node: int, nodes: Element, edges: Element) -> None:
    """Write a node, or the ring of its roundabout."""
    control = layout.control[node]
    if control is not Control.ROUNDABOUT:
        x_m, y_m = layout.skeleton.xy_m[node]
        _add_node(nodes, f"n{node}", (x_m, y_m), control.value)
        return
    arms = _arms(layout, node)
    names = [name for _, name in arms]
    for bearing_rad, name in arms:
        x_m, y_m = layout.skeleton.xy_m[node] + layout.ring_m[node] * _unit(bearing_rad)
        _add_node(nodes, name, (x_m, y_m), "priority")
    for at, (start_rad, name) in enumerate(arms):
        end_rad, following = arms[(at + 1) % len(arms)]
        turn_rad = (end_rad - start_rad) % (2 * np.pi)
        bearings_rad = start_rad + turn_rad * np.linspace(0.0, 1.0, 12)
        shape_m = layout.skeleton.xy_m[node] + layout.ring_m[node] * _unit(bearings_rad)
        edge = _add_edge(edges, f"{name}r", (name, following), shape_m, 10, _RING_LIMIT_MPS)
        edge.set("spreadType", "center")
        _add_lanes(edge, [("pedestrian", 2.0), (NO_USE, 1.0), (EVERYONE, 4.4)])
    ring = SubElement(edges, "roundabout")
    ring.set("nodes", " ".join(names))
    ring.set("edges", " ".join(f"{name}r" for name in names))


def _arms(layout: Layout, node: int) -> list[tuple[float, str]]:
    """Directions of a roundabout's arms, counter-clockwise, and the names of its nodes."""
    found = []
    for link in np.flatnonzero((layout.skeleton.link == node).any(axis=1)).tolist():
        one, other = layout.skeleton.link[link].tolist()
        away_m = layout.skeleton.xy_m[other if node == one else one]
        x_m, y_m = away_m - layout.skeleton.xy_m[node]
        found.append((float(np.arctan2(y_m, x_m)), f"n{node}x{link}"))
    return sorted(found)


def _write_link(layout: Layout, link: int, edges: Element) -> None:
    """Write both directions of a link, or the only one."""
    one, other = layout.skeleton.link[link].tolist()
    names = [
        f"n{node}x{link}" if layout.ring_m[node] else f"n{node}" for node in (one, other)
    ]
    shape_m = link_shape(layout, link)
    street = layout.street[link]
    for name, ends, points_m, only in (
        (f"e{link}f", names, shape_m, 1),
        (f"e{link}b", names[::-1], shape_m[::-1], -1),
    ):
        if layout.one_way[link] not in (0, only):
            continue
        edge = _add_edge(
            edges, name, (ends[0], ends[1]), points_m, street.rank, street.limit_mps
        )
        _add_lanes(edge, _lanes(street))


def link_shape(layout: Layout, link: int) -> Points:
    """Draw the middle of a link, from its lower node to the other."""
    nodes = layout.skeleton.link[link]
    start_m, end_m = layout.skeleton.xy_m[nodes]
    along_m = end_m - start_m
    way = along_m / np.linalg.norm(along_m)
    start_m = start_m + layout.ring_m[nodes[0]] * way
    end_m = end_m - layout.ring_m[nodes[1]] * way
    if not layout.bend[link]:
        return np.array([start_m, end_m])
    part = np.linspace(0.0, 1.0, _BEND_POINTS)[:, None]
    left = np.array([-along_m[1], along_m[0]])
    return (
        start_m
        + part * (end_m - start_m)
        + 4 * part * (1 - part) * (layout.bend[link] * left)
    )


def _lanes(street: Street) -> list[tuple[str, float]]:
    """Who may use the lanes of one direction, from the right, and their widths."""
    drivers = DRIVERS if street.bike_m else EVERYONE
    lanes = [("pedestrian", street.pavement_m)]
    lanes.append((NO_USE, street.parking_m or CURB_M))
    if street.bike_m:
        lanes.append(("bicycle", street.bike_m))
    lanes += [(drivers, street.lane_m)] * street.num_lanes
    if street.median_m:
        lanes.append((NO_USE, street.median_m))
    return lanes


def _add_node(nodes: Element, name: str, xy_m: tuple[float, float], control: str) -> None:
    node = SubElement(nodes, "node", {"id": name, "type": control})
    node.set("x", f"{xy_m[0]:.3f}")
    node.set("y", f"{xy_m[1]:.3f}")


def _add_edge(
    edges: Element,
    name: str,
    ends: tuple[str, str],
    shape_m: Float64[np.ndarray, "point 2"],
    priority: int | Rank,
    limit_mps: float,
) -> Element:
    edge = SubElement(edges, "edge", {"id": name, "from": ends[0], "to": ends[1]})
    edge.set("priority", str(int(priority)))
    edge.set("speed", f"{limit_mps:.2f}")
    edge.set("shape", " ".join(f"{x_m:.3f},{y_m:.3f}" for x_m, y_m in shape_m))
    return edge


def _add_lanes(edge: Element, lanes: list[tuple[str, float]]) -> None:
    edge.set("numLanes", str(len(lanes)))
    for at, (users, width_m) in enumerate(lanes):
        lane = SubElement(edge, "lane", {"index": str(at), "width": f"{width_m:.2f}"})
        if users in _REFUSED:
            lane.set("disallow", _REFUSED[users])
        else:
            lane.set("allow", users)


def _unit(bearing_rad: float | np.ndarray) -> np.ndarray:
    return np.stack([np.cos(bearing_rad), np.sin(bearing_rad)], axis=-1)
