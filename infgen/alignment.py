"""Scenes whose history ends where a token ends, as tokens and simulator need it."""

from dataclasses import replace

from infgen.clock import CLOCK, Clock
from infgen.scene import Scene, Signals, Tracks


def align_to_tokens(scene: Scene, clock: Clock = CLOCK) -> Scene:
    """Leave out the first steps of a scene so that its history ends with a token.

    WOMD's step 10 ends token 1, and the scene comes back as it is. Argoverse 2's step 49
    ends none: without the first four steps it is step 45, the end of token 8.

    Args:
        scene: Any scene.
        clock: How many steps a token spans.

    Returns:
        The scene without its first ``now % steps_per_token`` steps.
    """
    skip = scene.now % clock.steps_per_token
    if not skip:
        return scene
    tracks, signals = scene.tracks, scene.signals
    later = signals.step >= skip
    return replace(
        scene,
        timestamps_s=scene.timestamps_s[skip:],
        now=scene.now - skip,
        tracks=Tracks(
            id=tracks.id,
            agent_type=tracks.agent_type,
            xyz_m=tracks.xyz_m[:, skip:],
            heading_rad=tracks.heading_rad[:, skip:],
            velocity_mps=tracks.velocity_mps[:, skip:],
            size_lwh_m=tracks.size_lwh_m[:, skip:],
            valid=tracks.valid[:, skip:],
        ),
        signals=Signals(
            step=(signals.step[later] - skip).astype(signals.step.dtype),
            lane_id=signals.lane_id[later],
            state=signals.state[later],
            stop_xyz_m=signals.stop_xyz_m[later],
        ),
    )
