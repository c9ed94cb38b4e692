"""Where a mechanism is to be held: closed poses of the perfect rigid mechanism, and how these move.

Place in the pipeline: model, positions of what is held -> **poses** -> statics, turn.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import ArrayLike, Float

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.study_file.statics import DIMENSIONS_OF
from rfem_jax.mechanics.laws.couplings import RatioTransmission, Transmission
from rfem_jax.mechanics.model import nominal_geometry as nominal
from rfem_jax.mechanics.model.discretisation import CLOSING_TOLERANCE, close_at
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import Topology

LARGEST_MOVE = 0.2  # rad, or share of the longest link, between two poses of which one is sought from the other
DEAD_CENTRE = 1e-6  # share of the largest singular value of the loops' Jacobian: sine of the angle of a crank, about
Positions = Mapping[str, ArrayLike | str | Sequence[float | str]]


class ClosedPose(eqx.Module):
    """Coordinates of the tree joints [rad, m] and angles of the cut joints [rad] of the perfect rigid mechanism, at one
    position or, with a first axis, at several; rates and accelerations of the held coordinates in their order, None at
    rest."""

    start_joints: Float[Array, "*positions numbers"]
    cut_angles: Float[Array, "*positions cuts"]
    rates: Float[Array, "*positions held"] | None = None
    accelerations: Float[Array, "*positions held"] | None = None


def start_pose(model: Model) -> ClosedPose:
    """The start of a model as the only position."""
    return ClosedPose(model.start_joints[None], model.cut_angles[None])


def posed(model: Model, pose: ClosedPose) -> Model:
    """The model with its start at a closed pose."""
    return eqx.tree_at(lambda m: (m.start_joints, m.cut_angles), model, (pose.start_joints, pose.cut_angles))


def poses_at(
    model: Model, positions: Positions | None, rates: Positions | None = None, accelerations: Positions | None = None
) -> ClosedPose | None:
    """Closed poses at positions of held coordinates by their names; None for the start; with `rates` or
    `accelerations`, which may be empty, in motion. Raises `InputError` as `static_loads` and `inverse_dynamics`."""
    moving = rates is not None or accelerations is not None
    given = {"positions": positions or {}, "rates": rates or {}, "accelerations": accelerations or {}}
    if isinstance(model.start_joints, Tracer):
        if not moving and not positions:
            return None
        raise InputError(
            "Argument `positions` must be left out for a model of traced numbers, as its loops are closed before "
            "anything is compiled; vary its numbers as deviations among `errors`."
        )
    # Errors may be traced where this is called: places are none of these.
    with jax.ensure_compile_time_eval():
        if moving or positions:
            return _poses(model, given, moving)
        _require_decided(model, start_pose(model), ())
        return None


def _poses(model: Model, given: dict[str, Positions], moving: bool) -> ClosedPose:
    topology = model.topology
    if moving:
        _require_rigid(model)
    known = {topology.label_of(k): k for k in topology.held_at_start if not topology.freedoms[k].any_axis}
    wanted = {what: _by_coordinate(topology, what, values, known) for what, values in given.items()}
    count = max((len(values) for of in wanted.values() for values in of.values()), default=1)
    for what, values in given.items():
        for name in values:
            here = wanted[what][known[name]]
            if here.shape not in ((1,), (count,)) or not np.isfinite(here).all():
                raise InputError(
                    f"Argument `{what}` must have one finite number for each of {count} positions, or one for all, but "
                    f"that of {name!r} is {np.asarray(values[name]).tolist()}; correct it."
                )
    places = {k: np.broadcast_to(values, (count,)) for k, values in wanted["positions"].items()}
    if places:
        poses = search_poses(model, places, topology.held_at_start)
    else:
        start = start_pose(model)
        poses = jax.tree.map(lambda one: jnp.broadcast_to(one, (count, *one.shape[1:])), start)
    _require_decided(model, poses, tuple(places))
    if not moving:
        return poses

    def of_all(what: str) -> Float[Array, "positions held"]:
        columns = [np.broadcast_to(wanted[what].get(k, np.zeros(1)), (count,)) for k in topology.held_at_start]
        return jnp.asarray(np.stack(columns, axis=1))

    return ClosedPose(poses.start_joints, poses.cut_angles, of_all("rates"), of_all("accelerations"))


def _by_coordinate(
    topology: Topology, what: str, given: Positions, known: Mapping[str, int]
) -> dict[int, Float[np.ndarray, " positions"]]:
    """Values by the index of their coordinate. Raises `InputError` for what is not held, and for texts whose units do
    not fit."""

    def read(name: str, values: Any) -> np.ndarray:
        listed = [values] if isinstance(values, str) else values
        if any(isinstance(one, Tracer) for one in jax.tree.leaves(listed)):
            raise InputError(
                f"Argument `{what}` must hold known numbers, but that of {name!r} is traced; vary errors, parameters "
                "or a design instead."
            )
        if isinstance(listed, (list, tuple)):
            dimension = DIMENSIONS_OF[what][not topology.slides[known[name]]]
            listed = [quantity(one, dimension, what) if isinstance(one, str) else one for one in listed]
        return np.atleast_1d(np.asarray(listed, float))

    for name in given:
        if name not in known:
            raise InputError(
                f"Argument `{what}` must name coordinates that are held, but {name!r} is not; "
                f"{suggestion(name, known) if known else 'nothing is held: leave it out.'}"
            )
    return {known[name]: read(name, values) for name, values in given.items()}


def _require_decided(model: Model, poses: ClosedPose, given: tuple[int, ...]) -> None:
    """Raise `InputError` for a place at which rigid loops may go on in more than one way, or none, where all that is
    held stands: a dead centre, whose loads are infinite or anything. `given`: the coordinates whose positions are."""
    topology = model.topology
    free = np.setdiff1d(np.arange(topology.n_freedoms), topology.held_at_start)
    if topology.n_constraints == 0 or topology.settles or _gives_way(topology) or not free.size:
        return
    geometry = nominal.geometry_of(model)
    for i, joints in enumerate(np.asarray(poses.start_joints)):
        sizes = np.linalg.svd(
            nominal.closure_jacobian(geometry, nominal.place(geometry, joints))[:, free], compute_uv=False
        )
        if sizes[-1] > DEAD_CENTRE * sizes[0]:
            continue
        here = " and ".join(f"{topology.label_of(k)} = {joints[topology.place_of(k)]:.6g}" for k in given)
        held = ", ".join(f"`{topology.label_of(k)}`" for k in topology.held_at_start) or "nothing"
        raise InputError(
            f"Argument `positions` must be ones at which what is held ({held}) decides how the mechanism stands, but "
            f"{f'at {here} (number {i})' if given else 'at its start'} it is at a dead centre, where loads are "
            "infinite or undecided; give a place beside it, or hold another joint."
        )


def _gives_way(topology: Topology) -> bool:
    """Whether links or joints are not rigid."""
    return bool(topology.n_rfes or topology.sprung_coordinates or topology.sprung or topology.clearances)


def _require_rigid(model: Model) -> None:
    """Raise `InputError` for a model whose motion is not known by that of what is held."""
    topology = model.topology
    sentence = "Argument `model` must move as its held coordinates say, but "
    loaded = [] if model.friction is None else [name for name, law in model.friction.items() if law.load is not None]
    if loaded:
        raise InputError(
            f"Argument `model` must have no friction that depends on loads, which then depend on it, but `{loaded[0]}` "
            "does; give it as `constant` and `viscous`, or simulate the motion by generalised alpha."
        )
    if _gives_way(topology):
        what = "links are flexible" if topology.n_rfes else "joints give way"
        raise InputError(f"{sentence}its {what}, and would swing; make them rigid, or simulate the motion.")
    if topology.settles:
        raise InputError(f'{sentence}it starts in equilibrium; set start = "as_given", or give it drives.')
    if any(topology.freedoms[k].any_axis for k in topology.held_at_start) or not topology.held_at_start:
        raise InputError(
            f"{sentence}has free motions that no coordinate describes, or none at all; simulate the motion."
        )


class _Follower(NamedTuple):
    """A coordinate that a coupling moves with another one: their places, its index, and how far it goes as the other
    one goes from a position to another."""

    source: int
    place: int
    coordinate: int
    change: Callable[[float, float], float]


def _followers(model: Model, moved: Iterable[int], stay: Iterable[int]) -> tuple[_Follower, ...]:
    """Coordinates that couplings, elastic ones too, move with `moved` ones, in the order in which they are known; of
    `stay` none moves."""
    known, found = {*moved, *stay}, []
    reached = {*moved}
    while True:
        for law in (model.couplings or {}).values():
            (a, b), (first, second), function = law.coordinates, law.places, law.transmission
            if a in reached and b not in known:
                found.append(_Follower(first, second, b, partial(_transmitted, function)))
                break
            if b in reached and a not in known and isinstance(function, RatioTransmission):
                found.append(_Follower(second, first, a, partial(_returned, function)))
                break
        else:
            return tuple(found)
        known.add(found[-1].coordinate)
        reached.add(found[-1].coordinate)


def _transmitted(function: Transmission, old: float, new: float) -> float:
    return float(function.at(jnp.asarray(new))[0] - function.at(jnp.asarray(old))[0])


def _returned(function: RatioTransmission, old: float, new: float) -> float:
    return (new - old) / float(function.ratio)


def _closed_at(
    model: Model, guess: Float[np.ndarray, " numbers"], held: tuple[int, ...]
) -> tuple[Float[np.ndarray, " numbers"], Float[np.ndarray, " cuts"], bool]:
    """A pose close to a guess, angles of its cut joints, and whether it closes."""
    found, residual, alignment, cut = close_at(model, guess, held)
    return found, cut, bool(np.abs(residual).max(initial=0.0) <= CLOSING_TOLERANCE and (alignment >= 0.0).all())


def _followed(
    model: Model,
    pose: Float[np.ndarray, " numbers"],
    wanted: Mapping[int, float],
    units: Float[np.ndarray, " positions"],
    held: tuple[int, ...],
    followers: tuple[_Follower, ...],
) -> tuple[Float[np.ndarray, " numbers"], Float[np.ndarray, " cuts"], bool]:
    """The pose with these values at their places, its angles of cut joints, and whether it closes.

    It is followed from the pose before in small moves: one large move may end in another way to close. Where that
    leads through positions at which nothing closes, it is one move after all. `units`: of the places; what couplings
    move goes along, unless the loops say otherwise.
    """

    def closed(share: float, start: Float[np.ndarray, " numbers"]):
        guess = np.array(start)
        guess[at] = (1.0 - share) * pose[at] + share * values
        for one in followers:
            guess[one.place] += one.change(start[one.source], guess[one.source])
        here = _closed_at(model, guess, (*held, *(one.coordinate for one in followers)))
        return here if here[2] or not followers else _closed_at(model, guess, held)

    at, values = list(wanted), np.array(list(wanted.values()))
    moves = math.ceil(np.max(np.abs(values - pose[at]) / units) / LARGEST_MOVE)
    here, cut, closes = pose, np.zeros(0), moves > 0
    for n in range(moves):
        here, cut, closes = closed((n + 1) / moves, here)
        if not closes:
            break
    return (here, cut, closes) if closes else closed(1.0, pose)


def search_poses(
    model: Model, positions: Mapping[int, Float[np.ndarray, " positions"]], held: tuple[int, ...] | None = None
) -> ClosedPose:
    """Closed poses of the perfect rigid mechanism at positions [rad, m] of some coordinates, by their index; the search
    for each pose begins at the pose before; `held`: the coordinates that stay (None: those of drives).

    **Raises:** `InputError` for a position at which the mechanism does not close.
    """
    topology = model.topology
    places = {topology.place_of(k): values for k, values in positions.items()}
    units = nominal.joint_units(nominal.geometry_of(model))[list(positions)]
    names = [topology.label_of(k) for k in positions]
    held = topology.held if held is None else held
    followers = _followers(model, positions, held)
    pose, closed = np.asarray(model.start_joints), []
    for i in range(len(next(iter(places.values())))):
        wanted = {place: values[i] for place, values in places.items()}
        pose, cut, closes = _followed(model, pose, wanted, units, held, followers)
        if not closes:

            def at(numbers):
                return " and ".join(f"{x:.6g}" for x in numbers)

            last = "" if not closed else f"; the last position that closes is {at(closed[-1][0][p] for p in places)}"
            here = at(values[i] for values in places.values())
            raise InputError(
                f"Argument `positions` must be ones at which the mechanism closes, but at {here} (rad or m) of "
                f"joint `{'` and `'.join(names)}` it does not{last}; give a smaller range."
            )
        closed.append((pose, cut))
    joints, cuts = (np.stack(part) for part in zip(*closed, strict=True))
    return ClosedPose(jnp.asarray(joints), jnp.asarray(cuts))
