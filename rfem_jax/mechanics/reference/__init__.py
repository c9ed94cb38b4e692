"""The same equations in a dense form that uses nothing of the recursion, to test against.

node_transforms     transforms of all nodes, closure equations
face_deflections    of geometrically exact elements
work_of_joints      generalised forces of drives, springs and laws of joints
work_of_elements    those of force elements and loads along links
formulation         accelerations and multipliers
loads               joint loads
friction            with friction in the joints
"""
