"""Craig-Bampton reduction: of the sparse matrices of a mesh of solids to interfaces and a few modes.

Place in the pipeline: reduced_bodies -> **reduction** -> the user's program, which has assembled mass and stiffness.

Symbols: u (3 p) displacements of p nodes [m], node after node; q (6 n) displacements and rotations of n interfaces;
C u = D q ties the nodes of all interfaces to q.  With multipliers lambda of these rows

    [[K, C^T], [C, 0]] [u; lambda] = [f; D q]

gives the constraint modes (f = 0, each q of one) and, with q = 0, the flexibility of the body between its interfaces,
whose largest eigenvalues are the modes of lowest frequency.  One factorisation serves both.
Source: Craig and Bampton, AIAA J. 6 (1968) 1313-1319.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_choice
from rfem_jax.description.basics.units import short, vector
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody

COUPLINGS = ("averaged", "rigid")
_SPREAD = 1e-6  # of the largest extent of the nodes of an interface: less, and they lie on one line


@dataclass(frozen=True, eq=False)
class Interface(ChecksItself):
    """Where a body of solids is held: nodes of its mesh, such as those of a bore, that move a frame at their middle.

    Args:
        place: (x, y, z) [m] of the frame in the axes of the link.
        nodes: numbers of the nodes, from 0.
        coupling: "averaged" moves the frame as the nodes move on the average and leaves their shape free (a pin in a
            bore, RBE3); "rigid" moves all nodes with the frame (a bore that a shaft is pressed into, RBE2).
        weights: of the nodes in the average, such as the area of the bore that each one stands for; None: equal ones.
    Raises:
        InputError: a value is of the wrong kind or out of range.
    """

    place: tuple[float, float, float]
    nodes: Sequence[int]
    coupling: str = "averaged"
    weights: Sequence[float] | None = None

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("place", vector, "length", "`place` of an interface")
        checks.convert("nodes", _numbers_of_nodes)
        checks.convert("coupling", require_choice, COUPLINGS, "`coupling` of an interface")
        if self.weights is not None:
            checks.relation(("nodes", "coupling"), self._check_weights)

    def _check_weights(self) -> None:
        given = np.asarray(self.weights, dtype=float)
        if self.coupling == "rigid" or given.shape != np.shape(self.nodes) or not (given >= 0.0).all():
            raise InputError(
                "Argument `weights` of an interface must be a number of at least 0 for each of its "
                f"{len(self.nodes)} nodes, of an averaged one, but was {short(self.weights)}; leave them out for equal "
                "ones."
            )
        object.__setattr__(self, "weights", given)

    def ties(self, nodes: Float[np.ndarray, "p 3"]) -> tuple[Any, Float[np.ndarray, "r 6"]]:
        """Rows of C, by displacements of its own nodes alone, and of D.

        Args: nodes, places (p, 3) [m] of all nodes of the mesh.
        Raises: InputError, the nodes are none of the mesh, or lie on one line, which leaves a rotation about it free.
        """
        own = np.asarray(self.nodes)
        if own.max() >= len(nodes):
            raise InputError(
                f"Argument `nodes` of an interface must be numbers of the {len(nodes)} nodes, from 0, but one is "
                f"{own.max()}; count from 0."
            )
        arms = nodes[own] - np.asarray(self.place)
        spread = np.linalg.svd(nodes[own] - nodes[own].mean(axis=0), compute_uv=False)
        if len(spread) < 2 or spread[1] <= _SPREAD * spread[0]:
            raise InputError(
                "Argument `nodes` of an interface must not lie on one line, about which nothing would hold them, but "
                f"its {len(own)} nodes do; take the nodes of a face or a bore."
            )
        rigid = rigid_motions(arms)
        if self.coupling == "rigid":
            return np.eye(3 * len(own)), rigid
        weights = np.repeat(np.ones(len(own)) if self.weights is None else np.asarray(self.weights), 3)
        return np.linalg.solve(rigid.T @ (weights[:, None] * rigid), rigid.T * weights), np.eye(6)


def rigid_motions(arms: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "3*p 6"]:
    """Displacements of points, each after the other, by those of the origin and by rotations about it."""
    motions = np.zeros((len(arms), 3, 6))
    motions[:, :, :3] = np.eye(3)
    for axis in range(3):
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arms)
    return motions.reshape(-1, 6)


def craig_bampton(
    mass: Any,
    stiffness: Any,
    nodes: Float[np.ndarray, "p 3"],
    interfaces: Sequence[Interface],
    modes: int = 10,
    damping: float = 0.0,
    stresses: Any = None,
    stress_names: tuple[str, ...] = (),
) -> ReducedBody:
    """Reduce a mesh of solids to its interfaces and its modes of lowest frequency between fixed interfaces.

    Args:
        mass, stiffness: (3 p, 3 p) [kg, N/m] of the free body, sparse (SciPy) or dense; rows are displacements along
            x, y and z of the first node, then of the next.  The mass is a consistent one, by which the integrals
            `moments` of the body are exact.
        nodes: places (p, 3) [m] of the nodes, in the axes of the link.
        interfaces: Interface objects without a common node; the first one becomes the origin of the link's frame.
        modes: number of modes, 0 for none (Guyan's reduction).
        damping: eta [s]: the damping matrix is eta times the stiffness.
        stresses: (6 k, 3 p) [Pa/m] at k places, sparse or dense: xx, yy, zz, xy, yz and zx of the first place by the
            displacements of the nodes, then of the next.
        stress_names: of these places.
    Returns:
        The body, with `moments`.
    Raises:
        InputError: sizes do not fit, or the matrices are not those of one free body.
    """
    from scipy.sparse import csc_array

    nodes = np.asarray(nodes, dtype=float)
    _check_sizes({"mass": mass, "stiffness": stiffness, "stresses": stresses}, nodes, modes, len(stress_names))
    mass, stiffness = csc_array(mass), csc_array(stiffness)
    ties, moved = _all_ties(nodes, interfaces)
    solve = _between_interfaces(stiffness, ties)
    basis = solve(np.zeros((3 * len(nodes), moved.shape[1])), moved)
    if modes:
        basis = np.hstack([basis, _modes(mass, stiffness, lambda load: solve(load, 0.0 * moved[:, :1]), modes)])
    held, places = mass @ basis, [one.place for one in interfaces]
    offsets = nodes - np.asarray(places[0])
    return ReducedBody(
        places,
        _symmetric(basis.T @ held),
        _symmetric(basis.T @ (stiffness @ basis)),
        damping,
        np.einsum("pa,pbn->abn", offsets, held.reshape(len(nodes), 3, -1)),
        None if stresses is None else (csc_array(stresses) @ basis).reshape(-1, 6, basis.shape[1]),
        stress_names,
    )


def _check_sizes(matrices: dict[str, Any], nodes: Any, modes: Any, places: int) -> None:
    if nodes.ndim != 2 or nodes.shape[1] != 3:
        raise InputError(f"Argument `nodes` must be places (p, 3), but has the shape {nodes.shape}; give x, y and z.")
    rows = 3 * len(nodes)
    for name, matrix in matrices.items():
        shape, wanted = np.shape(matrix), 6 * max(places, 1) if name == "stresses" else rows
        fits = len(shape) == 2 and shape[1] == rows and (shape[0] == wanted or (name == "stresses" and not places))
        if matrix is not None and (not fits or shape[0] % wanted or not shape[0]):
            raise InputError(
                f"Argument `{name}` must have three columns for each of {len(nodes)} nodes and {wanted} rows, but its "
                f"shape is {shape}; give all displacements of all nodes, and no rotations."
            )
    if not isinstance(modes, int) or isinstance(modes, bool) or not 0 <= modes < rows // 2:
        raise InputError(
            f"Argument `modes` must be a whole number from 0 to less than half of the {rows} rows, but was {modes!r}; "
            "ten are usual."
        )


def _all_ties(nodes: Float[np.ndarray, "p 3"], interfaces: Sequence[Interface]) -> tuple[Any, Float[np.ndarray, "r q"]]:
    """C (sparse) and D of all interfaces."""
    from scipy.sparse import csc_array, vstack

    if not interfaces or any(not isinstance(one, Interface) for one in interfaces):
        raise InputError(
            f"Argument `interfaces` must be a list of Interface objects, but was {short(interfaces)}; give one or more."
        )
    every = np.concatenate([np.asarray(one.nodes) for one in interfaces])
    if len(np.unique(every)) < len(every):
        raise InputError(
            "Argument `interfaces` must not have nodes in common, but some have; give every node to one interface once."
        )
    blocks, moved = [], np.zeros((0, 6 * len(interfaces)))
    for k, one in enumerate(interfaces):
        by_own, by_frame = one.ties(nodes)
        columns = (3 * np.asarray(one.nodes)[:, None] + np.arange(3)).reshape(-1)
        row, column = np.nonzero(by_own)
        entries = (by_own[row, column], (row, columns[column]))
        blocks.append(csc_array(entries, shape=(len(by_own), 3 * len(nodes))))
        own_rows = np.zeros((len(by_frame), moved.shape[1]))
        own_rows[:, 6 * k : 6 * k + 6] = by_frame
        moved = np.vstack([moved, own_rows])
    return vstack(blocks, format="csc"), moved


def _between_interfaces(stiffness: Any, ties: Any) -> Callable[[Any, Any], Any]:
    """A function of forces (3 p, m) and motions D q (r, m) that gives displacements (3 p, m)."""
    from scipy.sparse import block_array
    from scipy.sparse.linalg import splu

    rows, size = stiffness.shape[0], np.abs(stiffness.diagonal()).max()
    try:
        factors = splu(block_array([[stiffness, size * ties.T], [size * ties, None]], format="csc"))
    except RuntimeError:  # SuperLU: "Factor is exactly singular"
        raise InputError(
            "Argument `stiffness` must hold all nodes that no interface holds, but leaves some free; remove nodes that "
            "belong to no element, and join the parts of the mesh."
        ) from None

    def displacements(forces: Any, motions: Any) -> Any:
        return factors.solve(np.vstack([forces, size * motions]))[:rows]

    return displacements


def _modes(mass: Any, stiffness: Any, flexibility: Callable[[Any], Any], modes: int) -> Float[np.ndarray, "rows m"]:
    """Modes of lowest frequency between fixed interfaces, of unit modal mass."""
    from scipy.sparse.linalg import LinearOperator, eigsh

    rows = mass.shape[0]
    kind: Any = LinearOperator  # whose stubs know one of its two forms
    inverse = kind((rows, rows), matvec=lambda load: flexibility(load.reshape(-1, 1))[:, 0], dtype=float)
    # Eigenvectors have any sign, and a random start: a body that is made again is to be the same.
    start = flexibility(mass @ np.random.default_rng(0).normal(size=(rows, 1)))[:, 0]
    values, found = eigsh(stiffness, modes, mass, sigma=0.0, OPinv=inverse, v0=start)
    found = found[:, np.argsort(values)]
    return found * np.sign(found[np.abs(found).argmax(axis=0), np.arange(modes)])


def _symmetric(matrix: Float[np.ndarray, "N N"]) -> Float[np.ndarray, "N N"]:
    return 0.5 * (matrix + matrix.T)


def _numbers_of_nodes(given: Any) -> Any:
    numbers = np.asarray(given)
    if numbers.ndim != 1 or not numbers.size or not np.issubdtype(numbers.dtype, np.integer) or numbers.min() < 0:
        raise InputError(
            f"Argument `nodes` of an interface must be a list of numbers of nodes, from 0, but was {short(given)}; "
            "give whole numbers."
        )
    return numbers
