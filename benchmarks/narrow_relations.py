"""Narrow the relation features of trained weights without training them again.

The features of a relative pose are read by several attention layers, through linear maps
only. So narrow features that predict the wide ones linearly can take their place: they are
fitted, family by family, to the relative poses of some scenes, and the maps are folded
into the weights of the layers. Nothing else of the network changes::

    python benchmarks/narrow_relations.py --width 16 [--weights FOLDER] [--out FOLDER]

Prints how much of the wide features the narrow ones explain, as the layers weigh it, and
the loss terms of both networks on scenes held out. The last line is one JSON object. With
``--out`` the narrow weights are written, for ``train.initial_weights`` or ``rollout``.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import torch
from records import BUILT_IN, read_split
from torch import Tensor, nn

from infgen.config import TrainSettings
from infgen.model.batching.batch import Batch, Limits, collate
from infgen.model.layers import Attention
from infgen.model.network import Network
from infgen.model.relation_tables import RelationEmbedding
from infgen.model.training.losses import losses
from infgen.pretrained import builtin_weights
from infgen.tokens.tokenizer import tokenize_scene
from pipeline.commands.screen import show_table
from pipeline.storage.weights import load_network, save_network

POSES = 1 << 17
"""Relative poses that a family is fitted to, at most."""
BATCH = 1 << 13
LEARNING_RATE = 5e-3


@dataclass(frozen=True)
class Family:
    """Relations of one kind, and the layers that read them.

    Attributes:
        name: Name of the embedding in the network.
        layers: Names of the attention layers.
    """

    name: str
    layers: tuple[str, ...]


def embedding_of(network: Network, name: str) -> RelationEmbedding:
    """Return the embedding of a family."""
    part = network.get_submodule(name)
    assert isinstance(part, RelationEmbedding)
    return part


def layer_of(network: Network, name: str) -> Attention:
    """Return an attention layer."""
    part = network.get_submodule(name)
    assert isinstance(part, Attention)
    return part


def families(network: Network) -> list[Family]:
    """List the families of relations of a network."""
    names = [name for name, part in network.named_modules() if isinstance(part, Attention)]

    def of(embedding: str, first: str, last: str) -> Family:
        found = tuple(
            name for name in names if name.startswith(first) and name.endswith(last)
        )
        return Family(embedding, found)

    both = ("cells", "details") if network.cells is not None else ()
    return [
        of("roads.relation", "roads.blocks.", ""),
        of("motion.past_relation", "motion.", ".past"),
        of("motion.roads_relation", "motion.", ".roads"),
        of("motion.agents_relation", "motion.", ".agents"),
        *(of(f"{stack}.roads_relation", f"{stack}.", ".roads") for stack in both),
        *(of(f"{stack}.agents_relation", f"{stack}.", ".agents") for stack in both),
    ]


def batches(network: Network, records: str, count: int) -> Iterator[Batch]:
    """Yield the first scenes of some records, one at a time."""
    settings, motion, roads = (
        network.grid_settings,
        network.motion_vocabulary(),
        network.map_vocabulary(),
    )
    limits = Limits.of(network.settings, TrainSettings(), settings)
    for scene in islice(read_split(records), count):
        yield collate([tokenize_scene(scene, motion, roads, settings)], limits, draw=0)


@torch.no_grad()
def seen_poses(network: Network, scenes: Sequence[Batch]) -> dict[str, Tensor]:
    """Collect the relative poses [pose, scalar] that each family looks up."""
    kept: dict[str, list[Tensor]] = {family.name: [] for family in families(network)}
    parts = {embedding_of(network, name): name for name in kept}
    plain = RelationEmbedding.look_up

    def look_up(self: RelationEmbedding, values: Tensor, table_PD: Tensor) -> Tensor:
        kept[parts[self]].append(values.flatten(0, -2))
        return plain(self, values, table_PD)

    RelationEmbedding.look_up = look_up  # type: ignore[method-assign]
    try:
        for batch in scenes:
            network(batch)
    finally:
        RelationEmbedding.look_up = plain  # type: ignore[method-assign]
    random = torch.Generator().manual_seed(0)
    found = {}
    for name, values in kept.items():
        poses = torch.cat(values)
        embedding = embedding_of(network, name)
        poses = poses[poses[:, 0] <= embedding.spans[0].last]  # Farther ones are not seen.
        found[name] = poses[torch.randperm(len(poses), generator=random)[:POSES]]
    return found


def weighing(network: Network, family: Family) -> Tensor:
    """How much errors [D, D] of wide features change keys and values of all layers."""
    weighed = torch.zeros(1)
    for name in family.layers:
        layer = layer_of(network, name)
        gain, width = layer.norm_relation.weight, layer.query.out_features
        key = layer.relation_key.weight * gain * (width // layer.heads) ** -0.5
        value = layer.relation_value.weight * gain
        weighed = weighed + key.T @ key + value.T @ value
    return weighed.detach()


def fit(
    wide: RelationEmbedding,
    narrow: RelationEmbedding,
    poses: Tensor,
    by: Tensor,
    width: int,
    steps: int,
) -> tuple[Tensor, Tensor, float]:
    """Fit narrow features, and the map from them to the wide ones.

    Returns:
        The map [D, R], what is added [D], and the share of the wide features' variance, as
        the layers weigh it, that is not explained.
    """
    with torch.no_grad():
        table = wide.table()
        wanted = wide.look_up(poses[:, None], table)[:, 0]
    leads = nn.Linear(width, wanted.shape[1])
    learned = [*narrow.parameters(), *leads.parameters()]
    optimizer = torch.optim.Adam(learned, lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    random = torch.Generator().manual_seed(0)
    for _ in range(steps):
        rows = torch.randint(len(poses), (min(BATCH, len(poses)),), generator=random)
        found = leads(narrow.look_up(poses[rows, None], narrow.table())[:, 0])
        error = found - wanted[rows]
        loss = ((error @ by) * error).sum(dim=-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        error = leads(narrow.look_up(poses[:, None], narrow.table())[:, 0]) - wanted
        away = wanted - wanted.mean(dim=0)
        left = ((error @ by) * error).sum() / ((away @ by) * away).sum()
    return leads.weight.detach(), leads.bias.detach(), float(left)


@torch.no_grad()
def fold(wide: Attention, narrow: Attention, leads: Tensor, added: Tensor) -> None:
    """Give a layer for narrow relations the weights of one for wide ones."""
    gain, bias = wide.norm_relation.weight, wide.norm_relation.bias
    for name, parameter in narrow.named_parameters():
        other = wide.get_parameter(name)
        if other.shape == parameter.shape:
            parameter.copy_(other)
    narrow.norm_relation.weight.fill_(1.0)
    narrow.norm_relation.bias.zero_()
    narrow.relation_key.weight.copy_(wide.relation_key.weight * gain @ leads)
    narrow.relation_value.weight.copy_(wide.relation_value.weight * gain @ leads)
    # What is the same for all neighbours cancels out in keys, and is a bias in values.
    narrow.value.bias.add_(wide.relation_value.weight @ (gain * added + bias))


def narrowed(
    network: Network, width: int, scenes: Sequence[Batch], steps: int
) -> tuple[Network, dict[str, float]]:
    """Return a network with narrow relations, and the share of each family lost."""
    torch.manual_seed(0)
    settings = replace(network.settings, relation_width=width)
    other = Network(
        settings,
        network.motion_vocabulary(),
        network.map_vocabulary(),
        network.grid_settings,
    ).eval()
    names = {family.name: family for family in families(network)}
    state = network.state_dict()
    same = {n: t for n, t in other.state_dict().items() if state[n].shape == t.shape}
    other.load_state_dict({n: state[n] for n in same}, strict=False)
    lost = {}
    for name, poses in seen_poses(network, scenes).items():
        family, embedding = names[name], embedding_of(other, name)
        wide = embedding_of(network, name)
        by = weighing(network, family)
        leads, added, lost[name] = fit(wide, embedding, poses, by, width, steps)
        for layer in family.layers:
            fold(layer_of(network, layer), layer_of(other, layer), leads, added)
        print(f"{name}: {lost[name]:.3%} lost", file=sys.stderr)
    return other, lost


@torch.no_grad()
def terms(network: Network, scenes: Sequence[Batch]) -> dict[str, float]:
    """Mean loss of each kind of token."""
    how, total = TrainSettings(label_smoothing=0.0), dict[str, list[Tensor]]()
    for batch in scenes:
        for name, term in losses(network(batch), batch, how).items():
            total.setdefault(name, []).append(torch.stack([term.loss, term.weight]))
    sums = {name: torch.stack(parts).sum(dim=0) for name, parts in total.items()}
    return {name: float(loss / weight) for name, (loss, weight) in sums.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Narrow the relations of weights, and compare."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--width", type=int, default=16)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--weights", type=Path, default=builtin_weights())
    parser.add_argument("--records", default=str(BUILT_IN / "training.tfrecord*"))
    parser.add_argument("--held-out", default=str(BUILT_IN / "validation.tfrecord*"))
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args(arguments)
    torch.set_num_threads(1)
    wide = load_network(asked.weights)
    learned = list(batches(wide, asked.records, asked.scenes))
    other, lost = narrowed(wide, asked.width, learned, asked.steps)
    held_out = list(batches(wide, asked.held_out, asked.scenes))
    before, after = terms(wide, held_out), terms(other, held_out)
    show_table(
        f"relations of width {asked.width} in place of {wide.settings.width}",
        ("loss term", "wide", "narrow"),
        [(name, f"{before[name]:.4f}", f"{after[name]:.4f}") for name in before],
    )
    if asked.out:
        asked.out.mkdir(parents=True, exist_ok=True)
        save_network(asked.out, other, other.state_dict(), step=0)
    print(json.dumps({"lost": lost, "wide": before, "narrow": after}))


if __name__ == "__main__":
    main()
