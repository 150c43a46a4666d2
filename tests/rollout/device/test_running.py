"""States of insertion on a device are taken apart into tensors and put together again."""

from dataclasses import replace

import pytest
import torch

from infgen.rollout.device.insertion import DeviceInsertion
from infgen.rollout.device.running import tensors_of, with_tensors
from infgen.rollout.session import Session
from tests.rollout.single_rules import only


@pytest.fixture
def running(simulator, start, crossing):
    playing = simulator({"standing_features": True}, **only(insertion_mask=True))
    session = Session(playing, [start(crossing(), at) for at in range(3)])
    session.step()
    request = session._query_network(session.population)
    with torch.inference_mode():
        return DeviceInsertion(request)._begin(
            session._memory, session.population, session.token + 1, request
        )


def test_a_state_of_other_tensors_is_the_same_state(running):
    taken = tensors_of(running)

    other = with_tensors(running, (x.clone() for x in taken))

    again = tensors_of(other)
    assert len(again) == len(taken) > 25
    for one, two in zip(taken, again, strict=True):
        assert one.data_ptr() != two.data_ptr() or not one.numel()
        assert one.dtype == two.dtype
        assert torch.equal(one, two)


def test_maps_are_no_part_of_it_unless_they_are_asked_for(running):
    entries = running.entries

    changed = with_tensors(entries, (x.clone() for x in tensors_of(entries)))

    assert changed.map is entries.map
    assert any(x is entries.map.pose for x in tensors_of(entries, without=()))
    assert not any(x is entries.map.pose for x in tensors_of(entries))


def test_copies_in_other_precisions_are_made_anew(running):
    relation = running.entries.roads.relation
    relation.of_kind(torch.bfloat16)

    changed = with_tensors(relation, iter(tensors_of(relation)))

    assert relation.copies
    assert not changed.copies


def test_what_is_not_there_stays_away(running):
    state = replace(running, soon=None, wanted=None)

    assert len(tensors_of(state)) == len(tensors_of(running)) - 1
    assert with_tensors(state, iter(tensors_of(state))).soon is None
