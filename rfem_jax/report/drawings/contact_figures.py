"""Pictures of joints with clearance: where the pin moves in its bush.

Place in the pipeline: called by `figures`; `run.contacts` has the contacts at the saved times.
"""

from collections.abc import Mapping

import numpy as np

from rfem_jax.description.mechanism.clearance import Clearance
from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.annotations import Figure, Run
from rfem_jax.report.contents.summary import in_legend, status_of
from rfem_jax.report.drawings.style import add_legend, add_titles, line_style, new_figure

MILLI = 1e3
POINTS_OF_A_CIRCLE = 181


def orbit_figures(study: Study, runs: Mapping[str, Run]) -> dict[str, Figure]:
    """A picture for every joint with clearance, {file name without ending: figure}."""
    joints = [joint for joint in study.mechanism.joints if joint.clearance is not None]
    return {f"orbit_{joint.name}": _orbit_figure(study, runs, joint.name, joint.clearance) for joint in joints}


def _orbit_figure(study: Study, runs: Mapping[str, Run], joint: str, clearance: Clearance | None) -> Figure:
    """Both ends of a pin across the axis of its bush, and the circle in which they move freely."""
    assert clearance is not None
    figure = new_figure(7.2, 4.2)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    angles = np.linspace(0.0, 2.0 * np.pi, POINTS_OF_A_CIRCLE)
    radius = MILLI * float(np.asarray(clearance.radial))
    for end, (axes, letter) in enumerate(zip(panels, "ab", strict=True)):
        axes.plot(radius * np.cos(angles), radius * np.sin(angles), color="0.4", linewidth=0.8, label="clearance")
        for index, case in enumerate(study.cases):
            places = MILLI * np.asarray(runs[case.name].contacts[joint].eccentricity)[:, end]
            label = in_legend(case.name, status_of(runs[case.name]))
            axes.plot(*places.T, label=label, **{**line_style(index, len(places)), "linewidth": 0.9})
        axes.set_aspect("equal")
        axes.set_title(f"({letter}) {'start' if end == 0 else 'end'} of the pin", loc="left")
        axes.set_xlabel("x of the bush, mm")
    panels[0].set_ylabel("z of the bush, mm")
    add_legend(panels[0])
    add_titles(figure, f"Orbit of the pin in its bush, joint {joint}", study)
    return figure
