"""Published benchmarks of the field, and how near the program comes to them.

Place in the pipeline: simulation, mechanics, description -> **validation** -> report (the command
`rfem-jax validate`).

    lines                 one checked value: ours, the reference, what is allowed, its source
    four_bar_study        the main study, linear and geometrically exact
    cantilevers           statics and frequencies, elastica, Princeton beam, thick cantilever
    beam_tables           beams under loads along them, of a handbook's table
    rotating_beams        spin-up and slewing beam; rotating_beam_theory, an independent value
    tilted_hinge          the flexible four-bar with a crooked pin
    spinning_bodies       tumbling body, heavy tops; rigid_body_theory, independent values
    slider_cranks         on a guide, rigid, and flexible with errors
    flexible_slider_crank with an elastic rod, of the test set for initial value problems; flexible_rod_theory, an
                          independent value
    spatial_linkages      spherical, universal, prismatic, cylindrical, fixed joints
    geared_mechanisms     a geared five-bar
    nonideal_joints       bushings, and friction by constants and by loads
    clearances            pins pressed into bushes, a misaligned four-bar with play, first impacts
    bennett_loop          an overconstrained linkage
    andrews_squeezer      seven bodies, three planar loops
    published_linkages    IFToMM spatial slider-crank; Fourbar1, Fourbar2, Engine1a and EngineV6 of Modelica
    straight_lines        Hoecken's linkages of a textbook's table
    joint_tables          one body on a joint of each kind
    force_tables          a free body on a spring between two points, a body moved along a guide
    joint_cases, rigid_links serve the benchmarks of joints of other kinds than revolute
    catalogue             all of them by name
    reference_values      reads the reference values in `references`, each with its unit and source

No program updates the reference values.
"""
