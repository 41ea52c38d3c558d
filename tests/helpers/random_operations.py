"""The kinds of straight lines of which random JAX functions consist."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from helpers.random_terms import BITS, BOUND, SHAPES, RandomLines, shaken


class Operations(RandomLines):
    """Lines without control flow: arithmetic, indices, sums, orders, matrices, random numbers."""

    def _arithmetic(self):
        shape = self._draw(SHAPES)
        x, y = self._of("f", shape), self._of("f", self._broadcastable(shape))
        a, b = x.name, y.name
        exact = x.exact and y.exact
        name = self._draw(["add", "sub", "mul", "max", "min", "neg", "abs", "half", "clip", "cube"])
        if name in ("add", "sub", "mul", "max", "min"):
            do, bound, bits = {
                "add": (jnp.add, x.bound + y.bound, max(x.bits, y.bits)),
                "sub": (jnp.subtract, x.bound + y.bound, max(x.bits, y.bits)),
                "mul": (jnp.multiply, x.bound * y.bound, x.bits + y.bits),
                "max": (jnp.maximum, max(x.bound, y.bound), max(x.bits, y.bits)),
                "min": (jnp.minimum, max(x.bound, y.bound), max(x.bits, y.bits)),
            }[name]
            self._emit(
                f"{name}({a}, {b})",
                lambda known: do(known[a], known[b]),
                shape,
                "f",
                bound,
                bits,
                exact,
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
        else:
            do, bound, bits = {
                "neg": (jnp.negative, x.bound, x.bits),
                "abs": (jnp.abs, x.bound, x.bits),
                "clip": (lambda v: jnp.clip(v, -1.5, 2.0), 2.0, max(1, x.bits)),
                "half": (lambda v: v / 2, x.bound / 2, x.bits + 1),
            }[name]
            self._emit(f"{name}({a})", lambda known: do(known[a]), shape, "f", bound, bits, x.exact)

    def _broadcastable(self, shape):
        """A shape that broadcasts to another one."""
        ones = tuple(1 if self._chance(0.3) else n for n in shape)
        return self._draw([shape, (), ones, shape[1:]])

    def _inexact(self):
        x, y = self._any("f"), self._any("f")
        y = y if y.shape == x.shape else self._of("f", x.shape)
        a, b = x.name, y.name
        forms = {
            "sin": (lambda p, q: jnp.sin(p), 1),
            "cos": (lambda p, q: jnp.cos(p), 1),
            "sqrt": (lambda p, q: jnp.sqrt(jnp.abs(p) + 0.25), math.sqrt(x.bound + 1)),
            "rsqrt": (lambda p, q: lax.rsqrt(jnp.abs(p) + 0.25), 2),
            "div": (lambda p, q: p / (jnp.abs(q) + 0.5), 2 * x.bound),
            "exp": (lambda p, q: jnp.exp(-jnp.abs(p)), 1),
            "expm1": (lambda p, q: jnp.expm1(jnp.clip(p, -3, 2)), 8),
            "log": (lambda p, q: jnp.log(jnp.abs(p) + 0.125), 2 + math.log1p(x.bound)),
            "log1p": (lambda p, q: jnp.log1p(jnp.abs(p)), math.log1p(x.bound)),
            "tanh": (lambda p, q: jnp.tanh(p), 1),
            "logistic": (lambda p, q: jax.nn.sigmoid(p), 1),
            "atan2": (lambda p, q: jnp.arctan2(jnp.abs(p) + 0.5, q), 4),
            "erf": (lambda p, q: lax.erf(p), 1),
            "pow": (lambda p, q: (jnp.abs(p) + 0.5) ** jnp.clip(q, -1, 1), x.bound + 2),
            "hypot": (lambda p, q: jnp.sqrt(p * p + q * q + 0.1), x.bound + y.bound + 1),
            "softmax": (lambda p, q: jax.nn.softmax(p.ravel()).reshape(p.shape), 1),
            "logsumexp": (
                lambda p, q: jnp.full(p.shape, jax.nn.logsumexp(p)),
                x.bound + math.log(max(x.size, 1)),
            ),
            "slope": (
                lambda p, q: jax.grad(lambda v: (jnp.sin(v) * q + jax.nn.softplus(v)).sum())(p),
                y.bound + 1,
            ),
        }
        name = self._draw(forms)
        do, bound = forms[name]
        self._emit(
            f"{name}({a}, {b})",
            lambda known: do(shaken(known, a), shaken(known, b)),
            x.shape,
            "f",
            bound,
            exact=False,
        )

    def _logic(self):
        shape = self._draw(SHAPES)
        name = self._draw(
            [*("lt", "le", "gt", "ge", "eq", "ne"), *("max", "and", "xor", "not", "all")]
        )
        if name in ("max", "and", "xor", "not", "all"):
            x, y = self._of("b", shape), self._of("b", shape)
            do = {
                "and": lambda p, q: p & q,
                "max": lambda p, q: jnp.maximum(p, jnp.minimum(p | q, q)),
                "xor": lambda p, q: p ^ q,
                "not": lambda p, q: ~p,
                "all": lambda p, q: jnp.broadcast_to(p.all() == q.any(), p.shape),
            }[name]
        else:
            kind = self._draw("ffiub")
            x, y = self._of(kind, shape, True), self._of(kind, shape, True)
            do = getattr(lax, name)
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name]),
            shape,
            "b",
        )

    def _whole_numbers(self):
        shape = self._draw(SHAPES)
        x, y = self._of("i", shape), self._of(self._draw("ib"), shape)
        bound = (x.bound + 1) * (y.bound + 1)
        forms = {
            "add": (lambda p, q: p + q, bound),
            "sub": (lambda p, q: p - q, bound),
            "mul": (lambda p, q: p * q, bound),
            "max": (jnp.maximum, bound),
            "min": (jnp.minimum, bound),
            "abs": (lambda p, q: jnp.abs(p), x.bound),
            "neg": (lambda p, q: jnp.sign(p) - p, x.bound + 1),
            "floor": (lambda p, q: p // (jnp.abs(q) + 1), x.bound),
            "mod": (lambda p, q: p % (jnp.abs(q) + 1), y.bound + 1),
            "div": (lambda p, q: lax.div(p, q * 2 - 1), x.bound),
            "rem": (lambda p, q: lax.rem(p, q * 2 + 1), x.bound),
            "shift": (lambda p, q: p << (q & 3), 8 * x.bound),
            "power": (lambda p, q: jnp.clip(p, -3, 3) ** 3, 27),
        }
        if self._chance(0.2):
            name = self._draw(["float", "bool"])
            kind = name[0]
            dtype = self.dtypes[kind]
            self._emit(
                f"{name}({x.name})",
                lambda known: known[x.name].astype(dtype),
                shape,
                kind,
                x.bound,
            )
            return
        name = self._draw(forms)
        do, bound = forms[name]
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name].astype(self.dtypes["i"])),
            shape,
            "i",
            bound,
        )

    def _words(self):
        shape = self._draw(SHAPES)
        x, y = self._of("u", shape), self._of("u", self._draw([shape, ()]))
        forms = {
            "add": lambda p, q: p + q,
            "sub": lambda p, q: p - q,
            "mul": lambda p, q: p * q,
            "and": lambda p, q: p & q,
            "or": lambda p, q: p | q,
            "xor": lambda p, q: p ^ q,
            "not": lambda p, q: ~p,
            "max": jnp.maximum,
            "min": jnp.minimum,
            "div": lambda p, q: p // (q | 1),
            "rem": lambda p, q: p % (q | 1),
            "left": lambda p, q: p << (q & 31),
            "right": lambda p, q: p >> (q & 31),
            "far": lambda p, q: lax.shift_right_logical(p, jnp.broadcast_to(q & 63, p.shape)),
            "with sign": lambda p, q: (p.view(self.signed) >> 3).view(p.dtype),
            "ones": lambda p, q: lax.population_count(p),
            "zeros": lambda p, q: lax.clz(p),
        }
        if self._chance(0.25):
            self._emit(
                f"int({x.name} % 17)",
                lambda known: (known[x.name] % 17).astype(self.dtypes["i"]),
                shape,
                "i",
                17,
            )
            return
        name = self._draw(forms)
        do = forms[name]
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name]),
            shape,
            "u",
        )

    def _random_numbers(self):
        key = self._of("k", ())
        x = self._of("f", self._draw([(3,), (4,)]), exact=True)
        shape = self._draw(SHAPES)
        i, where = self._scalar("i"), self._whole(0, 1)
        draw = jax.random
        splits = (lambda k, p, n: draw.split(k)[1]), (lambda k, p, n: draw.split(k, 3)[n])
        # Kind, bound, bits behind the point, whether it is exact, shape, and the numbers.
        forms = {
            "split": ("k", 0, 0, True, (), splits[where]),
            "fold in": ("k", 0, 0, True, (), lambda k, p, n: draw.fold_in(k, n)),
            "bits": ("u", 0, 0, True, shape, lambda k, p, n: draw.bits(k, shape)),
            "uniform": ("f", 1, 23, True, shape, lambda k, p, n: draw.uniform(k, shape)),
            "randint": ("i", 9, 0, True, shape, lambda k, p, n: draw.randint(k, shape, -5, 9)),
            "bernoulli": ("b", 0, 0, True, shape, lambda k, p, n: draw.bernoulli(k, 0.3, shape)),
            "choice": ("f", x.bound, x.bits, True, (2,), lambda k, p, n: draw.choice(k, p, (2,))),
            "permuted": (
                "f",
                x.bound,
                x.bits,
                True,
                x.shape,
                lambda k, p, n: draw.permutation(k, p),
            ),
            "categorical": ("i", 4, 0, True, (), lambda k, p, n: draw.categorical(k, p)),
            "normal": ("f", 6, 0, False, shape, lambda k, p, n: draw.normal(k, shape)),
            "exponential": ("f", 17, 0, False, shape, lambda k, p, n: draw.exponential(k, shape)),
            "truncated": (
                *("f", 2, 0, False, shape),
                lambda k, p, n: draw.truncated_normal(k, -1.0, 2.0, shape),
            ),
        }
        name = self._draw(["split", "fold in", *forms])
        kind, bound, bits, exact, shape_, do = forms[name]
        self._emit(
            f"random {name}({key.name}, {x.name}, {i.name})",
            lambda known: do(known[key.name], known[x.name], known[i.name]),
            shape_,
            kind,
            bound,
            bits,
            exact,
        )

    def _moves(self):
        kind = self._draw("fffibu")
        x = self._of(kind, self._draw([(2, 3), (3, 2), (4,), (3,)]))
        y = self._of(kind, x.shape)
        n = x.shape[0]
        k, order = self._whole(0, n - 1), [self._whole(0, n - 1) for _ in range(3)]
        keys = np.array([self._whole(0, 3) for _ in range(n)])
        # Mapped, such a place would be one of many.
        if not self._in_map and self._chance(0.4):
            self._moves_at(x, y)
            return
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
            "join with nothing": lambda p, q: jnp.concatenate([p[:0], q, p[n:]]),
            "cut": lambda p, q: lax.pad(p.ravel(), q.ravel()[0], [(-1, 2, 1)]),
            "swap": lambda p, q: jnp.moveaxis(jnp.stack([p, q], -1), -1, 0)[1],
        }
        name = self._draw(moves)
        do = moves[name]
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name]),
            self._shape_of(do, x, y),
            kind,
            max(x.bound, y.bound),
            max(x.bits, y.bits),
            x.exact and y.exact,
        )

    def _moves_at(self, x, y):
        """Reads and writes at an index that is a number of the function, also beyond the ends."""
        at = self._scalar("i")
        moves = {
            "read": lambda p, q, i: p[i],
            "take": lambda p, q, i: jnp.take(p, jnp.stack([i, -i, i + 1]), 0, mode="clip"),
            "take or wrap": lambda p, q, i: jnp.take(p, i, 0, mode="wrap"),
            "slice": lambda p, q, i: lax.dynamic_slice_in_dim(p, i, 2),
            "last axis": lambda p, q, i: lax.dynamic_slice_in_dim(p, i, 1, -1),
            "write": lambda p, q, i: p.at[i].set(q[0]),
            "write two": lambda p, q, i: p.at[jnp.stack([i, i - 1])].set(q[:2], mode="drop"),
            "update": lambda p, q, i: lax.dynamic_update_slice_in_dim(p, q[:2], i, 0),
            "roll": lambda p, q, i: jnp.roll(p, i, 0),
            "at most": lambda p, q, i: p.at[i].min(q[-1]),
            "nothing": lambda p, q, i: lax.dynamic_update_slice_in_dim(p, q[:0], i, 0),
        }
        if x.kind == "b":
            del moves["at most"]
        name = self._draw(moves)
        do = moves[name]
        self._emit(
            f"{name}({x.name}, {y.name}) at {at.name}",
            lambda known: do(known[x.name], known[y.name], known[at.name]),
            self._shape_of(do, x, y, at),
            x.kind,
            max(x.bound, y.bound),
            max(x.bits, y.bits),
            x.exact and y.exact,
        )

    def _sums(self):
        x = self._of("f", self._draw([(3,), (2, 3), (2, 2), (1, 3)]))
        y = self._of("f", (x.shape[-1], 2))
        k = [self._whole(0, x.shape[0] - 1) for _ in range(3)]
        sums = {
            "sum": lambda p, q: p.sum(-1),
            "total": lambda p, q: p.sum(),
            "max": lambda p, q: p.max(0),
            "min": lambda p, q: p.min(),
            "cumsum": lambda p, q: jnp.cumsum(p, -1),
            "cumsum backwards": lambda p, q: lax.cumsum(p, 0, reverse=True),
            "cummax": lambda p, q: lax.cummax(p, p.ndim - 1),
            "matmul": lambda p, q: jnp.matmul(p, q, precision="highest"),
            "outer": lambda p, q: jnp.einsum("...i,ij->j...", p, q, precision="highest"),
            "squares": lambda p, q: jnp.einsum("...i,...i->...", p, p, precision="highest"),
            "scatter": lambda p, q: p.at[jnp.array(k)].add(p[0]),
            "multiplied": lambda p, q: p.at[0].multiply(p[-1]),
            "mean of two": lambda p, q: (p[..., 0] + p[..., -1]) * 0.5,
            "of nothing": lambda p, q: p[:0].sum(0) + q[:, :0].max(initial=0.5),
            "product with nothing": lambda p, q: p[..., :0] @ q[:0],
            "of a scan": lambda p, q: lax.associative_scan(jnp.add, p.ravel()),
            "of each": lambda p, q: (
                jax.vmap(lambda a, b: (a * b).sum(), (None, 1), 0)(p[0], q)
                if p.ndim > 1
                else jax.vmap(jnp.dot, (None, 1))(p, q)
            ),
        }
        name = self._draw(sums)
        do = sums[name]
        # No more than six products, or six numbers, are added up; scaling may add a bit.
        self._emit(
            f"{name}({x.name}, {y.name}, {k})",
            lambda known: do(known[x.name], known[y.name]),
            self._shape_of(do, x, y),
            "f",
            6 * max(x.bound, y.bound, 1.0) ** 2,
            x.bits + max(x.bits, y.bits) + 1,
            x.exact and y.exact,
        )

    def _whole_sums(self):
        x = self._of("i", self._draw([(3,), (2, 3), (2, 2)]))
        x = x if x.bound <= 9 else self._clipped(x, 9)
        b = self._of("b", x.shape)
        sums = {
            "sum": lambda p, q: p.sum(-1),
            "max": lambda p, q: p.max(0),
            "min": lambda p, q: p.min(),
            "product": lambda p, q: jnp.clip(p, -2, 2).prod(-1),
            "cumsum": lambda p, q: jnp.cumsum(p, 0),
            "cummin": lambda p, q: lax.cummin(p, 0, reverse=True),
            "matmul": lambda p, q: p @ p.T,
            "count": lambda p, q: q.sum(),
            "counts": lambda p, q: jnp.cumsum(q, -1),
            "masked": lambda p, q: jnp.where(q, p, 0).sum(0),
            "where": lambda p, q: jnp.sum(p, where=q),
            "bins": lambda p, q: jnp.bincount(jnp.clip(p.ravel(), 0, 3), length=4),
            "first": lambda p, q: jnp.argmax(q, -1),
            "least": lambda p, q: jnp.argmin(p, 0),
            "places": lambda p, q: jnp.nonzero(q.ravel(), size=2, fill_value=-1)[0],
        }
        name = self._draw(sums)
        do = sums[name]
        self._emit(
            f"whole {name}({x.name}, {b.name})",
            lambda known: do(known[x.name], known[b.name]),
            self._shape_of(do, x, b),
            "i",
            6 * 81,
        )

    def _orders(self):
        kind = self._draw("ffiub")
        x = self._of(kind, self._draw([(3,), (4,), (2, 3)]), exact=True)
        y = self._of(self._draw("fi"), x.shape, exact=True)
        orders = {
            "sort": (x, lambda p, q: jnp.sort(p, -1)),
            "sort columns": (x, lambda p, q: jnp.sort(p, 0, descending=True)),
            "pairs": (y, lambda p, q: lax.sort((p, q), num_keys=1)[1]),
            "two keys": (x, lambda p, q: lax.sort((jnp.sign(q), p, q), num_keys=2)[1]),
            "argsort": (None, lambda p, q: jnp.argsort(p, -1)),
            "two largest": (y, lambda p, q: lax.top_k(q, 2)[0]),
            "their places": (None, lambda p, q: lax.top_k(q, 2)[1]),
            "argmax": (None, lambda p, q: jnp.argmax(p, -1)),
            "argmin": (None, lambda p, q: jnp.argmin(p)),
            "found": (None, lambda p, q: jnp.searchsorted(jnp.sort(p.ravel()), p.ravel()[0])),
            "different": (x, lambda p, q: jnp.unique(p, size=3)),
            "max": (x, lambda p, q: p.max(-1)),
        }
        name = self._draw(orders)
        like, do = orders[name]
        self._emit(
            f"{name}({x.name}, {y.name})",
            lambda known: do(known[x.name], known[y.name]),
            self._shape_of(do, x, y),
            like.kind if like else "i",
            like.bound if like else 6,
            like.bits if like else 0,
        )

    def _matrices(self):
        """Factors and systems of a positive definite matrix."""
        m = self._of("f", self._draw([(2, 2), (2, 3), (3, 2), (1, 3)]))
        n = m.shape[0]
        b = self._of("f", (n, 2))

        def matrix(m):
            m = jnp.clip(m, -2, 2)
            return jnp.matmul(m, m.T, precision="highest") + jnp.eye(n)

        def lower(m):
            return jnp.tril(jnp.clip(m[:, :1] * m[:, 0], -1, 1), -1) + 2 * jnp.eye(n)

        solve = jax.scipy.linalg.solve_triangular
        forms = {
            "cholesky": (lambda p, q: jnp.linalg.cholesky(matrix(p)), 4),
            "by cholesky": (
                lambda p, q: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix(p)), True), q),
                n * b.bound,
            ),
            "triangular": (lambda p, q: solve(lower(p), q, lower=True), 2 * b.bound),
            "transposed": (lambda p, q: solve(lower(p), q, lower=True, trans=1), 2 * b.bound),
            "upper": (lambda p, q: solve(lower(p).T, q[:, 0]), 2 * b.bound),
            "solution": (lambda p, q: jnp.linalg.solve(matrix(p), q), n * b.bound),
            "inverse": (lambda p, q: jnp.linalg.inv(matrix(p)), 1),
            "determinant": (lambda p, q: jnp.linalg.det(matrix(p)), 13.0**n),
            "R": (lambda p, q: jnp.abs(jnp.linalg.qr(matrix(p))[1]), 20),
            "norm": (lambda p, q: jnp.linalg.norm(matrix(p)), 40),
        }
        name = self._draw(forms)
        do, bound = forms[name]
        self._emit(
            f"{name}({m.name}, {b.name})",
            lambda known: do(shaken(known, m.name), shaken(known, b.name)),
            self._shape_of(do, m, b),
            "f",
            bound,
            exact=False,
        )

    def _choices(self):
        kind = self._draw("ffibuk")
        shape = () if kind == "k" else self._draw(SHAPES)
        cases = [self._of(kind, shape) for _ in range(self._whole(2, 4))]
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

        self._emit(
            f"select {which.name} of {[t.name for t in cases]}",
            do,
            shape,
            kind,
            max(t.bound for t in cases),
            max(t.bits for t in cases),
            all(t.exact for t in cases),
        )
