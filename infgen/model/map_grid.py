"""The map tokens near a place, without looking at all of a map.

A map may be a town of ten thousand tokens, of which a few hundred are near anybody. They
are sorted into squares once per map. Who looks for the nearest looks at the squares around
it, which lie row by row one after the other, and finds exactly what a look at all of them
would find.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor
from torch.nn import functional

from infgen.model.relations import Neighbours, block_length, nearest_listed

SIDE_M = 10.0
"""Of a square."""
MARGIN_M = 0.1
"""Search a little farther than the radius, so that rounding loses nothing at the rim."""
CELL_M = 2.5
"""Side of a cell whose places have one list of tokens."""
HALF_DIAGONAL_M = CELL_M / math.sqrt(2)
KEPT_CELLS = 1 << 14
"""Cells whose lists are kept; a few thousand come up in a rollout of half a minute."""
MANY_ROWS = 64
"""Fewer rows are found their tokens sooner than a list for each."""
LISTED_FOR_ONE = 16
"""About so many tokens are looked at for each of the nearest, while a list is made."""
NUMBER_BITS = 20
"""Of the column and of the row of a cell."""


@dataclass(frozen=True, slots=True)
class _CellLists:
    """Tokens that can be among the nearest of places in cells, for one radius and count.

    Attributes:
        cell: Numbers of the cells, ascending.
        at: Their tokens, named as by ``MapGrid._listed`` [cell, listed].
        length: How many there are of each.
    """

    cell: Int64[Tensor, " cell"]
    at: Int64[Tensor, "cell listed"]
    length: Int64[Tensor, " cell"]

    @classmethod
    def none(cls, like: Int64[Tensor, " row"]) -> "_CellLists":
        """Know no cell yet."""
        return cls(like.new_empty(0), like.new_empty((0, 0)), like.new_empty(0))

    def unknown(self, cell: Int64[Tensor, " asked"]) -> Bool[Tensor, " asked"]:
        """Tell which of some cells have no list."""
        place = torch.searchsorted(self.cell, cell)
        known = functional.pad(self.cell, (0, 1), value=-1)
        return known[place] != cell

    def with_lists(self, others: "_CellLists") -> "_CellLists":
        """Add the lists of other cells."""
        both = self.at, others.at
        wide = max(at.shape[1] for at in both)
        at = torch.cat([functional.pad(at, (0, wide - at.shape[1])) for at in both])
        cell, order = torch.cat([self.cell, others.cell]).sort()
        length = torch.cat([self.length, others.length])
        return _CellLists(cell, at[order], length[order])

    def listed(self, cell: Int64[Tensor, " row"]) -> tuple[Tensor, Tensor]:
        """Tokens of known cells [row, listed], and which there are."""
        place = torch.searchsorted(self.cell, cell)
        length = self.length[place]
        longest = int(length.max()) if len(length) else 0
        there = torch.arange(longest, device=cell.device) < length[:, None]
        return self.at[:, :longest].index_select(0, place), there


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
        lists: Lists of cells by radius and count, as far as they were requested.
    """

    corner_m: Float32[Tensor, "scene 2"]
    size: tuple[int, int]
    start: Int64[Tensor, "scene bound"]
    order: Int64[Tensor, "scene road"]
    xy_m: Float32[Tensor, "scene road 2"]
    longest: dict[int, int] = field(default_factory=dict)
    lists: dict[tuple[float, int], _CellLists] = field(default_factory=dict)

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
        list_tokens = self._lister(xy_m, scene, radius_m, count, itself)
        across = math.ceil(2 * radius_m / SIDE_M) + 1
        block = block_length(across * across * 4, xy_m.device)

        def listed(begin: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
            part = slice(begin, begin + block)
            at, there = list_tokens(part)
            place = self.order.flatten().index_select(0, at.flatten()).view_as(at)
            if itself is not None:
                there &= place != itself[part, None]
            return xy_m[part], self._positions_m(at), place, there

        # One at a time: what a part lists stays in the cache until it is searched.
        parts = map(listed, range(0, max(1, len(xy_m)), block))
        return nearest_listed(parts, radius_m, count)

    def _lister(
        self,
        xy_m: Tensor,
        scene: Tensor,
        radius_m: float,
        count: int,
        itself: Tensor | None,
    ) -> Callable[[slice], tuple[Tensor, Tensor]]:
        """Return what lists tokens for some rows: by cells on a CPU, else by squares."""
        many = xy_m.device.type == "cpu" and len(xy_m) >= MANY_ROWS
        if many and itself is None:
            cell = self._cells(xy_m, scene)
            asked: Tensor = torch.unique(cell)
            if len(asked) <= KEPT_CELLS:
                lists = self._lists_of(asked, radius_m, count)
                return lambda part: lists.listed(cell[part])
        return lambda part: self._listed(xy_m[part], scene[part], radius_m)

    def _cells(self, xy_m: Tensor, scene: Tensor) -> Int64[Tensor, " row"]:
        """Number the cells that places on maps lie in."""
        at = ((xy_m - self.corner_m[scene]) / CELL_M).floor().long()
        column, row = (at + (1 << NUMBER_BITS - 1)).clamp(0, (1 << NUMBER_BITS) - 1).T
        return ((scene << NUMBER_BITS) + row << NUMBER_BITS) + column

    def _lists_of(
        self, asked: Int64[Tensor, " asked"], radius_m: float, count: int
    ) -> _CellLists:
        """Return lists that have all cells [asked]; forget others if they are too many."""
        lists = self.lists.get((radius_m, count), _CellLists.none(asked))
        if len(lists.cell) + len(asked) > KEPT_CELLS:
            lists = _CellLists.none(asked)
        new = asked[lists.unknown(asked)]
        block = block_length(LISTED_FOR_ONE * count, asked.device)
        for begin in range(0, len(new), block):
            some = self._list_cells(new[begin : begin + block], radius_m, count)
            lists = lists.with_lists(some)
        self.lists[radius_m, count] = lists
        return lists

    def _list_cells(
        self, cell: Int64[Tensor, " cell"], radius_m: float, count: int
    ) -> _CellLists:
        """List the tokens that can be among the ``count`` nearest of a place in a cell.

        They are within its half diagonal of what the place sees; and if ``count`` tokens
        are within some distance of the centre, within that and the diagonal of the centre.
        """
        low = (1 << NUMBER_BITS) - 1
        number = torch.stack([cell & low, (cell >> NUMBER_BITS) & low], dim=-1)
        scene = cell >> 2 * NUMBER_BITS
        away_m = (number - (1 << NUMBER_BITS - 1) + 0.5) * CELL_M
        centre_m = self.corner_m[scene] + away_m
        far_m = radius_m + HALF_DIAGONAL_M + MARGIN_M
        at, there = self._listed(centre_m, scene, far_m)
        gap_m = (self._positions_m(at) - centre_m[:, None]).square_().sum(dim=-1).sqrt_()
        gap_m.masked_fill_(~there, math.inf)
        limit_m = gap_m.new_full((len(cell), 1), far_m)
        if at.shape[1] >= count:
            held_m = gap_m.kthvalue(count, dim=-1, keepdim=True).values
            limit_m = limit_m.minimum(held_m + 2 * HALF_DIAGONAL_M + MARGIN_M)
        kept = gap_m <= limit_m
        length = kept.sum(dim=-1)
        rank = kept.cumsum(dim=-1) - 1
        row, listed = kept.nonzero().T
        lists = at.new_zeros((len(cell), int(length.max()) if len(cell) else 0))
        lists[row, rank[row, listed]] = at[row, listed]
        return _CellLists(cell, lists, length)

    def _positions_m(self, at: Int64[Tensor, "row listed"]) -> Tensor:
        """Where listed tokens are [row, listed, 2]."""
        # A pair of numbers at a time: the look-up costs as much as the search.
        pairs = torch.view_as_complex(self.xy_m).flatten()
        found = torch.view_as_real(pairs.index_select(0, at.flatten()))
        return found.view(*at.shape, 2)

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
