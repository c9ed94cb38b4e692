"""Which joint a drive acts on: the model's driven joint, and no other.

Place in the pipeline: model, drive -> **driving** -> integration, stability.
"""

from rfem_jax.description.drives import MomentDrive, PrescribedDrive
from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.mechanics.model import Model, Topology

Drive = MomentDrive | PrescribedDrive | None


def require_driven(model: Model, drive: Drive) -> None:
    """Check that a drive acts on the model's driven joint; None always passes.

    **Raises:** `InputError` if the model has no driven joint, or another one.
    """
    if drive is None or drive.joint == model.driven_joint:
        driven = model.topology.driven
        if isinstance(drive, PrescribedDrive) and driven is not None and model.topology.tilted(driven) is not None:
            raise InputError(
                f"Argument `drive` must not prescribe the angle of joint `{drive.joint}` because its tilt is sprung, "
                "but does; leave its tilt rigid, drive another joint, or give a moment."
            )
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
