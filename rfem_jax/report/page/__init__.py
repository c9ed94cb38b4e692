"""The page `report.html`: one file, which any browser opens without a network.

Place in the pipeline: after the files of a study have been written; it is made of these alone.

    animation    runs -> animation.npz: where the mechanism is, and where the perfect one would be
    histories    CSV files -> curves with names and units
    task_results JSON and CSV of the tasks
    folder       results.json and the above -> content, a dict without NaN
    run_page     one run -> content
    document     content, script and style -> report.html

`assets` has the page's own script and style, and uPlot, which draws the curves. What comes from files is untrusted: it
is put into the page as data, which the script shows as text only (`document` says how).
"""
