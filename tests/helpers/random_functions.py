"""Random JAX functions of one instance, with results that are exact or measurably well conditioned.

`random_terms` says which numbers there are, `random_operations` and `random_control` which lines.
"""

import copy

import jax
import jax.numpy as jnp
import numpy as np

from helpers.random_control import Control
from helpers.random_terms import BITS, DTYPES, SHAKE, Block, Term

LARGEST = 4.0

ARGUMENTS = {
    "x": Term(0, (6,), "f", LARGEST, BITS),
    "pair": (Term(0, (), "f", LARGEST, BITS), Term(0, (1, 3), "f", LARGEST, BITS)),
    "count": Term(0, (4,), "i", 9),
    "word": Term(0, (2,), "u", 0),
    "flag": Term(0, (3,), "b", 0),
    "key": Term(0, (), "k", 0),
}
"""A tree of all kinds of arguments."""

RESULTS = {"f": 12, "i": 6, "u": 4, "b": 4}
"""How many numbers of each kind a function returns, at most."""


class RandomFunction(Control):
    """A function of a tree like `ARGUMENTS` that returns a tree, the same for the same seed.

    The results are exact, but for those below "inexact": dictionaries of vectors by the kind of
    their numbers, of size 0 where there is no such number, beside whole arrays and a key.
    """

    def __init__(self, seed, size=8, dtypes=DTYPES):
        arguments, self._structure = jax.tree.flatten(ARGUMENTS)
        super().__init__(seed, arguments, dtypes)
        self._dropped = frozenset()
        self._controlled = set()
        self._add_lines(size)
        terms = self._block.terms[len(arguments) :]
        self._exact = {k: self._chosen(terms, k, True) for k in RESULTS}
        self._inexact_ones = self._chosen(terms, "f", False)
        self._whole_ones = [t for t in terms if t.kind != "k"][-2:]
        self._keys = [t for t in terms if t.kind == "k"][-1:]

    def __call__(self, arguments, shake=None):
        """Compute the function.

        Args:
          arguments: a tree like `ARGUMENTS`.
          shake: by how much each inexact number is multiplied, less 1, (shakes,); None: by nothing.
        """
        leaves = self._structure.flatten_up_to(arguments)
        known = {x.name: leaf for x, leaf in zip(self._arguments, leaves, strict=True)}
        known |= {} if shake is None else {SHAKE: shake}
        known = self._block.run(known)
        return {
            "exact": {
                kind: self._numbers(known, chosen, kind) for kind, chosen in self._exact.items()
            },
            "inexact": self._numbers(known, self._inexact_ones, "f"),
            "whole": tuple(known[t.name] for t in self._whole_ones),
            "keys": [known[t.name] for t in self._keys],
        }

    @property
    def shakes(self):
        """How many numbers `shake` has."""
        return self._names + 1

    @property
    def lines(self):
        """Names of the lines that `without` may drop: none in a branch or loop, and no keys."""
        keys = {t.name for t in self._block.terms if t.kind == "k"}
        return [name for name, *_ in self._block.lines if name not in self._dropped | keys]

    @property
    def text(self):
        """The lines, to be read: those of a branch or loop before the line that runs it."""
        text, inside = [], []
        for name, line in self._text:
            inside.append(line)
            if not line.startswith(" ") and name is not None:
                text += inside if name not in self._dropped else []
                inside = []
        return "\n".join(text)

    def without(self, name):
        """Return the function with nothing in the place of a line: zeros, or no loop or branch."""
        smaller = copy.copy(self)
        smaller._dropped = self._dropped | {name}
        likes = {t.name: t for t in self._block.terms if t.kind != "k"}

        def nothing(known):
            like = likes.get(name)
            # Of no results, none can be looked up.
            return {} if like is None else jnp.zeros(like.shape, self.dtypes[like.kind])

        lines = [(n, text, nothing if n == name else do) for n, text, do in self._block.lines]
        smaller._block = Block(self._block.terms, lines)
        return smaller

    @property
    def is_exact(self):
        """Which of the function's results are exact: a tree like these."""
        return {
            "exact": dict.fromkeys(self._exact, True),
            "inexact": False,
            "whole": tuple(t.exact for t in self._whole_ones),
            "keys": [True] * len(self._keys),
        }

    def _numbers(self, known, chosen, kind):
        """Some numbers of terms, in one vector."""
        numbers = [known[term.name].ravel()[i] for term, i in chosen]
        return jnp.stack(numbers) if numbers else jnp.zeros(0, self.dtypes[kind])

    def _add_lines(self, count):
        for _ in range(count):
            choices = [(self._arithmetic, 6), (self._logic, 2), (self._whole_numbers, 2)]
            choices += [(self._moves, 3), (self._sums, 2), (self._choices, 2), (self._inexact, 2)]
            choices += [(self._words, 1), (self._random_numbers, 1), (self._orders, 1)]
            choices += [(self._matrices, 1), (self._whole_sums, 1)]
            if self._depth < 3:
                choices += [(self._control, (6, 5, 2)[self._depth])]
            does, weights = zip(*choices, strict=True)
            self._random.choices(does, weights)[0]()

    def _chosen(self, terms, kind, exact):
        """Numbers that the function returns: most of them of loops and branches."""
        numbers = [
            (t, i) for t in terms if (t.kind, t.exact) == (kind, exact) for i in range(t.size)
        ]
        count = RESULTS[kind]
        if len(numbers) <= count:
            return numbers
        controlled = [(t, i) for t, i in numbers if t.name in self._controlled] or numbers
        late = numbers[::-1][: count // 3]
        return [*late, *self._random.choices(controlled, k=count - len(late))]


def inputs(seed, count, dtypes=DTYPES):
    """Arguments of so many instances."""
    rng = np.random.default_rng(seed)
    dtypes = {kind: np.dtype(dtype).type for kind, dtype in dtypes.items()}
    most, words = int(LARGEST * 8), np.iinfo(dtypes["u"]).max
    draw = {
        "f": lambda shape: rng.integers(-most, most + 1, shape).astype(dtypes["f"]) / 8,
        "i": lambda shape: rng.integers(-9, 10, shape).astype(dtypes["i"]),
        "u": lambda shape: rng.integers(0, words, shape, dtypes["u"], endpoint=True),
        "b": lambda shape: rng.random(shape) < 0.5,
        "k": lambda shape: jax.random.split(jax.random.key(seed), shape),
    }
    return jax.tree.map(lambda x: draw[x.kind]((count, *x.shape)), ARGUMENTS)
