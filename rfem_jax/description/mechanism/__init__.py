"""What a mechanism is made of.

materials, sections, rigid_bodies, links
bases                      what the mechanism stands on, if it grows with its temperature
joints                     with their bearings, compliance and clearance
forces, point_forces       springs, dampers, friction and forces in joints, and at points
distributed_forces         forces along links
mechanism                  all of these together
"""
