"""The equations as a residual, and Newton increments of it by recursion over the links.

residual            of the equations, for given accelerations and multipliers
condensation        flexible links condensed to their frames and interfaces
newton              the increments, from the joints and interfaces to the rfes
"""
