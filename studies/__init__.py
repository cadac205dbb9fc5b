"""The studies of the documentation: a folder each, with its suites, hypotheses, scripts
and rows.

`python -m studies NAME` repeats one. `NAME/study.yaml` says what it consists of;
`study.py` describes that file.
"""
