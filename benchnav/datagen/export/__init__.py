"""Export of datasets to Parquet with Croissant metadata, for other software."""
