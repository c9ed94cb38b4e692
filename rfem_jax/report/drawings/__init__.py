"""What a person sees: pictures of mechanisms and of curves, by matplotlib.

style             colours, sizes, titles and legends
pictures          how they are drawn and written, by another process beside other work
figures           curves of the runs
contact_figures   curves of contacts
shapes            mechanisms, at rest and bent
joint_symbols     symbols of the kinds of joints
force_shapes      springs, forces and loads on them
"""
