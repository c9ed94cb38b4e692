"""What moves a mechanism: moments, forces and prescribed motions, as functions of time or tables.

family                     every law of a drive once, whatever its motion; arguments, laws: what it is made of
rotations, translations    the drives about and along axes
driven_motions             which motion of a joint a drive acts on
numbers_by_name            their numbers as parameters
"""
