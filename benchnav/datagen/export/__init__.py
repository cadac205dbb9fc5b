"""Datasets in forms that are read without this package: Parquet with Croissant
metadata.
"""
