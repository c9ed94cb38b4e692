"""Reduced bodies of links: made from the matrices of a finite element model, written, and read from files.

reduction      Craig-Bampton reduction of full sparse matrices to interfaces and modes
body_files     files of NumPy and of Matrix Market; any file of a body
bulk_data      reduced matrices as Nastran and OptiStruct write them (DMIG)
nastran_output reduced matrices in binary files of Nastran (.op2, .op4)
file_units     units of these files
"""
