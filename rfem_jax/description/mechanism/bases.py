"""The base of a mechanism as a body that grows with its temperature.

Place in the pipeline: numbers -> **bases** -> mechanism.

The base does not move, and its shape matters nowhere but in the distances of what it carries. Source: theory (2.21).
"""

from dataclasses import dataclass
from typing import ClassVar

from rfem_jax.description.basics.errors import Checks, ChecksItself
from rfem_jax.description.basics.numbers import ANY, Fields, NumberTree, read_number
from rfem_jax.description.basics.units import Quantity


@dataclass(frozen=True)
class Base(NumberTree, ChecksItself):
    """What the mechanism stands on: by its temperature the places on it move apart, seen from the global origin.

    Args:
        thermal_expansion: alpha [1/K].
        temperature: its difference to the temperature of assembly [K].
    Raises:
        InputError: a value is of the wrong kind.
    """

    thermal_expansion: Quantity
    temperature: Quantity = 0.0

    numbers: ClassVar[Fields] = {
        "thermal_expansion": ("thermal_expansion", ANY),
        "temperature": ("temperature", ANY),
    }

    def _check_fields(self, checks: Checks) -> None:
        for name, field in self.numbers.items():
            checks.convert(name, read_number, field, f"`{name}` of the base")
