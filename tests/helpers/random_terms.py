"""Values of a random JAX function, and how its lines are drawn and written down.

Floats begin as multiples of 1/8 and stay whole multiples of a power of two, few enough bits long
for float32 to hold them: however they are computed, every one is the same to the last bit, and
whatever is decided by them is decided alike. So are whole numbers, words of 32 bits and random
keys. Roots, angles and quotients are not exact: nothing is decided by those, and `shake` changes
each of them in its last bits, and what it is computed of, so that what the function makes of its
round-off can be measured.
"""

import dataclasses
import math
import random
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

BOUND, BITS = 8.0, 3
"""Of floats that have been rounded and clipped."""

INEXACT_BOUND = 64.0
"""Of floats that are not exact: larger ones are scaled."""

SHAPES = ((), (), (), (1,), (2,), (3,), (3,), (2, 2), (2, 3), (1, 3), (2, 1), (4,))

SHAKE = 0
"""The name of the numbers by which results are shaken; lines are named from 1 on."""

DTYPES = {"f": jnp.float32, "i": jnp.int32, "u": jnp.uint32, "b": jnp.bool_}
"""The dtypes of the kinds of terms; that of "k" is a random key's."""

WIDE = {"f": jnp.float64, "i": jnp.int64, "u": jnp.uint64}
"""Those of 64 bits."""


def mixed_dtypes(seed):
    """Dtypes of which some have 64 bits, for functions under `jax_enable_x64`."""
    draw = random.Random(f"dtypes {seed}")
    kinds = draw.sample([*WIDE], draw.randint(1, len(WIDE)))
    return DTYPES | {kind: WIDE[kind] for kind in kinds}


@dataclasses.dataclass(frozen=True)
class Term:
    """A value of the function: of which kind, how large, and of how many bits after the point."""

    name: int
    shape: tuple[int, ...]
    kind: str
    bound: float
    bits: int = 0
    exact: bool = True

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


class RandomLines:
    """Draws terms, and writes lines down; the kinds of lines are those of classes that follow."""

    def __init__(self, seed, arguments, dtypes=DTYPES):
        self._random = random.Random(seed)
        self.dtypes = dtypes
        self._names = SHAKE
        self._depth = 0
        self._in_map = False
        self._text = []
        self._arguments = [dataclasses.replace(x, name=self._name()) for x in arguments]
        self._block = Block([*self._arguments])

    @property
    def signed(self):
        """The dtype of integers with a sign that have as many bits as words."""
        return np.dtype(f"i{np.dtype(self.dtypes['u']).itemsize}")

    def _name(self):
        self._names += 1
        return self._names

    def _draw(self, sequence):
        return self._random.choice(list(sequence))

    def _whole(self, low, high):
        return self._random.randint(low, high)

    def _chance(self, probability):
        return self._random.random() < probability

    def _emit(self, text, do, shape, kind, bound=0.0, bits=0, exact=True):
        """One more line; a float of many bits is rounded and clipped, a large one scaled."""
        term = self._line(text, do, shape, kind, bound, bits, exact)
        if kind == "f" and exact and bound * 2**bits > 2**20:
            return self._rounded(term)
        if kind == "f" and not exact and bound > INEXACT_BOUND:
            return self._scaled(term, BOUND)
        if kind == "i" and bound > 2**10:
            return self._clipped(term, 9)
        return term

    def _line(self, text, do, shape, kind, bound, bits=0, exact=True):
        term = Term(self._name(), tuple(shape), kind, bound, bits, exact)

        def run(known):
            # Under `jax_enable_x64`, sums and places have 64 bits.
            found = do(known)
            found = found.astype(self.dtypes[kind]) if kind in self.dtypes else found
            return found if exact else shaken(known | {term.name: found}, term.name)

        self._block.lines.append((term.name, text, run))
        self._block.terms.append(term)
        size = "" if exact else " inexact"
        self._write(term.name, f"{term.name}: {kind}{list(shape)}{size} = {text}")
        return term

    def _write(self, name, text):
        """Write down a line, or with None for a name the head of lines that follow."""
        self._text.append((name, "  " * self._depth + text))

    def _rounded(self, term):
        return self._line(
            f"rounded({term.name})",
            lambda known: jnp.clip(jnp.floor(known[term.name] * 8) / 8, -BOUND, BOUND),
            term.shape,
            "f",
            BOUND,
            BITS,
        )

    def _clipped(self, term, most):
        return self._line(
            f"clip({term.name}, {-most}, {most})",
            lambda known: jnp.clip(known[term.name], -most, most),
            term.shape,
            "i",
            most,
        )

    def _scaled(self, term, bound):
        factor = 2.0 ** math.floor(math.log2(min(1.0, bound / term.bound)))
        return self._line(
            f"{term.name} * {factor}",
            lambda known: known[term.name] * factor,
            term.shape,
            "f",
            term.bound * factor,
            exact=False,
        )

    def _any(self, kind, exact=False):
        """A term that is there, or one made from one that is."""
        # Late ones are drawn more often: functions that go deep, not wide.
        terms = [t for t in self._block.terms if t.kind == kind and (t.exact or not exact)]
        if terms and (kind == "k" or self._chance(0.9)):
            return self._draw(terms[-6:] if self._chance(0.7) else terms)
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
            )
        if kind == "u":
            word, signed = self.dtypes["u"](self._whole(0, 2**32 - 1)), self.signed
            return self._emit(
                f"int({source.name}) ^ {word}",
                lambda known: known[source.name].astype(signed).view(word.dtype) ^ word,
                source.shape,
                "u",
            )
        return self._emit(
            f"int({source.name})",
            lambda known: known[source.name].astype(self.dtypes["i"]),
            source.shape,
            "i",
            source.bound,
        )

    def _constant(self):
        shape = self._draw(SHAPES)
        values = np.dtype(self.dtypes["f"]).type(
            [self._whole(-16, 16) / 8 for _ in range(math.prod(shape))]
        )
        values = values.reshape(shape)
        return self._emit(f"{values.tolist()}", lambda known: jnp.asarray(values), shape, "f", 2, 3)

    def _of(self, kind, shape, exact=False):
        """A term of a shape."""
        shape = tuple(shape)
        fits = [
            t
            for t in self._block.terms
            if t.kind == kind and t.shape == shape and (t.exact or not exact)
        ]
        if fits and self._chance(0.5):
            return self._draw(fits[-3:])
        term = self._any(kind, exact)
        if term.shape == shape:
            return term
        if term.shape == () and self._chance(0.5):
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
        return self._emit(text, do, shape, term.kind, term.bound, term.bits, term.exact)

    def _scalar(self, kind):
        return self._of(kind, (), exact=True)

    def _shape_of(self, do, *terms):
        """The shape that JAX gives a function of some terms."""
        operands = [jax.ShapeDtypeStruct(t.shape, self.dtypes[t.kind]) for t in terms]
        return jax.eval_shape(do, *operands).shape


def shaken(known, name):
    """Return a float, changed by its share of the shake if there is one."""
    x = known[name]
    return x * (1 + known[SHAKE][name].astype(x.dtype)) if SHAKE in known else x
