"""Curves in space by their arc length: straight pieces, arcs and cubic ones, one after the other.

Place in the pipeline: axes, cambers -> **curves** -> links, `mechanics.model.form`.

A piece is p(t) = sum_k a_k t^k + b (cos(angle t) - 1) + c sin(angle t), t from 0 to 1: straight ones and arcs are run
through evenly, and a cubic one is not: its t at an arc length is found by Newton's method. Source: theory (1.20).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.description.basics.numbers import traced

NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
NODES, WEIGHTS = 0.5 * (1.0 + NODES), 0.5 * WEIGHTS  # from 0 to 1
STEPS = 6  # of Newton's method, which doubles the digits
LOOKED_AT = 24  # places of each piece where the nearest one is looked for


Values = Array | np.ndarray


class CurvePoint(NamedTuple):
    """Places on a curve [m], unit tangents there, and angles [rad] by which sections are turned about them."""

    position: Float[Values, " 3 *n"]
    tangent: Float[Values, " 3 *n"]
    roll: Float[Values, "*n"]


class Piece(NamedTuple):
    """One piece of a curve; length [m]."""

    powers: Float[Values, "4 3"]
    turns: Float[Values, "2 3"]
    angle: Any
    length: Any


class Curve(eqx.Module):
    """A curve of k pieces: edges [m], arc lengths at their ends; powers a_k, turns (b, c) and angle as above; rolls
    [rad] at their ends; even: whether all pieces are straight or arcs."""

    edges: Float[Values, " ends"]
    powers: Float[Values, "4 3 pieces"]
    turns: Float[Values, "2 3 pieces"]
    angles: Float[Values, " pieces"]
    rolls: Float[Values, " ends"]
    even: bool = eqx.field(static=True)

    @property
    def length(self) -> Any:
        """Arc length [m]."""
        return self.edges[-1]

    @property
    def end(self) -> Float[Values, "3"]:
        """Its last place [m]."""
        return self.at(self.edges[-1:]).position[:, 0]

    def at(self, s: Float[Values, " n"]) -> CurvePoint:
        """Places at arc lengths [m]."""
        xp = self._module(s)
        there = _pieces_at(xp, self.edges, s)
        begin, size, angle = (one @ there for one in (self.edges[:-1], xp.diff(self.edges), self.angles))
        powers, turns, share = self.powers @ there, self.turns @ there, (s - begin) / size
        t = share if self.even else _place(xp, powers, share)
        position, rate = _evaluated(xp, (powers, turns, angle), t)
        speed = size if self.even else xp.sqrt(xp.sum(rate**2, axis=0))
        first, more = self.rolls[:-1] @ there, xp.diff(self.rolls) @ there
        return CurvePoint(position, rate / speed[None], first + more * share)

    def nearest(self, places: Float[Values, "3 n"]) -> Float[Values, " n"]:
        """Arc lengths [m] of the places on the curve that are nearest to given ones."""
        xp = self._module(places)
        shares = np.arange(LOOKED_AT + 1) / LOOKED_AT
        grid = (self.edges[:-1, None] + xp.diff(self.edges)[:, None] * shares[None]).reshape(-1)
        apart = xp.sum((places[:, :, None] - self.at(grid).position[:, None]) ** 2, axis=0)  # (n, grid)
        nearest = apart <= xp.min(apart, axis=1, keepdims=True)
        s = xp.sum(xp.where(nearest, grid[None], 0.0), axis=1) / xp.sum(xp.where(nearest, 1.0, 0.0), axis=1)
        for _ in range(2 * STEPS):
            here = self.at(s)
            s = s + xp.sum((places - here.position) * here.tangent, axis=0)
            s = xp.minimum(xp.maximum(s, 0.0), self.length)
        return s

    def _module(self, *more: Any) -> Any:
        return jnp if traced([*jax.tree.leaves(self), *more]) else np


class Camber(eqx.Module):
    """Offsets along y and z of a straight link by the place along it, in k pieces that are cubic: edges [m], powers [m]
    of the share of a piece."""

    edges: Float[Values, " ends"]
    powers: Float[Values, "4 2 pieces"]

    def at(self, s: Float[Values, " n"]) -> Float[Values, "4 n"]:
        """Offsets [m] along y and z at places [m], and their rates by these."""
        xp: Any = jnp if traced([*jax.tree.leaves(self), s]) else np
        there = _pieces_at(xp, self.edges, s)
        begin, size = self.edges[:-1] @ there, xp.diff(self.edges) @ there
        a, b, c, d = self.powers @ there
        t = ((s - begin) / size)[None]
        return xp.concatenate([a + t * (b + t * (c + t * d)), (b + t * (2.0 * c + 3.0 * t * d)) / size[None]])


def camber_through(places: Sequence[Any], offsets: Sequence[Any]) -> Camber:
    """The spline of offsets (2,) [m] by the places [m] along a link, as `smooth` has its coordinates."""
    xp: Any = jnp if traced([*places, *offsets]) else np
    edges = xp.stack([xp.asarray(one, float) for one in places])
    pieces = _cubics(xp, xp.stack([xp.asarray(one) for one in offsets]), xp.diff(edges))
    return Camber(edges, xp.stack(pieces, axis=-1))


def _pieces_at(xp: Any, edges: Any, s: Any) -> Any:
    """Whether (k, n) each of k pieces between edges holds each of n places, as 1 and 0."""
    last = edges.shape[0] - 2
    beyond = xp.stack([s >= edge for edge in edges[1:-1]]) if last else xp.zeros((0, *s.shape), bool)
    ones, nothing = xp.ones((1, *s.shape), bool), xp.zeros((1, *s.shape), bool)
    there = xp.concatenate([ones, beyond]) & ~xp.concatenate([beyond, nothing])
    return xp.where(there, 1.0, 0.0)


def _evaluated(xp: Any, piece: tuple[Any, Any, Any], t: Any) -> tuple[Any, Any]:
    """p(t) and its derivative."""
    (a, b, c, d), (even, odd), angle = piece
    cosine, sine = xp.cos(angle * t)[None], xp.sin(angle * t)[None]
    t, angle = t[None], angle[None]
    position = a + t * (b + t * (c + t * d)) + even * (cosine - 1.0) + odd * sine
    rate = b + t * (2.0 * c + 3.0 * t * d) + angle * (odd * cosine - even * sine)
    return position, rate


def _place(xp: Any, powers: Any, share: Any) -> Any:
    """t at a share of the length of a cubic piece."""

    def speed(t):
        rate = powers[1] + t[None] * (2.0 * powers[2] + 3.0 * t[None] * powers[3])
        return xp.sqrt(xp.sum(rate**2, axis=0))

    def length(t):
        return sum(t * weight * speed(t * node) for node, weight in zip(NODES, WEIGHTS))

    t, whole = share, length(xp.ones_like(share))
    for _ in range(STEPS):
        t = t - (length(t) - share * whole) / speed(t)
    return t


def straight(first: Any, last: Any) -> Piece:
    """A straight piece between two places (3,) [m]."""
    xp: Any = jnp if traced([first, last]) else np
    along, nothing = last - first, np.zeros(3)
    powers = xp.stack([first, along, nothing, nothing])
    return Piece(powers, np.zeros((2, 3)), 0.0, xp.sqrt(xp.sum(along**2)))


def arc(first: Any, through: Any, last: Any) -> Piece:
    """The arc from one place to another through a third one (3,) [m]."""
    xp: Any = jnp if traced([first, through, last]) else np
    u, v = through - first, last - first
    w = xp.cross(u, v)
    centre = (xp.sum(v**2) * xp.cross(w, u) + xp.sum(u**2) * xp.cross(v, w)) / (2.0 * xp.sum(w**2))
    out = -centre
    across = xp.cross(w, out) / xp.sqrt(xp.sum(w**2))
    x, y = xp.sum((v - centre) * out), xp.sum((v - centre) * across)
    whole = xp.arctan2(y, x)
    whole = xp.where(whole > 0.0, whole, whole + 2.0 * np.pi)
    nothing = np.zeros(3)
    powers = xp.stack([first, nothing, nothing, nothing])
    return Piece(powers, xp.stack([out, across]), whole, xp.sqrt(xp.sum(out**2)) * whole)


def smooth(points: Sequence[Any]) -> list[Piece]:
    """The cubic spline through places (3,) [m] with the distances between them as its knots, whose third derivative
    is continuous at the second and the last but one place; through three places a parabola, through two a line."""
    xp: Any = jnp if traced(list(points)) else np
    through = xp.stack(list(points))
    apart = xp.sqrt(xp.sum(xp.diff(through, axis=0) ** 2, axis=1))
    pieces = []
    for powers in _cubics(xp, through, apart):
        rates = [powers[1] + t * (2.0 * powers[2] + 3.0 * t * powers[3]) for t in NODES]
        length = sum(weight * xp.sqrt(xp.sum(rate**2)) for weight, rate in zip(WEIGHTS, rates))
        pieces.append(Piece(powers, np.zeros((2, 3)), 0.0, length))
    return pieces


def _cubics(xp: Any, through: Any, apart: Any) -> list[Any]:
    """The powers a_k (4, d) of the pieces of the spline through places (n, d), whose knots are `apart`."""
    slopes, pieces = _slopes(xp, through, apart), []
    for i in range(len(through) - 1):
        rise, first, last = through[i + 1] - through[i], apart[i] * slopes[i], apart[i] * slopes[i + 1]
        pieces.append(xp.stack([through[i], first, 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise]))
    return pieces


def _slopes(xp: Any, through: Any, apart: Any) -> Any:
    """Derivatives of the spline by its knots at all places (n, 3)."""
    rises, n = xp.diff(through, axis=0) / apart[:, None], len(apart)
    if n == 1:
        return xp.stack([rises[0], rises[0]])
    if n == 2:
        change = (rises[1] - rises[0]) / (apart[0] + apart[1])
        return xp.stack([rises[0] - apart[0] * change, rises[0] + apart[0] * change, rises[1] + apart[1] * change])
    zero = 0.0 * apart[0]
    rows, values = [], []
    for i in range(n + 1):
        row = [zero] * (n + 1)
        if 0 < i < n:
            row[i - 1], row[i], row[i + 1] = apart[i], 2.0 * (apart[i - 1] + apart[i]), apart[i - 1]
            values.append(3.0 * (apart[i] * rises[i - 1] + apart[i - 1] * rises[i]))
        else:
            # The third derivative is the same on both sides of the place next to the end.
            a, b = (0, 1) if i == 0 else (n - 1, n - 2)
            h, k = apart[a], apart[b]
            row[i], row[1 if i == 0 else n - 1] = k, h + k
            values.append(((h + 2.0 * (h + k)) * k * rises[a] + h**2 * rises[b]) / (h + k))
        rows.append(xp.stack([xp.asarray(one) for one in row]))
    return xp.linalg.solve(xp.stack(rows), xp.stack(values))


def joined(parts: Sequence[tuple[Sequence[Piece], Any]], even: bool) -> Curve:
    """The curve of pieces one after the other, which begins with a roll of zero; parts: pieces, and the roll [rad] at
    the end of these, up to which it changes evenly; even: as of the curve."""
    pieces = [piece for some, _ in parts for piece in some]
    xp: Any = jnp if traced(jax.tree.leaves(list(parts))) else np
    edges, rolls, before = [0.0], [0.0], 0.0
    for some, roll in parts:
        whole, so_far = sum(piece.length for piece in some), 0.0
        for piece in some:
            so_far = so_far + piece.length
            edges.append(edges[-1] + piece.length)
            rolls.append(before + (roll - before) * so_far / whole)
        before = roll
    stacked = [xp.stack([xp.asarray(one) for one in part], axis=-1) for part in zip(*pieces)]
    edges, rolls = (xp.stack([xp.asarray(one, float) for one in part]) for part in (edges, rolls))
    return Curve(edges, stacked[0], stacked[1], stacked[2], rolls, even)
