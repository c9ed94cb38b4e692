"""What moves a mechanism: moments, forces and prescribed motions, as functions of time or tables.

rotations, translations    the classes of drives about and along axes; arguments, laws: what they share
driven_motions             which motion of a joint a drive acts on
numbers_by_name            their numbers as parameters
"""
