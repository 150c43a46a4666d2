"""All insertions of a batch at once, each given the true ones before it (training)."""

from dataclasses import replace

import torch
from torch import Tensor

from infgen.model.batching.batch import Batch
from infgen.model.batching.steps import steps_m
from infgen.model.insertion.agent_spacing import SpacedAgents, swept
from infgen.model.insertion.cell_features import CellSources
from infgen.model.insertion.cell_query import CellStack
from infgen.model.insertion.detail_query import DetailStack
from infgen.model.insertion.placement_features import Places
from infgen.model.logits import DetailOutputs, InsertionOutputs
from infgen.model.long_memory import Density
from infgen.model.neighbours import (
    MapFeatures,
    cell_pose,
    find_map_neighbours,
    find_neighbours,
)
from infgen.model.relations import Rows
from infgen.tokens.scene_tokens import EGO


def insertion_outputs(
    stack: CellStack,
    batch: Batch,
    asked: Rows,
    rows: Rows,
    raw: Tensor,
    shown: Tensor,
    roads: MapFeatures,
    density: Density | None,
) -> InsertionOutputs:
    """Ask for the inserted agents of every token, each slot seeing those before it.

    Attention sees the features ``shown``: the raw ones, turned if features are.
    """
    agents, entries = batch.agents, batch.entries
    alone = Rows(asked.at, asked.number.flatten()[:, None])
    ego_pose = agents.pose[:, :, EGO]
    around = find_neighbours(
        stack.agents_reach(agents.agent_type.shape[1]),
        alone,
        ego_pose.flatten(0, 1)[:, None],
        agents.pose.flatten(0, 1),
        rows.number.flatten(0, 1),
        agents.visible.flatten(0, 1)[:, None],
    )
    slot = torch.arange(entries.agent.shape[2], device=raw.device)[:, None]
    turn = asked.pack(agents.turn).gather(1, around.place)[:, None]  # [N, 1, K]
    cell = asked.pack(agents.cell).gather(1, around.place)[:, None]
    seen = around.seen(shown)
    seen = replace(seen, present=seen.present[:, None] & (turn < slot))
    occupied = stack.occupied(cell.expand_as(seen.present), seen.present)
    reach, scene = stack.map_reach(), _count(agents.agent_type)
    map_seen = find_map_neighbours(reach, asked, ego_pose, roads, scene)
    cell_features = None
    if stack.cell_features is not None:
        # Inserted agents differ by slot: they are left out.
        there = agents.visible & (agents.turn < 0)
        lying = CellSources(
            raw, *(asked.pack(each) for each in (rows.number, agents.pose, there))
        )
        map_of = asked.at // agents.pose.shape[1]
        cell_features = stack.cell_features(
            asked.pack(ego_pose), CellSources.roads(roads, map_of), lying
        )
    average = None if density is None else asked.pack(density.average)
    ego = None
    if stack.ego is not None:
        there = asked.pack(agents.visible[..., EGO])[:, None]
        ego = stack.ego(raw[asked.pack(rows.number[..., EGO])] * there)
    x = stack(occupied, map_seen, seen, average, ego)
    spaced = None
    if stack.spacing is not None:
        size_lw_m = agents.size_lwh_m[:, None, :, :2].expand(*agents.pose.shape[:3], 2)
        boxes = swept(agents.pose, size_lw_m, steps_m(agents))
        each = rows.number, *boxes, agents.visible
        near = SpacedAgents(raw, *(asked.pack(values) for values in each))
        said = stack.spacing.cells(asked.pack(ego_pose), near)
        spaced = stack.spacing.choose_each(x, said, asked.pack(agents.turn))
    return stack.answer(asked, x, cell_features, spaced)


def detail_outputs(
    stack: DetailStack,
    batch: Batch,
    wanted: Rows,
    rows: Rows,
    raw: Tensor,
    shown: Tensor,
    roads: MapFeatures,
) -> DetailOutputs:
    """Describe agents where they enter, without seeing them."""
    agents, details = batch.agents, batch.details
    scene = wanted.at // details.present.shape[1]
    token, cell = wanted.pack(details.token), wanted.pack(details.cell)
    ego_pose = agents.pose[scene, token, EGO]
    pose = cell_pose(ego_pose, stack.query_pose(cell, wanted.pack(details.offset_m)))
    each = Rows(_count(pose), _count(pose)[:, None])

    place = torch.arange(agents.agent_type.shape[1], device=shown.device)
    turn = wanted.pack(details.turn)[:, None]
    allowed = agents.visible[scene, token] & (agents.turn[scene, token] < turn)
    allowed &= place != wanted.pack(details.agent)[:, None]
    around = find_neighbours(
        stack.agents_reach(),
        each,
        pose[:, None],
        agents.pose[scene, token],
        rows.number[scene, token],
        allowed[:, None],
    )
    reach = stack.map_reach()
    map_seen = find_map_neighbours(reach, each, pose[:, None], roads, scene)
    x = stack(cell, map_seen, around.seen(shown))
    agent_type, offset = wanted.pack(details.agent_type), wanted.pack(details.offset)
    near = CellSources.near(roads, map_seen)
    said = stack.answer(wanted, x, agent_type, pose, near)
    if stack.offset_bins is None:
        return said
    beside = None
    if stack.spacing is not None:
        of_each = scene[:, None], token[:, None], around.place
        boxes = swept(
            agents.pose[of_each],
            agents.size_lwh_m[scene[:, None], around.place, :2],
            steps_m(agents)[of_each],
        )
        beside = SpacedAgents(raw, around.index, *boxes, around.present)
    places = None if stack.placement is None else Places.on(roads, pose, scene)
    return replace(
        said,
        offset_logits=stack.offset_logits(x, agent_type, pose, near, beside, places),
        heading_logits=stack.heading_logits(x, agent_type, offset, pose, near, places),
    )


def _count(like: Tensor) -> Tensor:
    return torch.arange(len(like), device=like.device)
