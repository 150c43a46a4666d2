"""What traffic engineers read from traffic, as histograms that add up over scenes."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from infgen.metrics.proper.engineering.encroachment import encroachments_s
from infgen.metrics.proper.engineering.green import Greens, delays_s, find_greens
from infgen.metrics.proper.engineering.headway import headways_s
from infgen.metrics.proper.engineering.lanes import Lanes, lane_traffic, read_lanes
from infgen.metrics.proper.engineering.stops import stays_s, stops_s
from infgen.metrics.proper.engineering.turns import find_junctions, turns_deg
from infgen.metrics.proper.engineering.vehicles import see_vehicles
from infgen.metrics.proper.engineering.wasserstein import Scale
from infgen.metrics.traffic import Traffic
from infgen.scene import Scene

SCALES = (
    Scale("speed", "m/s", 0.0, 30.0),
    Scale("acceleration", "m/s2", -8.0, 8.0),
    Scale("time_headway", "s", 0.0, 10.0),
    Scale("post_encroachment_time", "s", 0.0, 10.0),
    Scale("stop_duration", "s", 0.0, 60.0),
    Scale("setting_off_delay", "s", 0.0, 10.0),
    Scale("length_of_stay", "s", 0.0, 60.0),
    Scale("turn_at_junction", "degrees", -180.0, 180.0),
    Scale("lane_density", "vehicles/km", 0.0, 120.0),
    Scale("lane_flow", "vehicles/h", 0.0, 2400.0),
    Scale("lane_speed", "m/s", 0.0, 30.0),
)

Histograms = Mapping[str, Float64[np.ndarray, " bin"]]


@dataclass(frozen=True, slots=True)
class Place:
    """What of a scene's map and signals is the same for its log and its rollouts.

    Attributes:
        junctions_m: Middles of junctions.
        lanes: Its lanes.
        greens: When lights turn green; None where rollouts do not show the log's lights.
    """

    junctions_m: Float64[np.ndarray, "junction 2"]
    lanes: Lanes
    greens: Greens | None


def read_place(scene: Scene, radius_m: float, *, logged_lights: bool) -> Place:
    """Read a scene's map and signals.

    Args:
        scene: The scene.
        radius_m: Lanes that lie nearer to the ego now are measured.
        logged_lights: Whether the lights of the rollouts are those of the log.
    """
    ego_m = scene.tracks.xyz_m[scene.ego, scene.now, :2].astype(np.float64)
    greens = find_greens(scene.signals, scene.road_map, scene.now)
    return Place(
        junctions_m=find_junctions(scene.road_map),
        lanes=read_lanes(scene.road_map, ego_m, radius_m),
        greens=greens if logged_lights else None,
    )


def measure(
    traffic: Traffic, place: Place, radius_m: float, num_steps: int
) -> dict[str, Float64[np.ndarray, " bin"]]:
    """Count the values of every number of ``SCALES`` in one log or rollout.

    A number that has no value, or that cannot be told, has an empty histogram.
    """
    vehicles = see_vehicles(traffic, radius_m, num_steps)
    lanes = lane_traffic(vehicles, place.lanes)
    greens = place.greens
    values = {
        "speed": vehicles.speed_mps[vehicles.near],
        "acceleration": vehicles.accel_mps2[vehicles.near],
        "time_headway": headways_s(vehicles),
        "post_encroachment_time": encroachments_s(vehicles),
        "stop_duration": stops_s(vehicles),
        "setting_off_delay": np.zeros(0) if greens is None else delays_s(vehicles, greens),
        "length_of_stay": stays_s(traffic, radius_m, num_steps),
        "turn_at_junction": turns_deg(vehicles, place.junctions_m),
        "lane_density": lanes.density_per_km,
        "lane_flow": lanes.flow_per_h,
        "lane_speed": lanes.speed_mps,
    }
    return {scale.name: scale.count(values[scale.name]) for scale in SCALES}
