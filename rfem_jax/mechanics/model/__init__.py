"""A mechanism as arrays: from what is specified to the constants of the equations of motion.

topology            Topology: what does not change with the numbers
model               Model, State, Coordinates; summary: a model in words
building            description -> Model; places: what is on which rfe, and where; acting_laws: the forces
discretisation      its loops closed at the start, rank and mobility
nominal_geometry    the perfect mechanism in NumPy: does it close, rank, mobility; with nominal_path, start_freedoms,
                    normal_loads
errors              assembly errors by their names -> AssemblyErrors
with_errors         + AssemblyErrors -> constants of the equations of motion, with what stands on links with errors:
                    frames_with_errors: joints; masses_with_errors; elements_with_errors: springs and dampers;
                    carried_frames: forces, points
inputs              the drive at one instant
orientations        coordinates that are quaternions
sources             the numbers that a model was made of
status              what can happen to an assembly or a run
"""
