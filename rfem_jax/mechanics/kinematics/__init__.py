"""Positions and velocities of everything, and the loops.

motion        State -> frames and velocities of links, rfes and joints
cut_joints    constraints of the cut joints
branches      on which side each loop closes
self_stress   what the constraints leave open, the least reactions
"""
