"""A model in a few lines: what `print(model)` shows.

Place in the pipeline: used by `model`, whose numbers it reads; it must work for whatever stands in a model's places,
such as tracers, batches, shapes and masks, and then leaves the numbers out.
"""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from rfem_jax.text_layout import align_columns

MOST_ROWS = 20  # of links and of joints


def model_text(model: Any) -> str:
    """Links with their lengths, masses and rfes, joints with what they join, loops, mobility, and the whole mass."""
    topology = model.topology
    lengths, masses = _numbers(model.length), _masses(model)
    loops = topology.n_cuts
    head = (
        f"Model of {_count(topology.n_links, 'link')} and {_count(len(topology.joints), 'joint')}, "
        f"{_count(loops, 'loop')}"
    )
    if masses is not None:
        head += f", mass {np.sum(masses):.4g} kg"
    return "\n".join([head, *_mobility(model), *_links(topology, lengths, masses), *_joints(topology)])


def _count(number: int, word: str) -> str:
    return f"{number or 'no'} {word}{'' if number == 1 else 's'}"


def _mobility(model: Any) -> list[str]:
    found = getattr(getattr(model.source, "blueprint", None), "mobility", None)
    if found is None:
        return []
    rigid, flexible = found
    return [f"degrees of freedom: {rigid} with rigid links, {flexible} as discretised"]


def _links(topology: Any, lengths: np.ndarray | None, masses: np.ndarray | None) -> list[str]:
    rows = []
    for l, (name, n) in enumerate(zip(topology.links, topology.elements, strict=True)):
        numbers = ["-" if of is None else f"{of[l]:.4g}" for of in (lengths, masses)]
        rows.append([name, *numbers, "rigid" if n == 1 else str(n)])
    return ["", align_columns(["link", "length, m", "mass, kg", "rfes"], rows[:MOST_ROWS]), *_rest(rows)]


def _joints(topology: Any) -> list[str]:
    driven = {topology.link_of_freedom[k] for k in topology.drives}
    rows = []
    for j, (name, kind) in enumerate(zip(topology.joints, topology.kinds, strict=True)):
        sides = [
            "base" if node < 0 else topology.links[topology.link_of(node)]
            for node in (topology.parents[j], topology.children[j])
        ]
        words = ["cut"] * (j >= topology.n_links) + ["driven"] * (j in driven)
        words += ["compliant"] * bool(topology.sprung and topology.sprung[j] and j not in topology.clearances)
        words += ["with clearance"] * (j in topology.clearances)
        rows.append([name, kind, *sides, ", ".join(words)])
    return ["", align_columns(["joint", "kind", "parent", "child", ""], rows[:MOST_ROWS], range(5)), *_rest(rows)]


def _rest(rows: list[list[str]]) -> list[str]:
    left = len(rows) - MOST_ROWS
    return [f"... and {left} more"] if left > 0 else []


def _masses(model: Any) -> np.ndarray | None:
    """Masses of the links with their point masses and bodies [kg]."""
    density, length, points = (_numbers(of) for of in (model.section.line_density, model.length, model.point_mass))
    if density is None or length is None or points is None:
        return None
    found = density * length
    np.add.at(found, [model.topology.link_of(node) for node in model.topology.masses], points)
    return found


def _numbers(values: Any) -> np.ndarray | None:
    """Values of one model; None for a batch of models, and for a part without values."""
    known = isinstance(values, (np.ndarray, jax.Array)) and not isinstance(values, Tracer)
    return np.array(values, dtype=float) if known and np.ndim(values) == 1 else None
