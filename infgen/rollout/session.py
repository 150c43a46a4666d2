"""The closed loop, half a second at a time, for a batch of rollouts.

::

    session = Session(player, start)
    while planning:
        frame = session.step(ego_pose)      # or session.step(): the network drives

The order within a half second is SPEC 12.2's: everyone moves, whoever leaves is marked,
then newcomers enter one by one until the network says that motion begins.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.clock import CLOCK
from infgen.geometry import wrap_angle
from infgen.model.batching.batch import Roads, collate_roads
from infgen.model.relations import Rows
from infgen.model.signal_features import StopLines
from infgen.model.stepping import Memory
from infgen.model.token_step import MotionStep
from infgen.rollout.insertion import Asking, add_newcomers
from infgen.rollout.insertion_mask import make_room
from infgen.rollout.population import (
    EGO_ROW,
    Population,
    leave_beyond,
    move_on,
    settle,
)
from infgen.rollout.random_streams import Purpose, Stream
from infgen.rollout.recording import NOBODY, Frame, Start, number_maps
from infgen.rollout.rules.density import Fullness
from infgen.rollout.rules.rejection import look_out
from infgen.rollout.rules.stalls import Patience
from infgen.rollout.sampling import choose, happens
from infgen.rollout.simulator import Player
from infgen.tokens.motion_tokens import follow, make_match_table
from infgen.tokens.scene_tokens import Presence


class Session:
    """A batch of rollouts under way, whose egos may be driven from outside.

    What a rollout does depends on its own scene, index, seed and driver only, never on the
    others of the batch (but for rounding in the network's sums).

    Attributes:
        population: Everyone at the end of the last half second.
        token: That half second.
    """

    @torch.inference_mode()
    def __init__(self, player: Player, starts: Start | Sequence[Start]) -> None:
        """Play the history.

        Args:
            player: Network and settings.
            starts: Scenes to continue; several rollouts of one scene share its map.
        """
        starts = [starts] if isinstance(starts, Start) else list(starts)
        self._player = player
        self._streams = [Stream.of(s.seed, s.scene.scenario_id, s.index) for s in starts]
        history = settle(starts, player.settings.max_agents)
        roads = _lay_out(starts)
        self._memory, self._asking = _begin(
            player, roads, starts, self._streams, history[0]
        )
        self._fullness = _keep_full(player, starts, history[-1])
        self._patience = _be_patient(player, roads, starts)
        for population in history[:-1]:
            player.stepper.motion_step(self._memory, player.column(population))
        self.population = history[-1]
        self.token = starts[0].history.now
        self._table = make_match_table(player.vocabulary)
        self._lookout = look_out(
            starts, player.vocabulary, reject_off_road=player.settings.reject_off_road
        )
        self._standing = player.tensor(player.vocabulary.stationary)
        self._driven_to: np.ndarray | None = None

    @property
    def ego_pose(self) -> Float32[np.ndarray, "rollout 3"]:
        """Where each rollout's ego is: x, y, heading in the scene's frame."""
        if self._driven_to is not None:
            return self._driven_to
        return self.population.pose[:, EGO_ROW]

    @torch.inference_mode()
    def step(self, ego_pose: Float32[np.ndarray, "*steps 3"] | None = None) -> Frame:
        """Play the next half second; all others react to the ego in the one after it.

        Args:
            ego_pose: Where the ego drives, in the scene's frame: its pose [3] at the end of
                the half second, or at each of its five steps [5, 3]. For a batch with the
                rollouts as first dimension. The network sees it as moves of its vocabulary,
                each of which makes up for what the last one left out. None lets the network
                drive.
        """
        player, token = self._player, self.token + 1
        path = None if ego_pose is None else self._ego_path(ego_pose)
        before = self._at_the_wheel(path)
        said = player.stepper.motion_step(self._memory, player.column(before))
        moved, paths = self._move(before, said, path, token)
        after = moved
        if player.inserts:
            after = add_newcomers(self._ask(moved), self._memory, moved, token)
        self.population, self.token = after, token
        self._driven_to = None if path is None else path[:, -1]
        return Frame(
            token=token,
            life=moved.life,
            path=paths,
            shown=self._shown(before, moved, said, token),
            leaving=moved.presence == Presence.REMOVED,
            born=np.where(after.life != moved.life, after.life, np.int32(NOBODY)),
            kind=after.kind,
            size_lwh_m=after.size_lwh_m,
        )

    def _ask(self, moved: Population) -> Asking:
        """Who asks for newcomers around the egos where they are now."""
        if self._fullness is None:
            return self._asking
        wanted = self._fullness.wanted(moved.pose[:, EGO_ROW, :2])
        return replace(self._asking, wanted=wanted)

    def _ego_path(self, ego_pose: np.ndarray) -> Float32[np.ndarray, "rollout step 3"]:
        """Poses of the egos at the five steps; on a straight way if only the end is given.

        Raises:
            ValueError: if there is not one pose, or five, for each rollout.
        """
        rollouts, steps = len(self._streams), CLOCK.steps_per_token
        given = np.asarray(ego_pose, dtype=np.float32)
        given = given[None] if rollouts == 1 and given.shape[0] != 1 else given
        if given.shape == (rollouts, steps, 3):
            return given
        if given.shape != (rollouts, 3):
            raise ValueError(
                f"ego_pose has shape {ego_pose.shape}; expected ({rollouts}, 3) or "
                f"({rollouts}, {steps}, 3); the first dimension may be left out if it is 1"
            )
        begin = self.ego_pose
        way = given - begin
        way[:, 2] = wrap_angle(way[:, 2])
        share = np.arange(1, steps + 1, dtype=np.float32)[:, None] / steps
        path = begin[:, None] + share * way[:, None]
        path[..., 2] = wrap_angle(path[..., 2])
        path[:, -1] = given
        return path

    def _at_the_wheel(self, path: np.ndarray | None) -> Population:
        """Everyone as the network sees them; it takes over from where the ego really is."""
        if self._driven_to is None or path is not None:
            return self.population
        pose = self.population.pose.copy()
        pose[:, EGO_ROW] = self._driven_to
        return replace(self.population, pose=pose)

    def _move(
        self, before: Population, said: MotionStep, ego_path: np.ndarray | None, token: int
    ) -> tuple[Population, np.ndarray]:
        """Sample everyone's move, and who leaves; drive the egos that are driven."""
        player, settings = self._player, self._player.settings
        move = self._moves(before, said, token)
        move = self._hurry(before, said, token, move)
        if ego_path is not None:
            target, pose = ego_path[:, -1], before.pose[:, EGO_ROW]
            kind = before.kind[:, EGO_ROW]
            move[:, EGO_ROW], _ = follow(target, pose, kind, self._table)
        leave = self._leaves(said, token)
        driven = np.zeros(move.shape, dtype=bool)
        driven[:, EGO_ROW] = ego_path is not None
        move = self._take_care(before, said, token, move, driven)
        moved, path = move_on(before, move, leave, player.vocabulary)
        if settings.removes and settings.removal_radius_m:
            moved = leave_beyond(before, moved, settings.removal_radius_m)
        if ego_path is not None:
            path = path.copy()  # The population goes on from where the moves led.
            path[:, EGO_ROW] = ego_path
        return moved, path

    def _take_care(
        self,
        before: Population,
        said: MotionStep,
        token: int,
        move: Int64[np.ndarray, "rollout row"],
        driven: Bool[np.ndarray, "rollout row"],
    ) -> Int64[np.ndarray, "rollout row"]:
        """Draw moves again that lead into somebody or off the road."""
        tries, again = self._player.settings.max_motion_samples, ~driven
        slowest, changed = move.copy(), again
        for attempt in range(1, tries):
            # Whom the road and the others leave no way out is to spare the others.
            road = attempt <= tries // 2
            hits, departs = self._lookout.go_wrong(before, move, changed, road=road)
            again, steers = (hits | departs) & ~driven, departs & ~hits
            slower = self._lookout.is_slower(before, move, slowest)
            slowest = np.where(slower & steers, move, slowest)
            changed = again  # Whose move will be another; those who brake among them.
            if attempt == tries // 2:
                # Who is too fast for every way that it drew takes the slowest of them.
                brakes = steers & again & self._lookout.is_fast(before, move)
                move, again = np.where(brakes, slowest, move), again & ~brakes
            if not again.any():
                break
            move = self._moves_again(before, said, token, attempt, move, again, steers)
        return move

    def _moves(
        self, before: Population, said: MotionStep, token: int
    ) -> Int64[np.ndarray, "rollout row"]:
        """Sample everyone's move."""
        packed = said.packed
        kind = packed.rows.pack(self._player.tensor(before.kind).long())
        luck = self._luck(packed.rows, token, Purpose.MOVE)
        drawn = self._draw(packed.move_logits, kind, luck)
        return packed.rows.spread(drawn).cpu().numpy()

    def _moves_again(
        self,
        before: Population,
        said: MotionStep,
        token: int,
        attempt: int,
        move: Int64[np.ndarray, "rollout row"],
        again: Bool[np.ndarray, "rollout row"],
        steers: Bool[np.ndarray, "rollout row"],
    ) -> Int64[np.ndarray, "rollout row"]:
        """Sample the moves of some rows anew; who only has to steer does not stop."""
        player, rows = self._player, said.packed.rows
        which = rows.pack(player.tensor(again))
        luck = self._luck(rows, token, Purpose.MOVE, attempt)[which]
        kind = rows.pack(player.tensor(before.kind).long())[which]
        drawn = rows.pack(player.tensor(move))
        stops = rows.pack(player.tensor(steers))[which, None] & self._standing[kind]
        logits = said.packed.move_logits[which].masked_fill(stops, -torch.inf)
        drawn[which] = self._draw(logits, kind, luck)
        return rows.spread(drawn).cpu().numpy()

    def _hurry(
        self,
        before: Population,
        said: MotionStep,
        token: int,
        move: Int64[np.ndarray, "rollout row"],
    ) -> Int64[np.ndarray, "rollout row"]:
        """Let those set off who have stood in a lane for too long."""
        if self._patience is None:
            return move
        stalled = self._patience.stalled(before, token - 1)
        stalled &= self._player.vocabulary.stationary[before.kind, move]
        if not stalled.any():
            return move
        attempt = (
            self._player.settings.max_motion_samples
        )  # A number that no other draw has.
        return self._moves_again(before, said, token, attempt, move, stalled, stalled)

    def _draw(self, logits: Tensor, kind: Tensor, luck: Tensor) -> Tensor:
        """Sample a move. Who seldom sets off still does: standing has its own nucleus."""
        settings = self._player.settings
        return choose(
            logits,
            luck,
            settings.motion_top_k,
            nucleus=settings.motion_top_p,
            temperature=settings.motion_temperature,
            apart=self._standing[kind] if settings.motion_top_p < 1 else None,
        )

    def _leaves(self, said: MotionStep, token: int) -> Bool[np.ndarray, "rollout row"]:
        settings, packed = self._player.settings, said.packed
        if packed.leave_logit is None or not settings.removes:
            return np.zeros(self.population.life.shape, dtype=bool)
        luck = self._luck(packed.rows, token, Purpose.LEAVE)
        leave = happens(packed.leave_logit, luck, settings.remove_bias)
        return packed.rows.spread(leave).cpu().numpy()

    def _luck(self, rows: Rows, token: int, purpose: Purpose, attempt: int = 0) -> Tensor:
        """Draw a number for each of some rows; it does not depend on the others."""
        each = self.population.life.shape[1]
        return rows.pack(self._player.luck(self._streams, token, purpose, each, attempt))

    def _shown(
        self, before: Population, moved: Population, said: MotionStep, token: int
    ) -> Bool[np.ndarray, "rollout row 5"]:
        """When a detector would see everyone.

        The ego always, a newcomer as soon as it is in, whoever leaves to the end: so an
        entry and an exit are where they are said to be.
        """
        steps = CLOCK.steps_per_token
        shown = np.ones((*moved.life.shape, steps), dtype=bool)
        packed = said.packed
        if packed.pattern_logits is None or not self._player.settings.validity_patterns:
            return shown
        luck = self._luck(packed.rows, token, Purpose.PATTERN)
        drawn = choose(packed.pattern_logits, luck)
        pattern = packed.rows.spread(drawn).cpu().numpy()
        shown &= (pattern[..., None] >> np.arange(steps) & 1).astype(bool)
        shown[:, EGO_ROW] = True
        shown[..., 0] |= before.presence == Presence.INSERTED
        shown[..., -1] |= moved.presence == Presence.REMOVED
        return shown


def _lay_out(starts: Sequence[Start]) -> Roads:
    """Put the maps of rollouts side by side, each once."""
    maps, _ = number_maps(starts)
    histories = [start.history for start in maps]
    return collate_roads(
        histories,
        max(history.num_map_tokens for history in histories),
        [start.lights for start in maps],
    )


def _be_patient(player: Player, roads: Roads, starts: Sequence[Start]) -> Patience | None:
    """Remember who stands, if nobody is to stand for ever."""
    tokens = math.ceil(player.settings.max_stall_s / CLOCK.token_s)
    if not tokens:
        return None
    maps, scene = number_maps(starts)
    return Patience([one.scene for one in maps], scene, StopLines.of(roads), tokens)


def _keep_full(player: Player, starts: Sequence[Start], now: Population) -> Fullness | None:
    """Remember how full the street is at now, if it is to stay so."""
    if not (player.inserts and player.settings.density_control):
        return None
    return Fullness.of(starts, now, player.grid.radius_m)


def _begin(
    player: Player,
    roads: Roads,
    starts: Sequence[Start],
    streams: Sequence[Stream],
    first: Population,
) -> tuple[Memory, Asking]:
    """Encode every map once, however many rollouts of it there are."""
    maps, scene = number_maps(starts)
    histories = [start.history for start in maps]
    memory = player.stepper.begin(roads, player.tensor(scene), first.life.shape[1])
    settings, room = player.settings, None
    if settings.insertion_mask:
        room = make_room(
            histories,
            (player.vocabulary, player.roads),
            scene,
            settings.insertion_lane_distance_m,
        )
    most = np.maximum(settings.max_agents, first.num_agents)
    return memory, Asking(player, streams, room, most)
