"""Order the operations of a program so that few numbers wait for their use.

A processor has registers for some dozens of numbers. What waits longer is spilled to memory, and
loaded again when it is used. In the order in which JAX records a function, an array is computed
completely before anything uses it, and its numbers wait: hundreds of them in a simulation. LLVM
changes that order within narrow limits.

Here a list scheduler chooses the operations of a block one after the other. Of those whose operands
are there, it takes the one that sets most registers free: an operand is free after its last use.
Among equals it takes the one whose operand was touched last, which is likely to be in a register,
and otherwise the one that was recorded first. A block keeps its order if the new one spills more.
The order of operations changes no result.

Source: J. Goodman and W.-C. Hsu, Code Scheduling and Register Allocation in Large Basic Blocks, ICS
1988, for what is chosen where registers are scarce.
"""

import dataclasses
import heapq
from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Sequence

from onekernel.lower.jaxpr import ScalarProgram
from onekernel.lower.scalar_ir import Expr, Scalar, is_constant
from onekernel.lower.schedule import Block, Item, PlacedBranch, PlacedLoop

_MOST_USERS = 64
"""Most operations that wait for a number which, when it is touched, brings them forward. What has
more of them is used everywhere and tells nothing; looking at all of them would take a time that is
quadratic in their number."""

_REGISTERS = 32
"""Numbers that are in registers while spills are counted."""


def ordered(program: ScalarProgram, *, scans: bool = True) -> ScalarProgram:
    """Return a program whose operations are in an order in which few numbers wait for their use.

    Args:
      program: the program, which is not changed.
      scans: whether to order what is in counted loops, too.
    """
    results = [x for array in program.outputs for x in array.ravel()]
    return dataclasses.replace(program, block=_ordered_block(program.block, results, scans))


def _ordered_block(block: Block, results: Iterable[Scalar], scans: bool) -> Block:
    """Order a block and those inside it; `results` are used after its last item."""
    order = _Order(block.items, set(_indices(results)))
    items = min(block.items, order.find(), key=order.count_spills)
    return dataclasses.replace(block, items=[_ordered_item(item, scans) for item in items])


def _ordered_item(item: Item, scans: bool) -> Item:
    if isinstance(item, Expr):
        return item
    if isinstance(item, PlacedLoop) and item.loop.counter is not None and not scans:
        return item
    one, other = (_ordered_block(block, after, scans) for block, after in _inside(item))
    if isinstance(item, PlacedBranch):
        return dataclasses.replace(item, if_false=one, if_true=other)
    return dataclasses.replace(item, head=one, body=other)


class _Order:
    """An `_Order` arranges items that are executed one after the other."""

    def __init__(self, items: Sequence[Item], needed: set[int]) -> None:
        """Find who uses what.

        Args:
          items: the items, in an order in which operands precede what takes them.
          needed: indices of what is used after all of them.
        """
        self._items = items
        self._needed = needed
        self._own = [_index(item) for item in items]
        places = {index: place for place, index in enumerate(self._own)}
        # By the place of an item: the indices of what it takes, and how many items it waits for.
        self._operands = [[*dict.fromkeys(_indices(_taken(item)))] for item in items]
        self._waits_for = [sum(x in places for x in taken) for taken in self._operands]
        # By the index of a value: the places of the items that take it and are not yet chosen, and
        # the number of items that were chosen when it was touched last.
        self._users: dict[int, set[int]] = {index: set() for index in self._own}
        self._touched: dict[int, int] = {}
        for place, taken in enumerate(self._operands):
            for index in taken:
                self._users.setdefault(index, set()).add(place)
        # Only what is computed here becomes free: the rest is needed elsewhere, or in memory.
        self._can_become_free = places.keys() - needed
        # The items that can be next, the best first. An item whose rank changes is pushed again,
        # and its old entry is skipped.
        self._ready: list[tuple[int, int, int]] = []
        self._rank: dict[int, tuple[int, int, int]] = {}

    def find(self) -> list[Item]:
        """Return the items in their new order; call this once."""
        found: list[Item] = []
        self._push(place for place, count in enumerate(self._waits_for) if not count)
        while self._ready:
            rank = heapq.heappop(self._ready)
            place = rank[-1]
            if self._rank.get(place) == rank:
                del self._rank[place]
                found.append(self._items[place])
                self._choose(place, len(found))
        return found

    def count_spills(self, items: Sequence[Item]) -> int:
        """Return how often a value is stored and loaded in an order of the items.

        The value that is not touched for longest leaves its register.
        """
        operands = dict(zip(self._own, self._operands, strict=True))
        uses = Counter(x for taken in operands.values() for x in taken)
        uses.update(self._needed)
        registers: OrderedDict[int, None] = OrderedDict()
        stored, count = set(uses) - set(self._own), 0
        for index in map(_index, items):
            for x in operands[index]:
                count += x not in registers
                uses[x] -= 1
            for x in (*operands[index], index):
                registers[x] = None
                registers.move_to_end(x)
                if not uses[x]:
                    del registers[x]
            while len(registers) > _REGISTERS:
                x, _ = registers.popitem(last=False)
                count += x not in stored
                stored.add(x)
        return count

    def _choose(self, place: int, time: int) -> None:
        """Note that an item is chosen as the one with this number."""
        index = self._own[place]
        changed: set[int] = set()
        for user in self._users[index]:
            self._waits_for[user] -= 1
        for touched in (*self._operands[place], index):
            self._touched[touched] = time
            users = self._users[touched]
            users.discard(place)
            if touched == index or len(users) <= _MOST_USERS:
                changed |= users
        self._push(user for user in changed if not self._waits_for[user])

    def _push(self, places: Iterable[int]) -> None:
        """Make items that can be next candidates, by their present rank."""
        for place in places:
            taken, index = self._operands[place], self._own[place]
            freed = sum(len(self._users[x]) == 1 and x in self._can_become_free for x in taken)
            occupied = bool(self._users[index]) or index in self._needed
            touched = max((self._touched.get(x, 0) for x in taken), default=0)
            rank = occupied - freed, -touched, place
            if self._rank.get(place) != rank:
                self._rank[place] = rank
                heapq.heappush(self._ready, rank)


def _index(item: Item) -> int:
    """Return the index of an operation, loop or branch."""
    if isinstance(item, Expr):
        return item.index
    return item.loop.index if isinstance(item, PlacedLoop) else item.branch.index


def _indices(scalars: Iterable[Scalar]) -> Iterator[int]:
    """Yield the indices of the operations, loops and branches that compute some scalars."""
    for x in scalars:
        if not is_constant(x):
            computed_by = x.owner if x.op in ("result", "stack") else x
            assert computed_by is not None
            yield computed_by.index


def _taken(item: Item) -> Iterator[Scalar]:
    """Yield what an item takes, also what is computed inside of a loop or branch."""
    if isinstance(item, Expr):
        yield from item.operands
        return
    if isinstance(item, PlacedLoop):
        yield from (item.loop.initial[place] for place in item.places)
    else:
        yield item.branch.condition
    for block, after in _inside(item):
        yield from after
        yield from _taken_in(block)


def _taken_in(block: Block) -> Iterator[Scalar]:
    for item in block.items:
        yield from _taken(item)


def _inside(item: PlacedLoop | PlacedBranch) -> list[tuple[Block, list[Scalar]]]:
    """Return both blocks of a loop or branch, each with what is used after its last item."""
    if isinstance(item, PlacedBranch):
        sides = ((item.if_false, item.branch.if_false), (item.if_true, item.branch.if_true))
        return [(block, [side[x.place] for x in item.results]) for block, side in sides]
    loop = item.loop
    end = [loop.updated[place] for place in item.places]
    end += [loop.stacked[x.place] for x in item.stacks]
    # The body runs after the head, and so do the results: both use what the head computes.
    results = [loop.results[x.place] for x in item.results]
    return [
        (item.head, [*_taken_in(item.body), *end, *results, loop.condition]),
        (item.body, end),
    ]
