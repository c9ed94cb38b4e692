"""Accelerations and loads.

dynamics        accelerations by the articulated-body algorithm
loads           joint loads, by both ways to them
energy_and_momentum
                energies, momenta, what is left of the balance of these
section_loads   internal forces and moments along links, stresses
centre_lines    where the links are in space
"""
