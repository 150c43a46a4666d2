"""Offsets and headings of inserted agents: sampled one given the other, from a nucleus."""

from dataclasses import replace

import pytest
import torch

from infgen.model.insertion.cell_features import CellSources
from infgen.model.insertion.detail_query import DetailQuery, InsertionDetails
from infgen.rollout.insertion import sample_offset_and_heading

AGENTS = 64


@pytest.fixture
def playing(simulator):
    """A simulator whose offset bins, and headings given these, differ in probability."""
    made = simulator({"offset_token": True, "cell_feature_width": 4})
    torch.manual_seed(1)
    details = made.stepper.network.details
    with torch.no_grad():
        torch.nn.init.normal_(details.offset_bins.alone[-1].weight)
        torch.nn.init.normal_(details.given_offset.embed.weight)
        details.heading[-1].weight.mul_(20)
    return made


@pytest.fixture
def details(playing):
    stack = playing.stepper.network.details
    width = playing.stepper.network.settings.width
    roads = CellSources(
        features=torch.randn(1, width),
        row=torch.zeros((AGENTS, 1), dtype=torch.int64),
        pose=torch.zeros((AGENTS, 1, 3)),
        present=torch.ones((AGENTS, 1), dtype=torch.bool),
    )
    features = torch.randn(1, width).expand(AGENTS, -1)
    query = DetailQuery(stack, features, torch.zeros((AGENTS, 3)), roads)
    return InsertionDetails(
        agent_type_logits=torch.zeros((AGENTS, 3)),
        size_lwh_m=torch.ones((AGENTS, 3, 3)),
        heading_logits=None,
        turned_rad=None,
        offset_m=None,
        query=query,
    )


def sampled(playing, details, **settings):
    some = replace(playing, settings=replace(playing.settings, **settings))
    uniform = torch.rand((2, AGENTS), generator=torch.Generator().manual_seed(3)).double()
    numbers = iter(uniform)
    vehicle = torch.zeros(AGENTS, dtype=torch.int64)
    return sample_offset_and_heading(some, details, vehicle, lambda _: next(numbers))


def test_all_bins_may_be_sampled_and_few_of_a_narrow_nucleus(playing, details):
    every, _ = sampled(playing, details)
    few, _ = sampled(playing, details, offset_top_p=0.5)
    best, headings = sampled(playing, details, offset_top_p=0.001, heading_top_p=0.001)

    vehicle = torch.zeros(AGENTS, dtype=torch.int64)
    likeliest = details.query.offset_logits(vehicle).argmax(dim=-1)
    assert len(every.unique()) > len(few.unique()) > 1
    assert torch.equal(best, likeliest)
    of_headings = details.query.heading_logits(vehicle, likeliest)
    assert torch.equal(headings, of_headings.argmax(dim=-1))


def test_the_heading_is_sampled_for_the_offset(playing, details):
    offset, heading = sampled(playing, details, heading_top_p=0.001)

    vehicle = torch.zeros(AGENTS, dtype=torch.int64)
    expected = details.query.heading_logits(vehicle, offset).argmax(dim=-1)
    assert torch.equal(heading, expected)
    assert len(heading.unique()) > 1, "headings differ by the offset"
