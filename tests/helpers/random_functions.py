"""Random JAX functions of a vector, each result exact or with a known bound on its round-off.

Numbers begin as multiples of 1/8 and stay whole multiples of a power of two, few enough bits long
for float32 to hold them: however they are computed, every one is the same to the last bit, and
whatever is decided by them is decided alike. Roots, angles and quotients are not exact; nothing is
decided by those, and how far two ways of computing them may differ is added up.
"""

import dataclasses
import math
import random
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

INPUTS, RESULTS = 6, 24
LARGEST = 4.0
EPS = 2.0**-22

BOUND, BITS = 8.0, 3
"""Of numbers that have been rounded and clipped."""

SHAPES = ((), (), (), (2,), (3,), (3,), (2, 2), (2, 3), (4,))


@dataclasses.dataclass(frozen=True)
class Term:
    """A value of the function; `error` is 0 where it is exact."""

    name: int
    shape: tuple[int, ...]
    kind: str
    bound: float
    bits: int = 0
    error: float = 0.0

    @property
    def size(self):
        return math.prod(self.shape)


@dataclasses.dataclass
class Block:
    """Lines of a function, or of a branch or loop in it."""

    terms: list[Term]
    lines: list[tuple[int, str, Callable[[dict[int, Any]], Any]]] = dataclasses.field(
        default_factory=list
    )

    def run(self, known):
        known = dict(known)
        for name, _, do in self.lines:
            known[name] = do(known)
        return known


class RandomFunction:
    """A function of float32 (INPUTS,) that returns float32 (RESULTS,), the same for the same seed.

    Attributes:
      errors: (RESULTS,) by how much two ways of computing it may differ.
      text: its lines, to be read.
    """

    def __init__(self, seed, size=20):
        self._random = random.Random(seed)
        self._names = 0
        self._depth = 0
        self._in_map = False
        self._controlled = set()
        self.text = []
        x = Term(self._name(), (INPUTS,), "f", LARGEST, BITS)
        self._argument, self._block = x, Block([x])
        self._add_lines(size)
        self._results, errors = self._chosen_results()
        self.errors = np.float32(errors)

    def __call__(self, x):
        known = self._block.run({self._argument.name: x})
        numbers = [known[term.name].ravel()[i] for term, i in self._results]
        return jnp.stack([number.astype(jnp.float32) for number in numbers])

    def _chosen_results(self):
        """Numbers that the function returns: most of them of loops and branches."""
        terms = self._block.terms[1:]
        numbers = [(t, i) for t in terms for i in range(t.size)]
        controlled = [(t, i) for t, i in numbers if t.name in self._controlled] or numbers
        late = (numbers[::-1] * RESULTS)[: RESULTS // 3]
        chosen = [*late, *self._random.choices(controlled, k=RESULTS - len(late))]
        return chosen, [4 * term.error for term, _ in chosen]

    # What draws and what writes down.

    def _name(self):
        self._names += 1
        return self._names

    def _draw(self, sequence):
        return self._random.choice(list(sequence))

    def _whole(self, low, high):
        return self._random.randint(low, high)

    def _emit(self, text, do, shape, kind, bound, bits=0, error=0.0):
        """One more line; a float of many bits is rounded and clipped, a large one scaled."""
        term = self._line(text, do, shape, kind, bound, bits, error)
        if kind == "f" and not error and bound * 2**bits > 2**20:
            return self._rounded(term)
        if kind == "f" and error and bound > 64:
            factor = 2.0 ** -math.ceil(math.log2(bound / BOUND))
            return self._line(
                f"{term.name} * {factor}",
                lambda known: known[term.name] * factor,
                shape,
                "f",
                bound * factor,
                error=error * factor,
            )
        if kind == "i" and bound > 2**10:
            return self._line(
                f"clip({term.name}, -9, 9)",
                lambda known: jnp.clip(known[term.name], -9, 9),
                shape,
                "i",
                9,
            )
        return term

    def _line(self, text, do, shape, kind, bound, bits=0, error=0.0):
        term = Term(self._name(), tuple(shape), kind, bound, bits, error)
        self._block.lines.append((term.name, text, do))
        self._block.terms.append(term)
        size = f" +- {error:.1e}" if error else ""
        self.text.append(f"{'  ' * self._depth}{term.name}: {kind}{list(shape)}{size} = {text}")
        return term

    def _rounded(self, term):
        return self._line(
            f"rounded({term.name})",
            lambda known: jnp.clip(jnp.floor(known[term.name] * 8) / 8, -BOUND, BOUND),
            term.shape,
            "f",
            BOUND,
            BITS,
        )

    def _any(self, kind, exact=False):
        """A term that is there, or one made from one that is."""
        # Late ones are drawn more often: functions that go deep, not wide.
        terms = [t for t in self._block.terms if t.kind == kind and not (exact and t.error)]
        if terms and self._random.random() < 0.9:
            return self._draw(terms[-6:] if self._random.random() < 0.7 else terms)
        if kind == "f":
            return self._constant()
        source = self._any("f", exact=True)
        if kind == "b":
            limit = self._whole(-8, 8) / 8
            return self._emit(
                f"{source.name} > {limit}",
                lambda known: known[source.name] > limit,
                source.shape,
                "b",
                1,
            )
        return self._emit(
            f"int({source.name})",
            lambda known: known[source.name].astype(jnp.int32),
            source.shape,
            "i",
            source.bound,
        )

    def _constant(self):
        shape = self._draw(SHAPES)
        values = np.float32([self._whole(-16, 16) / 8 for _ in range(math.prod(shape))])
        values = values.reshape(shape)
        return self._emit(f"{values.tolist()}", lambda known: jnp.asarray(values), shape, "f", 2, 3)

    def _of(self, kind, shape, exact=False):
        """A term of a shape."""
        fits = [
            t
            for t in self._block.terms
            if t.kind == kind and t.shape == tuple(shape) and not (exact and t.error)
        ]
        if fits and self._random.random() < 0.5:
            return self._draw(fits[-3:])
        term = self._any(kind, exact)
        if term.shape == tuple(shape):
            return term
        if term.shape == () and self._random.random() < 0.5:
            return self._moved(
                f"broadcast({term.name})",
                lambda known: jnp.broadcast_to(known[term.name], shape),
                term,
                shape,
            )
        places = np.array([self._whole(0, term.size - 1) for _ in range(math.prod(shape))], int)
        mode = self._draw(["clip", "fill", "promise_in_bounds", None])
        return self._moved(
            f"{term.name}[{places.tolist()}] {mode}",
            lambda known: known[term.name].ravel().at[places].get(mode=mode).reshape(shape),
            term,
            shape,
        )

    def _moved(self, text, do, term, shape):
        return self._emit(text, do, shape, term.kind, term.bound, term.bits, term.error)

    def _scalar(self, kind):
        return self._of(kind, (), exact=True)

    def _add_lines(self, count):
        for _ in range(count):
            choices = [(self._arithmetic, 6), (self._logic, 2), (self._whole_numbers, 2)]
            choices += [(self._moves, 3), (self._sums, 2), (self._choices, 2), (self._inexact, 1)]
            if self._depth < 3:
                choices += [(self._control, (6, 5, 2)[self._depth])]
            does, weights = zip(*choices, strict=True)
            self._random.choices(does, weights)[0]()

    # Kinds of lines.

    def _arithmetic(self):
        shape = self._draw(SHAPES)
        x, y = self._of("f", shape), self._of("f", self._draw([shape, ()]))
        a, b = x.name, y.name
        name = self._draw(["add", "sub", "mul", "max", "min", "neg", "abs", "half", "clip", "cube"])
        both = x.error + y.error
        if name in ("add", "sub"):
            do = jnp.add if name == "add" else jnp.subtract
            bound = x.bound + y.bound
            self._emit(
                f"{name}({a}, {b})",
                lambda known: do(known[a], known[b]),
                shape,
                "f",
                bound,
                max(x.bits, y.bits),
                both + EPS * bound if both else 0.0,
            )
        elif name == "mul":
            bound = x.bound * y.bound
            error = x.bound * y.error + y.bound * x.error + both**2
            self._emit(
                f"mul({a}, {b})",
                lambda known: known[a] * known[b],
                shape,
                "f",
                bound,
                x.bits + y.bits,
                error + EPS * bound if both else 0.0,
            )
        elif name in ("max", "min"):
            do = jnp.maximum if name == "max" else jnp.minimum
            self._emit(
                f"{name}({a}, {b})",
                lambda known: do(known[a], known[b]),
                shape,
                "f",
                max(x.bound, y.bound),
                max(x.bits, y.bits),
                max(x.error, y.error),
            )
        elif name == "cube":
            x = self._of("f", shape, exact=True)
            x = x if x.bound <= BOUND and x.bits <= BITS else self._rounded(x)
            self._emit(
                f"cube({x.name})",
                lambda known: known[x.name] ** 3,
                shape,
                "f",
                x.bound**3,
                3 * x.bits,
            )
        elif name == "half":
            self._emit(
                f"{a} / 2",
                lambda known: known[a] / 2,
                shape,
                "f",
                x.bound / 2,
                x.bits + 1,
                x.error / 2,
            )
        else:
            do = {"neg": jnp.negative, "abs": jnp.abs, "clip": lambda v: jnp.clip(v, -1.5, 2.0)}
            self._emit(
                f"{name}({a})",
                lambda known: do[name](known[a]),
                shape,
                "f",
                max(2.0, x.bound),
                max(1, x.bits),
                x.error,
            )

    def _inexact(self):
        x, y = self._any("f"), self._any("f")
        y = y if y.shape == x.shape else self._of("f", x.shape)
        a, b = x.name, y.name
        name = self._draw(["sin", "cos", "sqrt", "div", "rsqrt"])
        if name in ("sin", "cos"):
            do = jnp.sin if name == "sin" else jnp.cos
            if x.bound > 64:
                return
            error = x.error + 1e-6 + 1e-7 * x.bound
            self._emit(f"{name}({a})", lambda known: do(known[a]), x.shape, "f", 1, 0, error)
        elif name == "div":
            bound = 2 * x.bound
            error = 2 * x.error + 4 * x.bound * y.error + 4 * EPS * bound
            self._emit(
                f"{a} / (|{b}| + 0.5)",
                lambda known: known[a] / (jnp.abs(known[b]) + 0.5),
                x.shape,
                "f",
                bound,
                0,
                error,
            )
        else:
            do = jnp.sqrt if name == "sqrt" else lax.rsqrt
            bound = math.sqrt(x.bound + 1) if name == "sqrt" else 2.0
            self._emit(
                f"{name}(|{a}| + 0.25)",
                lambda known: do(jnp.abs(known[a]) + 0.25),
                x.shape,
                "f",
                bound,
                0,
                4 * x.error + 4 * EPS * bound,
            )

    def _logic(self):
        shape = self._draw(SHAPES)
        name = self._draw(["lt", "le", "gt", "ge", "eq", "ne", "and", "or", "xor", "not", "all"])
        if name in ("and", "or", "xor", "not", "all"):
            x, y = self._of("b", shape), self._of("b", shape)
            do = {
                "and": lambda p, q: p & q,
                "or": lambda p, q: p | q,
                "xor": lambda p, q: p ^ q,
                "not": lambda p, q: ~p,
                "all": lambda p, q: jnp.broadcast_to(p.all() == q.any(), p.shape),
            }[name]
        else:
            kind = self._draw("ffi" if name not in ("eq", "ne") else "fib")
            x, y = self._of(kind, shape, True), self._of(kind, shape, True)
            do = getattr(lax, name)
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name]),
            shape,
            "b",
            1,
        )

    def _whole_numbers(self):
        shape = self._draw(SHAPES)
        name = self._draw(["add", "sub", "mul", "max", "min", "abs", "neg", "float", "bool", "arg"])
        if name == "arg":
            x = self._of("f", self._draw([(3,), (2, 3)]), exact=True)
            do = self._draw([jnp.argmin, jnp.argmax])
            self._emit(
                f"argm..({x.name})",
                lambda known: do(known[x.name], axis=-1).astype(jnp.int32),
                x.shape[:-1],
                "i",
                3,
            )
            return
        x, y = self._of("i", shape), self._of(self._draw("ib"), shape)
        if name == "float":
            self._emit(
                f"float({x.name})",
                lambda known: known[x.name].astype(jnp.float32),
                shape,
                "f",
                x.bound,
            )
            return
        if name == "bool":
            self._emit(f"bool({x.name})", lambda known: known[x.name].astype(bool), shape, "b", 1)
            return
        do = {
            "add": lambda p, q: p + q,
            "sub": lambda p, q: p - q,
            "mul": lambda p, q: p * q,
            "max": jnp.maximum,
            "min": jnp.minimum,
            "abs": lambda p, q: jnp.abs(p),
            "neg": lambda p, q: jnp.sign(p) - p,
        }[name]
        bound = (x.bound + 1) * (y.bound + 1)
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name].astype(jnp.int32)),
            shape,
            "i",
            bound,
        )

    def _moves(self):
        kind = self._draw("fffib")
        x = self._of(kind, self._draw([(2, 3), (3, 2), (4,), (3,)]))
        y = self._of(kind, x.shape)
        n = x.shape[0]
        k, order = self._whole(0, n - 1), [self._whole(0, n - 1) for _ in range(3)]
        keys = np.array([self._whole(0, 3) for _ in range(n)])
        # Mapped, such a place would be one of many.
        at = None if self._in_map or self._random.random() < 0.7 else self._scalar("i")
        moves = {
            "row": lambda p, q: p[k],
            "slice": lambda p, q: p[k:],
            "every other": lambda p, q: p[::2],
            "reverse": lambda p, q: p[::-1],
            "transpose": lambda p, q: p.T,
            "flatten": lambda p, q: p.ravel(),
            "join": lambda p, q: jnp.concatenate([p, q[:1]]),
            "stack": lambda p, q: jnp.stack([p.ravel(), q.ravel()], 1),
            "pad": lambda p, q: jnp.pad(p.ravel(), (1, 2)),
            "tile": lambda p, q: jnp.tile(p.ravel()[:2], 2),
            "roll": lambda p, q: jnp.roll(p, k, 0),
            "take": lambda p, q: p[jnp.array(order)],
            "take each": lambda p, q: jnp.take_along_axis(
                p.reshape(n, -1), jnp.array(keys[:, None] % (p.size // n)), 1
            ),
            "set": lambda p, q: p.at[k].set(q[0]),
            "sorted": lambda p, q: p[jnp.argsort(jnp.array(keys))],
            "split": lambda p, q: jnp.split(p.ravel(), [1])[1],
            "drop": lambda p, q: p.at[jnp.array([k, n + 1])].set(q[:2], mode="drop"),
        }
        name = self._draw(moves)
        do = moves[name]
        if at is not None:
            name = f"dynamic {at.name}"
            self._moved_by(name, x, lambda p, q, i: lax.dynamic_slice_in_dim(p, i, 2), y, at)
            return
        self._moved_by(name, x, lambda p, q, i: do(p, q), y)

    def _moved_by(self, name, x, do, y, at=None):
        """A move, whose shape JAX tells."""
        dtype = {"f": jnp.float32, "i": jnp.int32, "b": jnp.bool_}[x.kind]
        index = jax.ShapeDtypeStruct((), jnp.int32)
        operands = [jax.ShapeDtypeStruct(t.shape, dtype) for t in (x, y)]
        shape = jax.eval_shape(do, *operands, index).shape
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name], known[at.name] if at else 0),
            shape,
            x.kind,
            max(x.bound, y.bound),
            max(x.bits, y.bits),
            max(x.error, y.error),
        )

    def _sums(self):
        x = self._of("f", self._draw([(3,), (2, 3), (2, 2)]))
        y = self._of("f", (x.shape[-1], 2))
        k = [self._whole(0, x.shape[0] - 1) for _ in range(3)]
        sums = {
            "sum": lambda p, q: p.sum(-1),
            "total": lambda p, q: p.sum(),
            "max": lambda p, q: p.max(0),
            "min": lambda p, q: p.min(),
            "cumsum": lambda p, q: jnp.cumsum(p, -1),
            "cumsum backwards": lambda p, q: lax.cumsum(p, 0, reverse=True),
            "matmul": lambda p, q: jnp.matmul(p, q, precision="highest"),
            "outer": lambda p, q: jnp.einsum("...i,ij->j...", p, q, precision="highest"),
            "scatter": lambda p, q: p.at[jnp.array(k)].add(p[0]),
            "multiplied": lambda p, q: p.at[0].multiply(p[-1]),
            "mean of two": lambda p, q: (p[..., 0] + p[..., -1]) * 0.5,
        }
        name = self._draw(sums)
        do = sums[name]
        operands = [jax.ShapeDtypeStruct(t.shape, jnp.float32) for t in (x, y)]
        shape = jax.eval_shape(do, *operands).shape
        # No more than six products, or six numbers, are added up; scaling may add a bit.
        bound = 6 * max(x.bound, y.bound, 1.0) ** 2
        both = x.error + y.error
        error = 12 * max(x.bound, y.bound, 1.0) * both + 6 * EPS * bound
        self._emit(
            f"{name}({x.name}, {y.name}, {k})",
            lambda known: do(known[x.name], known[y.name]),
            shape,
            "f",
            bound,
            x.bits + max(x.bits, y.bits) + 1,
            error if both else 0.0,
        )

    def _choices(self):
        shape, kind = self._draw(SHAPES), self._draw("ffib")
        cases = [self._of(kind, shape) for _ in range(self._whole(2, 4))]
        bound, bits = max(t.bound for t in cases), max(t.bits for t in cases)
        error = max(t.error for t in cases)
        if len(cases) == 2:
            which = self._of("b", self._draw([shape, ()]))

            def do(known):
                return jnp.where(known[which.name], *(known[t.name] for t in cases))
        else:
            which = self._of("i", self._draw([shape, ()]))

            def do(known):
                last = len(cases) - 1
                number = jnp.clip(known[which.name], 0, last)
                return lax.select_n(number, *(known[t.name] for t in cases))

        names = [t.name for t in cases]
        self._emit(f"select {which.name} of {names}", do, shape, kind, bound, bits, error)

    # Control flow.

    def _control(self):
        kinds = [self._branch, self._branch, self._while, self._while, self._counted, self._scan]
        self._draw([*kinds, self._mapped, self._derived])()

    def _inside(self, parameters, count):
        """A block of lines in which the parameters are known too, and `self._block` before it."""
        outer = self._block
        self._block = Block([*outer.terms, *parameters])
        self._depth += 1
        self._add_lines(count)
        if count and self._depth < 3 and self._random.random() < 0.3:
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
        late = [t for t in late if t.shape == like.shape and (like.error or not t.error)]
        term = late[-1] if late else self._of(like.kind, like.shape, exact=not like.error)
        if like.kind == "i" and term.bound > like.bound:
            return self._line(
                f"clip({term.name})",
                lambda known: jnp.clip(known[term.name], -like.bound, like.bound).astype(jnp.int32),
                term.shape,
                "i",
                like.bound,
            )
        if like.kind == "f" and not like.error:
            if term.bound > BOUND or term.bits > BITS:
                return self._rounded(term)
        elif like.kind == "f":
            # So small that errors shrink from trip to trip.
            factors = [1.0, like.error / max(term.error, like.error), like.bound / term.bound]
            factor = 2.0 ** math.floor(math.log2(min(factors)))
            return self._line(
                f"{term.name} * {factor}",
                lambda known: known[term.name] * factor,
                term.shape,
                "f",
                term.bound * factor,
                error=max(term.error * factor, EPS),
            )
        return term

    def _carries(self):
        """What a loop begins with, and the same as its body knows it."""
        first, inside = [], []
        for _ in range(self._whole(1, 4)):
            kind = self._draw("fffib")
            like = Term(0, self._draw(SHAPES), kind, 9 if kind == "i" else BOUND, BITS)
            if kind == "f" and self._random.random() < 0.3:
                like = dataclasses.replace(like, error=1e-4, bits=0)
            first.append(self._end(like))
            inside.append(dataclasses.replace(like, name=self._name()))
        return first, inside

    def _loop_body(self, inside, count=5):
        """Lines of a trip, and what it ends with; some carries change places or stay."""
        outer = self._inside(inside, self._whole(1, count))
        ends = [
            carry if self._random.random() < 0.15 else end
            for carry, end in zip(inside, self._ends(inside), strict=True)
        ]
        return self._leave(outer), ends

    def _results_of(self, text, do, likes):
        together = self._names = self._names + 1
        self._block.lines.append((together, text, do))
        self.text.append(f"{'  ' * self._depth}{together} = {text}")
        for i, like in enumerate(likes):
            self._controlled.add(self._names + 1)
            self._line(
                f"{together}.{i}",
                lambda known, i=i: known[together][i],
                like.shape,
                like.kind,
                like.bound,
                like.bits,
                like.error,
            )

    def _while(self):
        first, inside = self._carries()
        trips = self._scalar("i")
        self.text.append(f"{'  ' * self._depth}while of {[t.name for t in inside]}:")
        body, ends = self._loop_body(inside)
        outer = self._inside(inside, self._whole(0, 2))
        going = self._scalar("b")
        condition = self._leave(outer)
        most = self._whole(2, 7)
        counts_down = self._random.random() < 0.5

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
            start = limit if counts_down else jnp.int32(0)
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
                (jnp.int32(0), first, prepared_of(first)),
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
        limit = self._scalar("i") if self._random.random() < 0.4 else None

        def do(known):
            def trip(count, state):
                state = {t.name: x for t, x in zip(inside, state, strict=True)}
                now = body.run(known | {i.name: count} | state)
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
        with_rows, reverse = self._random.random() < 0.7, self._random.random() < 0.3
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
        likes = [
            Term(0, self._draw(SHAPES), kind, 9 if kind == "i" else BOUND, BITS)
            for kind in self._random.choices("ffib", k=self._whole(1, 3))
        ]
        cases = self._whole(2, 4)
        which = self._scalar("b" if cases == 2 else "i")
        sides = []
        for _ in range(cases):
            self.text.append(f"{'  ' * self._depth}case of {which.name}:")
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


def inputs(seed, robots):
    """Arguments for so many robots: multiples of 1/8, (robots, INPUTS)."""
    rng = np.random.default_rng(seed)
    most = int(LARGEST * 8)
    return np.float32(rng.integers(-most, most + 1, (robots, INPUTS))) / np.float32(8)
