"""What is reported of drives: one on a rotation as "the driven joint", others by the names of their joints.

Place in the pipeline: read by `summary`, `tables`, `files`, `figures` and `overview`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.annotations import Run
from rfem_jax.simulation.outcome.quantities import Quantity

ROTATION = (
    Quantity("angle", "rad", "angle", "the driven joint's own coordinate"),
    Quantity("rate", "rad/s", "rate", "rate of this coordinate"),
    Quantity("moment", "N m", "drive moment", "given, or what enforces the motion"),
)
TRANSLATION = (
    Quantity("displacement", "m", "displacement", "the driven joint's own coordinate"),
    Quantity("speed", "m/s", "speed", "rate of this coordinate"),
    Quantity("force", "N", "drive force", "given, or what enforces the motion"),
)
_PARTS = ("position", "rate", "force")  # of `rfem_jax.simulation.outcome.run.DriveHistory`


@dataclass(frozen=True)
class DriveQuantity:
    """Position, rate or force of a drive: its label "A" or "C.T_y", and quantity."""

    label: str
    part: str
    quantity: Quantity

    @property
    def name(self) -> str:
        """As part of a column's or a file's name."""
        return f"{self.label.replace('.', '_')}_drive_{self.quantity.name}"

    @property
    def end(self) -> Quantity:
        """The value at the end of the run."""
        quantity = self.quantity
        return Quantity(f"{quantity.name}_end", quantity.unit, f"{self.label}: {quantity.label} at end", "")

    @property
    def values(self) -> Callable[[Run], Any]:
        """Reads the history of a run."""
        return lambda run: np.asarray(getattr(run.motion.drives[self.label], self.part))


def has_driven_joint(study: Study) -> bool:
    """Whether the study has one drive, and that on a rotation."""
    return len(study.drives) == 1 and not drive_quantities(study)


def drive_quantities(study: Study) -> list[DriveQuantity]:
    """Position, rate and force of all drives; none if one rotation is all that is driven."""
    found = []
    for label, motion in zip(study.drive_labels, study.drive_motions, strict=True):
        kinds = ROTATION if motion.startswith("R") else TRANSLATION
        found += [DriveQuantity(label, part, kind) for part, kind in zip(_PARTS, kinds, strict=True)]
    return [] if len(study.drives) == 1 and found[0].quantity.unit == "rad" else found
