"""Find what a loop need not carry, because it follows from what the loop carries anyway."""

from collections.abc import Hashable

from onekernel.lower.scalar_ir import (
    Branch,
    Expr,
    ExprGraph,
    Loop,
    Scalar,
    identity,
    is_constant,
    is_same,
)

_PairKey = tuple[Hashable, ...]
_Branches = dict[tuple[int, int], list[Scalar]]


def find_derived(graph: ExprGraph, loop: Loop, carried: set[int]) -> dict[int, Scalar]:
    """Find carried values of a loop that are functions of other carried values.

    A carried value is derived if it is the same function of the others before the first iteration
    and after every iteration. Example: a loop carries x and y, starts with y = f(x₀), and ends each
    iteration with y = f(x). Then y need not be carried, but is f(x) at the start of an iteration.
    The two expressions are compared operation by operation.

    Returns:
      How each derived value is computed from the others, by its place.
    """
    derived: dict[int, Scalar] = {}
    branches: _Branches = {}
    known: dict[_PairKey, Scalar] = {}
    # Begin with the values that were recorded first, because others may be derived from them.
    for place in sorted(carried, key=lambda k: _index(loop.updated[k])):
        # If an earlier place has the same two values, take its value; otherwise try to rebuild both
        # values from what is known at the start of an iteration.
        pair = loop.initial[place], loop.updated[place]
        found = known.get(_pair_key(pair))
        if found is None:
            found = _matched(graph, known, branches, *pair)
        if found is not None:
            derived[place] = found
        # From here on, this pair is computed from the carried or derived value.
        known[_pair_key(pair)] = loop.carries[place] if found is None else found
    return derived


def _matched(
    graph: ExprGraph,
    known: dict[_PairKey, Scalar],
    branches: _Branches,
    before: Scalar,
    after: Scalar,
) -> Scalar | None:
    """Return one expression for both `before` and `after`; None if there is none.

    Args:
      graph: the graph, to which the expression is added.
      known: for pairs of a value before the loop and after an iteration, the scalar that has this
        value at the start of every iteration.
      branches: the results of the branches that have been added for two equal ones.
      before: a carried value before the first iteration.
      after: the same value after an iteration.
    """
    # Walk down both expressions at once, with a stack instead of recursion: they may be thousands
    # of operations deep. A pair stays on the stack until all pairs of its operands are found.
    pending = [(before, after)]
    found: dict[_PairKey, Scalar | None] = {}
    while pending:
        pair = pending[-1]
        key = _pair_key(pair)
        if key in known or key in found:
            pending.pop()
            continue
        # An operation on different values matches if all of its operands do.
        parts = _parts(branches, *pair)
        if parts is None:
            # The two have no common operation, so the expressions that contain them differ.
            return None
        # Each operand is the same scalar on both sides, a known pair, a pair found before, or still
        # missing.
        operands, missing = [], []
        for part in parts:
            key_of_part = None if is_same(*part) else _pair_key(part)
            if key_of_part is None:
                operands.append(part[0])
            elif key_of_part in known:
                operands.append(known[key_of_part])
            elif key_of_part in found:
                operands.append(found[key_of_part])
            else:
                missing.append(part)
        if missing:
            pending += missing
            continue
        # All operands are there: record the operation once more, on them.
        found[key] = _repeated(graph, branches, pair, operands)
        pending.pop()
    return found[_pair_key((before, after))]


def _repeated(
    graph: ExprGraph, branches: _Branches, pair: tuple[Scalar, Scalar], operands: list[Scalar]
) -> Scalar:
    """Record what a pair has in common once more, on the operands that `_parts` asked for."""
    one, other = pair
    assert isinstance(one, Expr)
    assert isinstance(other, Expr)
    if not isinstance(other.owner, Branch):
        return graph.repeat(other, operands)
    assert one.owner is not None
    # A branch is recorded with all of its results, and once.
    both = one.owner.index, other.owner.index
    if both not in branches:
        condition, *sides = operands
        half = len(sides) // 2
        branches[both] = graph.branch(condition, sides[:half], sides[half:])
    return branches[both][other.place]


def _parts(
    branches: _Branches, before: Scalar, after: Scalar
) -> list[tuple[Scalar, Scalar]] | None:
    """Return the operands of two equal operations in pairs; None if the operations differ.

    Those of a branch are its condition and all of its sides, or none if it is there already.
    """
    if is_constant(before) or is_constant(after):
        return None
    one, other = before.owner, after.owner
    if isinstance(one, Branch) and isinstance(other, Branch) and before.place == after.place:
        if (one.index, other.index) in branches:
            return []
        parts = [[x.condition, *x.if_false, *x.if_true] for x in (one, other)]
        # A branch of another size is another branch.
        return list(zip(*parts, strict=True)) if len(parts[0]) == len(parts[1]) else None
    if not before.operands:
        return None
    if before.op != after.op or before.dtype != after.dtype or before.op == "input":
        return None
    # Arrays may have different lengths.
    if len(before.operands) != len(after.operands):
        return None
    return list(zip(before.operands, after.operands, strict=True))


def _pair_key(pair: tuple[Scalar, Scalar]) -> _PairKey:
    """Return a key that two pairs share if they are the same operations or equal constants."""
    before, after = pair
    return identity(before), identity(after)


def _index(x: Scalar) -> int:
    return -1 if is_constant(x) else x.index
