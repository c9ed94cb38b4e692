"""What springs, contacts, friction and forces are, as arrays and functions of their own motion: no mechanism yet.

joint_laws, joint_springs     springs, dampers, tables and functions along joint coordinates; compliance
friction_laws                 friction in joints
contact_law, clearances       contact of a pin and its bush; joints with clearance
couplings                     meshes between two joint coordinates
frame_forces, point_laws      wrenches between two frames; springs and forces at points
line_loads                    forces per length along links
bearings                      capacities
"""
