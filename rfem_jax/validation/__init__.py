"""Published benchmarks of the field, and how near the program comes to them.

Place in the pipeline: simulation, mechanics, description -> **validation** -> report (the command
`rfem-jax validate`).

    lines                 one checked value: ours, the reference, what is allowed, its source
    four_bar_study        the main study, linear and geometrically exact
    cantilevers           statics and frequencies, elastica, Princeton beam, thick cantilever
    rotating_beams        spin-up and slewing beam; rotating_beam_theory, an independent value
    tilted_hinge          the flexible four-bar with a crooked pin
    catalogue             all of them by name
    reference_values      reads the reference values in `references`, each with its unit and source

No program updates the reference values.
"""
