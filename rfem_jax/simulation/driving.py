"""Which joint a drive acts on: the model's driven joint, and no other.

Place in the pipeline: model, drive -> **driving** -> integration, stability.
"""

from rfem_jax.description.drives import MomentDrive, PrescribedDrive
from rfem_jax.mechanics.model import Topology

Drive = MomentDrive | PrescribedDrive | None


def driven_index(topology: Topology) -> int:
    """Index of the driven joint among the tree joints, of a model whose drive was checked by `require_driven`."""
    if topology.driven is None:
        raise ValueError("The model has no driven joint; call `require_driven` before.")
    return topology.driven
