"""Search for pairs of boxes that meet, with binary trees of boxes.

The trees are built over the boxes in the given order. Boxes of consecutive edges of a curve make a tight tree, whatever
the scale of the parts of the curve. So the cost for such boxes is about proportional to the number of boxes and of
pairs found.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray, invert_indices, repeat_each

# Levels of a box tree, from the root, whose pairs are enumerated directly.
_SKIPPED_LEVELS = 5
# Maximum number of pairs of boxes in a portion, except the first one, which has all pairs of its level.
PAIR_CHUNK = 1 << 17


def box_pairs(lo: FloatArray, hi: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield pairs ``i < j`` of closed boxes in the plane or in space that meet, in portions, each pair once.

    A binary tree over the boxes *in the given order* is traversed against itself. Pairs of the same level are processed
    together, in portions of at most `PAIR_CHUNK` pairs. The deepest portion is processed first.
    """
    tree = _box_tree(lo, hi, max(len(lo) - 1, 0).bit_length())
    for i, j in _find_meeting_boxes(tree, tree):
        yield i[i < j], j[i < j]


def box_pairs_within(lo: FloatArray, hi: FloatArray, starts: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield pairs of closed boxes of the same group that meet; equals `box_pairs` of each group.

    The boxes are sorted by group. ``starts`` (g + 1,) has the start of each group, and the end of the last one.
    """
    sizes, groups = np.diff(starts), len(starts) - 1
    depth = int(max(sizes.max(initial=1) - 1, 0)).bit_length()
    # Each group has its own tree. All trees have the same depth.
    leaf = np.arange(len(lo)) + repeat_each((np.arange(groups) << depth) - starts[:-1], sizes)
    number = invert_indices(groups << depth, leaf)
    leaves = np.full((2, groups << depth, 2), np.array([np.inf, -np.inf])[:, None, None])
    leaves[0, leaf], leaves[1, leaf] = lo, hi
    tree = _box_tree(leaves[0], leaves[1], depth)
    for i, j in _find_meeting_boxes(tree, tree):
        yield number[i[i < j]], number[j[i < j]]


def box_pairs_between(
    lo: FloatArray, hi: FloatArray, other_lo: FloatArray, other_hi: FloatArray
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield pairs of closed boxes that meet, the first of one set and the second of another; as `box_pairs`."""
    depth = max(len(lo) - 1, len(other_lo) - 1, 0).bit_length()
    yield from _find_meeting_boxes(_box_tree(lo, hi, depth), _box_tree(other_lo, other_hi, depth))


_BoxTree = list[tuple[FloatArray, FloatArray]]


def _box_tree(lo: FloatArray, hi: FloatArray, depth: int) -> _BoxTree:
    """Build a box tree from leaves to roots: each level has boxes around two boxes of the previous level."""
    # Pad with empty boxes, which do not meet any box.
    padding = ((0, max((1 << depth) - len(lo), 0)), (0, 0))
    tree = [(np.pad(lo, padding, constant_values=np.inf), np.pad(hi, padding, constant_values=-np.inf))]
    for _ in range(depth):
        lo, hi = tree[-1]
        tree.append((np.minimum(lo[::2], lo[1::2]), np.maximum(hi[::2], hi[1::2])))
    return tree


def _find_meeting_boxes(one: _BoxTree, other: _BoxTree) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs of leaves that meet, of two trees of the same depth; for a tree with itself, only ``i ≤ j``.

    With several roots, only leaves below the same root are compared.
    """
    # The first few levels have so few boxes that testing all pairs is faster than a traversal.
    depth, roots = len(one) - 1, np.arange(len(one[-1][0]))
    skipped = min(depth, _SKIPPED_LEVELS)
    number = np.arange(1 << skipped)
    i, j = (part.ravel() for part in np.broadcast_arrays(number[:, None], number))
    if one is other:
        i, j = i[i <= j], j[i <= j]
    i, j = ((np.add.outer(roots << skipped, part)).ravel() for part in (i, j))
    # Process the deepest portion first, so that the stack stays small for any number of pairs.
    waiting = [(depth - skipped, i, j)]
    while waiting:
        level, i, j = waiting.pop()
        (lo, hi), (other_lo, other_hi) = one[level], other[level]
        found = (lo.take(i, 0) <= other_hi.take(j, 0)) & (other_lo.take(j, 0) <= hi.take(i, 0))
        meet = found[:, 0] & found[:, 1]
        if found.shape[1] == 3:
            meet &= found[:, 2]
        i, j = i[meet], j[meet]
        if level == 0:
            yield i, j
            continue
        i = np.concatenate([2 * i, 2 * i, 2 * i + 1, 2 * i + 1])
        j = np.concatenate([2 * j, 2 * j + 1, 2 * j, 2 * j + 1])
        if one is other:
            i, j = i[i <= j], j[i <= j]
        for start in range(0, i.size, PAIR_CHUNK):
            chunk = slice(start, start + PAIR_CHUNK)
            waiting.append((level - 1, i[chunk], j[chunk]))
