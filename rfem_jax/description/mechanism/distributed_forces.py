"""Forces that are distributed along links: wind, pressure, hydrostatic load, what lies on a beam.

Place in the pipeline: point_forces -> **distributed_forces** -> mechanism; the mechanics sums them up over each rfe.

The force per length is constant, or linear from the begin of the load to its end. Source: theory (3.24) to (3.26).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from rfem_jax.description.basics.errors import Checks, InputError
from rfem_jax.description.basics.numbers import NOT_NEGATIVE, POSITIVE, Fields, Number, is_known, read_number
from rfem_jax.description.basics.units import Quantities, Quantity
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.point_forces import LoadOnLink

if TYPE_CHECKING:
    Vectors = Any
else:
    Vectors = Any  # what is none is refused in a sentence

_ROUNDING = 1e-12  # an end of a load may exceed the link's length by rounding


@dataclass(frozen=True)
class DistributedForce(LoadOnLink):
    """A force along the axis of a link, given per length, constant or over time; its reaction acts on the base.

    Args:
        name: a word.
        link: the link.
        load: (x, y, z) [N/m]; with `times` one such row for each, linear in between and zero after the last time; in
            Python also a function (t [s], phase) -> (3,) array, smooth within a phase.
        end_load: at `end`, in the same form, where `load` is at `begin` and the load is linear in between; None: `load`
            all along.
        begin: where the load begins [m], along the link from its start; None: at the start.
        end: where it ends [m]; None: at the link's end.
        times: [s] of tables, from 0, not decreasing; a time given twice is a jump.
        breakpoints: times [s] > 0 at which a function jumps, increasing; phase is the number of those passed.
        axes: "global", or "link": the load turns with the link (a flexible one: with each rfe).
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    link: str
    load: Vectors
    end_load: Vectors = None
    begin: Quantity | None = None
    end: Quantity | None = None
    times: Quantities | None = None
    breakpoints: Quantities = ()
    axes: str = "global"

    numbers: ClassVar[Fields] = {"begin": ("length", NOT_NEGATIVE), "end": ("length", POSITIVE)}
    vectors: ClassVar[Mapping[str, str]] = {"load": "line_load", "end_load": "line_load"}

    def ends(self) -> tuple[tuple[str, tuple[float, float, float]], ...]:
        """None: it acts on all rfes along it."""
        return ()

    def along(self, link: Link) -> tuple[Number, Number]:
        """Where it begins and ends on its link [m]."""
        begin, end = self.begin, self.end
        return 0.0 if begin is None else begin, link.length if end is None else end  # pyright: ignore[reportReturnType]  # converted

    def require_points(self, links: Mapping[str, Link]) -> None:
        self.require_link(self.link, links)
        link = links[self.link]
        if link.reduced:
            raise InputError(
                f"Argument `link` of force `{self.name}` must be a beam or a rigid body, but `{link.name}` has a "
                "reduced body, on whose interfaces alone forces act; give forces at these."
            )
        begin, end = self.along(link)
        if not is_known(begin, end, link.length) or 0.0 <= begin < end <= link.length * (1.0 + _ROUNDING):
            return
        given = "end" if self.begin is None else "begin"
        raise InputError(
            f"Argument `{given}` of force `{self.name}` must leave it a length on its link `{self.link}` (from 0 to "
            f"{link.length:g} m), but it goes from {begin:g} m to {end:g} m; give `begin` and `end` on the link, the "
            "smaller one first."
        )

    def _check_place(self, checks: Checks, of: str) -> None:
        for name, field in self.numbers.items():
            if getattr(self, name) is not None:
                checks.convert(name, read_number, field, f"`{name}` {of}")

    def _check_times(self, value: str, of: str) -> None:
        if self.end_load is not None and callable(self.load) != callable(self.end_load):
            raise InputError(
                f"Argument `end_load` {of} must be of the kind of `load`, but one of the two is a function; make both "
                "functions, or neither."
            )
        super()._check_times(value, of)
