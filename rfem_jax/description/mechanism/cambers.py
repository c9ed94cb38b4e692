"""The measured shape of a link that should be straight: its offsets at stations.

Place in the pipeline: curves -> **cambers** -> links.

Source: theory (1.33).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError
from rfem_jax.description.basics.numbers import (
    ANY,
    POSITIVE,
    Fields,
    Number,
    NumberTree,
    array_of,
    is_known,
    read_number,
)
from rfem_jax.description.mechanism.curves import Camber, camber_through


@dataclass(frozen=True)
class CamberPoint(NumberTree, ChecksItself):
    """Where the axis of a link was found that should be straight, from the line between its ends.

    Args:
        x: place along the link [m], > 0 and before its end.
        y, z: offsets [m] along y and z of the link's frame.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    x: float
    y: float = 0.0
    z: float = 0.0

    numbers: ClassVar[Fields] = {"x": ("length", POSITIVE), "y": ("length", ANY), "z": ("length", ANY)}

    def _check_fields(self, checks: Checks) -> None:
        for name, field in self.numbers.items():
            checks.convert(name, read_number, field, f"`{name}` of a point of a camber")


def camber_of(points: Sequence[CamberPoint], length: Number) -> Camber:
    """The offsets of a link of a length [m], whose numbers may be traced; zero at its ends."""
    ends = [np.zeros(2)]
    offsets = [*ends, *(array_of([point.y, point.z]) for point in points), *ends]
    return camber_through([0.0, *(point.x for point in points), length], offsets)


def require_between_ends(camber: Sequence[CamberPoint], length: Number, of: str) -> None:
    """Raise InputError for points that do not follow each other between the ends of a link of a length [m]."""
    places = [0.0, *(point.x for point in camber), length]
    if is_known(places) and any(b <= a for a, b in itertools.pairwise(places)):
        raise InputError(
            f"Argument `camber` {of} must have points that follow each other between 0 and {length} m, but their "
            f"places are {', '.join(f'{x:g} m' for x in places[1:-1])}; put them in order, and leave out the ends, "
            "from whose line offsets are measured."
        )
