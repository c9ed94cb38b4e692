"""From and to other programs: files of theirs as studies, and studies as files of theirs.

rigid_frames      rotations and frames in NumPy
layout            a mechanism of rigid bodies as other programs know it: where everything is, and what joins it
laying            link frames, joint frames and a tree where a file has none of ours
files             a file of another program as a layout, whatever its format; what all readers share
frame_table, fcstd, urdf, sdf, mjcf_reader  readers
study_writer      a layout as a commented study file
study_layout      a study, with the errors of one of its cases, as a layout
frame_table, urdf_writer, mjcf_writer  writers
exudyn_mechanism  a model as plain numbers for Exudyn
exudyn_writer     a study as a script of these numbers and of exudyn_system, exudyn_loads and exudyn_program

Place in the pipeline: beside `report`, whose commands call it; it reads all packages above, and shows nothing itself.
"""
