"""Place each recorded operation in a block of the program.

An `ExprGraph` records dependencies, not an order of execution. This module places every operation
in a block: outside of all loops that it does not depend on, and inside a branch if only one side of
the branch needs it.

Source: C. Click, Global Code Motion / Global Value Numbering, PLDI 1995, with blocks that are
nested instead of a control-flow graph.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from typing import TypeAlias

from onekernel.lower.scalar_ir import Branch, Expr, Loop, Scalar, is_constant, is_table

Item: TypeAlias = "Expr | PlacedLoop | PlacedBranch"
_Node: TypeAlias = Expr | Loop | Branch

_OF_ITERATION = ("carry", "counter")
"""Operations whose value a loop gives to an iteration."""

_AFTERWARDS = ("result", "stack")
"""Operations whose value is there after a loop or branch."""

_CHEAP = ("abs", "add", "max", "min", "mul", "neg", "sub")
"""Operations on floats that cost less than a register."""


@dataclasses.dataclass(eq=False, repr=False)
class Block:
    """A `Block` holds operations that are executed one after the other."""

    parent: "Block | None" = None
    """The enclosing block, whose values this block can use; None: the outermost block."""
    loop: Loop | None = None
    """The loop whose head (see `PlacedLoop`) is this block; None for all other blocks."""
    items: list[Item] = dataclasses.field(default_factory=list)

    def ancestors(self) -> "Iterator[Block]":
        """Yield this block and all enclosing blocks, the innermost first."""
        block: Block | None = self
        while block is not None:
            yield block
            block = block.parent

    def values(self) -> Iterator[Expr]:
        """Yield all operations of this block and of the blocks inside it."""
        for item in self.items:
            if isinstance(item, Expr):
                yield item
            else:
                for block in item.blocks:
                    yield from block.values()

    def arrays(self) -> Iterator[list[Expr]]:
        """Yield the arrays in memory, here and in the blocks inside, but those of constants.

        Those to which a loop adds are together.
        """
        for item in self.items:
            if isinstance(item, Expr):
                if item.op == "array" and not is_table(item):
                    yield [item]
            else:
                if isinstance(item, PlacedLoop) and item.stacks:
                    yield item.stacks
                for block in item.blocks:
                    yield from block.arrays()


@dataclasses.dataclass(eq=False, repr=False)
class PlacedLoop:
    """A `PlacedLoop` is a loop whose `head` computes the condition and `body` the iteration."""

    loop: Loop
    places: list[int]
    """Indices of the carries that are needed; the others are not computed."""
    results: list[Expr]
    """The results that are needed."""
    stacks: list[Expr]
    """The arrays with a scalar of every iteration that are needed."""
    head: Block
    body: Block

    @property
    def blocks(self) -> tuple[Block, Block]:
        """Return the blocks inside."""
        return self.head, self.body


@dataclasses.dataclass(eq=False, repr=False)
class PlacedBranch:
    """A `PlacedBranch` is a branch with a block for each side."""

    branch: Branch
    results: list[Expr]
    """The results that are needed."""
    if_false: Block
    if_true: Block

    @property
    def blocks(self) -> tuple[Block, Block]:
        """Return the blocks inside."""
        return self.if_false, self.if_true


def schedule(outputs: Iterable[Scalar]) -> Block:
    """Place all operations that the outputs depend on.

    Args:
      outputs: the scalars that the program returns; constants are not placed.

    Returns:
      The outermost block. Every operand of an item precedes it in the same block or in an enclosing
      one.
    """
    return _Scheduler().schedule([x for x in outputs if not is_constant(x)])


def recomputable(loop: PlacedLoop) -> frozenset[int]:
    """Return which values from before a loop follow from others that the loop uses, too.

    A value that a loop uses occupies a register during all iterations. One that takes a single
    operation on values which are there anyway can be computed inside instead.

    Args:
      loop: the loop.

    Returns:
      The indices of these values.
    """
    outside = _from_before(loop)
    return frozenset(
        index
        for index, x in outside.items()
        if x.op in _CHEAP
        and x.dtype.kind == "f"
        and all(operand.index in outside for operand in _expressions(x.operands))
    )


def most_kept(block: Block) -> int:
    """Return the most numbers that one of a block's loops keeps during its iterations.

    That is how many registers it needs, besides those for what an iteration computes.
    """
    return max(
        (
            len(item.places) + len(_from_before(item).keys() - recomputable(item))
            for item in block.items
            if isinstance(item, PlacedLoop)
        ),
        default=0,
    )


def _from_before(loop: PlacedLoop) -> dict[int, Expr]:
    """Return the values from before a loop that it uses, by their indices."""
    read: dict[int, Expr] = {}
    made: set[int] = set()
    pending: list[Item] = [loop]
    while pending:
        item = pending.pop()
        if isinstance(item, Expr):
            scalars, values = item.operands, [item]
        elif isinstance(item, PlacedBranch):
            branch, values = item.branch, item.results
            sides = [side[x.place] for x in values for side in (branch.if_false, branch.if_true)]
            scalars = [branch.condition, *sides]
        else:
            scalars, values = _read_by_loop(item, is_outermost=item is loop), _made_by_loop(item)
        read |= {x.index: x for x in _expressions(scalars)}
        made |= {x.index for x in values}
        if not isinstance(item, Expr):
            pending += [inner for block in item.blocks for inner in block.items]
    return {index: x for index, x in read.items() if index not in made}


def _read_by_loop(item: PlacedLoop, *, is_outermost: bool) -> list[Scalar]:
    """Return the scalars that a loop itself reads; the outermost one reads initial ones before."""
    loop = item.loop
    return [
        loop.condition,
        *(loop.initial[place] for place in item.places if not is_outermost),
        *(loop.updated[place] for place in item.places),
        *(loop.results[result.place] for result in item.results),
        *(loop.stacked[stack.place] for stack in item.stacks),
    ]


def _made_by_loop(item: PlacedLoop) -> list[Expr]:
    counter = [item.loop.counter] if item.loop.counter is not None else []
    return [*item.loop.carries, *counter, *item.results, *item.stacks]


class _Scheduler:
    """A `_Scheduler` places operations from the last to the first, so that users come first."""

    def __init__(self) -> None:
        # A node is an operation, a loop or a branch. All tables are by the index of a node. The
        # first one has all nodes that an output needs.
        self._reached: dict[int, _Node] = {}
        # The needed results of each loop or branch, and the needed arrays of a loop and the places
        # of its needed carries.
        self._results: dict[int, list[Expr]] = {}
        self._stacks: dict[int, list[Expr]] = {}
        self._carries: dict[int, list[int]] = {}
        # Indices of the loops whose iterations a node depends on: it must be inside of them.
        self._loops: dict[int, frozenset[int]] = {}
        # The innermost block that encloses all uses of a node that are placed so far.
        self._use: dict[int, Block] = {}

    def schedule(self, outputs: list[Expr]) -> Block:
        root = Block()
        # Find the loops that each operation depends on, in the order of recording.
        self._reach(outputs)
        nodes = sorted(self._reached.values(), key=lambda node: node.index)
        for node in nodes:
            # A node depends on the loops of its inputs, and a carry or counter on its own loop.
            # Behind a loop, its results no longer do.
            inputs = [self._loops[x.index] for x in self._inputs(node)]
            own = {node.index} if isinstance(node, Loop) else set()
            carried = {self._owner(node).index} if _op(node) in _OF_ITERATION else set()
            self._loops[node.index] = frozenset().union(*inputs, carried) - own
        # Place the operations in reverse order, so that all users of one are placed before it.
        self._add_uses(root, outputs)
        blocks = [root]
        for node in reversed(nodes):
            if isinstance(node, Expr):
                self._place_value(node)
            else:
                blocks += self._place_control(node)
        for block in blocks:
            block.items.reverse()
        return root

    def _reach(self, outputs: list[Expr]) -> None:
        # A stack instead of recursion, since chains of operations are thousands long.
        pending: list[_Node] = list(outputs)
        while pending:
            node = pending.pop()
            if node.index in self._reached:
                continue
            self._reached[node.index] = node
            if isinstance(node, Expr) and node.owner is not None:
                pending += self._reach_owned(node)
            elif isinstance(node, Expr):
                pending += _expressions(node.operands)
            else:
                pending += _expressions([node.condition])

    def _reach_owned(self, value: Expr) -> list[_Node]:
        owner, place = self._owner(value), value.place
        if value.op == "carry":
            assert isinstance(owner, Loop)
            # A carry needs its first value and the one at the end of an iteration.
            self._carries.setdefault(owner.index, []).append(place)
            return [owner, *_expressions([owner.initial[place], owner.updated[place]])]
        if value.op == "counter":
            return [owner]
        if value.op == "stack":
            assert isinstance(owner, Loop)
            self._stacks.setdefault(owner.index, []).append(value)
            return [owner, *_expressions([owner.stacked[place]])]
        # A result needs what it is inside of the loop, or on both sides of the branch.
        self._results.setdefault(owner.index, []).append(value)
        sides = (
            [owner.results[place]]
            if isinstance(owner, Loop)
            else [owner.if_false[place], owner.if_true[place]]
        )
        return [owner, *_expressions(sides)]

    def _owner(self, value: _Node) -> Loop | Branch:
        assert isinstance(value, Expr)
        assert value.owner is not None
        return value.owner

    def _inputs(self, node: _Node) -> list[_Node]:
        """Return all dependencies of a node, except the next value of a carry of the same loop."""
        if isinstance(node, Expr):
            if node.op in _OF_ITERATION:
                return []
            is_owned = node.op in _AFTERWARDS
            return [self._owner(node)] if is_owned else [*_expressions(node.operands)]
        results = [value.place for value in self._results.get(node.index, [])]
        if isinstance(node, Branch):
            sides = [side[place] for place in results for side in (node.if_false, node.if_true)]
            return [*_expressions([node.condition, *sides])]
        places = self._carries.get(node.index, [])
        scalars = [side[place] for place in places for side in (node.initial, node.updated)]
        scalars += [node.stacked[x.place] for x in self._stacks.get(node.index, [])]
        return [*_expressions([node.condition, *scalars, *(node.results[i] for i in results)])]

    def _place_value(self, value: Expr) -> None:
        # Inputs, carries and counters are there when their block begins.
        if value.op == "input" or value.op in _OF_ITERATION:
            return
        # A result or stack is computed where its loop or branch is.
        if value.op in _AFTERWARDS:
            self._add_uses(self._use[value.index], [self._owner(value)])
            return
        block = self._place(value)
        block.items.append(value)
        self._add_uses(block, _expressions(value.operands))

    def _place_control(self, node: Loop | Branch) -> tuple[Block, Block]:
        block = self._place(node)
        results = sorted(self._results.get(node.index, []), key=lambda value: value.place)
        places = [value.place for value in results]
        if isinstance(node, Branch):
            if_false, if_true = Block(block), Block(block)
            block.items.append(PlacedBranch(node, results, if_false, if_true))
            self._add_uses(block, _expressions([node.condition]))
            self._add_uses(if_false, _expressions(node.if_false[place] for place in places))
            self._add_uses(if_true, _expressions(node.if_true[place] for place in places))
            return if_false, if_true
        # The condition is computed in the head, which runs once more than the body. The body is
        # inside of it, and so can use what the head computes.
        head = Block(block, node)
        body = Block(head)
        carries = sorted(self._carries.get(node.index, []))
        stacks = sorted(self._stacks.get(node.index, []), key=lambda value: value.place)
        block.items.append(PlacedLoop(node, carries, results, stacks, head, body))
        self._add_uses(block, _expressions(node.initial[place] for place in carries))
        self._add_uses(
            head, _expressions([node.condition, *(node.results[place] for place in places)])
        )
        self._add_uses(body, _expressions(node.updated[place] for place in carries))
        self._add_uses(body, _expressions(node.stacked[stack.place] for stack in stacks))
        return head, body

    def _place(self, node: _Node) -> Block:
        """Return the innermost block that encloses all users, outside of independent loops."""
        block = self._use[node.index]
        for head in [x for x in block.ancestors() if x.loop is not None]:
            assert head.loop is not None
            if head.loop.index in self._loops[node.index]:
                break
            assert head.parent is not None
            block = head.parent
        return block

    def _add_uses(self, block: Block, nodes: Iterable[_Node]) -> None:
        for node in nodes:
            # A node with several users belongs to the innermost block around all of them.
            known = self._use.setdefault(node.index, block)
            if known is not block:
                self._use[node.index] = _common_ancestor(known, block)


def _expressions(scalars: Iterable[Scalar]) -> list[Expr]:
    return [x for x in scalars if not is_constant(x)]


def _op(node: _Node) -> str:
    return node.op if isinstance(node, Expr) else ""


def _common_ancestor(one: Block, other: Block) -> Block:
    """Return the innermost block that contains both blocks."""
    # Go up from the other block until a block that is around the first one, too.
    around = set(map(id, one.ancestors()))
    return next(block for block in other.ancestors() if id(block) in around)
