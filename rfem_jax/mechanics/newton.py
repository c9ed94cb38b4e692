"""Newton's corrections for implicit steps: the linearised equations of motion, solved by their structure.

Place in the pipeline: balance, condensation -> **newton** -> implicit integration.

The matrix is approximate: links have the inertia of their undeformed shape, and the stiffness of springs
and dampers but not that of gyroscopic and joint loads.  Every flexible link is then what `condensation`
makes of it, and the tree of links is solved by Featherstone's articulated-body recursion with these
inertias, for the residual and for unit multipliers of the cut joints at once; the multipliers follow from
the closure (theory (7.11) to (7.13)).  A matrix serves all corrections of one step.

Joints hang on the rfes where they are: rates of the angles of a rfe turn it about its present axes.
Springs are so stiff over a long step that a hundredth of a radian there would cost Newton's method most of
its rate.

Wrenches and accelerations of the skeleton are spatial vectors in global axes: of a link at the point of
its island (see `dynamics`), of a carrier at its own point.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import (
    apply, apply_transposed, by_component, constant_product, cross, dot, product, transpose,
)
from rfem_jax.mechanics.balance import Balance
from rfem_jax.mechanics.chains import solve
from rfem_jax.mechanics.condensation import LinkOperator
from rfem_jax.mechanics.cut_joints import Closure, invert_closure, unit_columns
from rfem_jax.mechanics.kinematics import Motion
from rfem_jax.mechanics.model import BASE, Coordinates, Topology
from rfem_jax.mechanics.realisation import Realisation


class LinkMatrix(NamedTuple):
    """One link in the present place, after the elimination of all that hangs on it.

    point (3,): of its spatial vectors; inertia (6, 6) felt at its hinge; frame (6, 6): link-axis wrenches at
    the link's origin to global ones at its island's point; turns 2 c of (3, 3): second derivatives of a
    carrier's angles and displacements to its accelerations in global axes;
    axis (6,): hinge; scaled (6,): inertia . axis / pivot; pivot: axis . inertia . axis (None: held);
    transfer (6, 6 c): wrench at the frame due to unit wrenches on the carriers; compliance (6 c, 6 c) of the
    carriers; hung (6 c, 6 c): inertias of what hangs on them, share (6 c, 6 c): of their own motion that it
    leaves; None where there is nothing of the kind.
    """

    point: Array
    inertia: Array
    frame: Array
    turns: tuple[Array, ...]
    axis: Array
    scaled: Array | None
    pivot: Array | None
    transfer: Array | None
    compliance: Array | None
    hung: Array | None
    share: Array | None


class NewtonMatrix(NamedTuple):
    """Factored matrix of one step: operators, links; units: wrenches (6, 5 C) of unit multipliers by node;
    responses to them; inverse (5 C, 5 C) of the closure's matrix."""

    operators: tuple[LinkOperator | None, ...]
    links: tuple[LinkMatrix, ...]
    units: dict[int, Array]
    responses: "Response"
    inverse: Array | None


class Response(NamedTuple):
    """Answers (..., K) to K columns of loads: loads {l: (6, K)} of links and all that hangs on them;
    hinges (L, K); links {l: (6, K)}; carriers {l: (6 c, K)}, on_carriers {l: (6 c, K)}: wrenches that the
    joints exert on them."""

    loads: tuple[Array, ...]
    hinges: Array
    links: tuple[Array, ...]
    carriers: tuple[Array | None, ...]
    on_carriers: tuple[Array | None, ...]


class Correction(NamedTuple):
    """What one Newton step adds: accelerations of the coordinates, multipliers (5, C)."""

    accelerations: Coordinates
    multipliers: Array


class Residual(NamedTuple):
    """What is left over of a balance: hinge (L,) [N m]; force, moment (3, N); closing (5, C): second
    derivative of Phi that there should not be [m/s^2]."""

    hinge: Array
    force: Array
    moment: Array
    closing: Array


def residual_of(left: Balance) -> Residual:
    """What a correction takes away."""
    return Residual(left.hinge, left.force, left.moment, left.closing)


def newton_matrix(
    realised: Realisation,
    operators: tuple[LinkOperator | None, ...],
    now: Motion,
    cuts: Closure | None,
    held: tuple[int, ...] = (),
) -> NewtonMatrix:
    """Matrix of the equations at one position; `held`: links whose joint's angle is given."""
    with jax.named_scope("newton_matrix"):
        topology = realised.topology
        links = _eliminate(realised, operators, now, held)
        if cuts is None:
            return NewtonMatrix(operators, links, {}, None, None)
        points = _points(topology, now)
        sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
        units = {
            node: unit_columns(topology, cuts, node, points[node])
            for node in sorted(set(sides))
            if node != BASE
        }
        width = (5 * topology.n_cuts,) + now.axis.shape[2:]
        hinge_loads = jnp.zeros((topology.n_links,) + width)
        responses = _respond(topology, links, hinge_loads, None, None, units, width)
        rows = sum(
            product(transpose(unit), _of_node(topology, responses, node))
            for node, unit in units.items()
        )
        return NewtonMatrix(operators, links, units, responses, invert_closure(topology, rows))


def correction(topology: Topology, matrix: NewtonMatrix, left: Residual) -> Correction:
    """Solve for the accelerations and multipliers that take away what is left over."""
    return correction_and_wrenches(topology, matrix, left)[0]


def correction_and_wrenches(
    topology: Topology, matrix: NewtonMatrix, left: Residual
) -> tuple[Correction, list[Array]]:
    """`correction`, and what it changes of the wrenches (6,) at the global origin in the tree joints."""
    with jax.named_scope("newton_correction"):
        operators = matrix.operators
        loads = jnp.concatenate([left.moment, left.force])
        on_rfes = tuple(by_component(loads[:, a:b]) for a, b in topology.ranges)
        on_links = tuple(
            None if operator is None else -constant_product(operator.reduced.T, load)
            for operator, load in zip(operators, on_rfes)
        )
        own = tuple(
            None if operator is None else constant_product(operator.pick, load)
            for operator, load in zip(operators, on_rfes)
        )
        width = (1,) + left.hinge.shape[1:]
        applied = _respond(
            topology, matrix.links, left.hinge[:, None], on_links, own, {}, width
        )
        answer = jax.tree.map(lambda x: x[:, 0], applied)
        multipliers = jnp.zeros_like(left.closing)
        if matrix.inverse is not None:
            rows = sum(
                apply_transposed(unit, _of_node(topology, answer, node))
                for node, unit in matrix.units.items()
            )
            by_cut = jnp.swapaxes(left.closing, 0, 1).reshape((-1,) + left.closing.shape[2:])
            flat = -apply(matrix.inverse, by_cut + rows)
            answer = jax.tree.map(lambda a, b: a + apply(b, flat), answer, matrix.responses)
            shape = (topology.n_cuts, 5) + flat.shape[1:]
            multipliers = jnp.swapaxes(flat.reshape(shape), 0, 1)
        elastic = _relative(topology, matrix, loads, answer)
        change = Correction(Coordinates(answer.hinges, elastic), multipliers)
        return change, _wrenches(matrix.links, answer)


def _wrenches(links: tuple[LinkMatrix, ...], answer: Response) -> list[Array]:
    """Wrenches (6,) at the global origin that move the links as they answer."""
    wrenches = []
    for link, load, acceleration in zip(links, answer.loads, answer.links):
        wrench = apply(link.inertia, acceleration) - load
        wrenches.append(algebra.wrench_at_origin(wrench[:3], wrench[3:], link.point))
    return wrenches


def _points(topology: Topology, now: Motion) -> dict[int, Array]:
    """Point at which each node's spatial vectors are taken."""
    n = topology.n_links
    points = {n + k: now.carriers.point[:, i] for i, k in enumerate(topology.carriers)}
    for l in range(n):
        root = topology.island_of(l)
        points[l] = points[root] if root >= n else now.hinges.point[:, root]
    return points


def _frame(rotation: Array, arm: Array) -> Array:
    """Wrenches in turned axes at a point to wrenches at another, `arm` away from it."""
    none = jnp.zeros_like(rotation)
    top = jnp.concatenate([rotation, product(algebra.cross_matrix(arm), rotation)], axis=1)
    return jnp.concatenate([top, jnp.concatenate([none, rotation], axis=1)])


def _turned(turns, columns: Array) -> Array:
    """Rows (3 k, n, ...) of k vectors, each by its matrix."""
    return jnp.concatenate(
        [product(turn, columns[3 * i : 3 * i + 3]) for i, turn in enumerate(turns)]
    )


def _turns(topology: Topology, now: Motion, link: int) -> tuple[Array, ...]:
    rotation, rate_matrix = now.links.rotation[:, :, link], now.relative.rate_matrix
    pairs = [
        (product(rotation, rate_matrix[:, :, node - topology.n_links]), rotation)
        for node in _carriers_of(topology, link)
    ]
    return tuple(turn for pair in pairs for turn in pair)


def _dual(turns) -> tuple[Array, ...]:
    """The matrices that turn a stiffness if `turns` turn the compliance."""
    return tuple(transpose(algebra.invert_block(turn)) for turn in turns)


def _constant(values: Array, example: Array) -> Array:
    """A constant matrix with trailing axes of length one, as many as `example` (3, 3, ...) has."""
    return values.reshape(values.shape + (1,) * (example.ndim - 2))


def _carriers_of(topology: Topology, link: int) -> tuple[int, ...]:
    first, last = topology.ranges[link]
    return tuple(topology.n_links + k for k in topology.carriers if first <= k < last)


def _eliminate(realised, operators, now: Motion, held) -> tuple[LinkMatrix, ...]:
    """From the chains' ends to the base: articulated inertias."""
    topology = realised.topology
    n = topology.n_links
    points = _points(topology, now)
    passed: dict[int, Array] = {}
    links: dict[int, LinkMatrix] = {}
    for l in reversed(range(n)):
        rotation, operator = now.links.rotation[:, :, l], operators[l]
        frame = _frame(rotation, now.links.point[:, l] - points[l])
        own = _rigid_inertia(realised, l) if operator is None else operator.inertia
        inertia = algebra.product_transposed(product(frame, _constant(own, frame)), frame)
        inertia = inertia + passed.get(l, 0.0)
        transfer = compliance = hung = share = None
        carriers, turns = _carriers_of(topology, l), _turns(topology, now, l)
        if carriers:
            # Rows and columns of the carriers in global axes at their own points.
            identity = _constant(algebra.IDENTITY, frame)
            shift = jnp.concatenate([_frame(identity, points[k] - points[l]) for k in carriers], axis=1)
            give = _turned(turns, _constant(operator.give, frame))
            transfer = shift - product(frame, transpose(give))
            compliance = _both(turns, _constant(operator.compliance, frame))
            if any(node in passed for node in carriers):
                hung = _block_diagonal([passed.get(node) for node in carriers], rotation)
                stiffness = _both(_dual(turns), _constant(operator.stiffness, frame))
                share = product(algebra.invert_positive(stiffness + hung), stiffness)
                inertia = inertia + product(
                    product(transfer, product(hung, share)), transpose(transfer)
                )
        axis = algebra.spatial(
            now.axis[:3, l], now.axis[3:, l] + cross(now.axis[:3, l], points[l])
        )
        at_hinge, scaled, pivot = inertia, None, None
        if l not in held:
            pushed = apply(inertia, axis)
            pivot = dot(axis, pushed)
            scaled = pushed / pivot[None]
            inertia = inertia - pushed[:, None] * scaled[None]
        node = topology.parents[l]
        if node != BASE:
            passed[node] = passed.get(node, 0.0) + inertia
        links[l] = LinkMatrix(
            points[l], at_hinge, frame, turns, axis, scaled, pivot, transfer, compliance, hung, share
        )
    return tuple(links[l] for l in range(n))


def _both(turns, matrix: Array) -> Array:
    """A symmetric matrix (6 c, 6 c) with rows and columns turned."""
    once = _turned(turns, matrix)
    return _turned(turns, transpose(once))


def _block_diagonal(blocks, example: Array) -> Array:
    none = jnp.zeros((6, 6) + example.shape[2:])
    blocks = [none if block is None else block for block in blocks]
    rows = [
        jnp.concatenate([block if i == j else none for j in range(len(blocks))], axis=1)
        for i, block in enumerate(blocks)
    ]
    return jnp.concatenate(rows)


def _rigid_inertia(realised: Realisation, link: int) -> Array:
    mass, centre = realised.mass[link], realised.centre[:, link]
    return algebra.spatial_inertia(mass, centre, realised.inertia[:, :, link])


def _respond(topology, links, hinge_loads, on_links, own, units, width) -> Response:
    """Accelerations for K columns of loads: moments (L, K) about the hinges, wrenches {l: (6, 1)} on the
    links in their axes and second derivatives `own` {l: (6 c, 1)} of the carriers' coordinates (the
    residual's), and wrenches `units` {node: (6, K)} on nodes."""
    n = topology.n_links
    none = jnp.zeros((6,) + width)
    loads: dict[int, Array] = dict(units)
    felt: dict[int, Array] = {}
    pushes: dict[int, Array] = {}
    on_carriers: dict[int, Array] = {}
    freely: dict[int, Array] = {}
    for l in reversed(range(n)):
        link, carriers = links[l], _carriers_of(topology, l)
        load = loads.get(l, none)
        if on_links is not None and on_links[l] is not None:
            load = load + apply(link.frame, on_links[l])[:, None]
        if carriers:
            wrench = jnp.concatenate([loads.get(node, none) for node in carriers])
            free = product(link.compliance, wrench)
            if own is not None:
                free = free + _turned(link.turns, own[l][:, None])
            if link.share is not None:
                # The wrench of what hangs there, for a frame at rest.
                free = product(link.share, free)
                wrench = wrench - product(link.hung, free)
            freely[l] = free
            load = load + product(link.transfer, wrench)
            on_carriers[l] = wrench
        felt[l] = load
        push = hinge_loads[l] + dot(link.axis[:, None], load)
        pushes[l] = push
        node = topology.parents[l]
        if node == BASE:
            continue
        if link.scaled is not None:
            load = load - link.scaled[:, None] * push[None]
        loads[node] = loads.get(node, 0.0) + load
    return _accelerate(topology, links, felt, pushes, freely, on_carriers, none)


def _accelerate(topology, links, felt, pushes, freely, wrenches, none) -> Response:
    """From the base to the chains' ends."""
    n = topology.n_links
    hinges, spatial, moved, on_carriers = [], [], [], []
    at: dict[int, Array] = {}
    for l in range(n):
        link, node = links[l], topology.parents[l]
        carried = none if node == BASE else at[node]
        rate = jnp.zeros_like(none[0])
        if link.scaled is not None:
            rate = pushes[l] / link.pivot[None] - dot(link.scaled[:, None], carried)
            carried = carried + link.axis[:, None] * rate[None]
        hinges.append(rate)
        spatial.append(carried)
        at[l] = carried
        carriers = _carriers_of(topology, l)
        if not carriers:
            moved.append(None)
            on_carriers.append(None)
            continue
        along = product(transpose(link.transfer), carried)
        wrench = wrenches[l]
        if link.share is not None:
            along = product(link.share, along)
            wrench = wrench - product(link.hung, along)
        ends = freely[l] + along
        moved.append(ends)
        on_carriers.append(wrench)
        for i, carrier in enumerate(carriers):
            at[carrier] = ends[6 * i : 6 * i + 6]
    loads = tuple(felt[l] for l in range(n))
    return Response(loads, jnp.stack(hinges), tuple(spatial), tuple(moved), tuple(on_carriers))


def _of_node(topology: Topology, response: Response, node: int) -> Array:
    """Acceleration (6, ...) of a link or a carrier."""
    if node < topology.n_links:
        return response.links[node]
    l = topology.link_of(node)
    i = _carriers_of(topology, l).index(node)
    return response.carriers[l][6 * i : 6 * i + 6]


def _relative(topology, matrix, loads: Array, answer: Response) -> Array:
    """Second derivatives (6, N) of the elastic coordinates under loads (6, N)."""
    parts = [jnp.zeros((6, 0) + loads.shape[2:])]
    for l, (operator, (a, b)) in enumerate(zip(matrix.operators, topology.ranges)):
        if operator is None:
            continue
        link = matrix.links[l]
        acceleration = apply_transposed(link.frame, answer.links[l])
        free = by_component(solve(operator.chain, loads[:, a:b]))
        y = free - constant_product(operator.reduced, acceleration)
        if answer.on_carriers[l] is not None:
            wrench = _turned_back(link.turns, answer.on_carriers[l])
            y = y + constant_product(operator.pick.T, wrench)
        parts.append(y.reshape((6, b - a) + y.shape[1:]))
    y = jnp.concatenate(parts, axis=1)
    return jnp.concatenate([y[3:], y[:3]])


def _turned_back(turns, wrench: Array) -> Array:
    return jnp.concatenate(
        [apply_transposed(turn, wrench[3 * i : 3 * i + 3]) for i, turn in enumerate(turns)]
    )
