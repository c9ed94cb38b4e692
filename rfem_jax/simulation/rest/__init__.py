"""The mechanism held still at given positions.

poses              where it is held: closed poses of the perfect mechanism
seen_at_rest       the equilibrium there, or the given motion, and what is to be seen of it
statics            loads at rest, and of rigid links in given motion
labelled_statics   these as tables and Datasets
turn               loads at positions of a drive, one after another
labelled_turn      these as tables and Datasets
"""
