"""Small scenes that every room's tests are built on. Each fixture is a function to call."""

import os
import random
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from hypothesis import settings

from infgen.scene import (
    AgentType,
    FeatureType,
    LaneType,
    RoadEdgeType,
    RoadMap,
    Scene,
    Signals,
    SignalState,
    Tracks,
)
from infgen.tokens.vocabulary import BOX_LW_M, MapVocabulary, MotionVocabulary

settings.register_profile("infgen", deadline=None)
settings.load_profile("infgen")  # How long an example takes is a matter of the machine.

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def pytest_configure() -> None:
    """Give this process, and those that tests start, one thread each.

    Results of training depend on the number of threads; two test processes share the cores.
    """
    os.environ.update(dict.fromkeys(THREADS, "1"))
    torch.set_num_threads(1)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add what CI asks for: all slow tests take an hour there."""
    parser.addoption(
        "--slow-share",
        type=float,
        help="run one case each of this share of the slow tests; tests and cases are drawn "
        "by the seed of the order of tests",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect all but one case each of a share of the slow tests, with that option."""
    share = config.getoption("slow_share")
    if share is None:
        return
    cases: dict[str, list[str]] = {}
    slow = [item.nodeid for item in items if item.get_closest_marker("slow")]
    for case in slow:
        cases.setdefault(case.partition("[")[0], []).append(case)
    # Every process that tests draws the same ones.
    draw = random.Random(config.getoption("randomly_seed", 0))
    tests = draw.sample(sorted(cases), round(share * len(cases)))
    drawn = {draw.choice(sorted(cases[test])) for test in tests}
    deselected = set(slow) - drawn
    config.hook.pytest_deselected(items=[i for i in items if i.nodeid in deselected])
    items[:] = [item for item in items if item.nodeid not in deselected]


@pytest.fixture(autouse=True)
def _same_threads_after_each_test():
    """Undo what a test, or a command it runs in this process, does to threads."""
    before = {name: os.environ.get(name) for name in THREADS}, torch.get_num_threads()
    yield
    environment, threads = before
    os.environ.update({name: value for name, value in environment.items() if value})
    torch.set_num_threads(threads)


STEP_S = 0.1
BOX_LWH_M = {
    AgentType.VEHICLE: (4.8, 2.0, 1.6),
    AgentType.PEDESTRIAN: (1.0, 1.0, 1.7),
    AgentType.CYCLIST: (2.0, 1.0, 1.7),
    AgentType.OTHER: (1.0, 1.0, 1.0),
}
LANE_ID, EDGE_ID, CROSSWALK_ID = 1, 2, 3


def straight_path(start_xy_m, heading_rad, speed_mps, steps):
    """Poses [step, 3] of constant speed along a straight line."""
    along_m = speed_mps * STEP_S * np.arange(steps)
    return np.column_stack(
        [
            start_xy_m[0] + along_m * np.cos(heading_rad),
            start_xy_m[1] + along_m * np.sin(heading_rad),
            np.full(steps, heading_rad),
        ]
    )


def make_tracks(path, kind, valid=None) -> Tracks:
    """Tracks from poses [agent, step, 3]; what is not valid is zero, as in most records."""
    path = np.asarray(path, dtype=np.float64)
    agents, steps = path.shape[:2]
    valid = np.ones((agents, steps), bool) if valid is None else np.asarray(valid, bool)
    velocity = (
        np.gradient(path[..., :2], STEP_S, axis=1) if steps > 1 else 0 * path[..., :2]
    )
    size = np.array([BOX_LWH_M[AgentType(k)] for k in kind]).reshape(agents, 1, 3)
    xyz = np.concatenate(
        [path[..., :2], np.broadcast_to(size[..., 2:] / 2, (agents, steps, 1))], -1
    )

    def shown(values):
        mask = valid.reshape(valid.shape + (1,) * (values.ndim - 2))
        return np.where(mask, values, 0).astype(np.float32)

    return Tracks(
        id=np.arange(100, 100 + agents, dtype=np.int32),
        agent_type=np.asarray(kind, dtype=np.int8),
        xyz_m=shown(xyz),
        heading_rad=shown((path[..., 2] + np.pi) % (2 * np.pi) - np.pi),
        velocity_mps=shown(velocity),
        size_lwh_m=shown(np.broadcast_to(size, (agents, steps, 3))),
        valid=valid,
    )


def make_map(lines: Sequence[tuple[int, FeatureType, int, np.ndarray]]) -> RoadMap:
    """A map of features (id, kind, type, points [length, 2 or 3]) without relations."""
    points = [
        np.pad(np.asarray(p, float), ((0, 0), (0, 3 - np.shape(p)[1]))) for *_, p in lines
    ]
    none_i8, none_i64 = np.empty(0, np.int8), np.empty(0, np.int64)
    return RoadMap(
        feature_id=np.array([line[0] for line in lines], dtype=np.int64),
        feature_type=np.array([line[1] for line in lines], dtype=np.int8),
        feature_subtype=np.array([line[2] for line in lines], dtype=np.int8),
        speed_limit_mph=np.zeros(len(lines), dtype=np.float32),
        interpolating=np.zeros(len(lines), dtype=bool),
        point_offsets=np.cumsum([0, *map(len, points)]).astype(np.int64),
        xyz_m=np.concatenate([np.empty((0, 3)), *points]).astype(np.float32),
        link_lane_id=none_i64,
        link_type=none_i8,
        link_other_id=none_i64,
        neighbour_lane_id=none_i64,
        neighbour_side=none_i8,
        neighbour_other_id=none_i64,
        neighbour_span=np.empty((0, 4), np.int32),
        boundary_lane_id=none_i64,
        boundary_side=none_i8,
        boundary_feature_id=none_i64,
        boundary_type=none_i8,
        boundary_span=np.empty((0, 2), np.int32),
        boundary_neighbour=np.empty(0, np.int32),
        sign_id=none_i64,
        sign_lane_id=none_i64,
    )


def straight_road(length_m: float = 200.0) -> RoadMap:
    """A lane along +x from behind the origin, its edge 3 m to the right, a crosswalk."""
    x = np.arange(-length_m / 2, length_m / 2 + 1.0)
    zebra = [(20.0, -4.0), (24.0, -4.0), (24.0, 8.0), (20.0, 8.0)]
    return make_map(
        [
            (
                LANE_ID,
                FeatureType.LANE,
                LaneType.SURFACE_STREET,
                np.column_stack([x, 0 * x]),
            ),
            (
                EDGE_ID,
                FeatureType.ROAD_EDGE,
                RoadEdgeType.BOUNDARY,
                np.column_stack([x, 0 * x - 3]),
            ),
            (CROSSWALK_ID, FeatureType.CROSSWALK, 0, np.array(zebra)),
        ]
    )


def make_signals(states: Sequence[tuple[int, int, SignalState]] = ()) -> Signals:
    """Lights as rows of (step, lane id, state)."""
    return Signals(
        step=np.array([row[0] for row in states], dtype=np.int16),
        lane_id=np.array([row[1] for row in states], dtype=np.int64),
        state=np.array([row[2] for row in states], dtype=np.int8),
        stop_xyz_m=np.zeros((len(states), 3), dtype=np.float32),
    )


def make_scene(
    path, kind, valid=None, *, ego=0, now=10, road_map=None, signals=None
) -> Scene:
    """A scene from poses [agent, step, 3], kinds [agent] and validity [agent, step]."""
    tracks = make_tracks(path, kind, valid)
    return Scene(
        scenario_id="made-by-hand",
        origin_xyz_m=np.array([1000.0, -2000.0, 10.0]),
        timestamps_s=STEP_S * np.arange(tracks.num_steps),
        now=now,
        ego=ego,
        predict_row=np.array([ego], dtype=np.int32),
        predict_difficulty=np.zeros(1, dtype=np.int8),
        interest_id=np.empty(0, dtype=np.int32),
        tracks=tracks,
        road_map=straight_road() if road_map is None else road_map,
        signals=make_signals() if signals is None else signals,
    )


@pytest.fixture(scope="session")
def build_scene() -> Callable[..., Scene]:
    """``build_scene(path, kind, valid=None, *, ego, now, road_map, signals)``."""
    return make_scene


@pytest.fixture(scope="session")
def build_map() -> Callable[..., RoadMap]:
    """``build_map([(id, FeatureType, type, points), ...])``."""
    return make_map


@pytest.fixture(scope="session")
def build_signals() -> Callable[..., Signals]:
    """``build_signals([(step, lane id, SignalState), ...])``."""
    return make_signals


@pytest.fixture(scope="session")
def drive() -> Callable[..., Scene]:
    """One agent, the ego, straight ahead at constant speed."""

    def build(speed_mps=10.0, heading_rad=0.0, kind=AgentType.VEHICLE, steps=91, **more):
        path = straight_path((0.0, 0.0), heading_rad, speed_mps, steps)
        return make_scene(path[None], [kind], **more)

    return build


@pytest.fixture(scope="session")
def crossing() -> Callable[..., Scene]:
    """The ego drives east past a car coming from the south, a pedestrian and a cyclist.

    The car (row 1) is seen all the time, the pedestrian (row 2) from step 30 on, the
    cyclist (row 3) until step 60.
    """

    def build(speed_mps=10.0, steps=91, **more):
        paths = [
            straight_path((-40.0, 0.0), 0.0, speed_mps, steps),
            straight_path((0.0, -60.0), np.pi / 2, speed_mps, steps),
            straight_path((22.0, 8.0), -np.pi / 2, 1.4, steps),
            straight_path((40.0, 2.0), np.pi, 4.0, steps),
        ]
        valid = np.ones((4, steps), bool)
        valid[2, :30] = False
        valid[3, 61:] = False
        kinds = [
            AgentType.VEHICLE,
            AgentType.VEHICLE,
            AgentType.PEDESTRIAN,
            AgentType.CYCLIST,
        ]
        return make_scene(np.stack(paths), kinds, valid, **more)

    return build


@pytest.fixture(scope="session")
def parked() -> Callable[..., Scene]:
    """The ego stands at the origin, and ``count`` cars stand every 8 m along the road."""

    def build(count=3, steps=91, **more):
        paths = [
            straight_path((8.0 * i, -2.0 * (i > 0)), 0.0, 0.0, steps)
            for i in range(count + 1)
        ]
        return make_scene(np.stack(paths), [AgentType.VEHICLE] * (count + 1), **more)

    return build


@pytest.fixture(scope="session")
def metre_moves() -> MotionVocabulary:
    """Moves of whole metres, the same for each kind.

    Row ``i`` up to 20 goes ``i`` metres straight ahead; rows 21 to 40 the same with a turn
    of 10 degrees to the left at the end, rows 41 to 60 to the right.
    """
    ahead_m = np.concatenate([np.arange(21), np.tile(np.arange(1, 21), 2)])
    turn_rad = np.repeat(np.deg2rad([0.0, 10.0, -10.0]), [21, 20, 20])
    share = np.linspace(0, 1, 6)
    path = np.stack(
        [np.outer(ahead_m, share), np.zeros((61, 6)), np.outer(turn_rad, share)], axis=-1
    )
    return MotionVocabulary(
        size_lw_m=BOX_LW_M,
        path=np.broadcast_to(path, (3, 61, 6, 3)).astype(np.float32),
        real=np.ones((3, 61), bool),
    )


@pytest.fixture(scope="session")
def dense_moves() -> MotionVocabulary:
    """Moves close together: every 0.1 m ahead up to 18 m, along arcs, and small side steps.

    Good enough for real logs: most are followed within a few decimetres.
    """
    ahead_m = np.concatenate([np.arange(0, 3, 0.1), np.arange(3, 18, 0.2)])
    curve = np.deg2rad([0.0, -1, 1, -3, 3, -7, 7, -12, 12, -18, 18])
    end = [(x * np.cos(c / 2), x * np.sin(c / 2), c) for c in curve for x in ahead_m]
    end += [(x, y, 0.0) for x in (-0.4, -0.1, 0.1, 0.3, 1.0) for y in (-0.15, 0.15)]
    path = np.array(end)[:, None] * np.linspace(0, 1, 6)[:, None]
    return MotionVocabulary(
        size_lw_m=BOX_LW_M,
        path=np.broadcast_to(path, (3, *path.shape)).astype(np.float32),
        real=np.ones((3, len(path)), bool),
    )


@pytest.fixture(scope="session")
def bent_roads() -> MapVocabulary:
    """Five-metre arcs that end 0, 5, ... 40 degrees to the left, then to the right."""
    bend_rad = np.deg2rad([0, 5, 10, 20, 40, -5, -10, -20, -40])
    headings = np.outer(bend_rad, np.arange(10) / 9)
    steps_m = 0.5 * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    curve = np.concatenate([np.zeros((9, 1, 2)), np.cumsum(steps_m, axis=1)], axis=1)
    return MapVocabulary(curve_m=curve.astype(np.float32), real=np.ones(9, bool))
