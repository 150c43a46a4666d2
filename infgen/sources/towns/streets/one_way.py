"""One-way streets: those that leave every place reachable from every other."""

import numpy as np
from jaxtyping import Bool, Int64

from infgen.sources.towns.streets.topology import Skeleton


def draw_one_way(
    skeleton: Skeleton,
    street_of: Int64[np.ndarray, " link"],
    minor: Bool[np.ndarray, " link"],
    most: float,
    rng: np.random.Generator,
) -> Int64[np.ndarray, " link"]:
    """Draw directions of one-way streets.

    Args:
        skeleton: Nodes and links.
        street_of: Number of the street that each link is part of.
        minor: Links that may be one-way.
        most: Largest share of the streets that are asked to be one-way.
        rng: Of all that is drawn.

    Returns:
        For each link 0 for both directions, 1 for that from its lower node to the other
        alone, -1 for the other alone.
    """
    one_way = np.zeros(len(skeleton.link), np.int64)
    leads_out = (skeleton.degree[skeleton.link] == 1).any(axis=1)
    share = rng.uniform(0.0, most)
    for street in np.unique(street_of).tolist():
        part = street_of == street
        if rng.random() > share or leads_out[part].any() or not minor[part].all():
            continue
        way = skeleton.xy_m[skeleton.link[:, 1]] - skeleton.xy_m[skeleton.link[:, 0]]
        first = way[part][0] * rng.choice([-1.0, 1.0])
        tried = np.where(part, np.where(way @ first > 0, 1, -1), one_way)
        if goes_on_everywhere(skeleton, tried):
            one_way = tried
    return one_way


def goes_on_everywhere(skeleton: Skeleton, one_way: Int64[np.ndarray, " link"]) -> bool:
    """Whether every node is reached from every other, and no edge ends without a way on.

    No vehicle turns round at a junction; where a street leads out of town it may end.
    """
    ahead = [tuple(pair) for pair in skeleton.link[one_way >= 0].tolist()]
    edges = ahead + [(end, start) for start, end in skeleton.link[one_way <= 0].tolist()]
    follows: dict[int, set[int]] = {node: set() for node in range(len(skeleton.xy_m))}
    precedes: dict[int, set[int]] = {node: set() for node in range(len(skeleton.xy_m))}
    for start, end in edges:
        follows[start].add(end)
        precedes[end].add(start)
    inner = skeleton.degree > 1
    goes_on = all(
        (not inner[end] or follows[end] - {start})
        and (not inner[start] or precedes[start] - {end})
        for start, end in edges
    )
    return goes_on and _reaches_all(follows) and _reaches_all(precedes)


def _reaches_all(onward: dict[int, set[int]]) -> bool:
    reached, waiting = {0}, [0]
    while waiting:
        new = onward[waiting.pop()] - reached
        reached |= new
        waiting += new
    return len(reached) == len(onward)
