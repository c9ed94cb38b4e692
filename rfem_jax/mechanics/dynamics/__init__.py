"""Accelerations and loads.

dynamics        accelerations by the articulated-body algorithm
loads           joint loads, energies, balance of momentum
section_loads   internal forces and moments along links, stresses
centre_lines    where the links are in space
"""
