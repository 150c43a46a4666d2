"""Insertion on a device, run on the CPU, inserts what insertion on the host inserts."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from infgen.rollout.device.insertion import DeviceInsertion, _kept
from infgen.rollout.insertion import insert_agents
from infgen.rollout.session import Session
from infgen.tokens.scene_tokens import Presence
from tests.rollout.single_rules import only

MASK = {"insertion_mask": True, "insertion_lane_distance_m": 4.0}
FEW = {"max_agents": 12, "max_insertions": 5, "position_top_k": 0}
VARIANTS = {
    "plain": ({}, {}),
    "masked": ({}, only(insertion_mask=True, max_insertion_attempts=6)),
    "near lanes": ({}, only(**MASK, max_insertion_attempts=9)),
    "density control": ({}, only(**MASK, density_control=2.0)),
    "regressed positions": ({"position_token": False}, {}),
    "regressed headings": ({"heading_token": False}, {"position_top_p": 0.9}),
    "offset tokens": (
        {"offset_token": True, "cell_feature_width": 8},
        {"offset_top_p": 0.5, "heading_top_p": 0.9},
    ),
    "features": ({"cell_feature_width": 8, "ego_embedding": True}, {}),
    "cell refinement": ({"cell_feature_width": 8, "cell_refinement_width": 8}, {}),
    "agent spacing": (
        {"agent_spacing_width": 8, "offset_token": True, "cell_feature_width": 8},
        {},
    ),
    "rotary": ({"relations": "rotary", "cell_feature_width": 8}, {}),
    "latent rates": ({"latent_rates": True}, {}),
    "latent rates, density control": (
        {"latent_rates": True},
        only(**MASK, density_control=2.0),
    ),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_it_inserts_what_the_host_inserts(simulator, force, start, crossing, parked, name):
    model, settings = VARIANTS[name]
    playing = simulator({"temporal_window_tokens": 4, **model}, **{**FEW, **settings})
    force(playing, add=1.0, leave=-1.0)
    pairs = 6 if name == "masked" else 2  # Of more than eight rollouts some are left out.
    starts = [start(scene, at) for at, scene in enumerate([crossing(), parked(3)] * pairs)]
    session = Session(playing, starts)
    ours = DeviceInsertion(session._asking)
    inserted = 0
    for _ in range(2):
        frame = session.step()
        inserted += int((frame.inserted_number >= 0).sum())
        # The memory holds the token step before the one that agents were inserted in.
        token, request = session.token + 1, session._query_network(session.population)
        with torch.inference_mode():
            host = insert_agents(request, session._memory, session.population, token)
            device = ours.insert(request, session._memory, session.population, token)

        assert (host.presence == Presence.INSERTED).sum() > 0
        for field in fields(host):
            one, other = getattr(host, field.name), getattr(device, field.name)
            assert one.dtype == other.dtype, field.name
            # Sums of the network are rounded by the rollouts of a pass. Positions that are
            # in no cell go into the next turn as they are, and rounding grows by turns.
            most = 1e-3 if name == "regressed positions" else 1e-4
            near = {"rtol": 1e-5, "atol": most} if one.dtype.kind == "f" else {"rtol": 0}
            np.testing.assert_allclose(one, other, err_msg=field.name, **near)
    assert inserted > 0


@pytest.mark.parametrize(
    ("asked", "going", "kept"),
    [
        (8, [3], [0, 1, 2, 3, 4, 5, 6, 7]),  # Fewer than eight save nothing.
        (20, [1, 19], [0, 1, 2, 3, 4, 5, 6, 19]),
        (20, [*range(9)], [*range(16)]),
        (20, [*range(3, 20)], [*range(20)]),
    ],
)
def test_passes_are_for_a_power_of_two_of_rollouts(asked, going, kept):
    mask = np.zeros(asked, dtype=bool)
    mask[going] = True

    assert _kept(mask).tolist() == kept


def test_nothing_is_inserted_where_nothing_may_be(simulator, start, crossing):
    playing = simulator(max_insertions=0)
    session = Session(playing, start(crossing()))

    after = DeviceInsertion(session._asking).insert(
        replace(session._asking), session._memory, session.population, 2
    )

    assert after is session.population
