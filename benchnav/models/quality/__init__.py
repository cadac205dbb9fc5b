"""Measures, tables and figures of the quality of models."""
