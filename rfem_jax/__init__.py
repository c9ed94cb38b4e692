"""Differentiable simulation of flexible mechanisms with assembly errors.

    load_study / Mechanism(...)          description   what the user specifies
        |
    discretise -> Model                  mechanics     rigid finite elements, closed start
        |  assembly_errors({...})                      how it is wrong
    assemble -> state, preload
        |
    simulate(drive, method) -> Run       simulation    motion, loads in all joints, balances
        |
    Problem: errors -> metrics, status   tolerancing   sensitivity, monte_carlo, worst_case, allocate
        |
    tables, pictures, files              report        the command `rfem-jax`

Everything computes in float64: call `jax.config.update("jax_enable_x64", True)` first.  Names are
loaded when they are first used, so importing the package is instant.
"""

from rfem_jax.lazy_names import lazy_names as _lazy_names

_names = {
    "description": (
        "Automatic AxisPoint Base Bearing CamberPoint Case Circle Clearance Compliance Coupling DistributedForce "
        "Explicit ForceFunction ForceRamp "
        "ForceTable GeneralisedAlpha GivenSection InputError Joint JointForceFunction JointForceTable JointFriction "
        "JointSpring Leapfrog Link Material Mechanism Method MomentFunction "
        "MomentRamp MomentTable Point PointForce PointMass PointMoment PointSpring PointSpringFunction "
        "PointSpringTable "
        "PrescribedDisplacements PrescribedFunction PrescribedRate PrescribedRunUp PrescribedSpeed "
        "PrescribedSpinUp PrescribedTable Rectangle RigidBody RungeKutta4 Sensor Station Study Tube load_study "
        "AngleSection ChannelSection CompositeSection HollowRectangle ISection PolygonSection TeeSection "
        "Interface ReducedBody craig_bampton load_body save_body"
    ),
    "mechanics": (
        "AssemblyErrors Coordinates Design Deviations Model State STATUS assemble assembly_errors describe design "
        "designed deviations discretise parameters"
    ),
    "tolerancing": (
        "CorrelatedNormal Exponential FunctionProblem Metric Normal Problem ProcessNormal Reciprocal "
        "ReciprocalSquared StaticProblem Tolerances Triangular TruncatedNormal Uniform Zone allocate correct "
        "estimate_production expand "
        "first_samples fit_response_surface identifiability identify mesh_convergence metric monte_carlo optimise "
        "pareto_front path_bands process_capability "
        "register_metric reliability sensitivity sweep worst_case"
    ),
    "compilation.keeping": "keep_programs",
    "task_kinds": "TaskKind register_task",
    "report.page.run_page": "report_run",
    "simulation": (
        "EquationsOfMotion Run Simulation StaticLoads check_step choose_method cycle_run derivative_residual "
        "equations_of_motion inverse_dynamics kinetostatic_turn largest_stable_step natural_frequencies "
        "register_method run_cases simulate static_loads steady_cycle"
    ),
}

__getattr__, __dir__, __all__ = _lazy_names(__name__, _names)
