"""Mechanisms and studies as HTML for notebooks.

Place in the pipeline: `Mechanism._repr_html_` and `Study._repr_html_` call these. SI units in every heading.
"""

from typing import Any

from rfem_jax import rich_text

Mechanism = Any  # the classes of `mechanism` and `study`, which import this module
Study = Any


def mechanism_tables(mechanism: Mechanism) -> str:
    """Tables of the links and of the joints."""
    links = [
        [one.name, one.length, one.mass, "rigid" if one.elements == 1 else one.elements] for one in mechanism.links
    ]
    joints = [
        [
            one.name,
            one.kind,
            one.parent,
            one.child,
            "cut" if one.cut else "",
            ", ".join(f"{x:.6g}" for x in _start(one)),
        ]
        for one in mechanism.joints
    ]
    header = ["joint", "kind", "parent", "child", "", "start, rad or m"]
    return rich_text.table(["link", "length, m", "mass, kg", "rfes"], links) + rich_text.table(header, joints, range(6))


def _start(joint: Any) -> tuple[float, ...]:
    return () if joint.cut else joint.start_values


def mechanism_html(mechanism: Mechanism) -> str:
    """The mechanism with its tables."""
    title = f"Mechanism of {len(mechanism.links)} links and {len(mechanism.joints)} joints"
    return rich_text.document(title, mechanism_tables(mechanism))


def study_html(study: Study) -> str:
    """Title, note, method, cases with their errors, tasks, and the mechanism."""
    method = (
        study.method.name if study.method.step is None else f"{study.method.name} with steps of {study.method.step:g} s"
    )
    drives = ", ".join(type(one).__name__ for one in study.drives) or "no drive"
    cases = [[case.name, ", ".join(f"{name} = {x:.6g}" for name, x in case.errors.items())] for case in study.cases]
    parts = [rich_text.paragraph(study.note)] if study.note else []
    time = "At rest" if study.duration is None else f"{study.duration:g} s by {method}"
    parts.append(rich_text.paragraph(f"{time}; {drives}."))
    parts.append(rich_text.table(["case", "errors, rad or m"], cases, (0, 1)))
    if study.tasks.declared:
        parts.append(rich_text.paragraph(f"Tasks: {', '.join(study.tasks.declared)}."))
    return rich_text.document(study.title, *parts, mechanism_tables(study.mechanism))
