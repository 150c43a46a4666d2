"""Rollouts drawn by hand: who is where, token step by token step."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from infgen.model.batching.batch import collate
from infgen.model.batching.tensors import map_tensors
from infgen.model.latent_rates import Rate
from infgen.model.training.policy_gradient.rollouts import SimulatedRollouts
from infgen.tokens.scene_tokens import Presence
from infgen.tokens.vocabulary import BOX_LW_M, MotionVocabulary

METRES = 24


@pytest.fixture(scope="session")
def metres():
    """A vocabulary whose token k goes k metres ahead."""
    path = np.zeros((3, METRES, 6, 3), dtype=np.float32)
    path[..., 0] = np.arange(METRES)[:, None] * np.linspace(0, 1, 6)
    return MotionVocabulary(BOX_LW_M, path, np.ones((3, METRES), dtype=bool))


@pytest.fixture(scope="session")
def drawn(record, limits):
    """``drawn(poses)``: rollouts of one scene, with boxes of 4 by 2 m at these poses.

    ``poses`` are [rollout, token, agent, 3]. All agents are there from the beginning, and
    move from the second token step on. Motion tokens are as long as the way.
    """

    def draw(poses):
        pose = torch.tensor(poses, dtype=torch.float32)
        rollouts, tokens, agents, _ = pose.shape
        lives = [(0, tokens - 1)] * (agents - 1)
        logged = collate([record(0, tokens=tokens, lives=lives)], limits, 0)
        played = map_tensors(
            logged.agents, lambda x: x.repeat(rollouts, *[1] * (x.dim() - 1))
        )
        way_m = (pose[:, 1:] - pose[:, :-1])[..., :2].norm(dim=-1).round().long()
        played = replace(
            played,
            pose=pose,
            agent_type=torch.zeros_like(played.agent_type),
            size_lwh_m=torch.tensor([4.0, 2.0, 1.5]).expand(rollouts, agents, 3),
            presence=torch.full_like(played.presence, int(Presence.PRESENT)),
            observed=torch.ones_like(played.observed),
            motion_token=torch.cat([torch.zeros_like(way_m[:, :1]), way_m], dim=1),
            turn=torch.full_like(played.turn, -1),
        )
        moved = torch.ones_like(played.observed)
        moved[:, 0] = False
        return SimulatedRollouts(
            batch=replace(logged, agents=played),
            logged=played,
            count=rollouts,
            moved=moved,
            inserted=torch.zeros_like(moved),
            known=torch.ones_like(moved[:, 0]),
            rate_log_odds=torch.zeros((*moved.shape[:2], len(Rate))),
        )

    return draw
