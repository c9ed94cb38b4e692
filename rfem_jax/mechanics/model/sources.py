"""The numbers that the arrays of a model were made of, by which a design makes them anew.

Place in the pipeline: parts, parameters -> **sources** -> model, designs.

All numbers that are parameters are one array, which programs take as an input. The rest of the description is static,
with nothing in the places of these numbers: models of other numbers are the same programs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.compilation import keys
from rfem_jax.compilation.naming import Names
from rfem_jax.description.basics.numbers import Number, array_of
from rfem_jax.description.mechanism.forces import Force
from rfem_jax.description.mechanism.sections import Section, Tube
from rfem_jax.description.parameters.parameters import ParameterNames, named_parameters
from rfem_jax.description.parameters.parts import (
    Parts,
    Path,
    measured,
    number_at,
    renamed_parts,
    scaled,
    with_numbers,
)

ForceNodes = tuple[tuple[str, tuple[int, ...]], ...]
# Of the longest link.  Overconstrained loops close only as well as their numbers were typed: with angles of six
# decimals a Bennett linkage stays open by 2e-7.  flexible links close the remaining gap in the static start.
CLOSING_TOLERANCE = 1e-6
RIGID_CLOSING_TOLERANCE = 1e-9  # where reactions are redundant, nothing gives way
NOTHING = float("nan")


@dataclass(frozen=True, eq=False)
class Blueprint:
    """A description without its numbers that may change; equal to others of equal content.

    parts: with nothing in the places of the parameters; names: of all parameters, in the order of the numbers; points:
    nodes of the ends of the forces at points, and of the points whose paths are followed, by their names; products:
    whether point masses have products of inertia; closing_tolerance: what the loops may stay open by at the start, over
    the longest link; described: the numbers of one description of this content, with which all formulas can be
    evaluated (a tube has a hole, say); mobility: degrees of freedom at the start, of rigid links and of these. The last
    two are no part of the content.
    """

    parts: Parts
    names: ParameterNames
    points: ForceNodes
    products: bool
    closing_tolerance: float
    described: tuple[float, ...] = field(compare=False)
    mobility: tuple[int, int] | None = None

    @cached_property
    def key(self) -> str:
        """Key of equal content; the blueprint itself if it holds a function of the user, whose content is unknown."""
        content = self.parts, self.names.all, self.points, self.products, self.closing_tolerance
        try:
            return keys.digest_value(content)
        except keys.NotDigestible:
            return str(id(self))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Blueprint) and self.key == other.key)

    def __hash__(self) -> int:
        return hash(self.key)

    @cached_property
    def own_names(self) -> tuple[str, ...]:
        """Names of the things that have parameters."""
        full = (one.full.split(".")[:2] for one in self.names.all)
        things = (name for kind, name in full if kind != "mechanism")
        return tuple(dict.fromkeys((*(force.name for force in self.parts.forces), *things)))

    @cached_property
    def _renamed(self) -> "dict[tuple, Blueprint]":
        return {}

    def renamed(self, names: Names) -> "Blueprint":
        """With other names; the same object each time, since one with a function of the user equals no other."""
        if names.key not in self._renamed:
            points = tuple((names.of(name), nodes) for name, nodes in self.points)
            parts, known = renamed_parts(self.parts, names), self.names.renamed(names)
            self._renamed[names.key] = replace(self, parts=parts, names=known, points=points)
        return self._renamed[names.key]

    def filled(self, numbers: Sequence[Number]) -> Parts:
        """The parts with numbers, one for each parameter, in their places."""
        values: dict[Path, Any] = {}
        for parameter, number in zip(self.names.all, numbers, strict=True):
            for path in parameter.paths:
                values[path] = scaled(number_at(self.parts, path), number) if parameter.factor else number
        return measured(with_numbers(self.parts, values))


class Source(eqx.Module):
    """The numbers of a description [SI units], one for each parameter of its blueprint."""

    numbers: Float[Array, " parameters"]
    blueprint: Blueprint = eqx.field(static=True)

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of the things that have parameters."""
        return self.blueprint.own_names


def source_of(parts: Parts, held: Sequence[tuple[str, str]], points: ForceNodes, products: bool) -> Source:
    """The numbers of parts, and what is left of these without them."""
    names = named_parameters(parts, held)
    numbers = [parameter.value_in(parts) for parameter in names.all]
    paths = [path for parameter in names.all if not parameter.factor for path in parameter.paths]
    blank = with_numbers(_drop_derived_numbers(parts), dict.fromkeys(paths, NOTHING))
    blueprint = Blueprint(blank, names, points, products, CLOSING_TOLERANCE, tuple(numbers))
    return Source(jnp.asarray(array_of(numbers), jnp.float64), blueprint)


def _drop_derived_numbers(parts: Parts) -> Parts:
    """Without numbers that follow from others: derived shear factors, and start values, which loops or drives set."""
    links, joints = [], []
    for link in parts.links:
        stations = tuple(
            station.with_fields(section=_without_derived(station.section), after=_without_derived(station.after))
            for station in link.stations
        )
        changed = {"length": 0.0} if link.course else {}
        links.append(link.with_fields(section=_without_derived(link.section), stations=stations, **changed))
    for joint in parts.joints:
        zeros = {"angle": 0.0, "displacement": 0.0, "start": scaled(joint.start, 0.0)}
        given = {name: zero for name, zero in zeros.items() if getattr(joint, name) is not None}
        # Its springs are parts of their own.
        joints.append(joint.with_fields(**given, compliance=None))
    return replace(parts, links=tuple(links), joints=tuple(joints), forces=tuple(map(_zero_arrays, parts.forces)))


def _without_derived(section: Section | None) -> Section | None:
    """A section without a shear factor that follows from its diameters."""
    if isinstance(section, Tube) and section.shear_factor == section.derived_factor:
        return section.with_fields(shear_factor=None)
    return section


def _zero_arrays(force: Force) -> Force:
    """A force with zeros for the arrays that a function of the user holds, which may be traced and are the model's."""
    functions = {name: value for name, value in vars(force).items() if callable(value)}
    blank = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), functions)
    return force.with_fields(**blank)
