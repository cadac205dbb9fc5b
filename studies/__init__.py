"""Studies of the documentation; each has a folder of suites, hypotheses, scripts, rows.

`python -m studies NAME` repeats one. `NAME/study.yaml` lists its parts; `study.py`
describes the format of that file.
"""
