"""A planner drives the ego through simulated traffic, half a second at a time.

In a scene of the package, in traffic of its weights::

    python examples/planner.py --page drive.html

In a logged scene, in traffic of your weights::

    python examples/planner.py --weights work --scenes "$WOMD/*.tfrecord*" --scene 637f20
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

import infgen
from infgen.clock import CLOCK
from infgen.geometry import to_local
from infgen.rollout.population import EGO_ROW, Population
from infgen.scene import FeatureType, Scene
from infgen.tokens.scene_tokens import Presence

MAX_ACCEL_MPS2, COMFORT_BRAKE_MPS2 = 1.5, 2.0
HEADWAY_S, STANDING_GAP_M = 1.5, 2.0
BESIDE_M = 2.0
"""Whoever is farther to the side is not in the way."""
RETURN_M = 15.0
"""Distance on which the planner comes back to the lane's middle, by a factor of e."""


@dataclass
class LaneKeeper:
    """Follows one lane and keeps its distance (the Intelligent Driver Model).

    Attributes:
        lane_m: Points of the lane's middle [point, 2].
        length_m: Of the car.
        desired_mps: Its speed on a free road.
        speed_mps: Its speed now.
        at_m: How far along the lane it is.
        aside_m: How far left of the lane's middle it is.
    """

    lane_m: np.ndarray
    length_m: float
    desired_mps: float
    speed_mps: float
    at_m: float
    aside_m: float

    @classmethod
    def of(cls, scene: Scene, desired_mps: float) -> "LaneKeeper":
        """Start on the lane nearest to the ego, at the ego's speed."""
        tracks, ego = scene.tracks, scene.ego
        xy_m = tracks.xyz_m[ego, scene.now, :2]
        rows = scene.road_map.rows(FeatureType.LANE)
        lanes = [scene.road_map.points(row)[:, :2] for row in rows.tolist()]
        gaps_m = [np.linalg.norm(lane_m - xy_m, axis=1).min() for lane_m in lanes]
        lane_m = lanes[int(np.argmin(gaps_m))]
        first = int(np.linalg.norm(lane_m - xy_m, axis=1).argmin())
        keeper = cls(
            lane_m=lane_m,
            length_m=float(tracks.size_lwh_m[ego, scene.now, 0]),
            desired_mps=desired_mps,
            speed_mps=float(np.hypot(*tracks.velocity_mps[ego, scene.now])),
            at_m=float(np.linalg.norm(np.diff(lane_m[: first + 1], axis=0), axis=1).sum()),
            aside_m=0.0,
        )
        frame = keeper._pose_at(keeper.at_m)
        local = to_local(np.array([[*xy_m, 0.0]]), frame[None])[0]
        keeper.at_m += float(local[0])
        keeper.aside_m = float(local[1])
        return keeper

    def plan(self, gap_m: float, closing_mps: float) -> Float32[np.ndarray, "5 3"]:
        """Drive half a second on: poses at its five steps.

        Args:
            gap_m: Free way to the next car ahead; infinite if there is none.
            closing_mps: How fast that shrinks.
        """
        poses = []
        for _ in range(CLOCK.steps_per_token):
            self._accelerate(gap_m, closing_mps)
            moved_m = self.speed_mps * CLOCK.step_s
            gap_m -= closing_mps * CLOCK.step_s
            self.at_m += moved_m
            self.aside_m *= np.exp(-moved_m / RETURN_M)
            pose = self._pose_at(self.at_m)
            left = np.array([-np.sin(pose[2]), np.cos(pose[2]), 0.0])
            poses.append(pose + self.aside_m * left)
        return np.array(poses, dtype=np.float32)

    def _accelerate(self, gap_m: float, closing_mps: float) -> None:
        braking = 2 * np.sqrt(MAX_ACCEL_MPS2 * COMFORT_BRAKE_MPS2)
        wanted_m = STANDING_GAP_M + self.speed_mps * max(
            0.0, HEADWAY_S + closing_mps / braking
        )
        free = (self.speed_mps / self.desired_mps) ** 4
        accel_mps2 = MAX_ACCEL_MPS2 * (1 - free - (wanted_m / max(gap_m, 0.1)) ** 2)
        self.speed_mps = max(0.0, self.speed_mps + max(accel_mps2, -8.0) * CLOCK.step_s)

    def _pose_at(self, along_m: float) -> np.ndarray:
        """Pose so far along the lane; straight on beyond its end."""
        steps_m = np.diff(self.lane_m, axis=0)
        reached_m = np.concatenate([[0], np.linalg.norm(steps_m, axis=1).cumsum()])
        passed = int(np.searchsorted(reached_m, along_m, side="right"))
        piece = min(max(passed - 1, 0), len(steps_m) - 1)
        way = steps_m[piece] / np.linalg.norm(steps_m[piece])
        x_m, y_m = self.lane_m[piece] + (along_m - reached_m[piece]) * way
        return np.array([x_m, y_m, np.arctan2(way[1], way[0])])


def gap_ahead(
    session: infgen.PlannerSession, before: Population, length_m: float
) -> tuple[float, float]:
    """Free way of the ego to the next agent in its way, and how fast that agent drives."""
    now = session.population
    there = now.presence[0] != Presence.ABSENT
    there[EGO_ROW] = False
    pose = now.pose[0]
    local = to_local(pose, np.broadcast_to(session.ego_pose[0], pose.shape))
    in_the_way = there & (local[:, 0] > 0) & (np.abs(local[:, 1]) < BESIDE_M)
    if not in_the_way.any():
        return np.inf, np.inf
    row = int(np.where(in_the_way, local[:, 0], np.inf).argmin())
    gap_m = float(local[row, 0]) - (length_m + float(now.size_lwh_m[0, row, 0])) / 2
    same = before.agent_number[0, row] == now.agent_number[0, row]
    moved_m = np.linalg.norm(pose[row, :2] - before.pose[0, row, :2]) if same else 0.0
    return gap_m, float(moved_m) / CLOCK.token_s


@dataclass(frozen=True)
class Moment:
    """The ego at the end of one token step.

    Attributes:
        seconds: Since the drive began.
        ego_pose: Where it is.
        speed_mps: How fast it drives.
        gap_m: Free way ahead of it.
        num_others: Agents around it.
    """

    seconds: float
    ego_pose: np.ndarray
    speed_mps: float
    gap_m: float
    num_others: int


def drive(session: infgen.PlannerSession, scene: Scene, seconds: float) -> Iterator[Moment]:
    """Let the planner drive in traffic that reacts to it."""
    keeper = LaneKeeper.of(scene, desired_mps=12.0)
    before = session.population
    for step in range(CLOCK.tokens_in(seconds)):
        gap_m, other_mps = gap_ahead(session, before, keeper.length_m)
        closing_mps = keeper.speed_mps - other_mps if np.isfinite(gap_m) else 0.0
        before = session.population
        session.step(keeper.plan(gap_m, closing_mps))
        there = session.population.presence[0] != Presence.ABSENT
        yield Moment(
            seconds=(step + 1) * CLOCK.token_s,
            ego_pose=session.ego_pose[0],
            speed_mps=keeper.speed_mps,
            gap_m=gap_m,
            num_others=int(there.sum()) - 1,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive, and print where to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--weights", default="towns", help="as infgen.load takes them")
    parser.add_argument("--scenes", default="builtin", help="as infgen.open_scenes does")
    parser.add_argument("--scene", default="", help="start of its id; else the first")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the drive")
    parser.add_argument("--seed", type=int, default=0, help="another seed, other traffic")
    parser.add_argument("--page", help="page to write that plays the drive")
    options = parser.parse_args(arguments)
    scene = infgen.open_scenes(options.scenes)[options.scene or 0]
    session = infgen.load(options.weights, rules="safe").session(scene, seed=options.seed)
    print("   s      x m      y m   m/s   gap m  others")
    for moment in drive(session, scene, options.seconds):
        x_m, y_m, _ = moment.ego_pose
        print(
            f"{moment.seconds:4.1f} {x_m:8.1f} {y_m:8.1f} {moment.speed_mps:5.1f} "
            f"{moment.gap_m:7.1f} {moment.num_others:7d}"
        )
    if options.page:
        print(session.rollouts().view(options.page))


if __name__ == "__main__":
    main()
