"""A folder of results with known numbers, for tests of the page: nothing is simulated."""

import json

import numpy as np

from rfem_jax import discretise
from rfem_jax.mechanics.model.nominal_geometry import geometry_of
from rfem_jax.mechanics.model.nominal_path import nearest_closed, nominal_shapes
from rfem_jax.report.contents.files import write_files
from rfem_jax.report.contents.summary import summarise
from rfem_jax.report.page.acting import ACTING
from rfem_jax.report.page.animation import PARTS, write_arrays

BEND = 1e-3  # m, the largest deviation of the case with the largest errors


def write_results(folder, study, runs):
    """results.json, CSV files and animation.npz of synthetic runs, whose mechanism goes once round."""
    folder.mkdir(parents=True, exist_ok=True)
    statuses = dict.fromkeys(runs, ("ok", "The run is complete."))
    write_files(folder, study, runs, summarise(study, runs, statuses))
    description, cases = animation(study, runs)
    write_arrays(folder, description, cases)
    return folder


def animation(study, runs):
    """Description and arrays of synthetic runs: links bent out of plane by `BEND` times the size of the case."""
    model = discretise(study.mechanism)
    topology = model.topology
    counts = [2 if n == 1 else n + 1 for n in topology.elements]
    description = {
        "cases": list(runs),
        "links": [{"name": name, "points": n} for name, n in zip(topology.links, counts, strict=True)],
        "joints": [
            {"name": one.name, "kind": one.kind, "parent": one.parent, "child": one.child, "cut": one.cut}
            for one in (study.mechanism.joint(name) for name in topology.joints)
        ],
        "paths": [{"name": "P", "link": "coupler"}],
        "forces": [
            {"name": "strut", "kind": "spring", "links": ["base", "coupler"]},
            {"name": "push", "kind": "force", "links": ["rocker"]},
        ],
        "laws": [{"name": "return", "spring": True, "joint": "A", "motion": "R_y"}],
    }  # fmt: skip
    cases = [_arrays(model, np.asarray(run.times), 0.5 * number * BEND) for number, run in enumerate(runs.values())]
    return description, cases


def _arrays(model, times, bend):
    geometry, path = geometry_of(model), [np.asarray(model.start_joints)]
    for _ in times[1:]:
        path.append(nearest_closed(geometry, path[-1][None] + np.array([2.0 * np.pi / len(times), 0.0, 0.0]))[0])
    path = np.array(path)
    nominal = nominal_shapes(model, path)
    arrays = {"times": times}
    arrays |= {f"nominal_{part}": getattr(nominal, part) for part in PARTS}
    arrays |= {part: np.array(getattr(nominal, part)) for part in PARTS}
    arrays["points"][..., 1] += bend * np.sin(np.linspace(0.0, np.pi, arrays["points"].shape[1]))
    arrays["centre"][..., 1] += bend
    # A spring from above the base to the end of the second link, and a force that grows at the end of the third.
    ends = np.cumsum([2 if n == 1 else n + 1 for n in model.topology.elements]) - 1
    top, pulled, pushed = np.array([0.1, 0.0, 0.4]), *(arrays["points"][:, ends[i]] for i in (1, 2))
    force = 100.0 * times[:, None] * np.array([0.0, 0.0, -1.0])
    parts = (top + 0.0 * pulled, 0.0 * pulled), (pulled, pushed), (force, force)
    arrays |= {name: np.stack(part, axis=1) for name, part in zip(ACTING, parts, strict=True)}
    # The point in the middle of the coupler.
    middle = slice(ends[1] - 1, ends[1])
    arrays |= {"path_place": arrays["points"][:, middle], "nominal_path_place": arrays["nominal_points"][:, middle]}
    names = ("seat_rotation", "seat_centre", "bore_rotation")
    return arrays | {part: getattr(nominal, part) for part in names}


def content_of(path):
    """The content of a page as its script reads it."""
    text = path.read_text(encoding="utf-8")
    start = text.index('id="content">') + len('id="content">')
    return json.loads(text[start : text.index("</script>", start)])
