"""From a described mechanism to a model: discretisation, closed start, rank and mobility.

Place in the pipeline: description -> **discretisation** -> everything else.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.description.errors import InputError, require_choice
from rfem_jax.description.mechanism import ELEMENTS
from rfem_jax.mechanics import loads
from rfem_jax.mechanics.cut_joints import RANK_TOLERANCE, closure
from rfem_jax.mechanics.kinematics import motion
from rfem_jax.mechanics.model import Coordinates, Model, build_model
from rfem_jax.mechanics.realisation import assembly_errors, realise
from rfem_jax.mechanics.statics import length_scale

CLOSING_TOLERANCE = 1e-9


class Structure(NamedTuple):
    """Coordinates and constraints of a model at its nominal start.

    coordinates: number of coordinates; constraints: closure equations; rank: of their Jacobian;
    mobility: coordinates - rank; rigid_*: the same with every link rigid; redundant: the
    multipliers, hence the joint loads, are not unique.
    """

    coordinates: int
    constraints: int
    rank: int
    mobility: int
    rigid_coordinates: int
    rigid_rank: int
    rigid_mobility: int
    redundant: bool


def discretise(mechanism, rfes: int | None = None, elements: str | None = None) -> Model:
    """Divide the links into rigid finite elements and close the loops at the start.

    **Arguments:** `mechanism`: a `Mechanism`; `rfes`: number of rfes of every flexible link (None:
    each link's own); `elements`: "linear" or "geometrically_exact" spring-damping elements (None:
    the mechanism's).

    **Raises:** `InputError` if JAX is not in double precision, if the loops cannot be closed with
    the given lengths and start angles, or if the reactions are not unique and the mechanism does
    not ask for the minimum-norm ones.
    """
    require_double_precision()
    if rfes is not None and (rfes != int(rfes) or rfes < 2):
        raise InputError(f"Argument `rfes` must be a whole number of at least 2, but is {rfes}.")
    elements = mechanism.elements if elements is None else elements
    require_choice(elements, ELEMENTS, "elements")
    counts = {
        link.name: link.elements if rfes is None or link.elements == 1 else int(rfes)
        for link in mechanism.links
    }
    model = _close(build_model(mechanism, counts, elements == "geometrically_exact"))
    structure = describe(model)
    if structure.redundant and not model.topology.minimum_norm:
        raise InputError(
            f"Argument `mechanism` must have unique joint reactions, but its "
            f"{structure.constraints} closure equations have rank {structure.rank}: rigid loops with "
            "parallel axes are statically indeterminate. Make one link of each loop flexible, or set "
            'redundant_reactions = "minimum_norm" to get the reactions of least norm.'
        )
    return model


def require_double_precision() -> None:
    """Refuse to go on in float32."""
    if not jax.config.jax_enable_x64:
        raise InputError(
            "Argument `jax_enable_x64` must be True, but JAX computes in float32; put "
            '`jax.config.update("jax_enable_x64", True)` before the first call.'
        )


def describe(model: Model) -> Structure:
    """Rank and mobility at the nominal start, flexible and with every link rigid."""
    size = model.topology.n_links + 6 * model.topology.n_rfes
    jacobian = np.asarray(_jacobian(model))
    rank, rigid_rank = _rank(jacobian), _rank(jacobian[:, : model.topology.n_links])
    constraints = jacobian.shape[0]
    return Structure(
        coordinates=size,
        constraints=constraints,
        rank=rank,
        mobility=size - rank,
        rigid_coordinates=model.topology.n_links,
        rigid_rank=rigid_rank,
        rigid_mobility=model.topology.n_links - rigid_rank,
        redundant=rank < constraints,
    )


def _rank(jacobian: np.ndarray) -> int:
    if 0 in jacobian.shape:
        return 0
    singular = np.linalg.svd(jacobian, compute_uv=False)
    return int(np.sum(singular > 1e3 * RANK_TOLERANCE * singular[0]))


def _constraints(model: Model, position: Coordinates):
    realised = realise(model, assembly_errors(model))
    now = motion(realised, loads.static_state(position))
    cuts = closure(realised, now, length_scale(model))
    if cuts is None:
        return jnp.zeros(0), jnp.ones(0), jnp.zeros(0)
    return cuts.residual.T.reshape(-1) / length_scale(model), cuts.alignment, cuts.angle


@eqx.filter_jit
def _jacobian(model: Model):
    """Closure equations differentiated by all coordinates (5 cuts, coordinates), dimensionless."""
    slope = jax.jacfwd(lambda position: _constraints(model, position)[0])(
        model.start_coordinates()
    )
    elastic = jnp.moveaxis(slope.elastic, 1, 2)
    elastic = elastic.reshape(elastic.shape[0], 6 * model.topology.n_rfes)
    weights = jnp.tile(jnp.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), model.topology.n_rfes)
    lengths = length_scale(model) * weights + (1.0 - weights)
    return jnp.concatenate([slope.angles, elastic * lengths[None]], axis=1)


@eqx.filter_jit
def _closing_step(model: Model, angles):
    def residual(angles):
        out, alignment, turned = _constraints(
            model, Coordinates(angles, jnp.zeros((6, model.topology.n_rfes)))
        )
        return out, (out, alignment, turned)

    slope, (value, alignment, turned) = jax.jacfwd(residual, has_aux=True)(angles)
    return value, slope, alignment, turned


def close_at(model: Model, angles: np.ndarray):
    """Refine all joint angles but the driven one so that the nominal rigid loops close.

    **Returns:** angles (links,), remaining residuals (5 cuts,) over the longest link, y_L . y_P of
    each cut joint, and the angles of the cut joints.
    """
    topology = model.topology
    free = np.array([l for l in range(topology.n_links) if l != topology.driven], dtype=int)
    angles = np.array(angles)
    for _ in range(100):
        value, slope, _, _ = map(np.asarray, _closing_step(model, jnp.asarray(angles)))
        step = np.linalg.lstsq(slope[:, free], value, rcond=1e-10)[0]
        largest = np.abs(step).max(initial=0.0)
        angles[free] -= step * min(1.0, 0.5 / max(largest, 1e-300))
        if largest < 1e-14:
            break
    value, _, alignment, turned = map(np.asarray, _closing_step(model, jnp.asarray(angles)))
    return angles, value, alignment, turned


def _close(model: Model) -> Model:
    """Close the nominal rigid loops at the start, or say why they cannot close."""
    topology = model.topology
    if topology.n_cuts == 0:
        return model
    angles, value, alignment, turned = close_at(model, np.asarray(model.start_angles))
    gap = np.abs(value).max() * float(length_scale(model))
    if not gap < CLOSING_TOLERANCE * float(length_scale(model)):
        worst = topology.joints[topology.n_links + int(np.abs(value).argmax()) // 5]
        raise InputError(
            f"Argument `mechanism` must close at its start, but joint {worst!r} stays open by "
            f"{gap:.3g} m with every link rigid; check lengths, positions and start angles (all "
            "but the driven one are refined)."
        )
    if (alignment < 0.0).any():
        worst = topology.joints[topology.n_links + int(alignment.argmin())]
        raise InputError(
            f"Argument `mechanism` must close with both hinge axes of joint {worst!r} alike, but "
            "they point in opposite directions; turn the frame of its child by 180 deg."
        )
    return eqx.tree_at(
        lambda m: (m.start_angles, m.cut_angles), model, (jnp.asarray(angles), jnp.asarray(turned))
    )
