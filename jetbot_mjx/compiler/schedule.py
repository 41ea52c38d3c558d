"""Place each recorded operation in a block of the program.

An `ExprGraph` says what depends on what, not when it is computed. Here every operation gets a
place: out of all loops that it does not depend on, and into a branch if nothing outside the branch
needs it.

Source: C. Click, Global Code Motion / Global Value Numbering, PLDI 1995, with blocks that are
nested instead of a control-flow graph.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from typing import TypeAlias

from jetbot_mjx.compiler.scalar_ir import Branch, Expr, Loop, Scalar, is_constant

Item: TypeAlias = "Expr | PlacedLoop | PlacedBranch"
_Node: TypeAlias = Expr | Loop | Branch


@dataclasses.dataclass(eq=False)
class Block:
    """A `Block` holds operations that are executed one after the other."""

    parent: "Block | None" = None
    """The block that this one lies in, whose numbers it can use."""
    loop: Loop | None = None
    """The loop that begins here, if one does."""
    items: list[Item] = dataclasses.field(default_factory=list)

    def ancestors(self) -> "Iterator[Block]":
        """Yield this block and all that it lies in, the innermost first."""
        block: Block | None = self
        while block is not None:
            yield block
            block = block.parent

    def values(self) -> Iterator[Expr]:
        """Yield all operations of this block and of those inside it."""
        for item in self.items:
            if isinstance(item, Expr):
                yield item
            else:
                for block in item.blocks:
                    yield from block.values()


@dataclasses.dataclass(eq=False)
class PlacedLoop:
    """A loop: `head` computes the condition of an iteration, `body` the iteration."""

    loop: Loop
    places: list[int]
    """Which carries are needed; the others are not computed."""
    results: list[Expr]
    """Which results are needed."""
    head: Block
    body: Block

    @property
    def blocks(self) -> tuple[Block, Block]:
        """Return the blocks inside."""
        return self.head, self.body


@dataclasses.dataclass(eq=False)
class PlacedBranch:
    """A branch and the block of each side."""

    branch: Branch
    results: list[Expr]
    """Which results are needed."""
    no: Block
    yes: Block

    @property
    def blocks(self) -> tuple[Block, Block]:
        """Return the blocks inside."""
        return self.no, self.yes


def schedule(outputs: Iterable[Scalar]) -> Block:
    """Place all operations that the outputs depend on.

    Args:
      outputs: the scalars that the program returns; constants need no place.

    Returns:
      The outermost block. Every operand of an item stands before it or in a block around it.
    """
    return _Scheduler().schedule([x for x in outputs if not is_constant(x)])


class _Scheduler:
    def __init__(self) -> None:
        self._reached: dict[int, _Node] = {}
        self._results: dict[int, list[Expr]] = {}
        self._carries: dict[int, list[int]] = {}
        self._loops: dict[int, frozenset[int]] = {}
        self._use: dict[int, Block] = {}

    def schedule(self, outputs: list[Expr]) -> Block:
        root = Block()
        self._reach(outputs)
        nodes = sorted(self._reached.values(), key=lambda node: node.index)
        for node in nodes:
            inputs = [self._loops[x.index] for x in self._inputs(node)]
            own = {node.index} if isinstance(node, Loop) else set()
            carried = {self._owner(node).index} if _op(node) == "carry" else set()
            self._loops[node.index] = frozenset().union(*inputs, carried) - own
        self._needed_in(root, outputs)
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
        pending: list[_Node] = list(outputs)
        while pending:
            node = pending.pop()
            if node.index in self._reached:
                continue
            self._reached[node.index] = node
            if isinstance(node, Expr) and node.owner is not None:
                pending += self._reach_owned(node)
            elif isinstance(node, Expr):
                pending += _values(node.operands)
            else:
                pending += _values([node.going if isinstance(node, Loop) else node.which])

    def _reach_owned(self, value: Expr) -> list[_Node]:
        owner, place = self._owner(value), value.place
        if value.op == "carry":
            assert isinstance(owner, Loop)
            self._carries.setdefault(owner.index, []).append(place)
            return [owner, *_values([owner.first[place], owner.following[place]])]
        self._results.setdefault(owner.index, []).append(value)
        sides = (
            [owner.outcomes[place]]
            if isinstance(owner, Loop)
            else [owner.no[place], owner.yes[place]]
        )
        return [owner, *_values(sides)]

    def _owner(self, value: _Node) -> Loop | Branch:
        assert isinstance(value, Expr)
        assert value.owner is not None
        return value.owner

    def _inputs(self, node: _Node) -> list[_Node]:
        """Return all dependencies of a node, except the next value of a carry of the same loop."""
        if isinstance(node, Expr):
            if node.op == "carry":
                return []
            return [self._owner(node)] if node.op == "result" else [*_values(node.operands)]
        results = [value.place for value in self._results.get(node.index, [])]
        if isinstance(node, Branch):
            sides = [side[place] for place in results for side in (node.no, node.yes)]
            return [*_values([node.which, *sides])]
        places = self._carries.get(node.index, [])
        numbers = [side[place] for place in places for side in (node.first, node.following)]
        return [*_values([node.going, *numbers, *(node.outcomes[i] for i in results)])]

    def _place_value(self, value: Expr) -> None:
        if value.op in ("input", "carry"):
            return
        if value.op == "result":
            self._needed_in(self._use[value.index], [self._owner(value)])
            return
        block = self._place(value)
        block.items.append(value)
        self._needed_in(block, _values(value.operands))

    def _place_control(self, node: Loop | Branch) -> tuple[Block, Block]:
        block = self._place(node)
        results = sorted(self._results.get(node.index, []), key=lambda value: value.place)
        places = [value.place for value in results]
        if isinstance(node, Branch):
            no, yes = Block(block), Block(block)
            block.items.append(PlacedBranch(node, results, no, yes))
            self._needed_in(block, _values([node.which]))
            self._needed_in(no, _values(node.no[place] for place in places))
            self._needed_in(yes, _values(node.yes[place] for place in places))
            return no, yes
        head = Block(block, node)
        body = Block(head)
        carries = sorted(self._carries.get(node.index, []))
        block.items.append(PlacedLoop(node, carries, results, head, body))
        self._needed_in(block, _values(node.first[place] for place in carries))
        self._needed_in(head, _values([node.going, *(node.outcomes[place] for place in places)]))
        self._needed_in(body, _values(node.following[place] for place in carries))
        return head, body

    def _place(self, node: _Node) -> Block:
        """Return the innermost block that serves all users, outside of independent loops."""
        block = self._use[node.index]
        for head in [x for x in block.ancestors() if x.loop is not None]:
            assert head.loop is not None
            if head.loop.index in self._loops[node.index]:
                break
            assert head.parent is not None
            block = head.parent
        return block

    def _needed_in(self, block: Block, nodes: Iterable[_Node]) -> None:
        for node in nodes:
            before = self._use.get(node.index)
            self._use[node.index] = block if before is None else _common(before, block)


def _values(numbers: Iterable[Scalar]) -> list[Expr]:
    return [x for x in numbers if not is_constant(x)]


def _op(node: _Node) -> str:
    return node.op if isinstance(node, Expr) else ""


def _common(one: Block, other: Block) -> Block:
    """Return the innermost block that contains both."""
    around = set(map(id, one.ancestors()))
    return next(block for block in other.ancestors() if id(block) in around)
