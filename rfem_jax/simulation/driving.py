"""Which joint a drive acts on: the model's driven joint, and no other; and the jumps of drive and forces.

Place in the pipeline: model, drive -> **driving** -> integration, stability.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from rfem_jax.description.drives import MomentDrive, PrescribedDrive
from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.mechanics.frame_forces import Time
from rfem_jax.mechanics.model import Model, Topology
from rfem_jax.mechanics.point_laws import breakpoints_of, changing

Drive = MomentDrive | PrescribedDrive | None


class Clocked(eqx.Module):
    """A drive beside forces that are functions of time; a phase counts the jumps of all of them that were passed."""

    drive: Drive
    jumps: tuple[float, ...] = eqx.field(static=True)

    def time(self, t, phase: Int[Array, ""]) -> Time:
        """The instant t [s] in a phase."""
        return Time(t, jnp.asarray((-1.0, *self.jumps))[phase])

    def own_phase(self, time: Time) -> Int[Array, ""]:
        """Number of the drive's own jumps that were passed."""
        own = () if self.drive is None else self.drive.breakpoints()
        return time.phase(own).astype(jnp.int32)


def jumps_of(drive: Drive, model: Model | None) -> tuple[float, ...]:
    """Times [s] > 0 at which the drive or a force of the model jumps, increasing."""
    own = () if drive is None else drive.breakpoints()
    of_forces = () if model is None else breakpoints_of(model.frame_forces)
    return tuple(sorted({*own, *of_forces})) if of_forces else own


def clocked(model: Model, drive: Drive) -> Drive | Clocked:
    """The drive with the jumps of all functions of time, where there are others than its own."""
    return Clocked(drive, jumps_of(drive, model)) if changing(model.frame_forces) else drive


def require_driven(model: Model, drive: Drive) -> None:
    """Check that a drive acts on the model's driven joint; None always passes.

    **Raises:** `InputError` if the model has no driven joint, or another one.
    """
    if drive is None or drive.joint == model.driven_joint:
        return
    tree = model.topology.joints[: model.topology.n_links]
    if drive.joint not in tree:
        raise InputError(
            f"Argument `drive` must act on a joint of the tree, but acts on `{drive.joint}`; "
            f"{suggestion(drive.joint, tree)}"
        )
    found = "the model has none" if model.driven_joint is None else f"that is `{model.driven_joint}`"
    raise InputError(
        f"Argument `drive` must act on the model's driven joint, but acts on `{drive.joint}` and {found}; the model is "
        f"assembled with this joint held, so describe it by Mechanism(..., driven_joint={drive.joint!r})."
    )


def driven_coordinate(topology: Topology) -> int:
    """Index of the driven joint's rate, of a model whose drive was checked by `require_driven`."""
    if topology.driven_coordinate is None:
        raise ValueError("The model has no driven joint; call `require_driven` before.")
    return topology.driven_coordinate


def driven_position(topology: Topology) -> int:
    """Index of the driven joint's coordinate in the position, as `driven_coordinate`."""
    if topology.driven_position is None:
        raise ValueError("The model has no driven joint; call `require_driven` before.")
    return topology.driven_position
