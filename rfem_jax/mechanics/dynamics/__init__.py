"""Accelerations and loads.

reduced_tree    the bodies that hinges join, with what acts on them; slender_chains: those of slender links
tree_recursion  the articulated-body algorithm on these
closing_multipliers
                multipliers of the cut joints
dynamics        accelerations, from all of these
loads           joint loads, by both ways to them
energy_and_momentum
                energies, momenta, what is left of the balance of these
section_loads   internal forces and moments along links, stresses, by the equilibrium of parts of links:
                link_bodies, link_pieces, link_attachments
centre_lines    where the links are in space
"""
