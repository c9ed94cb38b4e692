"""Cut joints: their constraint equations, with first and second derivatives by time.

Place in the pipeline: kinematics -> **cut_joints** -> dynamics, residual, newton, statics.

What a cut joint holds together is the complement of its kind's free motions (theory (5.1), (5.14), (5.15)): the
joint centres of the left side L and the right side P coincide (global axes), or are apart only along free
directions of L; and axes of L stay perpendicular to axes of P (times a length, so that all equations are in
metres and the multipliers in newtons).  Theory (5.3) is complete: gamma = -(Phi_q)_dot q_dot.  All cut joints of
one kind are one array axis.  Of a compliant joint the multipliers of sprung directions are no unknowns but what its
springs exert at the residual (theory (13.6)).

Symbols: a axes of L, b axes of P that stay perpendicular; r equations of centres, s of axes, n joints of a kind.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import KINDS, JointKind
from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import Scalar, apply, apply_transposed, cross, dot, product
from rfem_jax.mechanics.kinematics.ideal_couplings import CouplingRows
from rfem_jax.mechanics.kinematics.motion import Motion, node_frames
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring, diagonal_tangent
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class Constraints(eqx.Module):
    """The constraints of all cut joints of one kind at one instant.

    members: these joints, counted among the cut joints.  residual, rate, bias (r + s, n): Phi [m], its rate and
    (Phi_q)_dot q_dot.  forces (3, r, n): unit multipliers of the equations of centres as forces on P, None where
    these are the global axes; couples (3, s, n) [m]: moments on P of the other unit multipliers.  On L all act in
    the opposite sense.  left_point, right_point (3, n): where the forces act on L and on P.  sprung: which equations of
    each joint are laws of springs, () if none is.
    """

    kind: str = eqx.field(static=True)
    members: tuple[int, ...] = eqx.field(static=True)
    residual: Float[Array, "constraints n"]
    rate: Float[Array, "constraints n"]
    bias: Float[Array, "constraints n"]
    forces: Float[Array, "3 r n"] | None
    couples: Float[Array, "3 s n"]
    left_point: Float[Array, "3 n"]
    right_point: Float[Array, "3 n"]
    sprung: tuple[bool, ...] = eqx.field(static=True, default=())

    @property
    def n_centres(self) -> int:
        """Number r of equations of the centres of one joint."""
        return 3 if self.forces is None else self.forces.shape[1]

    def wrenches(self, place: int, side: str, point: Float[Array, "3"]) -> Float[Array, "6 constraints"]:
        """Wrenches at `point` of unit multipliers of one of the joints as they act on P (`side` "child"), or on L
        ("parent") with the opposite sign."""
        arm = (self.right_point if side == "child" else self.left_point)[:, place] - point
        couples = self.couples[:, :, place]
        if self.forces is None:
            forces = jnp.asarray(np.hstack([vectors.IDENTITY, np.zeros(couples.shape)]))
            moments = jnp.concatenate([vectors.cross_matrix(arm), couples], axis=1)
            return jnp.concatenate([moments, forces])
        of_centres = self.forces[:, :, place]
        moments = jnp.concatenate([cross(arm[:, None], of_centres), couples], axis=1)
        return jnp.concatenate([moments, jnp.concatenate([of_centres, jnp.zeros_like(couples)], axis=1)])

    def loads(self, multipliers: Float[Array, "constraints n"]) -> tuple[Float[Array, "3 n"], Float[Array, "3 n"]]:
        """Forces on P, and moments about its centre, of revolute joints about that of L, in global axes."""
        r = self.n_centres
        force = multipliers[:r] if self.forces is None else apply(self.forces, multipliers[:r])
        couple = dot(jnp.swapaxes(self.couples, 0, 1), multipliers[r:, None])
        if self.kind == "revolute":
            couple = couple + cross(self.right_point - self.left_point, force)
        return force, couple


class SpringMultipliers(NamedTuple):
    """Multipliers [N] of the springs of compliant cut joints, zero in all other equations, and the power [W] that their
    dampers dissipate."""

    multipliers: Float[Array, " constraints"]
    dissipated: Float[Array, ""]


class Closure(NamedTuple):
    """All cut joints at one instant.

    groups: their constraints, a group a kind; rotation (3, 3, C), centre (3, C): the frames L; right_centre: the
    joints' centres on P; alignment (C,): above 0 where a joint is closed as it is built, below 0 where its axes
    point in opposite directions (theory (5.11), (5.16)); angle (C,) [rad]: from L to P about y of L; springs: what the
    springs of compliant joints exert, None without any; scale [m]: by which equations of axes are multiplied, None
    where the least of redundant reactions are not asked for; couplings: equations [m] of ideal couplings, which come
    last, None without any.
    """

    groups: tuple[Constraints, ...]
    rotation: Float[Array, "3 3 cuts"]
    centre: Float[Array, "3 cuts"]
    right_centre: Float[Array, "3 cuts"]
    alignment: Float[Array, " cuts"]
    angle: Float[Array, " cuts"]
    springs: "SpringMultipliers | None" = None
    scale: Float[Array, ""] | None = None
    couplings: CouplingRows | None = None

    @property
    def sprung_rows(self) -> tuple[bool, ...]:
        """For every equation, cut by cut, whether it is the law of a spring; () for models without such springs."""
        if self.springs is None:
            return ()
        by_cut = {i: group.sprung or (False,) * group.residual.shape[0] for group in self.groups for i in group.members}
        coupled = 0 if self.couplings is None else self.couplings.residual.shape[0]
        return (*(row for i in sorted(by_cut) for row in by_cut[i]), *(False for _ in range(coupled)))

    @property
    def residual(self) -> Float[Array, " constraints"]:
        """Phi [m], cut by cut, then of ideal couplings."""
        return self._cut_by_cut([group.residual for group in self.groups], "residual")

    @property
    def rate(self) -> Float[Array, " constraints"]:
        """The rate of Phi [m/s]."""
        return self._cut_by_cut([group.rate for group in self.groups], "rate")

    @property
    def bias(self) -> Float[Array, " constraints"]:
        """(Phi_q)_dot q_dot [m/s^2]."""
        return self._cut_by_cut([group.bias for group in self.groups], "bias")

    def by_group(self, multipliers: Float[Array, " constraints"]) -> list[Float[Array, "rows n"]]:
        """Rows of the closure equations of cut joints, joints of a kind side by side."""
        if self.couplings is not None:
            multipliers = multipliers[: multipliers.shape[0] - self.couplings.residual.shape[0]]
        if len(self.groups) == 1:
            (group,) = self.groups
            return [jnp.swapaxes(multipliers.reshape(len(group.members), -1), 0, 1)]
        order = sorted((i, group.residual.shape[0]) for group in self.groups for i in group.members)
        stops = np.cumsum([size for _, size in order])
        return [
            jnp.stack([multipliers[stops[i] - group.residual.shape[0] : stops[i]] for i in group.members], axis=1)
            for group in self.groups
        ]

    def place_of(self, cut: int) -> tuple[Constraints, int]:
        """The group of a cut joint, and its place there."""
        return next((group, group.members.index(cut)) for group in self.groups if cut in group.members)

    def wrenches(self, cut: int, side: str, point: Float[Array, "3"]) -> Float[Array, "6 rows"]:
        """`Constraints.wrenches` of one cut joint."""
        group, place = self.place_of(cut)
        return group.wrenches(place, side, point)

    def _cut_by_cut(self, parts: list[Array], of_couplings: str) -> Array:
        """Rows (r, n) of all groups as one vector, all of the first cut joint first, and the field of the couplings."""
        single = len(parts) == 1
        rows = [jnp.swapaxes(parts[0], 0, 1).reshape(-1)] if single else _ordered_columns(self.groups, parts)
        if self.couplings is not None:
            rows = [*rows, getattr(self.couplings, of_couplings)]
        return rows[0] if len(rows) == 1 else jnp.concatenate(rows)


def _ordered_columns(groups: Sequence[Constraints], parts: Sequence[Array]) -> list[Array]:
    """Columns of the last axis of all groups, in the order of the cut joints."""
    by_cut = {i: part[..., k] for group, part in zip(groups, parts) for k, i in enumerate(group.members)}
    return [by_cut[i] for i in sorted(by_cut)]


def columns(groups: Sequence[Constraints], parts: Sequence[Float[Array, "*k n"]]) -> Float[Array, "*k cuts"]:
    """Columns of all groups in the order of the cut joints."""
    return parts[0] if len(parts) == 1 else jnp.stack(_ordered_columns(groups, parts), axis=-1)


class _Side(NamedTuple):
    """One side of n cut joints: axes (3, 3, n) and centre (3, n), their rates, and their second derivatives for
    q_ddot = 0."""

    axes: Float[Array, "3 3 n"]
    axes_rate: Float[Array, "3 3 n"]
    axes_bias: Float[Array, "3 3 n"]
    centre: Float[Array, "3 n"]
    velocity: Float[Array, "3 n"]
    centre_bias: Float[Array, "3 n"]


@jax.jit  # traced once for all its places
def closure(actual: ModelWithErrors, motion: Motion, scale: Scalar) -> Closure | None:
    """Constraints of all cut joints and ideal couplings (None without any); `scale` [m] multiplies the equations of
    axes, and of couplings at angles."""
    topology = actual.topology
    couplings = None if motion.couplings is None else motion.couplings.in_metres(actual, scale)
    least = jnp.asarray(scale) if topology.minimum_norm else None
    if topology.n_cuts == 0 and couplings is None:
        return None
    if topology.n_cuts == 0:
        none = jnp.zeros((3, 0))
        return Closure((), jnp.zeros((3, 3, 0)), none, none, none[0], none[0], scale=least, couplings=couplings)
    with jax.named_scope("closure"):
        n, c = topology.n_links, topology.n_cuts
        nodes = topology.parents[n:] + topology.children[n:]
        frames = node_frames(topology, motion, nodes)
        in_node = jnp.concatenate([actual.seat_rotation[:, :, n:], actual.bore_rotation[:, :, n:]], axis=2)
        offset = jnp.concatenate([actual.seat_position[:, n:], actual.bore_position[:, n:]], axis=1)
        rotation = product(frames.rotation, in_node)
        centre = frames.point + apply(frames.rotation, offset)
        spin = frames.velocity[:3]
        velocity = frames.velocity[3:] + cross(spin, centre)
        axis_rate = cross(spin[:, None], rotation)
        centre_bias, axis_bias = cross(spin, velocity), cross(spin[:, None], axis_rate)
        both = _Side(rotation, axis_rate, axis_bias, centre, velocity, centre_bias)
        left, right = _Side(*(part[..., :c] for part in both)), _Side(*(part[..., c:] for part in both))
        kinds = [(topology.kinds[j], topology.sprung[j] if topology.sprung else ()) for j in topology.cuts]
        groups = []
        for kind in dict.fromkeys(kinds):
            members = tuple(i for i in range(c) if kinds[i] == kind)
            on_left, on_right = (_Side(*(_members(part, members) for part in side)) for side in (left, right))
            rows = topology.constraints[members[0]]
            sprung = topology.sprung_rows[rows.start : rows.stop]
            groups.append(_constraints(KINDS[kind[0]], members, on_left, on_right, scale, sprung))
        x = apply_transposed(left.axes, right.axes[:, 0])
        alignment = [
            _alignment(KINDS[group.kind], *(_members(side.axes, group.members) for side in (left, right)))
            for group in groups
        ]
        cuts = Closure(
            groups=tuple(groups),
            rotation=left.axes,
            centre=left.centre,
            right_centre=right.centre,
            alignment=columns(groups, alignment),
            angle=jnp.arctan2(-x[2], x[0]),
            scale=least,
            couplings=couplings,
        )
        return cuts._replace(springs=_spring_multipliers(actual, cuts, scale)) if topology.sprung_rows else cuts


def cut_springs(actual: ModelWithErrors) -> list[CompliantSpring]:
    """The springs of compliant cut joints."""
    return [spring for spring in (actual.springs or {}).values() if spring.rows]


def _scattered(parts: dict[int, Array], size: int) -> Float[Array, " constraints"]:
    """A vector with given entries, zero elsewhere."""
    return jnp.stack([parts.get(k, jnp.zeros(())) for k in range(size)])


def _spring_multipliers(actual: ModelWithErrors, cuts: Closure, scale: Scalar) -> SpringMultipliers:
    """Forces of the springs of compliant cut joints (theory (13.6), (13.7))."""
    residual, rate = cuts.residual, cuts.rate
    by_row, dissipated = {}, jnp.zeros(())
    for spring in cut_springs(actual):
        at, moving = (jnp.stack([values[k] for k in spring.rows]) for values in (residual, rate))
        exerted = spring.in_rows(at, moving, scale)
        by_row |= dict(zip(spring.rows, exerted))
        dissipated = dissipated - dot(exerted - spring.in_rows(at, 0.0 * moving, scale), moving)
    return SpringMultipliers(_scattered(by_row, residual.shape[0]), dissipated)


def spring_row_tangent(
    actual: ModelWithErrors, cuts: Closure | None, scale: Scalar, q_factor: Scalar, v_factor: Scalar
) -> Float[Array, " constraints"] | None:
    """Minus the derivatives of the springs' multipliers [N] with respect to the second derivatives of their own
    residuals, for the derivatives of residual [s^2] and rate [s] by these; None without such springs."""
    if cuts is None or cuts.springs is None:
        return None
    residual, rate = cuts.residual, cuts.rate
    by_row = {}
    for spring in cut_springs(actual):
        at = [jnp.stack([values[k] for k in spring.rows]) for values in (residual, rate)]
        tangent = diagonal_tangent(partial(_exerted, spring, scale), at[0], at[1], q_factor, v_factor)
        by_row |= dict(zip(spring.rows, tangent))
    return _scattered(by_row, residual.shape[0])


def _exerted(spring: CompliantSpring, scale: Scalar, residual: Array, rate: Array) -> Array:
    return spring.in_rows(residual, rate, scale)


def cut_spring_energy(actual: ModelWithErrors, motion: Motion) -> Float[Array, ""]:
    """Potential energy [J] of the springs of compliant cut joints."""
    cuts = closure(actual, motion, jnp.ones(()))
    residual = jnp.zeros((0,)) if cuts is None else cuts.residual
    energies = [
        spring.energy_in_rows(jnp.stack([residual[k] for k in spring.rows]), jnp.ones(()))
        for spring in cut_springs(actual)
    ]
    return jnp.asarray(sum(energies, jnp.zeros(())))


def spring_residual(
    topology: Topology, cuts: Closure, multipliers: Float[Array, " constraints"], closing: Float[Array, " constraints"]
) -> Float[Array, " constraints"]:
    """The residuals of the closure equations `closing`, and in the places of springs' laws multipliers less what the
    springs exert [N]."""
    if cuts.springs is None:
        return closing
    return jnp.where(np.array(topology.sprung_rows), multipliers - cuts.springs.multipliers, closing)


def _members(values: Array, members: tuple[int, ...]) -> Array:
    """Columns of the last axis, the array itself where these are all."""
    if members == tuple(range(values.shape[-1])):
        return values
    return vectors.columns(values, members)


def _constraints(
    kind: JointKind, members: tuple[int, ...], left: _Side, right: _Side, scale: Scalar, sprung: tuple[bool, ...]
) -> Constraints:
    coincident = kind.coincident and not any(sprung[: len(kind.across)])
    centres = _coincidence(left, right) if coincident else _guidance(kind.across, left, right)
    forces, left_point, *of_centres = centres
    couples, *of_axes = _perpendicularity(kind.perpendicular, left, right, scale)
    residual, rate, bias = (jnp.concatenate(parts) for parts in zip(of_centres, of_axes))
    return Constraints(kind.name, members, residual, rate, bias, forces, couples, left_point, right.centre, sprung)


def _coincidence(left: _Side, right: _Side) -> tuple[None, Array, Array, Array, Array]:
    """The centres coincide (theory (5.1)): forces, where they act on L, residual, rate, bias."""
    return (
        None,
        left.centre,
        right.centre - left.centre,
        right.velocity - left.velocity,
        right.centre_bias - left.centre_bias,
    )


def _guidance(across: tuple[int, ...], left: _Side, right: _Side) -> tuple[Array, Array, Array, Array, Array]:
    """The centre of P stays on lines or planes of L (theory (5.14)); as `_coincidence`."""
    a, a_rate, a_bias = (
        jnp.stack([part[:, i] for i in across], axis=1) for part in (left.axes, left.axes_rate, left.axes_bias)
    )
    d, d_rate = (right.centre - left.centre)[:, None], (right.velocity - left.velocity)[:, None]
    d_bias = (right.centre_bias - left.centre_bias)[:, None]
    # On L the force acts at the centre of P, too.
    return (
        a,
        right.centre,
        dot(a, d),
        dot(a_rate, d) + dot(a, d_rate),
        dot(a_bias, d) + 2.0 * dot(a_rate, d_rate) + dot(a, d_bias),
    )


def _perpendicularity(
    pairs: tuple[tuple[int, int], ...], left: _Side, right: _Side, scale: Scalar
) -> tuple[Array, Array, Array, Array]:
    """Axes of L are perpendicular to axes of P (theory (5.1), (5.15)): couples, residual, rate, bias."""
    if not pairs:
        none = left.centre[:0]
        return left.centre[:, None][:, :0], none, none, none
    on_left = {i for i, _ in pairs}

    def of_left(part: Array) -> Array:
        return vectors.columns(part, [pairs[0][0]] if len(on_left) == 1 else [i for i, _ in pairs], axis=1)

    a, a_rate, a_bias = (of_left(part) for part in (left.axes, left.axes_rate, left.axes_bias))
    b, b_rate, b_bias = (
        vectors.columns(part, [j for _, j in pairs], axis=1) for part in (right.axes, right.axes_rate, right.axes_bias)
    )
    bend = dot(a, b)
    bend_rate = dot(a_rate, b) + dot(a, b_rate)
    bend_bias = dot(a_bias, b) + 2.0 * dot(a_rate, b_rate) + dot(a, b_bias)
    return scale * cross(b, a), scale * bend, scale * bend_rate, scale * bend_bias


def _alignment(kind: JointKind, left: Float[Array, "3 3 n"], right: Float[Array, "3 3 n"]) -> Float[Array, " n"]:
    """Sign by which the solutions of a kind's equations of axes differ, at most 1 (theory (5.11), (5.16))."""
    if kind.angles == 0:
        # Turned by 180 deg about any axis, frames solve the equations, too.
        return 0.5 * (jnp.sum(left * right, axis=(0, 1)) - 1.0)
    if kind.angles == 3:
        return jnp.ones_like(left[0, 0])
    axis = next(freedom.axis for freedom in kind.freedoms if freedom.rotation)
    return dot(left[:, axis], right[:, axis])


def unit_columns(
    topology: Topology, cuts: Closure, node: int, point: Float[Array, "3"]
) -> Float[Array, "6 multipliers"]:
    """Wrenches at `point` on one node of unit multipliers of all cut joints: columns of Phi_q^T."""
    columns = []
    for i, j in enumerate(topology.cuts):
        unit = jnp.zeros((6, len(topology.constraints[i])) + point.shape[1:])
        if node == topology.children[j]:
            unit = unit + cuts.wrenches(i, "child", point)
        if node == topology.parents[j]:
            unit = unit - cuts.wrenches(i, "parent", point)
        columns.append(unit)
    if topology.ideal:  # they act along joint coordinates alone
        columns.append(jnp.zeros((6, len(topology.ideal))))
    return jnp.concatenate(columns, axis=1)
