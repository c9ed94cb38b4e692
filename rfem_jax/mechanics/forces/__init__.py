"""What acts at one instant: along joints, between points, in contacts, by friction.

joint_forces      forces along the joint coordinates
element_loads     what wrenches between frames exert on the nodes
bush_contacts     contacts of joints with clearance
friction          friction in joints, and the losses
nonsmooth_forces  of the last two, and of play in couplings: what a method of integration heeds
"""
