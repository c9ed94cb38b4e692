"""Pictures of worst cases and allocations.

Place in the pipeline: called by `task_figures` with {metric: WorstCase} or an `AllocationStudy`.
Tolerances in deg and mm, metrics in their own units.
"""

import numpy as np
from matplotlib.figure import Figure

from rfem_jax.report.quantities import as_specified
from rfem_jax.report.style import CASE_COLOURS, MARKERS, add_titles
from rfem_jax.tolerancing.layout import show_number

MOST_PANELS = 8


def worst_case_figure(study, results) -> Figure:
    """Values at all corners (sorted) and at the ends of all searches, against the worst found."""
    shown = list(results.values())[:MOST_PANELS]
    figure = Figure(figsize=(7.2, 2.5 * len(shown) + 1.5), layout="constrained")
    panels = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axes, one in zip(panels, shown, strict=True):
        total = 1
        if one.corners is not None:
            corners = np.sort(one.corners.values)
            total = len(corners)
            axes.plot(
                np.arange(1, total + 1), corners, MARKERS[1], color=CASE_COLOURS[2],
                label="corners of the box",
            )  # fmt: skip
        ends = np.sort(one.end_values)
        axes.plot(
            np.linspace(1, max(total, 2), len(ends)), ends, MARKERS[0], color=CASE_COLOURS[1],
            markerfacecolor="none", label="ends of searches",
        )  # fmt: skip
        lines = (
            ("worst found", one.value, "-", CASE_COLOURS[1]),
            ("quadratic model", one.quadratic_value, "--", CASE_COLOURS[0]),
            ("nominal", one.nominal, ":", CASE_COLOURS[0]),
        )
        for word, height, style, colour in lines:
            if np.isfinite(height):
                axes.axhline(
                    height, color=colour, linestyle=style, linewidth=1.2,
                    label=f"{word}: {show_number(height, scale=one.scale)}",
                )  # fmt: skip
        axes.set_title(f"{one.metric} over the {one.region}: {one.status}", loc="left")
        axes.set_ylabel(one.unit or "1")
        axes.set_xticks([])
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    panels[-1].set_xlabel("corners and searches, each sorted by value")
    left_out = len(results) - len(shown)
    heading = "Worst case found against every corner of the tolerance box"
    heading += f" ({left_out} more metrics are in the tables)" if left_out else ""
    add_titles(figure, heading, study)
    return figure


def tolerances_figure(study, found) -> Figure:
    """Tolerances before and after within their bounds, each on a scale of its own."""
    answer, bounds = found.answer, study.tasks.allocation.bounds
    names = list(answer.tolerances)
    height = 0.55 * len(names) + 2.0
    figure = Figure(figsize=(7.2, height), layout="constrained")
    axes = figure.subplots()
    for place, name in enumerate(reversed(names)):
        specified, factor = as_specified(answer.units[name])
        low, high = bounds[name]
        after, before = answer.tolerances[name], found.before.get(name)
        axes.plot([low / high, 1.0], [place, place], "|-", color="#A0A0A0", linewidth=1.0)
        if before is not None:
            _mark(axes, before / high, place, False, f"{factor * before:.3g} {specified}")
        _mark(axes, after / high, place, True, f"{factor * after:.3g} {specified}")
    axes.plot([], [], MARKERS[0], color=CASE_COLOURS[0], mfc="white", label="before")
    axes.plot([], [], MARKERS[1], color=CASE_COLOURS[1], label="after")
    axes.plot([], [], "|-", color="#A0A0A0", label="bounds")
    axes.set_xscale("log")
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_yticks(range(len(names)), list(reversed(names)))
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("tolerance / its largest bound")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False)
    heading = f"Tolerances before and after: cost {answer.cost:.4g}"
    if np.isfinite(found.cost_before):
        heading += f", before {found.cost_before:.4g}"
    add_titles(figure, f"{heading} ({answer.criterion.replace('_', ' ')}, {answer.status})", study)
    return figure


def _mark(axes, x, place, after, text):
    colour, marker = (CASE_COLOURS[1], MARKERS[1]) if after else (CASE_COLOURS[0], MARKERS[0])
    fill = colour if after else "white"
    axes.plot([x], [place], marker, color=colour, markerfacecolor=fill, zorder=3)
    where = (0, 7) if after else (0, -13)
    axes.annotate(
        text, (x, place), xytext=where, textcoords="offset points", ha="center", fontsize=8,
        color=colour,
    )  # fmt: skip


def front_figure(study, found) -> Figure:
    """Cost against the limits (all distances from the nominal values scaled together), and the
    tolerances that belong to each."""
    scales = np.array(list(found.front))
    answers = list(found.front.values())
    good = np.array([one.status == "ok" for one in answers])
    costs = np.array([one.cost for one in answers])
    single = len(found.answer.limits) == 1
    check = found.answer.limits[0]
    x = np.array([one.limits[0].limit for one in answers]) if single else scales
    label = f"limit on {check.metric}, {check.unit or '1'}" if single else "scale of all limits"
    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(x, np.where(good, costs, np.nan), "-", color=CASE_COLOURS[0], linewidth=1.2)
    above.plot(x[good], costs[good], MARKERS[0], color=CASE_COLOURS[0], label="limits verified")
    if not good.all():
        above.plot(x[~good], costs[~good], "x", color=CASE_COLOURS[1], label="limits not met")
    here = list(found.front).index(1.0)
    above.plot(
        x[here], costs[here], MARKERS[0], ms=12, mfc="none", color=CASE_COLOURS[1],
        label="asked for",
    )  # fmt: skip
    if np.isfinite(found.cost_before):
        above.axhline(
            found.cost_before, color="#808080", linestyle="--", linewidth=1.0,
            label="cost of the tolerances before",
        )  # fmt: skip
    above.set_ylabel("cost")
    above.legend(frameon=False)
    for i, name in enumerate(found.answer.tolerances):
        specified, factor = as_specified(found.answer.units[name])
        widths = [factor * one.tolerances[name] for one in answers]
        below.plot(
            x, widths, marker=MARKERS[i % len(MARKERS)], label=f"{name}, {specified}",
            color=CASE_COLOURS[i % len(CASE_COLOURS)], linewidth=1.2,
        )  # fmt: skip
    below.set_yscale("log")
    scaled = [below.yaxis]
    if x.min() > 0.0:
        below.set_xscale("log")
        scaled.append(below.xaxis)
    for axis in scaled:
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
        axis.set_tick_params(which="both", labelsize=8)
    below.set_ylabel("tolerance (half-width)")
    below.set_xlabel(label)
    below.legend(frameon=False)
    add_titles(figure, "Cheapest tolerances against the limit that they keep", study)
    return figure
