"""All benchmarks by name.

Place in the pipeline: what `rfem-jax validate` runs, one after the other.
"""

from collections.abc import Callable, Iterator, Sequence

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.validation import (
    acting_forces,
    andrews_squeezer,
    beam_tables,
    bennett_loop,
    cantilevers,
    clearances,
    curved_beams,
    flexible_slider_crank,
    force_tables,
    four_bar_study,
    geared_mechanisms,
    joint_tables,
    large_deflections,
    nonideal_joints,
    published_linkages,
    rotating_beams,
    slider_cranks,
    spatial_linkages,
    spinning_bodies,
    straight_lines,
    tilted_hinge,
)
from rfem_jax.validation.lines import Benchmark, Outcome, Progress

BENCHMARKS = (
    Benchmark("cantilever", "cantilever, statics and frequencies", cantilevers.validate),
    Benchmark("beam_tables", "beams of a handbook's table", beam_tables.validate),
    Benchmark("curved_beams", "quarter ring, statics; ring, frequencies", curved_beams.validate),
    Benchmark("elastica", "elastica", large_deflections.elastica),
    Benchmark("princeton_beam", "Princeton beam", large_deflections.princeton_beam),
    Benchmark("thick_cantilever", "thick cantilever", large_deflections.thick_cantilever),
    Benchmark("rotating_beams", "spin-up and slewing beam", rotating_beams.validate),
    Benchmark("main_study", "main study, two forms of elements", four_bar_study.validate),
    Benchmark("tilted_hinge", "four-bar with a tilted hinge", tilted_hinge.validate),
    Benchmark("spinning_bodies", "tumbling body and tops", spinning_bodies.validate),
    Benchmark("slider_cranks", "slider-cranks, rigid and flexible", slider_cranks.validate),
    Benchmark("elastic_rod", "slider-crank with an elastic rod", flexible_slider_crank.validate),
    Benchmark("spatial_linkages", "spatial linkages with joints of many kinds", spatial_linkages.validate),
    Benchmark("acting_forces", "gas force, spring and forces at points", acting_forces.validate),
    Benchmark("geared_mechanisms", "geared five-bar", geared_mechanisms.validate),
    Benchmark("bushings", "four-bar on bushings", nonideal_joints.bushed),
    Benchmark("friction", "friction in hinges", nonideal_joints.friction),
    Benchmark("clearances", "joints with clearance at rest, first impacts", clearances.validate),
    Benchmark("bennett_loop", "Bennett's overconstrained linkage", bennett_loop.validate),
    Benchmark("andrews_squeezer", "Andrews' squeezing mechanism", andrews_squeezer.validate),
    Benchmark("published_linkages", "linkages of two libraries", published_linkages.validate),
    Benchmark("straight_lines", "straight-line linkages of a textbook", straight_lines.validate),
    Benchmark("joint_tables", "one body on a joint of each kind", joint_tables.validate),
    Benchmark("force_tables", "a body on a spring, a body moved by an actuator", force_tables.validate),
)


def chosen(names: Sequence[str] | None) -> tuple[Benchmark, ...]:
    """The benchmarks of these names in the order of the catalogue (None: all).

    **Raises:** `InputError` for a name that is not in the catalogue.
    """
    known = [one.name for one in BENCHMARKS]
    for name in names or ():
        if name not in known:
            raise InputError(
                f"Argument `--only` must name benchmarks ({', '.join(known)}), but "
                f"`{name}` is not one; {suggestion(name, known)}"
            )
    return tuple(one for one in BENCHMARKS if not names or one.name in names)


def compute(
    benchmarks: Sequence[Benchmark], full: bool, watch: Callable[[Benchmark], Progress]
) -> Iterator[tuple[Benchmark, Outcome]]:
    """Compute benchmarks one after the other; `watch(benchmark)` returns the function that is called with the
    fraction done."""
    for benchmark in benchmarks:
        yield benchmark, benchmark.run(full, watch(benchmark))
