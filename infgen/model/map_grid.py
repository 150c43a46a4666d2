"""The map tokens near a place, without looking at all of a map.

A map may be a town of ten thousand tokens, of which a few hundred are near anybody. They
are sorted into squares once per map. Who looks for the nearest looks at the squares around
it, which lie row by row one after the other, and finds exactly what a look at all of them
would find.
"""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from infgen.model.relations import Neighbours, block_length, nearest_listed

SIDE_M = 10.0
"""Of a square."""
MARGIN_M = 0.1
"""Search a little farther than the radius, so that rounding loses nothing at the rim."""


@dataclass(frozen=True, slots=True)
class MapGrid:
    """Map tokens of some maps, sorted into squares.

    Attributes:
        corner_m: Corner of each map's first square.
        size: Squares along x and y: of the largest map.
        start: Where each square's tokens begin in ``order``, all maps' one after the other;
            then where they end.
        order: Tokens by square, those that are none last.
        xy_m: Where the tokens are, in the order of ``order``.
        longest: Most tokens of so many consecutive squares, as far as it is known.
    """

    corner_m: Float32[Tensor, "scene 2"]
    size: tuple[int, int]
    start: Int64[Tensor, "scene bound"]
    order: Int64[Tensor, "scene road"]
    xy_m: Float32[Tensor, "scene road 2"]
    longest: dict[int, int] = field(default_factory=dict)

    @classmethod
    @torch.no_grad()
    def of(
        cls, pose: Float32[Tensor, "scene road 3"], real: Bool[Tensor, "scene road"]
    ) -> "MapGrid":
        """Sort the real tokens of maps."""
        xy_m = pose[..., :2].contiguous()
        shown_m = torch.where(real[..., None], xy_m, torch.inf)
        corner_m = shown_m.amin(dim=1) if real.shape[1] else xy_m.new_zeros(len(xy_m), 2)
        corner_m = torch.where(corner_m.isfinite(), corner_m, 0.0)
        token_step, row = _squares(xy_m - corner_m[:, None]).unbind(-1)
        columns = 1 + int(token_step[real].max()) if real.any() else 1
        rows = 1 + int(row[real].max()) if real.any() else 1
        square = torch.where(real, row * columns + token_step, rows * columns)
        ordered, order = square.sort(dim=1, stable=True)
        squares = torch.arange(rows * columns + 1, device=pose.device)
        start = torch.searchsorted(ordered, squares.expand(len(pose), -1).contiguous())
        maps = torch.arange(len(pose), device=pose.device)[:, None]
        start += maps * order.shape[1]
        ordered_m = xy_m.gather(1, order[..., None].expand_as(xy_m))
        return cls(corner_m, (columns, rows), start, order, ordered_m)

    def measure(self, squares: int) -> None:
        """Find the most tokens of up to so many consecutive squares, on the host."""
        for each in range(1, squares + 1):
            self._most_held(each)

    @torch.no_grad()
    def nearest(
        self,
        xy_m: Float32[Tensor, "row 2"],
        scene: Int64[Tensor, " row"],
        radius_m: float,
        count: int,
        *,
        itself: Int64[Tensor, " row"] | None = None,
    ) -> Neighbours:
        """Find the ``count`` nearest tokens of each row's map, as ``relations.nearest``.

        Args:
            xy_m: From where.
            scene: On which map.
            radius_m: How far.
            count: How many.
            itself: A token that does not count.

        Returns:
            Neighbours of a single group.
        """
        count = min(count, self.order.shape[1])
        if not count:
            empty = scene.new_zeros((1, len(scene), 0))
            return Neighbours(empty, empty.bool())
        across = math.ceil(2 * radius_m / SIDE_M) + 1
        block = block_length(across * across * 4, xy_m.device)

        def listed(begin: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            part = slice(begin, begin + block)
            at, there = self._listed(xy_m[part], scene[part], radius_m)
            place = self.order.flatten().index_select(0, at.flatten()).view_as(at)
            # A pair of numbers at a time: the look-up costs as much as the search.
            pairs = torch.view_as_complex(self.xy_m).flatten()
            listed_m = torch.view_as_real(pairs.index_select(0, at.flatten()))
            if itself is not None:
                there &= place != itself[part, None]
            return xy_m[part], listed_m.view(*at.shape, 2), place, there

        # One at a time: what a part lists stays in the cache until it is searched.
        parts = map(listed, range(0, max(1, len(xy_m)), block))
        return nearest_listed(parts, radius_m, count)

    def _listed(
        self, xy_m: Tensor, scene: Tensor, radius_m: float
    ) -> tuple[Tensor, Tensor]:
        """Tokens [row, listed] of the squares that a circle touches; which there are.

        They are named by where all maps' tokens, one map after the other, are in ``order``.
        """
        columns, rows = self.size
        here_m, reach_m = xy_m - self.corner_m[scene], radius_m + MARGIN_M
        ends_m = torch.stack([here_m - reach_m, here_m + reach_m])
        low, high = _squares(ends_m).unbind()
        left = low[:, 0].clamp(0, columns)
        right = high[:, 0].clamp(-1, columns - 1) + 1
        most = math.ceil(2 * reach_m / SIDE_M) + 1
        row = low[:, 1:] + torch.arange(most, device=xy_m.device)  # [target, row]
        touched = (row >= 0) & (row < rows) & (row <= high[:, 1:])
        touched &= (left < right)[:, None]
        # Those of rows that are not touched are not used, but must be there.
        first = row.clamp(0, rows - 1) * columns
        # One by one: a row of all of a map's squares for each target would be large.
        begin = self.start[scene[:, None], first + left[:, None]]
        end = self.start[scene[:, None], first + right[:, None]]
        length = (end - begin) * touched
        longest = self._longest(length, most)
        steps = torch.arange(longest, device=row.device)
        there = steps < length[..., None]  # [target, row, step]
        at = torch.where(there, begin[..., None] + steps, 0).flatten(1)
        return at, there.flatten(1)

    def _longest(self, length: Tensor, squares: int) -> int:
        """Most tokens of one row of so many squares, of those asked for or of the map.

        On a CPU what is asked for is looked at. Elsewhere the host would wait for it at
        each token step, so there it is the most that any row of any map has.
        """
        if length.device.type == "cpu":
            return max(1, int(length.max())) if length.numel() else 1
        return self._most_held(squares)

    def _most_held(self, squares: int) -> int:
        if squares not in self.longest:
            ends = self.start[:, min(squares, self.start.shape[1] - 1) :]
            held = ends - self.start[:, : ends.shape[1]]
            self.longest[squares] = max(1, int(held.max())) if held.numel() else 1
        return self.longest[squares]


def _squares(away_m: Tensor) -> Tensor:
    return (away_m / SIDE_M).floor().long()
