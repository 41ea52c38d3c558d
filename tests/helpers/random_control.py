"""Loops, branches, maps and calls of random JAX functions."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax

from helpers.random_operations import Operations
from helpers.random_terms import BITS, BOUND, SHAPES, Block, Term
from onekernel import fuse


class Control(Operations):
    """Lines that hold blocks of other lines."""

    def _control(self):
        kinds = [self._branch, self._branch, self._while, self._while, self._counted, self._scan]
        self._draw([*kinds, self._scan, self._mapped, self._derived, self._called, self._called])()

    def _inside(self, parameters, count):
        """A block of lines in which the parameters are known too, and `self._block` before it."""
        outer = self._block
        self._block = Block([*outer.terms, *parameters])
        self._depth += 1
        self._add_lines(count)
        if count and self._depth < 3 and self._chance(0.3):
            self._control()
        return outer

    def _leave(self, outer):
        inner, self._block = self._block, outer
        self._depth -= 1
        return inner

    def _ends(self, wanted):
        """Terms like others, as a branch or a trip ends with them."""
        return [self._end(like) for like in wanted]

    def _end(self, like):
        late = [t for t in self._block.terms[-3:] if t.kind == like.kind]
        late = [t for t in late if t.shape == like.shape and (t.exact or not like.exact)]
        term = late[-1] if late else self._of(like.kind, like.shape, like.exact)
        if like.kind == "i" and term.bound > like.bound:
            return self._clipped(term, like.bound)
        if like.kind == "f" and like.exact and (term.bound > BOUND or term.bits > BITS):
            return self._rounded(term)
        if like.kind == "f" and not like.exact:
            return self._scaled(term, like.bound)
        return term

    def _like(self, kinds):
        """What a branch or a trip may return."""
        kind = self._draw(kinds)
        shape = () if kind == "k" else self._draw(SHAPES)
        is_exact = kind != "f" or self._chance(0.7)
        return Term(0, shape, kind, 9 if kind == "i" else BOUND, BITS if is_exact else 0, is_exact)

    def _carries(self):
        """What a loop begins with, and the same as its body knows it."""
        first, inside = [], []
        for _ in range(self._whole(1, 4)):
            like = self._like("fffibuk")
            first.append(self._end(like))
            inside.append(dataclasses.replace(like, name=self._name()))
        return first, inside

    def _loop_body(self, inside, count=5):
        """Lines of a trip, and what it ends with; some carries change places or stay."""
        outer = self._inside(inside, self._whole(1, count))
        ends = [
            carry if self._chance(0.15) else end
            for carry, end in zip(inside, self._ends(inside), strict=True)
        ]
        return self._leave(outer), ends

    def _results_of(self, text, do, likes):
        together = self._names = self._names + 1
        self._block.lines.append((together, text, do))
        self._write(together, f"{together} = {text}")
        for i, like in enumerate(likes):
            self._controlled.add(self._names + 1)
            self._line(
                f"{together}.{i}",
                lambda known, i=i: known[together][i],
                like.shape,
                like.kind,
                like.bound,
                like.bits,
                like.exact,
            )

    def _while(self):
        first, inside = self._carries()
        trips = self._scalar("i")
        self._write(None, f"while of {[t.name for t in inside]}:")
        body, ends = self._loop_body(inside)
        outer = self._inside(inside, self._whole(0, 2))
        going = self._scalar("b")
        condition = self._leave(outer)
        most = self._whole(2, 7)
        counts_down = self._chance(0.5)

        def do(known):
            def known_in(state):
                return known | {t.name: x for t, x in zip(inside, state[1:], strict=True)}

            def goes_on(state):
                more = state[0] > 0 if counts_down else state[0] < limit
                return more & condition.run(known_in(state))[going.name]

            def trip(state):
                now = body.run(known_in(state))
                step = -1 if counts_down else 1
                return (state[0] + step, *(now[t.name] for t in ends))

            limit = jnp.clip(known[trips.name], 0, most)
            start = limit if counts_down else self.dtypes["i"](0)
            return lax.while_loop(goes_on, trip, (start, *(known[t.name] for t in first)))[1:]

        text = f"while {trips.name} and {going.name}: {[t.name for t in first]}"
        text += f" -> {[t.name for t in ends]}"
        self._results_of(text, do, inside)

    def _derived(self):
        """A loop that ends a trip with what the next one begins with, as solvers do."""
        x = self._rounded(self._of("f", (3,), exact=True))
        trips = self._scalar("i")
        inside = [dataclasses.replace(x, name=self._name())]
        outer = self._inside(inside, self._whole(1, 4))
        value = self._rounded(self._of("f", (3,), exact=True))
        prepare = self._leave(outer)
        prepared = dataclasses.replace(value, name=self._name())
        body, (end, *_) = self._loop_body([*inside, prepared], 3)
        end_is_rounded = end.bound <= BOUND and end.bits <= BITS
        assert end_is_rounded

        def do(known):
            def prepared_of(x):
                return prepare.run(known | {inside[0].name: x})[value.name]

            def trip(state):
                i, x, y = state
                x = body.run(known | {inside[0].name: x, prepared.name: y})[end.name]
                return i + 1, x, prepared_of(x)

            first = known[x.name]
            return lax.while_loop(
                lambda state: (state[0] < known[trips.name]) & (state[0] < 5),
                trip,
                (self.dtypes["i"](0), first, prepared_of(first)),
            )

        i = Term(0, (), "i", 5)
        text = f"while {trips.name}: {x.name}, {value.name} -> {end.name}"
        self._results_of(text, do, [i, *inside, prepared])

    def _counted(self):
        first, inside = self._carries()
        length = self._whole(0, 6)
        i = Term(self._name(), (), "i", 6)
        body, ends = self._loop_body([i, *inside])
        ends = ends[1:]
        # With a limit that is known it is a scan to JAX, and without a while.
        limit = self._scalar("i") if self._chance(0.4) else None

        def do(known):
            def trip(count, state):
                state = {t.name: x for t, x in zip(inside, state, strict=True)}
                now = body.run(known | {i.name: jnp.asarray(count, self.dtypes["i"])} | state)
                return tuple(now[t.name] for t in ends)

            last = length if limit is None else jnp.clip(known[limit.name], 0, 6)
            return lax.fori_loop(0, last, trip, tuple(known[t.name] for t in first))

        text = f"for {length if limit is None else limit.name}: {[t.name for t in first]}"
        self._results_of(f"{text} -> {[t.name for t in ends]}", do, inside)

    def _scan(self):
        first, inside = self._carries()
        rows = self._of("f", self._draw([(3,), (2, 3), (4,)]))
        row = dataclasses.replace(rows, name=self._name(), shape=rows.shape[1:])
        body, ends = self._loop_body([row, *inside])
        ends = ends[1:]
        with_rows, reverse = self._chance(0.7), self._chance(0.3)
        told = ends[0]

        def do(known):
            def trip(state, x):
                if not with_rows:
                    x = known[rows.name][0]
                state = {t.name: x for t, x in zip(inside, state, strict=True)}
                now = body.run(known | {row.name: x} | state)
                return tuple(now[t.name] for t in ends), now[told.name] if with_rows else None

            state = tuple(known[t.name] for t in first)
            xs = known[rows.name] if with_rows else None
            length = rows.shape[0] if with_rows else 5
            state, all_told = lax.scan(trip, state, xs, length=length, reverse=reverse)
            return *state, (all_told if with_rows else state[0])

        shape = (rows.shape[0], *told.shape) if with_rows else told.shape
        last = dataclasses.replace(inside[0], shape=shape)
        text = f"scan {rows.name} {with_rows} {reverse}: {[t.name for t in first]}"
        self._results_of(f"{text} -> {[t.name for t in ends]}", do, [*inside, last])

    def _branch(self):
        likes = [self._like("ffibuk") for _ in range(self._whole(1, 3))]
        cases = self._whole(2, 4)
        which = self._scalar("b" if cases == 2 else "i")
        sides = []
        for _ in range(cases):
            self._write(None, f"case of {which.name}:")
            outer = self._inside([], self._whole(1, 6))
            ends = self._ends(likes)
            sides.append((self._leave(outer), ends))

        def do(known):
            def side(number):
                def run():
                    block, ends = sides[number]
                    now = block.run(known)
                    return tuple(now[t.name] for t in ends)

                return run

            if cases == 2:
                return lax.cond(known[which.name], side(1), side(0))
            return lax.switch(known[which.name], [side(n) for n in range(cases)])

        ends = [[t.name for t in ends] for _, ends in sides]
        self._results_of(f"branch {which.name}: {ends}", do, likes)

    def _mapped(self):
        """Branches and loops of several rows at once."""
        x = self._rounded(self._of("f", (3,), exact=True))
        which = self._of("i", (3,))
        one = Term(self._name(), (), "f", BOUND, BITS)
        likes, sides = [Term(0, (), "f", BOUND, BITS)], []
        was_in_map, self._in_map = self._in_map, True
        for _ in range(3):
            outer = self._inside([one], self._whole(1, 3))
            (end,) = self._ends(likes)
            sides.append((self._leave(outer), end))
        self._in_map = was_in_map
        kind = self._draw(["switch", "cond", "while"])

        def do(known):
            def run(number, x):
                block, end = sides[number]
                return block.run(known | {one.name: x})[end.name]

            def each(x, i):
                if kind == "switch":
                    return lax.switch(i, [lambda x, n=n: run(n, x) for n in range(3)], x)
                if kind == "cond":
                    return lax.cond(i > 0, lambda x: run(0, x), lambda x: run(1, x), x)
                return lax.while_loop(
                    lambda state: state[0] < jnp.clip(i, 0, 4),
                    lambda state: (state[0] + 1, run(2, state[1])),
                    (jnp.int32(0), x),
                )[1]

            return (jax.vmap(each)(known[x.name], known[which.name]),)

        text = f"mapped {kind} {x.name} by {which.name}: {[end.name for _, end in sides]}"
        self._results_of(text, do, [Term(0, (3,), "f", BOUND, BITS)])

    def _called(self):
        """A function of a function: compiled by itself, of own derivative, mapped, fused."""
        name = self._draw([*CALLS])
        call, axes = CALLS[name], self._whole(1, 2) if name == "vmap" else 0
        x = self._any("f") if not axes else self._of("f", [(3,), (2, 3)][axes - 1])
        x = x if not x.exact else self._rounded(x)
        one = dataclasses.replace(x, name=self._name(), shape=x.shape[axes:])
        self._write(None, f"{name} of {one.name}:")
        was_in_map, self._in_map = self._in_map, self._in_map or axes > 0
        outer = self._inside([one], self._whole(1, 4))
        like = self._like("ffiu")
        end = self._end(like)
        body = self._leave(outer)
        self._in_map = was_in_map

        def do(known):
            called = call(lambda v: body.run(known | {one.name: v})[end.name])
            for _ in range(axes - 1):
                called = call(called)
            return (called(known[x.name]),)

        result = dataclasses.replace(like, shape=(*x.shape[:axes], *like.shape))
        self._results_of(f"{name} {x.name} -> {end.name}", do, [result])


def _with_jvp(function):
    """A function with a derivative of its own, which nobody asks for."""
    wrapped = jax.custom_jvp(function)
    wrapped.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    return wrapped


def _with_vjp(function):
    wrapped = jax.custom_vjp(function)
    wrapped.defvjp(lambda x: (wrapped(x), None), lambda _, slope: (slope,))
    return wrapped


CALLS = {
    "jit": jax.jit,
    "checkpoint": jax.checkpoint,
    "custom_jvp": _with_jvp,
    "custom_vjp": _with_vjp,
    "fuse": fuse,
    "vmap": jax.vmap,
}
