"""What is asked of a run.

catalogue        all metrics by name: unit, meaning, equation
design_metrics   masses, stresses, bearing lives and the like, which register themselves
path_metrics     of the paths of points, likewise
shaking_metrics  of the force on the base, likewise
coupling_metrics loads of meshes, likewise
subjects         what a metric can be of: joints, links
reference        the metrics as a text
"""
