"""Reference values of the benchmarks, each with its unit and source, from the files in `references`.

Place in the pipeline: **reference_values** -> the benchmarks of `catalogue`; tests and the programs in `benchmarks/`
read the same files.

    {"title": ..., "label": ..., "source": ...,
     "quantities": {name: {"unit": ..., "description": ..., "values": ...}}}

`label` is the source in a few words, for tables; a quantity may have a label and a source of its own, and an
`accuracy` where this is less than the digits of the values.  No program writes these files.
"""

import functools
import json
from dataclasses import dataclass
from importlib import resources
from typing import Any


@dataclass(frozen=True)
class Quantity:
    """Values of one quantity: numbers, or lists and tables (by case, joint, ...) of them, as `description` says."""

    values: Any
    unit: str
    description: str
    label: str
    source: str
    accuracy: str = ""


@dataclass(frozen=True)
class Reference:
    """All quantities of one benchmark by name."""

    title: str
    label: str
    source: str
    quantities: dict[str, Quantity]

    def __getitem__(self, name: str) -> Any:
        """Values of a quantity."""
        return self.quantities[name].values


@functools.cache
def read_reference(name: str) -> Reference:
    """The reference values of one benchmark.

    **Arguments:** `name`: of a file in `references`, without its ending, such as "four_bar_study".

    **Raises:** OSError if there is no such file.
    """
    file = resources.files("rfem_jax.validation").joinpath("references", f"{name}.json")
    content = json.loads(file.read_text(encoding="utf-8"))
    quantities = content.pop("quantities")
    of_file = {"label": content["label"], "source": content["source"]}
    return Reference(**content, quantities={key: Quantity(**{**of_file, **entry}) for key, entry in quantities.items()})
